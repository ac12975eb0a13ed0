"""Augmentations of examples: what moves in them, moved rigidly to among what stays."""

from abc import abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from doojax.augmentation.objectives import Weights, any_transform, free_hands
from doojax.augmentation.projection import Problem, ProjectionConfig, Term, project
from doojax.geometry.motion import RigidMotion
from doojax.parts import in_parts, worth_parts
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState
from doojax.types import Obstacles, Verdict

PART = 16  # examples that a thread augments in one call on a CPU
LEAST_MOVE = 1e-4  # m: an example in which everything moves less shows nothing


@dataclass(frozen=True)
class Bounds:
    """Between which transforms are drawn, uniformly; the released code's for ropes, but no tilt.

    A rope hangs along gravity: a tilted one is another rope. In a plane, `planar` leaves z out, too.
    """

    translation: tuple[float, float, float] = (0.25, 0.25, 0.25)  # m, either way along each axis
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.5)  # rad, either way, rotation vector

    def __post_init__(self):
        """Refuse what moves nothing, or has no meaning."""
        values = (*self.translation, *self.rotation)
        if not all(0 <= value < np.inf for value in values):
            raise ValueError(f"bounds are {self}, expected numbers of at least 0")
        if not any(values):
            raise ValueError("the range of transforms is zero: nothing would move; give a bound above 0")
        if np.linalg.norm(self.rotation) > np.pi:
            raise ValueError(f"rotation is {self.rotation}, expected at most pi in all: more is less")

    @property
    def planar(self) -> "Bounds":
        """Of these, what stays in a horizontal plane."""
        return Bounds((*self.translation[:2], 0.0), (0.0, 0.0, self.rotation[2]))

    @property
    def array(self) -> Float[Array, "6"]:
        """The upper bounds; the lower ones are their opposites."""
        return jnp.array([*self.translation, *self.rotation], dtype=jnp.float32)


class Examples(eqx.Module):
    """B examples of T actions; T is 1 for transitions."""

    states: Any  # a `doojax.types.State`, [B, T+1]
    actions: Float[Array, "*b T G 3"]  # m
    obstacles: Obstacles | None  # [B, M]; None where a task has none
    sound: Bool[Array, "*b"]  # false where the example has a fault


class Movable(NamedTuple):
    """What moves in one example, and what stays."""

    points: Float[Array, "Q 3"]  # m, at all its times, of all that moves
    radii: Float[Array, "Q"]  # m
    stays: Obstacles  # [M]
    way: Float[Array, ""]  # m, of what moves farthest
    some: Int[np.ndarray, "R"] | None = None  # see `Problem.some`


class Setting(eqx.Module):
    """What augmentations need to know of a task; its kinds are those of states."""

    box_low: Float[Array, "3"]
    box_high: Float[Array, "3"]
    bounds: Float[Array, "6"]  # of translation (m) and rotation vector (rad), either way

    @abstractmethod
    def movable(self, states: Any, obstacles: Any) -> Movable:
        """What moves in states [T+1], and what stays."""

    @abstractmethod
    def moved(self, states: Any, motion: RigidMotion) -> Any:
        """The states [T+1] with what moves in them elsewhere."""

    @abstractmethod
    def moved_start(self, scene: Scene, start: SimState, states: Any, motion: RigidMotion) -> SimState:
        """The state that the moved example is simulated from."""

    @abstractmethod
    def clearance(self, states: Any, obstacles: Any) -> Float[Array, "T1"] | None:
        """Of moved states, their least distance to an obstacle, m; None where no data set has it."""


class Augmented(eqx.Module):
    """B results; those rejected hold NaN instead of states, actions and transform, never a copy."""

    states: Any
    actions: Float[Array, "*b T G 3"]
    transform: Float[Array, "*b 6"]  # translation (m), rotation vector (rad)
    centre: Float[Array, "*b 3"]  # what it turns about, m
    target: Float[Array, "*b 6"]  # what was drawn
    verdict: Int[Array, "*b"]  # `Verdict`
    iterations: Int[Array, "*b"]

    @property
    def motion(self) -> RigidMotion:
        """The motions, [B]."""
        return jax.vmap(RigidMotion.of)(self.transform, self.centre)


def drawn(key: Array, bounds: Float[Array, "6"]) -> Float[Array, "6"]:
    """A transform to aim at, uniform within the bounds."""
    return jax.random.uniform(key, (6,), bounds.dtype, minval=-bounds, maxval=bounds)


def problem_of(setting: Setting, movable: Movable) -> Problem:
    """What the projection is given: what moves in an example, and where it may go."""
    some = movable.some
    return Problem(
        points=movable.points,
        radii=movable.radii,
        obstacles=movable.stays,
        box_low=setting.box_low,
        box_high=setting.box_high,
        low=-setting.bounds,
        high=setting.bounds,
        some=None if some is None else jnp.asarray(some),
    )


@eqx.filter_jit
def transformed(
    examples: Examples, setting: Setting, parameters: Float[Array, "B 6"]
) -> tuple[Any, Float[Array, "*b T G 3"]]:
    """States and actions of examples with what moves in them moved, whatever it then goes through."""

    def one(states: Any, actions: Array, obstacles: Obstacles | None, own: Array) -> tuple[Any, Array]:
        motion = RigidMotion.of(own, setting.movable(states, obstacles).points.mean(0))
        return setting.moved(states, motion), motion.vectors(actions)

    return jax.vmap(one)(examples.states, examples.actions, examples.obstacles, parameters)


def augment(
    keys: Key[Array, "B"],
    examples: Examples,
    setting: Setting,
    config: ProjectionConfig = ProjectionConfig(),  # noqa: B008
    weights: Weights = Weights(),  # noqa: B008
    validity: Term = any_transform,
    robot: Term = free_hands,
) -> Augmented:
    """One augmentation of each example; each depends on its own key and example alone.

    On a CPU each processor projects one example after another, so that none waits for a slower one.

    Args:
        keys: of the targets, one for each example.
        examples: what is moved, among what stays.
        setting: see `Setting`.
        config: of the projection.
        weights: of its objective.
        validity: equation 3.4.
        robot: equation 3.7.

    Returns:
        see `Augmented`. Examples that have a fault or a number missing, in which nothing moves, or that leave
        the workspace themselves, are refused, with a verdict of their own.
    """
    how = partial(_augment, setting=setting, config=config, weights=weights, validity=validity, robot=robot)
    if worth_parts(PART, keys, examples, setting):
        return in_parts(how, PART, keys, examples)
    return how(keys, examples)


@eqx.filter_jit
def _augment(keys: Key[Array, "B"], examples: Examples, **setting_and_terms: Any) -> Augmented:
    one = partial(_augment_one, **setting_and_terms)
    batch = keys, examples.states, examples.actions, examples.obstacles, examples.sound
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda arguments: one(*arguments), batch)
    return jax.vmap(one)(*batch)


def _augment_one(
    key: Array,
    states: Any,
    actions: Array,
    obstacles: Obstacles | None,
    sound: Array,
    *,
    setting: Setting,
    config: ProjectionConfig,
    weights: Weights,
    validity: Term,
    robot: Term,
) -> Augmented:
    finite = sound & jnp.isfinite(actions).all()
    for leaf in jax.tree.leaves((states, obstacles)):
        finite &= jnp.isfinite(leaf).all()
    found = setting.movable(states, obstacles)
    points = jnp.where(finite, found.points, 0.0)
    problem = problem_of(setting, found._replace(points=points))
    target = drawn(key, setting.bounds)
    moves = found.way > LEAST_MOVE
    tolerance = config.box_tolerance
    inside = ((points >= setting.box_low - tolerance) & (points <= setting.box_high + tolerance)).all()

    projected = project(problem, target, finite & moves & inside, config, weights, validity, robot)
    verdict = projected.verdict
    for reason, refused in (
        (Verdict.OUTSIDE, ~inside),
        (Verdict.NOTHING_MOVED, ~moves),
        (Verdict.FAULTY, ~finite),
    ):
        verdict = jnp.where(refused, int(reason), verdict)
    transform = jnp.where(verdict == Verdict.ACCEPTED, projected.parameters, jnp.nan)
    motion = RigidMotion.of(transform, problem.centre)
    there = setting.moved(states, motion)
    return Augmented(
        states=jax.tree.map(lambda leaf: jnp.where(jnp.isnan(transform[0]), jnp.nan, leaf), there),
        actions=motion.vectors(actions),
        transform=transform,
        centre=problem.centre,
        target=target,
        verdict=verdict,
        iterations=projected.iterations,
    )
