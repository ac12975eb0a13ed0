"""MJX keeps every contact that matters, or says so, beside MuJoCo C, which keeps all."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from doojax.simulation.build import build_model
from doojax.simulation.engines import make_simulator
from doojax.simulation.engines.mjx import MjxSimulator
from doojax.simulation.engines.mujoco import write_state
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, Shape, SolverSettings
from doojax.simulation.state import Fault
from doojax.types import ShapeKind
from tests.simulation.scenes import no_start, planar_scene, straight_states

TOP = 0.1  # m, of the table; the box on it is 0.1 m high


def cluttered_scene() -> Scene:
    """A rope over a table whose bounding sphere holds everything, with eight boxes on it."""
    table = Obstacle("table", (Shape(ShapeKind.BOX, (0.8, 0.8, 0.05)),))
    boxes = [Obstacle(f"box{i}", (Shape(ShapeKind.BOX, (0.03, 0.1, 0.05)),)) for i in range(8)]
    hand = Gripper(link=0, end=-1, radius=0.01, max_force=5.0, max_speed=0.15)
    return Scene(
        "cluttered",
        RopeModel("capsule_chain", 3),
        RopeParameters(0.2, 0.01, 0.04, 5e-5, 5e-5, bending_damping=2e-4, friction=0.5),
        (hand, replace(hand, link=2, end=1)),
        (table, *boxes),
        floor=False,
        timestep=0.006,
        substeps=100,
        viscosity=0.15,
        solver=SolverSettings(contact_time=0.012),
    )


def lowered(scene: Scene, engine: str):
    """The rope, brought down beyond the top of a box under its middle: the last states, and what was seen."""
    states = straight_states(scene, 1, height=TOP + 0.16)
    far = [(0.5 + 0.1 * i, 0.5, TOP + 0.05) for i in range(7)]
    places = jnp.array([[(0.0, 0.0, TOP - 0.05), *far, (0.0, 0.0, TOP + 0.05)]])
    upright = jnp.tile(jnp.array([1.0, 0, 0, 0]), (1, 9, 1))
    states = replace(states, obstacle_position=places, obstacle_quaternion=upright)
    down = jnp.array([[[0.0, 0, -0.055], [0.0, 0, -0.055]]])
    actions = jnp.stack([down, 0 * down], axis=1)
    return make_simulator(scene, no_start, engine).rollout(states, actions)


@pytest.fixture(scope="module")
def on_c():
    return lowered(cluttered_scene(), "mujoco")[1]


def touching(model: mujoco.MjModel, geoms, depths) -> dict[tuple[str, ...], list[float]]:
    """Of each pair of geoms that touch, by name: how deep each contact is (m), the deepest first."""
    found = {}
    for pair, depth in zip(np.asarray(geoms), np.asarray(depths), strict=True):
        if depth < 0:
            found.setdefault(tuple(sorted(model.geom(int(geom)).name for geom in pair)), []).append(depth)
    return {pair: sorted(values) for pair, values in found.items()}


@pytest.mark.slow  # in test_engines MJX finds one cube that C finds
def test_where_a_rope_rests_on_a_box_on_a_table_mjx_finds_what_c_finds():
    """The 24 pairs (of 33) whose bounding spheres overlap most leave out some that touch."""
    scene = cluttered_scene()
    state = jax.tree.map(lambda leaf: leaf[0], lowered(scene, "mujoco")[0])
    model, simulator = build_model(scene), MjxSimulator(scene, no_start)
    write_state(model, simulator.layout, jax.tree.map(np.asarray, state))
    data = mujoco.MjData(model)
    data.qpos[:] = state.qpos
    mujoco.mj_fwdPosition(model, data)

    @jax.jit
    def contacts(state):
        model, data = simulator._load(state)
        found = mjx.collision(model, mjx.kinematics(model, data))._impl.contact
        return found.geom, found.dist

    by_c, by_mjx = touching(model, data.contact.geom, data.contact.dist), touching(model, *contacts(state))
    assert len(by_c) >= 1 and all("box7" in " ".join(pair) for pair in by_c)
    assert by_mjx.keys() == by_c.keys()
    for pair, depths in by_c.items():
        assert by_mjx[pair][0] == pytest.approx(depths[0], abs=1e-5), pair


@pytest.mark.slow
def test_a_rope_rests_on_a_box_on_a_table_as_on_c(on_c):
    on_mjx = lowered(cluttered_scene(), "mjx")[1]
    np.testing.assert_allclose(on_mjx.states.points, on_c.states.points, atol=1e-3)
    assert float(on_mjx.states.points[0, -1, 1, 2]) == pytest.approx(TOP + 0.1 + 0.01, abs=2e-3)
    assert not on_mjx.faults.any()
    np.testing.assert_allclose(on_mjx.clearance, on_c.clearance, atol=1e-3)


@pytest.mark.slow
def test_contacts_for_which_there_is_no_room_are_a_fault():
    scene = planar_scene(
        substeps=50,
        rope_model=RopeModel("planar_chain", 3),
        grippers=(Gripper(link=2, end=1, radius=0.02, max_force=10.0, max_speed=0.18),),
        solver=SolverSettings(max_contact_points=1, cone="pyramidal"),
    )
    states = replace(
        straight_states(scene, 1),
        obstacle_position=jnp.array([[[0.0, 0.068, 0.05]]]),  # 2 mm into all of the rope
        obstacle_quaternion=jnp.array([[[1.0, 0.0, 0.0, 0.0]]]),
    )
    _, seen = make_simulator(scene, no_start, "mjx").rollout(states, jnp.zeros((1, 1, 1, 3)))
    assert int(seen.faults[0, 0]) & int(Fault.CONTACTS_DROPPED)
