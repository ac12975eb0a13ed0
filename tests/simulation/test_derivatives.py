"""Derivatives through 20 steps of MJX, free, at rest and in steady contact, against finite differences."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from doojax.simulation.build import build_model
from doojax.simulation.engines import make_simulator
from doojax.simulation.engines.implicit import _forces, _residual
from doojax.simulation.scenes import Obstacle, Shape, SolverSettings
from doojax.types import ShapeKind
from tests.simulation.scenes import no_start, planar_scene, straight_states

STEP = 1e-6
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # to compile
PRESS = np.array([[0.03, 0.0]])
WEIGHTS = np.array([1.0, 2.0, -3.0, 0.5])  # of the gripper's and the tail's coordinates


@pytest.fixture(scope="module")
def x64():
    with jax.enable_x64(True):
        yield


def in_double(tree):
    return jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, tree)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((True, "pyramidal"), marks=pytest.mark.slow),  # a wall is a plane
        pytest.param((False, "pyramidal"), marks=pytest.mark.slow),
        pytest.param((False, "elliptic"), marks=pytest.mark.slow),
    ],
    ids=["wall", "cube", "cube-elliptic"],
)
def compiled(request, x64):
    """Where gripper and tail are after a step, the derivatives of that by the action, and the state there."""
    wall, cone = request.param
    cube = Obstacle("cube", (Shape(ShapeKind.BOX, (0.05, 0.05, 0.05), wall=wall),))
    scene = planar_scene(substeps=20, obstacles=(cube,), solver=SolverSettings(cone=cone))
    simulator = make_simulator(scene, start=no_start, engine="mjx")

    def reached(state, action):
        after = simulator.step(state, jnp.append(action, jnp.zeros((1, 1)), axis=1))
        seen = simulator.observe(after)
        return jnp.concatenate([seen.grippers[0, :2], seen.points[0, :2]]), after

    @partial(jax.jit, compiler_options=QUICKLY)
    def forward(state, action):
        def along(direction):
            return jax.jvp(lambda a: reached(state, a), (action,), (direction[None],))

        (at, after), (slope, _) = jax.vmap(along)(jnp.eye(2))
        return at[0], slope.T, jax.tree.map(lambda leaf: leaf[0], after)

    gradient = jax.grad(lambda a, state: WEIGHTS @ reached(state, a)[0])
    return scene, forward, jax.jit(gradient, compiler_options=QUICKLY)


@pytest.fixture(scope="module")
def cases(compiled):
    """Pushed along while free, at rest, and pressed on the cube's face, or the wall's, for 3 s."""
    scene, forward, _ = compiled
    straight = in_double(jax.tree.map(lambda leaf: leaf[0], straight_states(scene, 1)))
    state = replace(
        straight,
        obstacle_position=jnp.array([[0.17, 0.01, 0.05]]),
        obstacle_quaternion=jnp.array([[0.0, 0.0, 0.0, 1.0]]),  # its own +x face looks at the gripper
    )
    for _ in range(30):
        state = forward(state, PRESS)[2]
    # the face is at 0.12 m, the gripper's radius 0.02
    assert abs(forward(state, PRESS)[0][0] - 0.1) < 1e-3
    return {"free": (straight, PRESS), "at rest": (straight, 0.0 * PRESS), "pressed": (state, PRESS)}


def test_forward_mode_agrees_with_finite_differences(compiled, cases):
    _, forward, _ = compiled
    slopes = {name: forward(*case)[1] for name, case in cases.items()}
    for name, (state, action) in cases.items():
        for axis, along in enumerate(STEP * np.eye(2)):
            numeric = (forward(state, action + along)[0] - forward(state, action - along)[0]) / (2 * STEP)
            assert jnp.abs(slopes[name][:, axis] - numeric).max() < 1e-5
    assert jnp.abs(slopes["pressed"][:, 0]).max() < 1e-6  # the face does not give way
    assert slopes["pressed"][1, 1] > 0.05  # but the gripper slides along it


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward_mode(compiled, cases):
    _, forward, gradient = compiled
    for state, action in cases.values():
        np.testing.assert_allclose(gradient(action, state)[0], WEIGHTS @ forward(state, action)[1], atol=1e-9)


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_forces_and_residual_are_those_of_mujoco(cone, x64):
    """Row by row, of a rope at rest and of one that slides on the floor along a cube."""
    scene = replace(planar_scene(substeps=20), solver=SolverSettings(cone=cone, tolerance=1e-12))
    model = build_model(scene)
    at_bounds, touching = [], []
    for speed in (0.0, 0.2):
        data = mujoco.MjData(model)
        start = jax.tree.map(lambda leaf: np.array(leaf[0]), straight_states(scene, 1))
        data.qpos[:], data.ctrl[:] = start.qpos, start.commanded[0]
        data.mocap_pos[0] = [-0.1, 0.0695, 0.05]  # its side is 0.5 mm inside the rope or the gripper
        if not speed:
            data.mocap_pos[0, 1] = 1.0
        data.qvel[-2:] = [speed, -speed]
        mujoco.mj_forward(model, data)
        on_jax, state = mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax")
        rows = state._impl
        force = np.array(_forces(rows.efc_J @ state.qacc - rows.efc_aref, on_jax, state))
        np.testing.assert_allclose(force, rows.efc_force, rtol=1e-6, atol=1e-9)
        largest = np.abs(state.qfrc_constraint).max()
        assert np.abs(_residual(state.qacc, on_jax, state)).max() < 1e-6 * largest + 1e-9
        bounds = np.array(rows.efc_frictionloss)[rows.ne : rows.ne + rows.nf]
        at_bounds.append(np.abs(force[rows.ne : rows.ne + rows.nf]) >= bounds * (1 - 1e-9))
        touching.append(force[rows.ne + rows.nf :] != 0)
    assert at_bounds[1].all() and not at_bounds[0].any()
    assert touching[1].any() and not touching[1].all() and not touching[0].any()
