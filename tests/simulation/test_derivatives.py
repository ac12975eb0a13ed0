"""Derivatives through 20 steps of MJX, free and in steady contact, against finite differences.

Forward mode works at any number of iterations; reverse mode cannot cross the solver's loop and needs one.
Both need friction pyramids: MJX's elliptic cones have no derivative where nothing slides.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.simulation.engines import make_simulator
from doojax.simulation.scenes import SolverSettings
from tests.simulation.scenes import no_start, planar_scene, straight_states

STEP = 1e-6
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # to compile
PRESS = np.array([[0.03, 0.0, 0.0]])
DIRECTIONS = np.array([[[0.0, 1.0, 0.0]], [[0.6, 0.8, 0.0]], [[1.0, 0.0, 0.0]]])
WEIGHTS = np.array([1.0, 2.0, -3.0, 0.5])  # of the gripper's and the tail's coordinates


@pytest.fixture(scope="module")
def x64():
    with jax.enable_x64(True):
        yield


def compiled(iterations):
    """Step, where gripper and tail are after it, and the derivatives of that by the action."""
    scene = replace(
        planar_scene(substeps=20),
        solver=SolverSettings(iterations=iterations, line_search_iterations=6, cone="pyramidal"),
    )
    simulator = make_simulator(scene, start=no_start, engine="mjx")

    def reached(state, action):
        after = simulator.step(state, action)
        seen = simulator.observe(after)
        return jnp.concatenate([seen.grippers[0, :2], seen.points[0, :2]]), after

    def along(state, action, direction):
        return jax.jvp(lambda a: reached(state, a)[0], (action,), (direction,))[1]

    gradient = jax.grad(lambda a, state: WEIGHTS @ reached(state, a)[0])
    return scene, *(jax.jit(f, compiler_options=QUICKLY) for f in (reached, along, gradient))


def free_and_pressed(scene, reached):
    """A rope that lies straight, and one whose gripper has been pressed on a cube for 3 s."""
    state = jax.tree.map(lambda leaf: leaf[0], straight_states(scene, 1))
    state = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, state)
    pressed = replace(
        state,
        obstacle_position=jnp.array([[0.17, 0.01, 0.05]]),
        obstacle_quaternion=jnp.array([[1.0, 0.0, 0.0, 0.0]]),
    )
    for _ in range(30):
        pressed = reached(pressed, PRESS)[1]
    seen = reached(pressed, PRESS)[0]
    assert abs(seen[0] - 0.1) < 1e-3  # the cube's face is at 0.12 m, the gripper's radius 0.02 m
    return {"free": state, "pressed": pressed}


def slope(reached, state, direction):
    ahead, behind = (reached(state, PRESS + sign * STEP * direction)[0] for sign in (1, -1))
    return (ahead - behind) / (2 * STEP)


def test_forward_and_reverse_mode_agree_with_finite_differences(x64):
    scene, reached, along, gradient = compiled(iterations=1)
    for state in free_and_pressed(scene, reached).values():
        reverse = gradient(PRESS, state)
        for direction in DIRECTIONS:
            numeric = slope(reached, state, direction)
            forward = along(state, PRESS, direction)
            assert jnp.abs(forward - numeric).max() < 1e-5
            assert abs((reverse * direction).sum() - WEIGHTS @ forward) < 1e-9


def test_forward_mode_agrees_with_finite_differences_where_the_solver_iterates(x64):
    scene, reached, along, _ = compiled(iterations=SolverSettings().iterations)
    states = free_and_pressed(scene, reached)
    for state in states.values():
        for direction in DIRECTIONS:
            assert jnp.abs(along(state, PRESS, direction) - slope(reached, state, direction)).max() < 1e-5
    into, beside = (along(states["pressed"], PRESS, d)[:2] for d in (DIRECTIONS[2], DIRECTIONS[0]))
    assert jnp.abs(into).max() < 1e-6  # the cube does not give way
    assert beside[1] > 0.1  # but the gripper slides along it
