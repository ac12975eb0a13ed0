"""Moved examples, simulated again: how far from where the augmentation says they end."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.actions import sampled
from doojax.augmentation.examples import Examples, Setting, transformed
from doojax.datasets.collect import random_trajectories
from doojax.geometry.motion import RigidMotion
from doojax.geometry.shapes import FAR
from doojax.keys import numbered
from doojax.simulation.state import SimState, Simulator
from doojax.tasks.base import Task
from doojax.types import PushingState

BEFORE = 5  # control periods before a transition


def drawn_examples(
    task: Task, simulator: Simulator, count: int, start_key: Array, action_key: Array
) -> tuple[SimState, Examples]:
    """Examples of random actions, and the states that they were simulated from.

    Of ropes, transitions in the middle of trajectories, so that they lie against what obstacles there are; of
    pushing, whole trajectories.
    """
    if task.scene.cylinders:
        keys = numbered(start_key, range(count))
        starts, _, trajectory = random_trajectories(task, simulator, keys, task.trajectory_states - 1)
        sound = jnp.asarray((np.asarray(trajectory.faults) == 0).all(1))
        states = jax.tree.map(jnp.asarray, trajectory.states)
        return starts, Examples(states, jnp.asarray(trajectory.actions), None, sound)
    _, starts, _ = random_trajectories(task, simulator, numbered(start_key, range(count)), BEFORE)
    rope, none = simulator.observations(starts).state, jnp.zeros((count, task.grippers, 3))
    actions = _actions(task, numbered(action_key, range(count)), rope, none)
    _, trajectory = simulator.rollout(starts, actions[:, None])
    examples = Examples(
        states=jax.tree.map(jnp.asarray, trajectory.states),
        actions=actions[:, None],
        obstacles=jax.vmap(simulator.obstacles)(starts),
        sound=jnp.asarray((np.asarray(trajectory.faults) == 0).all(1)),
    )
    return starts, examples


@eqx.filter_jit
def _actions(task: Task, keys: Array, ropes: Any, previous: Array) -> Array:
    def one(key, rope, before):
        return sampled(task.actions, key, rope, before)

    return jax.vmap(one)(keys, ropes, previous)


def resimulation_errors(
    task: Task,
    simulator: Simulator,
    setting: Setting,
    starts: SimState,
    examples: Examples,
    parameters: Float[Array, "B 6"],
) -> Float[np.ndarray, "B"]:
    """Distances (m) between where the simulator takes moved examples and their moved outcomes.

    At most `FAR`, and that where the simulation blows up.
    """
    moved, actions, outcomes = _moved(task, setting, starts, examples, parameters)
    _, again = simulator.rollout(moved, actions)
    last = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, -1], again.states)
    errors = np.array(jnp.sqrt(((_places(last) - _places(outcomes)) ** 2).sum(-1).mean(-1)))
    return np.nan_to_num(errors, nan=FAR, posinf=FAR).clip(max=FAR)


def _places(states: Any) -> Float[Array, "B P 3"]:
    """What errors are measured of: a rope's points, or all bodies."""
    return states.bodies() if isinstance(states, PushingState) else states.points


@eqx.filter_jit
def _moved(task: Task, setting: Setting, starts: SimState, examples: Examples, parameters: Array):
    states, actions = transformed(examples, setting, parameters)

    def one(start: SimState, before: Any, obstacles: Any, parameters: Array) -> SimState:
        motion = RigidMotion.of(parameters, setting.movable(before, obstacles).points.mean(0))
        return setting.moved_start(task.scene, start, before, motion)

    moved = jax.vmap(one)(starts, examples.states, examples.obstacles, parameters)
    return moved, actions, jax.tree.map(lambda leaf: leaf[:, -1], states)
