"""The fluid's step by all pairs of particles: what neighbour lists are to equal, and to be faster than."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from doojax.simulation.fluid import Fluid, FluidSettings, Walls
from doojax.simulation.fluid import walls as by_walls
from doojax.simulation.fluid.step import RELAXATION, behind_walls


def dense_step(settings: FluidSettings, around: Walls, fluid: Fluid) -> Fluid:
    """What `doojax.simulation.fluid.step` gives, but for rounding."""
    dt, scale = settings.time_step, settings.volume / settings.crowding
    velocity = fluid.velocities + dt * jnp.zeros(settings.dimensions).at[-1].set(-settings.gravity)
    guess = fluid.positions + dt * velocity
    near = by_walls.look(around, guess)
    x = [guess[:, axis] for axis in range(settings.dimensions)]
    beside = sum((one[:, None] - one[None]) ** 2 for one in x) < settings.kernel.reach**2
    x = by_walls.kept_out(near, x, settings.radius)

    def pairs(x: list[Array]) -> tuple[Float[Array, "P P"], list[Float[Array, "P P"]]]:
        away = [one[None] - one[:, None] for one in x]
        r = jnp.sqrt(sum(one * one for one in away))
        weight = jnp.where(beside, settings.kernel.value(r), 0.0) * scale
        slope = jnp.where(beside, settings.kernel.slope(r), 0.0) * scale
        return weight, [slope * one for one in away]

    def iterate(_: Array, carry: tuple[list[Array], Array]) -> tuple[list[Array], Array]:
        x, _ = carry
        weight, gradient = pairs(x)
        part, outwards = behind_walls(settings, near, x)
        excess = jnp.maximum(weight.sum(0) + part - 1, 0.0)
        own = [one.sum(0) + wall for one, wall in zip(gradient, outwards, strict=True)]
        squares = sum((one * one).sum(0) for one in gradient) + sum(one * one for one in own)
        push = excess / (squares + RELAXATION / settings.spacing**2)
        both = push[None] + push[:, None]
        moved = [
            place - (both * one).sum(0) - 2 * push * wall
            for place, one, wall in zip(x, gradient, outwards, strict=True)
        ]
        return by_walls.kept_out(near, moved, settings.radius), weight

    x, weight = jax.lax.fori_loop(0, settings.iterations, iterate, (x, jnp.zeros((len(guess), len(guess)))))
    end, _ = by_walls.pushed_out(around, jnp.stack(x, axis=1), settings.radius)
    moved = (end - fluid.positions) / dt
    part, _ = settings.kernel.behind(by_walls.distances(near, list(end.T)))
    found = []
    for axis, wall in enumerate(by_walls.velocities(around, near)):
        own = moved[:, axis]
        drawn = weight.T @ own - weight.sum(0) * own + (part * (wall - own)).sum(0)
        found.append(own + settings.smoothing * drawn)
    return Fluid(end, jnp.stack(found, axis=1))
