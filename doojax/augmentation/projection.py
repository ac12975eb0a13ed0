"""The thesis's Algorithm 2 for a batch: towards a random target, back to what is valid, and on.

Each round goes a part of the remaining way to the target, then descends on the objective until the example is
valid there. The objective's terms are hinges whose least value, zero, is known: Polyak's step (the value over
the gradient's squared length) needs no learning rate. Rounds and steps are one loop, so that in a batch,
under `jax.vmap`, each element goes to its next round as soon as it is ready and stops by itself.

The last valid transform on the way is kept: a target that cannot be reached gives what came nearest to it,
where the thesis's algorithm gives nothing. Of a long trajectory the descent looks at some of its states, and
what it came to in each round is checked at all of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from doojax.augmentation.objectives import (
    ROUNDING,
    Bands,
    Terms,
    Weights,
    any_transform,
    box_excess,
    distance_change,
    free_hands,
    occupancy_excess,
)
from doojax.geometry.motion import RigidMotion
from doojax.geometry.sdf import signed_distance_at
from doojax.types import Obstacles, Verdict

Term = Callable[[Float[Array, "6"]], Float[Array, ""]]
"""A term of the transform alone: translation (m) and rotation vector (rad)."""


@dataclass(frozen=True)
class ProjectionConfig:
    """How the projection searches, and what it accepts; lengths in metres."""

    rounds: int = 5  # N_p
    steps: int = 25  # M_p, of each round at most
    skin: float = 0.001  # what is nearer to an obstacle touches it
    distance_tolerance: float = 0.055  # of the least distance's change; the released code's for ropes
    box_tolerance: float = 0.001
    least_motion: float = 0.01  # what moves less is no augmentation
    least_progress: float = 0.001  # of a round; what does less has ended
    longest_step: float = 0.05  # of the descent

    def __post_init__(self):
        """Refuse what could not search or accept."""
        for name in ("rounds", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected at least 1")
        for name in ("skin", "distance_tolerance", "box_tolerance", "least_motion", "longest_step"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected more than 0 m")
        if not self.least_progress >= 0:
            raise ValueError(f"least_progress is {self.least_progress}, expected at least 0 m")


class Problem(eqx.Module):
    """One example to be moved: the points of all that moves, at all its times, and where they may go."""

    points: Float[Array, "Q 3"]  # m, world frame
    radii: Float[Array, "Q"]  # m
    obstacles: Obstacles  # [M]: what does not move
    box_low: Float[Array, "3"]  # m
    box_high: Float[Array, "3"]
    low: Float[Array, "6"]  # of translation (m) and rotation vector (rad)
    high: Float[Array, "6"]
    some: Int[Array, "R"] | None = None  # points that the descent looks at; by default all

    @property
    def centre(self) -> Float[Array, "3"]:
        """What the example is turned about."""
        return self.points.mean(0)

    @property
    def scale(self) -> Float[Array, "6"]:
        """Metres that points move per unit of each parameter: root mean square distance from the centre."""
        size = jnp.sqrt(((self.points - self.centre[None]) ** 2).sum(-1).mean())
        return jnp.concatenate([jnp.ones(3, size.dtype), jnp.full(3, jnp.maximum(size, 1e-3))])

    def looked_at(self, which: Int[Array, "R"]) -> "Problem":
        """Some of its points alone."""
        return replace(self, points=self.points[which], radii=self.radii[which], some=None)

    @property
    def coordinates(self) -> list[Float[Array, "Q"]]:
        """Of its points, apart: on a CPU what is computed of them then takes half the time."""
        return [self.points[:, axis] for axis in range(3)]

    def distances(self, coordinates: Sequence[Float[Array, "Q"]]) -> Float[Array, "Q"]:
        """Of its points' surfaces, when they are there, to the nearest obstacle, m."""
        return signed_distance_at(self.obstacles, *coordinates) - self.radii


class Projected(NamedTuple):
    """What came of one element."""

    parameters: Float[Array, "6"]  # the last valid transform, else the best of the last round
    verdict: Int[Array, ""]  # a `Verdict`
    objective: Float[Array, ""]  # at ``parameters``
    iterations: Int[Array, ""]


class _Judged(NamedTuple):
    total: Float[Array, ""]
    excess: Float[Array, "5"]  # by how much each check fails, in the terms' order; 0 where it holds


def objective(
    problem: Problem,
    config: ProjectionConfig,
    validity: Term = any_transform,
    robot: Term = free_hands,
    *,
    everywhere: bool = True,
) -> Callable[[Float[Array, "6"]], tuple[Terms, Float[Array, "5"]]]:
    """The function of the transform that gives all terms, and by how much each of the five checks fails.

    Of all points, or not ``everywhere`` but at `Problem.some` and the one nearest to an obstacle.
    """
    centre, before = problem.centre, problem.distances(problem.coordinates)
    nearest = jnp.argmin(before)
    if problem.some is not None and not everywhere:
        problem = problem.looked_at(jnp.append(problem.some, nearest))
        before, nearest = problem.distances(problem.coordinates), len(problem.points) - 1
    offsets = [along - axis for along, axis in zip(problem.coordinates, centre, strict=True)]
    bands = Bands.of(before, config.skin)
    aim = bands.narrowed(config.skin / 4)
    slack = 0.9 * config.distance_tolerance

    def evaluate(parameters: Float[Array, "6"]) -> tuple[Terms, Float[Array, "5"]]:
        motion = RigidMotion.of(parameters, centre)
        axes, origin = motion.vectors(jnp.eye(3, dtype=centre.dtype)), motion.points(centre)
        moved = [
            origin[axis] + sum(offset * turned[axis] for offset, turned in zip(offsets, axes, strict=True))
            for axis in range(3)
        ]
        after = problem.distances(moved)
        out = jnp.stack(
            [
                box_excess(along, low, high)
                for along, low, high in zip(moved, problem.box_low, problem.box_high, strict=True)
            ]
        )
        change = jnp.abs(after[nearest] - before[nearest])
        terms = Terms(
            box=out.sum(),
            validity=validity(parameters),
            occupancy=occupancy_excess(after, aim).sum(),
            distance=distance_change(before[nearest], after[nearest], slack),
            robot=robot(parameters),
        )
        fails = [
            jnp.max(out) - config.box_tolerance,
            terms.validity,
            jnp.max(occupancy_excess(after, bands)),
            change - config.distance_tolerance,
            terms.robot - ROUNDING,
        ]
        return terms, jnp.maximum(jnp.stack(fails), 0.0)

    return evaluate


def project(
    problem: Problem,
    target: Float[Array, "6"],
    usable: Bool[Array, ""],
    config: ProjectionConfig = ProjectionConfig(),
    weights: Weights = Weights(),  # noqa: B008
    validity: Term = any_transform,
    robot: Term = free_hands,
) -> Projected:
    """Move one example as far towards ``target`` as it stays valid.

    Args:
        problem: finite numbers.
        target: translation (m) and rotation vector (rad), within the problem's bounds.
        usable: false leaves the element alone; its verdict is then that of a transform that does not move.
        config: see `ProjectionConfig`.
        weights: of the objective's terms.
        validity: equation 3.4.
        robot: equation 3.7, less than 2e-6 where the robot can follow.

    Returns:
        `Verdict.ACCEPTED`, or the first check that fails at the best transform of the last round, or
        `Verdict.NO_PROGRESS`. Within a round, the objective at its end is never above that at its beginning.
    """
    begin, proceed = _steps(problem, target, usable, config, weights, validity, robot)
    end = jax.lax.while_loop(lambda carry: ~carry.done, proceed, begin)
    excess, sound = end.excess, end.is_kept
    if problem.some is not None:
        fails = jax.vmap(objective(problem, config, validity, robot))(end.kept)[1]
        latest = _last(end.is_kept)
        excess = jnp.where(end.is_kept.any(), fails[latest], end.excess)
        sound &= (fails == 0).all(1)
    latest, any_sound = _last(sound), sound.any()
    kept = jnp.where(any_sound, end.kept[latest], 0.0)
    checks = jnp.array([Verdict.BOX, Verdict.INVALID, Verdict.OCCUPANCY, Verdict.DISTANCE, Verdict.ROBOT])
    failed = checks[jnp.argmax(excess > 0)]
    accepted = any_sound & (_size(kept, problem.scale) >= config.least_motion)
    still = jnp.where((excess > 0).any(), failed, int(Verdict.NO_PROGRESS))
    return Projected(
        parameters=jnp.where(any_sound, kept, end.best),
        verdict=jnp.where(accepted, int(Verdict.ACCEPTED), still),
        objective=jnp.where(any_sound, end.kept_low[latest], end.low),
        iterations=end.iterations,
    )


@eqx.filter_jit
def projection_path(
    problem: Problem,
    target: Float[Array, "6"],
    config: ProjectionConfig = ProjectionConfig(),
    weights: Weights = Weights(),  # noqa: B008
    validity: Term = any_transform,
    robot: Term = free_hands,
) -> tuple[Float[Array, "S 6"], Int[Array, ""]]:
    """The transforms that `project` looks at, one a step, and how many it does before it ends; see there."""
    begin, proceed = _steps(problem, target, jnp.array(True), config, weights, validity, robot)

    def step(carry: _Carry, _: None) -> tuple[_Carry, tuple[Array, Array]]:
        after = proceed(carry)
        after = jax.tree.map(lambda new, old: jnp.where(carry.done, old, new), after, carry)
        return after, (carry.at, ~carry.done)

    _, (at, takes) = jax.lax.scan(step, begin, length=config.rounds * config.steps)
    return at, takes.sum()


def _size(parameters: Float[Array, "6"], scale: Float[Array, "6"]) -> Float[Array, ""]:
    """How far a transform moves points, m."""
    return jnp.sqrt(jnp.sum((scale * parameters) ** 2))


def _steps(
    problem: Problem,
    target: Float[Array, "6"],
    usable: Bool[Array, ""],
    config: ProjectionConfig,
    weights: Weights,
    validity: Term,
    robot: Term,
) -> "tuple[_Carry, Callable[[_Carry], _Carry]]":
    """How the search begins, and one step of it."""
    evaluate = objective(problem, config, validity, robot, everywhere=False)
    free, scale = problem.high > problem.low, problem.scale

    def judged(parameters: Array) -> tuple[Array, _Judged]:
        terms, excess = evaluate(parameters)
        total = terms.total(weights)
        return total, _Judged(total, excess)

    with_gradient = jax.grad(judged, has_aux=True)

    def proceed(carry: _Carry) -> _Carry:
        gradient, here = with_gradient(carry.at)
        first = jnp.where(carry.step == 0, here.total, carry.first)
        valid = (here.excess == 0).all()
        may = here.total <= first
        # of those not above the round's first: a valid one rather than another, then the lowest
        better = may & (
            (valid & ~carry.best_valid) | ((valid == carry.best_valid) & (here.total < carry.low))
        )
        better = better | (carry.step == 0)
        best = jnp.where(better, carry.at, carry.best)
        best_valid = jnp.where(better, valid, carry.best_valid)
        low = jnp.where(better, here.total, carry.low)
        excess = jnp.where(better, here.excess, carry.excess)

        slope = jnp.where(free, gradient / scale, 0.0)
        square = jnp.sum(slope**2)
        stuck = ~(square > 0)
        polyak = 1.5 * here.total / jnp.where(stuck, 1.0, square)
        length = jnp.minimum(polyak, config.longest_step / jnp.sqrt(jnp.where(stuck, 1.0, square)))
        down = jnp.clip(carry.at - length * slope / scale, problem.low, problem.high)

        over = best_valid | stuck | (carry.step + 1 >= config.steps)  # this round is
        short = _size(best - carry.before, scale) < config.least_progress
        done = over & (short | (carry.round + 1 >= config.rounds))
        rest = jnp.maximum(config.rounds - carry.round - 1, 1)
        onward = best + (target - best) / rest
        ends = (over & best_valid & (jnp.arange(config.rounds) == carry.round))[:, None]
        return _Carry(
            at=jnp.where(over, onward, down),
            before=jnp.where(over, best, carry.before),
            kept=jnp.where(ends, best, carry.kept),
            kept_low=jnp.where(ends[:, 0], low, carry.kept_low),
            is_kept=carry.is_kept | ends[:, 0],
            best=best,
            best_valid=best_valid & ~over,
            low=low,
            excess=excess,
            first=first,
            step=jnp.where(over, 0, carry.step + 1),
            round=carry.round + over,
            iterations=carry.iterations + 1,
            done=done,
        )

    zero, nothing = jnp.zeros_like(target), jnp.zeros_like(target[0])
    begin = _Carry(
        at=target / config.rounds,
        before=zero,
        kept=jnp.zeros((config.rounds, 6), target.dtype),
        kept_low=jnp.zeros(config.rounds, target.dtype),
        is_kept=jnp.zeros(config.rounds, bool),
        best=zero,
        best_valid=jnp.array(False),
        low=nothing,
        excess=jnp.zeros(5, target.dtype),
        first=nothing,
        step=jnp.array(0),
        round=jnp.array(0),
        iterations=jnp.array(0),
        done=~usable,
    )
    return begin, proceed


def _last(which: Bool[Array, "N"]) -> Int[Array, ""]:
    """The last index that is true; the last of all where none is."""
    return len(which) - 1 - jnp.argmax(which[::-1])


class _Carry(NamedTuple):
    at: Float[Array, "6"]
    before: Float[Array, "6"]  # where the last round ended
    kept: Float[Array, "rounds 6"]  # where each round ended
    kept_low: Float[Array, "rounds"]
    is_kept: Bool[Array, "rounds"]  # which ended validly
    best: Float[Array, "6"]  # of this round
    best_valid: Bool[Array, ""]
    low: Float[Array, ""]
    excess: Float[Array, "5"]
    first: Float[Array, ""]  # the objective where this round began
    step: Int[Array, ""]
    round: Int[Array, ""]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]
