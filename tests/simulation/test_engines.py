"""MJX and MuJoCo C run the same scenes to the same states."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.build import with_parameters
from doojax.simulation.engines import make_simulator
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, SolverSettings
from doojax.simulation.state import Fault, SimState
from doojax.tasks.dual_gripper import DualGripper
from tests.simulation.scenes import no_start, planar_scene, straight_states

BATCH = 5


def small(substeps: int):
    """As few links as a rope can have: MJX compiles each."""
    hand = Gripper(link=2, end=1, radius=0.02, max_force=10.0, max_speed=0.18)
    return planar_scene(substeps, rope_model=RopeModel("planar_chain", 3), grippers=(hand,))


@pytest.fixture(scope="session")
def scene():
    return small(substeps=100)


@pytest.fixture(scope="session")
def on_mujoco(scene):
    return make_simulator(scene, start=no_start, engine="mujoco")


@pytest.fixture(scope="session")
def on_mjx(scene):
    return make_simulator(scene, start=no_start, engine="mjx")


@pytest.fixture(scope="session")
def compiled(on_mjx):
    """The rollout on MJX, compiled once for all tests, and a list with an entry for each time it was."""
    traces = []

    @jax.jit
    def run(states, actions):
        traces.append(1)
        return on_mjx.rollout(states, actions)

    return run, traces


def with_ropes(scene, states, last):
    """States that carry their ropes: the scene's own, but for the last."""
    ropes = [scene.rope] * (BATCH - 1) + [last]
    fields = {name: jnp.asarray(value) for name, value in with_parameters(scene, ropes).items()}
    return replace(states, model_fields=fields)


@pytest.fixture(scope="session")
def actions():
    angle = np.linspace(0, 2 * np.pi, BATCH, endpoint=False)
    move = 0.06 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    return jnp.asarray(np.tile(move[:, None, None], (1, 2, 1, 1)), dtype=jnp.float32)


def with_cube(states, x, y):
    return eqx.tree_at(
        lambda s: (s.obstacle_position, s.obstacle_quaternion),
        states,
        (
            jnp.tile(jnp.array([[[x, y, 0.05]]]), (BATCH, 1, 1)),
            jnp.tile(jnp.array([[[1.0, 0.0, 0.0, 0.0]]]), (BATCH, 1, 1)),
        ),
    )


@pytest.mark.slow
def test_free_motion_agrees_within_a_millimetre_after_a_second(scene, on_mujoco, compiled, actions):
    states = with_ropes(scene, straight_states(scene, BATCH), scene.rope)
    _, by_c = on_mujoco.rollout(states, actions)
    _, by_mjx = compiled[0](states, actions)
    gap = jnp.linalg.norm(by_c.states.points - by_mjx.states.points, axis=-1)
    assert gap.max() < 1e-3
    moved = jnp.linalg.norm(by_c.states.grippers[:, -1] - by_c.states.grippers[:, 0], axis=-1)
    np.testing.assert_allclose(moved, 0.12, atol=0.002)


@pytest.mark.slow
def test_a_batch_in_parts_is_the_batch(scene, on_mjx, actions, monkeypatch):
    states = straight_states(scene, BATCH)
    whole = on_mjx.rollout(states, actions)
    monkeypatch.setattr("doojax.simulation.engines.mjx.PART", 3)
    parts = on_mjx.rollout(states, actions)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, atol=1e-4)  # rounded differently


@pytest.mark.slow
def test_a_cube_stops_the_gripper_on_both_engines(scene, on_mujoco, compiled, actions):
    states = with_cube(straight_states(scene, BATCH), x=0.2, y=0.0)  # its face is 3 cm ahead of the gripper
    states = with_ropes(scene, states, scene.rope)
    straight = jnp.tile(actions[:1], (BATCH, 1, 1, 1))
    for rollout in (on_mujoco.rollout, compiled[0]):
        _, seen = rollout(states, straight)
        assert abs(float(seen.states.grippers[0, -1, 0, 0]) - 0.13) < 0.002  # 0.15 less the gripper's radius
        assert float(seen.clearance.min()) > -0.002
        assert float(seen.stretch.max()) < 0.03


def test_two_periods_equal_two_calls_with_one_bit_for_bit(scene, on_mujoco, actions):
    states = with_cube(straight_states(scene, BATCH), x=0.2, y=0.02)
    last, at_once = on_mujoco.rollout(states, actions)
    middle, _ = on_mujoco.rollout(states, actions[:, :1])
    end, second = on_mujoco.rollout(middle, actions[:, 1:])
    assert np.array_equal(last.qpos, end.qpos)
    assert np.array_equal(at_once.states.points[:, 2], second.states.points[:, 1])


@pytest.mark.slow
def test_new_obstacles_starts_and_ropes_compile_nothing(scene, compiled, actions):
    run, traces = compiled
    other = RopeParameters(0.2, 0.02, 0.4, 1e-3, bending_damping=1e-3, friction=0.3)
    states = with_ropes(scene, straight_states(scene, BATCH), other)
    first = run(states, actions)[1].states.points
    moved = with_cube(states, x=0.25, y=0.1)
    moved = eqx.tree_at(lambda s: s.qpos, moved, moved.qpos.at[:, 0].add(0.01))
    heavier = jax.tree.map(lambda x: x, moved)
    heavier.model_fields["body_mass"] = 1.5 * heavier.model_fields["body_mass"]
    run(moved, actions)
    second = run(heavier, actions)[1].states.points
    assert len(traces) == 1
    assert not np.array_equal(first, second)


def test_an_element_that_blows_up_is_named_and_takes_no_other_along(scene, on_mujoco, actions):
    states = straight_states(scene, BATCH)
    broken = eqx.tree_at(lambda s: s.qvel, states, states.qvel.at[3, 0].set(jnp.nan))
    _, seen = on_mujoco.rollout(broken, actions)
    faulty = np.asarray(seen.faults & int(Fault.NOT_FINITE)).any(axis=1)
    assert faulty.tolist() == [i == 3 for i in range(BATCH)]
    _, healthy = on_mujoco.rollout(states, actions)
    assert np.array_equal(seen.states.points[4:], healthy.states.points[4:])


def test_methods_are_jitted_as_they_are(scene):
    simulator = make_simulator(small(substeps=1), start=no_start, engine="mjx")
    state = jax.tree.map(lambda leaf: leaf[0], straight_states(scene, 1))
    assert jax.jit(simulator.obstacles)(state).centre.shape == (1, 3)
    assert jax.jit(simulator.observe)(state).points.shape == (3, 3)
    assert hash(simulator.step) == hash(simulator.step)
    with pytest.raises(AssertionError, match="make their own starts"):
        jax.jit(simulator.reset)(jax.random.key(0))  # it got as far as the start that these tests forbid


SHARDED = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from doojax.simulation.engines import make_simulator
from tests.simulation.scenes import no_start, planar_scene, straight_states
simulator = make_simulator(planar_scene(substeps=4), no_start, "mjx")
states, actions = straight_states(simulator.scene, 32), jnp.full((32, 1, 1, 3), 0.01)
alone = simulator.rollout(states, actions)[1].states.points
spread = NamedSharding(Mesh(np.array(jax.devices()), ("batch",)), PartitionSpec("batch"))
shared = simulator.rollout(*jax.device_put((states, actions), spread))[1].states.points
assert len(shared.devices()) == 2
np.testing.assert_allclose(np.asarray(shared), np.asarray(alone), atol=1e-5)
"""


@pytest.mark.slow
def test_states_spread_over_devices_are_simulated_there():
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    subprocess.run([sys.executable, "-c", SHARDED], check=True, env={**os.environ, **flags}, timeout=600)


def test_unknown_engines_are_refused_with_the_list(scene):
    with pytest.raises(ValueError, match="unknown engine 'bullet', expected one of auto, mujoco, mjx, warp"):
        make_simulator(scene, start=no_start, engine="bullet")


def test_ropes_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match=r"rope mass is 0\.0, expected > 0"):
        RopeParameters(1.0, 0.01, 0.0, 1e-3)
    with pytest.raises(ValueError, match="rope friction is -1"):
        RopeParameters(1.0, 0.01, 1.0, 1e-3, friction=-1.0)
    with pytest.raises(ValueError, match="at least 3 links, got 2"):
        RopeModel("capsule_chain", 2)
    with pytest.raises(ValueError, match="gripper 0 holds link 9"):
        planar_scene(grippers=(Gripper(9, 1, 0.02, 10.0, 0.2),))
    with pytest.raises(ValueError, match="a rope of point masses is limp"):
        make_simulator(planar_scene(rope_model=RopeModel("point_masses", 4)), start=no_start, engine="mujoco")


def test_a_rope_pulled_taut_over_an_edge_neither_bursts_nor_passes_through_it():
    """With 10 iterations of the solver it did, for the stored actions and two in five of those near them."""
    with np.load(Path(__file__).with_name("taut_over_an_edge.npz"), allow_pickle=False) as stored:
        fields = ("qpos", "qvel", "obstacle_position", "obstacle_quaternion", "holding")
        start = {name: jnp.repeat(stored[name], BATCH, axis=0) for name in fields}
        actions = np.repeat(stored["actions"], BATCH, axis=0)
    actions[1:] += np.random.default_rng(0).normal(0, 5e-4, actions[1:].shape)
    scene = DualGripper().scene
    states = SimState(
        **start,
        commanded=start["qpos"][:, scene.layout.driven],
        faults=jnp.zeros(BATCH, dtype=jnp.int32),
        model_fields={},
    )
    simulator = make_simulator(scene, start=no_start, engine="mujoco")
    _, seen = simulator.rollout(states, jnp.asarray(actions))
    assert not seen.faults.any()
    assert seen.clearance.min() > -2e-3
    assert seen.stretch.max() < 0.01


def test_a_rope_that_can_touch_nothing_is_simulated_with_any_cone():
    """MJX's elliptic cones fail where no contact is possible; without contacts, cones make no difference."""
    for cone in ("elliptic", "pyramidal"):
        scene = planar_scene(
            rope_model=RopeModel("capsule_chain", 3),
            grippers=(Gripper(link=2, end=1, radius=0.02, max_force=10.0, max_speed=0.18),),
            obstacles=(),
            floor=False,
            solver=SolverSettings(cone=cone),
            substeps=1,
        )
        simulator = make_simulator(scene, start=no_start, engine="mjx")
        state = jax.tree.map(lambda leaf: leaf[0], straight_states(scene, 1))
        after = jax.eval_shape(simulator.step, state, jnp.zeros((1, 3)))
        assert after.qpos.shape == state.qpos.shape
