"""Ropes behave as closed forms say: catenary, elastica, twist, friction."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.benchmarks.physics import clamped_scene
from doojax.geometry.curves import catenary, clamped_elastica
from doojax.simulation.build import build_model, with_parameters
from doojax.simulation.engines.mujoco import MujocoSimulator
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Scene, SolverSettings
from doojax.tasks.dual_gripper import default_scene
from tests.simulation.scenes import no_start, planar_scene, straight_states


def hang(scene: Scene, periods: int):
    """Bring the ends of a straight rope to 0.5 m from each other and let it settle."""
    simulator = MujocoSimulator(scene, start=no_start)
    states = straight_states(scene, 1, height=1.5)
    gap = float(states.qpos[0, -3] - states.qpos[0, -6])
    step = np.array([[(gap - 0.5) / 2, 0, 0], [-(gap - 0.5) / 2, 0, 0]]) / 2
    actions = np.concatenate([np.tile(step, (1, 2, 1, 1)), np.zeros((1, periods, 2, 3))], axis=1)
    last, seen = simulator.rollout(states, jnp.asarray(actions, dtype=jnp.float32))
    return simulator.observations(last), seen


def test_a_hanging_chain_is_a_catenary():
    scene = default_scene()
    observed, seen = hang(scene, periods=10)
    points, ends = np.asarray(observed.state.points[0]), np.asarray(observed.state.grippers[0])
    curve = np.asarray(catenary(jnp.asarray(ends[0]), jnp.asarray(ends[1]), jnp.array(0.8), 51))[1::2]
    rms = np.sqrt(((points - curve) ** 2).sum(-1).mean())
    assert rms < 0.005 * 0.8
    assert float(seen.stretch[0, -1]) < 0.005


def test_hanging_point_masses_are_a_catenary():
    scene = replace(
        default_scene(),
        rope_model=RopeModel("point_masses", 25),
        rope=RopeParameters(0.8, 0.01, 0.2, 0.0),
        solver=SolverSettings(contact_time=0.008),
        timestep=0.004,
        grippers=tuple(replace(gripper, end=0) for gripper in default_scene().grippers),
    )
    # straight_qpos describes chains: point masses keep their reference pose and hang from two fixed hands
    model = build_model(scene)
    data = mujoco.MjData(model)
    half = (0.8 - 0.032) / 2
    data.qpos[2:75:3] = 1.5
    data.qpos[75:] = [-half, 0, 1.5, half, 0, 1.5]
    for step in range(4000):
        inward = min(step * 0.004 * 0.15, half - 0.25)
        data.ctrl[:] = [-half + inward, 0, 1.5, half - inward, 0, 1.5]
        mujoco.mj_step(model, data)
    points = np.array([data.body(f"rope{i}").xpos for i in range(25)])
    curve = np.asarray(catenary(jnp.asarray(points[0]), jnp.asarray(points[-1]), jnp.array(0.768), 25))
    assert np.sqrt(((points - curve) ** 2).sum(-1).mean()) < 0.005 * 0.8
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / 0.768 - 1 < 0.006


@pytest.mark.parametrize("links", [10, 25, pytest.param(50, marks=pytest.mark.slow)])
def test_a_clamped_rope_sags_as_the_elastica(links):
    stiffnesses = (1e-3, 1e-2, 1e-1)
    scenes = [clamped_scene(links, stiffness) for stiffness in stiffnesses]
    fields = with_parameters(scenes[0], [scene.rope for scene in scenes])
    simulator = MujocoSimulator(scenes[0], start=no_start)
    states = replace(straight_states(scenes[0], 3), model_fields=fields)
    last, _ = simulator.rollout(states, jnp.zeros((3, 20, 1, 3)))
    points = np.asarray(simulator.observations(last).state.points)
    pitch = 0.5 / links
    for own, stiffness in zip(points, stiffnesses, strict=True):
        free = 0.5 - pitch / 2  # the clamp holds the middle of link 0
        curve = clamped_elastica(free, stiffness, 0.05 * 9.81 / 0.5, 2001)
        sag = np.interp((links - 1) * pitch, np.linspace(0, free, 2001), curve[:, 2])
        assert own[-1, 2] - own[0, 2] == pytest.approx(sag, rel=0.03)


def test_an_end_torque_twists_by_torque_times_length_over_gj():
    scene = replace(clamped_scene(10, 1e-2), gravity=0.0)
    model = build_model(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(straight_states(scene, 1).qpos[0])
    data.ctrl[:] = data.qpos[-3:]
    tip = model.body("rope9").id
    data.xfrc_applied[tip, 3] = 5e-3
    for _ in range(2500):
        mujoco.mj_step(model, data)
    twist = np.arctan2(data.xmat[tip].reshape(3, 3)[2, 1], data.xmat[tip].reshape(3, 3)[1, 1])
    assert twist == pytest.approx(5e-3 * 0.45 / 1e-2, rel=0.03)  # 9 joints, 0.05 m each


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_sliding_rope_stops_as_coulomb_says(friction):
    scene = planar_scene()
    scene = replace(scene, rope=replace(scene.rope, friction=friction))
    simulator = MujocoSimulator(scene, start=no_start)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    states = straight_states(scene, len(angle))
    push = 0.8 * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    states = eqx.tree_at(
        lambda s: (s.qvel, s.holding),
        states,
        (states.qvel.at[:, :2].set(push), jnp.zeros_like(states.holding)),
    )
    _, seen = simulator.rollout(states, jnp.zeros((len(angle), 2, 1, 3)))
    slid = np.linalg.norm(seen.states.points[:, -1, 0] - seen.states.points[:, 0, 0], axis=-1)
    by_coulomb = 0.8**2 / (2 * friction * 9.81)
    assert slid.mean() == pytest.approx(by_coulomb, rel=0.03)
    assert np.abs(slid / by_coulomb - 1).max() < 0.1  # the friction is an octagon, not a circle


@pytest.mark.parametrize("self_contact", [True, False])
def test_a_rope_passes_through_itself_only_without_self_contact(self_contact):
    scene = clamped_scene(12, 1e-4)
    scene = replace(scene, rope_model=replace(scene.rope_model, self_contact=self_contact), gravity=0.0)
    model = build_model(scene)
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(straight_states(scene, 1).qpos[0])
    for link in (name for name in range(12) if name != 6):  # an octagon, its last links over its first ones
        data.joint(f"rope{link}_bend_z").qpos[:] = np.pi / 4 * (1 if link > 6 else -1)
        data.joint(f"rope{link}_bend_y").qpos[:] = 0.02 * (1 if link > 6 else -1)
    mujoco.mj_forward(model, data)
    across = [(i, j) for i in range(12) for j in range(i + 3, 12)]
    touching = {tuple(sorted(model.geom_bodyid[pair])) for pair in data.contact.geom}
    named = {tuple(sorted((model.body(f"rope{i}").id, model.body(f"rope{j}").id))) for i, j in across}
    assert bool(touching & named) == self_contact
    assert touching <= named


def test_parameters_reach_every_model_of_a_batch_and_only_values_differ():
    scene = planar_scene(grippers=(Gripper(3, 1, 0.02, 10.0, 0.18),))
    longer = replace(scene.rope, length=0.4, mass=0.4)
    fields = with_parameters(scene, [scene.rope, longer])
    alone = build_model(scene, longer)
    for name, values in fields.items():
        assert np.array_equal(values[1], getattr(alone, name)), name
    assert fields["body_mass"][1].sum() - fields["body_mass"][0].sum() == pytest.approx(0.2)
