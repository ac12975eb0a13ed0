"""Augmentations of ropes: transitions and trajectories moved rigidly among obstacles that stay."""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from doojax.augmentation.objectives import Weights, any_transform, free_hands
from doojax.augmentation.projection import Problem, ProjectionConfig, Term, project
from doojax.geometry.motion import RigidMotion
from doojax.tasks.base import Box, Task
from doojax.types import Obstacles, RopeState, ShapeKind, Verdict

LEAST_MOVE = 1e-4  # m: an example in which every point moves less shows nothing
UPRIGHT = 10.0  # m, half the height of obstacles that a planar rope meets


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


class RopeExamples(eqx.Module):
    """B examples of T actions; T is 1 for transitions."""

    states: RopeState  # points [B, T+1, N, 3], grippers [B, T+1, G, 3]
    actions: Float[Array, "*b T G 3"]  # m
    obstacles: Obstacles  # [B, M]
    sound: Bool[Array, "*b"]  # false where the example has a fault


class Setting(eqx.Module):
    """What augmentations of a task's ropes need to know of it."""

    rope_radius: Float[Array, ""]  # m
    gripper_radii: Float[Array, "G"]
    box_low: Float[Array, "3"]
    box_high: Float[Array, "3"]
    bounds: Float[Array, "6"]  # of translation (m) and rotation vector (rad), either way
    planar: bool = eqx.field(static=True)

    @classmethod
    def of(cls, task: Task, bounds: Bounds = Bounds(), box: Box | None = None) -> "Setting":
        """A task's ropes in its workspace, or in another box.

        Raises:
            ValueError: bounds that move nothing in the task's plane.
        """
        scene, box = task.scene, task.workspace if box is None else box
        planar = scene.planar or box.low[2] == box.high[2]
        return cls(
            rope_radius=jnp.array(scene.rope_part.parameters.radius, jnp.float32),
            gripper_radii=jnp.array([gripper.radius for gripper in scene.grippers], jnp.float32),
            box_low=jnp.array(box.low, jnp.float32),
            box_high=jnp.array(box.high, jnp.float32),
            bounds=(bounds.planar if planar else bounds).array,
            planar=planar,
        )


class Augmented(eqx.Module):
    """B results; those rejected hold NaN instead of states, actions and transform, never a copy."""

    states: RopeState
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


def moving_points(
    setting: Setting, states: RopeState, between: int = 2
) -> tuple[Float[Array, "Q 3"], Float[Array, "Q"]]:
    """Points on the axis of the rope and the grippers' centres at T + 1 states and between them, and radii.

    On the rope: link centres, the middles between them, and both ends half a link beyond. ``between`` looks
    on the straight way from each state to the next.
    """
    points = states.points
    middle = (points[:, 1:] + points[:, :-1]) / 2
    ends = jnp.stack([1.5 * points[:, 0] - 0.5 * points[:, 1], 1.5 * points[:, -1] - 0.5 * points[:, -2]], 1)
    at = jnp.concatenate([points, middle, ends, states.grippers], axis=1)  # [T+1, P, 3]
    radii = jnp.concatenate(
        [jnp.full(at.shape[1] - states.grippers.shape[1], setting.rope_radius), setting.gripper_radii]
    ).astype(at.dtype)
    steps = jnp.arange(1, between + 1, dtype=at.dtype)[:, None, None, None] / (between + 1)
    ways = (at[None, :-1] + steps * (at[None, 1:] - at[None, :-1])).reshape(-1, *at.shape[1:])
    every = jnp.concatenate([at, ways])
    return every.reshape(-1, 3), jnp.tile(radii, len(every))


def upright(obstacles: Obstacles) -> Obstacles:
    """Obstacles without top or bottom, for ropes that stay in a plane: the way out of one is sideways.

    Boxes and cylinders have to stand; capsules stay as they are.
    """
    tall = obstacles.half_size.at[..., 2].set(UPRIGHT)
    capsule = (obstacles.kind == ShapeKind.CAPSULE)[..., None]
    return replace(obstacles, half_size=jnp.where(capsule, obstacles.half_size, tall))


@eqx.filter_jit
def augment(
    keys: Key[Array, "B"],
    examples: RopeExamples,
    setting: Setting,
    config: ProjectionConfig = ProjectionConfig(),  # noqa: B008
    weights: Weights = Weights(),  # noqa: B008
    validity: Term = any_transform,
    robot: Term = free_hands,
) -> Augmented:
    """One augmentation of each example; each depends on its own key and example alone.

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
    one = partial(
        _augment_one, setting=setting, config=config, weights=weights, validity=validity, robot=robot
    )
    return jax.vmap(one)(keys, examples.states, examples.actions, examples.obstacles, examples.sound)


def _augment_one(
    key: Array,
    states: RopeState,
    actions: Array,
    obstacles: Obstacles,
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
    points, radii = moving_points(setting, states)
    points = jnp.where(finite, points, 0.0)
    low, high = -setting.bounds, setting.bounds
    problem = Problem(
        points=points,
        radii=radii,
        obstacles=upright(obstacles) if setting.planar else obstacles,
        box_low=setting.box_low,
        box_high=setting.box_high,
        low=low,
        high=high,
    )
    target = jax.random.uniform(key, (6,), low.dtype, minval=low, maxval=high)
    way = [jnp.abs(leaf - leaf[:1]).max() for leaf in (states.points, states.grippers)]
    moves = jnp.maximum(*way) > LEAST_MOVE
    tolerance = config.box_tolerance
    inside = ((points >= setting.box_low - tolerance) & (points <= setting.box_high + tolerance)).all()

    found = project(problem, target, finite & moves & inside, config, weights, validity, robot)
    verdict = found.verdict
    for reason, refused in (
        (Verdict.OUTSIDE, ~inside),
        (Verdict.NOTHING_MOVED, ~moves),
        (Verdict.FAULTY, ~finite),
    ):
        verdict = jnp.where(refused, int(reason), verdict)
    transform = jnp.where(verdict == Verdict.ACCEPTED, found.parameters, jnp.nan)
    motion = RigidMotion.of(transform, problem.centre)
    return Augmented(
        states=states.moved(motion),
        actions=motion.vectors(actions),
        transform=transform,
        centre=problem.centre,
        target=target,
        verdict=verdict,
        iterations=found.iterations,
    )
