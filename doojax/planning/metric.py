"""What a planner aims at and what it calls near.

A sample is a whole rope that could be: the shape of a state that was reached, turned about the vertical and
put somewhere. The distance between states is the root mean square over the rope's points and the grippers,
so that ropes are near if they lie at one place in one shape. The released code of the thesis copies one
uniform point to all points and grippers instead, which calls those ropes near that are crumpled up around it;
`doojax bench planner` compares the two.
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from doojax.geometry.box import Box
from doojax.geometry.frames import exact_product
from doojax.goals import Goal
from doojax.types import State

CHUNK = 256  # slots compared at once


@runtime_checkable
class Sampler(Protocol):
    """Draws positions (m) of all bodies, points and then grippers, that a branch is to head for."""

    def __call__(
        self,
        key: Array,
        workspace: Box,
        shape: Float[Array, "NG 3"],
        goal: Goal,
        towards_goal: Bool[Array, ""],
    ) -> Float[Array, "NG 3"]:
        """A sample; ``shape`` are the bodies of some state of the tree."""
        ...


def rope_sample(
    key: Array, workspace: Box, shape: Float[Array, "NG 3"], goal: Goal, towards_goal: Bool[Array, ""]
) -> Float[Array, "NG 3"]:
    """``shape``, turned by any yaw, with its middle anywhere in the workspace, or where it reaches the goal.

    Towards a goal one of the bodies that may reach the first target is put there, and the rope goes with it;
    bodies of further targets are put on theirs alone.
    """
    draws = jax.random.uniform(key, (4 + goal.bodies.size,))  # at once: every call costs seconds to compile
    yaw = 2 * jnp.pi * draws[0]
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    turned = exact_product(shape, jnp.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))
    low, high = jnp.array(workspace.low), jnp.array(workspace.high)
    somewhere = turned - turned.mean(0) + low + (high - low) * draws[1:4]
    chosen = jnp.argmax(jnp.where(goal.bodies, draws[4:].reshape(goal.bodies.shape), -1.0), axis=-1)
    there = turned - turned[chosen[0]] + goal.targets[0]
    there = there.at[chosen].set(goal.targets)
    return jnp.where(towards_goal, there, somewhere)


def point_sample(
    key: Array, workspace: Box, shape: Float[Array, "NG 3"], goal: Goal, towards_goal: Bool[Array, ""]
) -> Float[Array, "NG 3"]:
    """One uniform point of the workspace, or the first target, for all bodies: the thesis's released code."""
    point = jnp.where(towards_goal, goal.targets[0], workspace.sample(key))
    return jnp.broadcast_to(point, shape.shape)


def nearest(
    samples: Float[Array, "L NG 3"], states: State, eligible: Bool[Array, "C"], filled: Int[Array, ""]
) -> Int[Array, "L"]:
    """The slot of the eligible state nearest to each sample, the first of equals.

    Args:
        samples: positions of the bodies, metres.
        states: C of them.
        eligible: which of them may be chosen.
        filled: only so many slots are looked at, in chunks: a tree costs what it holds.
    """
    count, capacity = len(samples), eligible.shape[0]
    chunk = min(CHUNK, capacity)
    ours = samples.reshape(count, -1)

    def compare(index, best):
        # A last chunk that would reach beyond the end starts earlier: some slots are then looked at twice.
        start = jnp.minimum(index * chunk, capacity - chunk)
        slots, allowed = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, chunk), (states, eligible)
        )
        allowed &= start + jnp.arange(chunk) < filled
        theirs = slots.bodies().reshape(chunk, -1)  # of a chunk, because all of them would be a copy
        length = (theirs**2).sum(-1)
        along = exact_product(theirs, ours.T)
        squared = jnp.where(
            allowed[:, None], length[:, None] - 2 * along, jnp.inf
        )  # rejected ones may be NaN
        least = squared.min(0)  # two reductions over the first axis: several times faster than one argmin
        here = jnp.where(squared == least, jnp.arange(chunk)[:, None], chunk).min(0)
        closer = least < best[0]
        return jnp.where(closer, least, best[0]), jnp.where(closer, start + here, best[1])

    nothing = jnp.full(count, jnp.inf), jnp.zeros(count, dtype=jnp.int32)
    return jax.lax.fori_loop(0, -(-filled // chunk), compare, nothing)[1]
