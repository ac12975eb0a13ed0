"""The thesis's Algorithm 2 for a batch: towards a random target, back to what is valid, and on.

Each round goes a part of the remaining way to the target, then descends on the objective until the example is
valid there. The objective's terms are hinges whose least value, zero, is known: Polyak's step (the value over
the gradient's squared length) needs no learning rate. Rounds and steps are one loop, so that in a batch,
under `jax.vmap`, each element goes to its next round as soon as it is ready and stops by itself.

The last valid transform on the way is kept: a target that cannot be reached gives what came nearest to it,
where the thesis's algorithm gives nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
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
from doojax.geometry.sdf import signed_distance
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

    @property
    def centre(self) -> Float[Array, "3"]:
        """What the example is turned about."""
        return self.points.mean(0)

    @property
    def scale(self) -> Float[Array, "6"]:
        """Metres that points move per unit of each parameter: root mean square distance from the centre."""
        size = jnp.sqrt(((self.points - self.centre[None]) ** 2).sum(-1).mean())
        return jnp.concatenate([jnp.ones(3, size.dtype), jnp.full(3, jnp.maximum(size, 1e-3))])

    def distances(self, parameters: Float[Array, "6"]) -> Float[Array, "Q"]:
        """Of the moved points' surfaces to the nearest obstacle, m."""
        moved = RigidMotion.of(parameters, self.centre).points(self.points)
        return signed_distance(self.obstacles, moved) - self.radii


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
) -> Callable[[Float[Array, "6"]], tuple[Terms, Float[Array, "5"]]]:
    """The function of the transform that gives all terms, and by how much each of the five checks fails."""
    before = problem.distances(jnp.zeros_like(problem.low))
    bands, nearest = Bands.of(before, config.skin), jnp.argmin(before)
    aim = bands.narrowed(config.skin / 4)
    slack = 0.9 * config.distance_tolerance

    def evaluate(parameters: Float[Array, "6"]) -> tuple[Terms, Float[Array, "5"]]:
        moved = RigidMotion.of(parameters, problem.centre).points(problem.points)
        after = signed_distance(problem.obstacles, moved) - problem.radii
        out = box_excess(moved, problem.box_low, problem.box_high)
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
    evaluate = objective(problem, config, validity, robot)
    free, scale = problem.high > problem.low, problem.scale

    def judged(parameters: Array) -> tuple[Array, _Judged]:
        terms, excess = evaluate(parameters)
        total = terms.total(weights)
        return total, _Judged(total, excess)

    with_gradient = jax.grad(judged, has_aux=True)

    def size(parameters: Array) -> Array:
        return jnp.sqrt(jnp.sum((scale * parameters) ** 2))

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
        short = size(best - carry.before) < config.least_progress
        done = over & (short | (carry.round + 1 >= config.rounds))
        rest = jnp.maximum(config.rounds - carry.round - 1, 1)
        onward = best + (target - best) / rest
        return _Carry(
            at=jnp.where(over, onward, down),
            before=jnp.where(over, best, carry.before),
            kept=jnp.where(over & best_valid, best, carry.kept),
            kept_low=jnp.where(over & best_valid, low, carry.kept_low),
            any_kept=carry.any_kept | (over & best_valid),
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
        kept=zero,
        kept_low=nothing,
        any_kept=jnp.array(False),
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
    end = jax.lax.while_loop(lambda carry: ~carry.done, proceed, begin)
    parameters = jnp.where(end.any_kept, end.kept, end.best)
    checks = jnp.array([Verdict.BOX, Verdict.INVALID, Verdict.OCCUPANCY, Verdict.DISTANCE, Verdict.ROBOT])
    failed = checks[jnp.argmax(end.excess > 0)]
    moved = size(end.kept) >= config.least_motion
    accepted = end.any_kept & moved
    still = jnp.where((end.excess > 0).any(), failed, int(Verdict.NO_PROGRESS))
    return Projected(
        parameters=parameters,
        verdict=jnp.where(accepted, int(Verdict.ACCEPTED), still),
        objective=jnp.where(end.any_kept, end.kept_low, end.low),
        iterations=end.iterations,
    )


class _Carry(NamedTuple):
    at: Float[Array, "6"]
    before: Float[Array, "6"]  # where the last round ended
    kept: Float[Array, "6"]  # the last valid end of a round
    kept_low: Float[Array, ""]
    any_kept: Bool[Array, ""]
    best: Float[Array, "6"]  # of this round
    best_valid: Bool[Array, ""]
    low: Float[Array, ""]
    excess: Float[Array, "5"]
    first: Float[Array, ""]  # the objective where this round began
    step: Int[Array, ""]
    round: Int[Array, ""]
    iterations: Int[Array, ""]
    done: Bool[Array, ""]
