"""One time step of a position-based fluid (Macklin and Mueller 2013).

A particle's density is the kernels' sum over its neighbours, and over what walls have of its kernel, as if
the fluid went on behind them. Where it is above that at rest, particles are moved apart, in each iteration by
lambda = - C / (sum of the squared gradients of C), C = density / rest - 1. Such a move in a time step dt is
that of a pressure p = - lambda rho / (dt^2), which is what `Stepped.pressure` adds up.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from doojax.simulation.fluid import walls as by_walls
from doojax.simulation.fluid.neighbours import Neighbours, find_neighbours, in_order, take
from doojax.simulation.fluid.settings import FluidSettings
from doojax.simulation.fluid.walls import Near, Walls

RELAXATION = 0.05  # added to the sum of squared gradients, in units of 1 / spacing^2


class Fluid(eqx.Module):
    """Where P particles are and how they move: in space, or x and z in the plane."""

    positions: Float[Array, "*b P D"]  # m
    velocities: Float[Array, "*b P D"]  # m/s


class Stepped(eqx.Module):
    """What `step` gives."""

    fluid: Fluid
    pressure: Float[Array, "P"]  # Pa
    dropped: Bool[Array, ""]  # had a particle more neighbours than there is room for?
    too_fast: Bool[Array, ""]  # did a particle go so far that it could have passed a wall?
    entered: Bool[Array, ""]  # is the centre of a particle in a wall?


class _Pairs(eqx.Module):
    """Of K neighbours of P particles: kernels, and the gradients of constraints by the neighbour's place."""

    weight: Float[Array, "K P"]  # kernel times volume, over the crowding at rest
    gradient: list[Float[Array, "K P"]]  # of that by one's own place, 1/m


def at_rest(positions: Float[Array, "P D"]) -> Fluid:
    """Particles that do not move."""
    return Fluid(positions, jnp.zeros_like(positions))


def step(settings: FluidSettings, walls: Walls, fluid: Fluid) -> Stepped:
    """The fluid a time step later.

    Args:
        settings: static.
        walls: where they are at the end of the step.
        fluid: one.
    """
    dt, radius = settings.time_step, settings.radius
    fall = jnp.zeros(settings.dimensions).at[-1].set(-settings.gravity)
    velocity = fluid.velocities + dt * fall
    order, keys, cells = in_order(fluid.positions + dt * velocity, settings.kernel.reach, settings.region)
    begin, velocity = fluid.positions[order], velocity[order]
    guess = begin + dt * velocity
    pairs = find_neighbours(guess, keys, cells, settings.kernel.reach, settings.region, settings.capacity)
    near = by_walls.look(walls, guess)
    x = [guess[:, axis] for axis in range(settings.dimensions)]
    x = by_walls.kept_out(near, x, radius)

    def iterate(_: Array, carry: tuple[list[Array], Array, Array]) -> tuple[list[Array], Array, Array]:
        x, pressed, _ = carry
        shift, push, weight = _corrected(settings, pairs, near, x)
        x = [one + move for one, move in zip(x, shift, strict=True)]
        return by_walls.kept_out(near, x, radius), pressed + push, weight

    begun = x, jnp.zeros(len(begin)), jnp.zeros(pairs.index.shape)
    x, pressed, weight = jax.lax.fori_loop(0, settings.iterations, iterate, begun)
    end, entered = by_walls.pushed_out(walls, jnp.stack(x, axis=1), radius)
    moved = end - begin
    velocity = _smoothed(settings, pairs, weight, walls, near, end, moved / dt)
    thinnest = jnp.where(walls.obstacles.active, walls.obstacles.half_size.min(1), jnp.inf).min(
        initial=jnp.inf
    )
    far = jnp.sqrt((moved**2).sum(1)) > radius + thinnest
    back = jnp.zeros_like(order).at[order].set(jnp.arange(len(order)))
    return Stepped(
        Fluid(end[back], velocity[back]),
        (settings.density * settings.evenness / dt**2 * pressed)[back],
        pairs.dropped,
        far.any(),
        entered.any(),
    )


def density(settings: FluidSettings, walls: Walls, positions: Float[Array, "P D"]) -> Float[Array, "P"]:
    """Of each particle, over that at rest; what walls have of a kernel counts as fluid."""
    order, keys, cells = in_order(positions, settings.kernel.reach, settings.region)
    placed = positions[order]
    pairs = find_neighbours(placed, keys, cells, settings.kernel.reach, settings.region, settings.capacity)
    x = [placed[:, axis] for axis in range(settings.dimensions)]
    found = _pairs(settings, pairs, x).weight.sum(0)
    part, _ = behind_walls(settings, by_walls.look(walls, placed), x)
    return jnp.zeros_like(found).at[order].set(found + part)


def _pairs(settings: FluidSettings, pairs: Neighbours, x: list[Float[Array, "P"]]) -> _Pairs:
    away = [one[None] - take(one, pairs.index) for one in x]
    square = sum(one * one for one in away)
    r = jnp.sqrt(square)
    scale = settings.volume / settings.crowding
    weight = jnp.where(pairs.there, settings.kernel.value(r), 0.0) * scale
    slope = jnp.where(pairs.there, settings.kernel.slope(r), 0.0) * scale
    return _Pairs(weight, [slope * one for one in away])


def behind_walls(
    settings: FluidSettings, near: Near, x: list[Float[Array, "P"]]
) -> tuple[Float[Array, "P"], list[Float[Array, "P"]]]:
    """What walls have of each kernel, and its gradient, 1/m: one wall after the other of what is left."""
    part, slope = settings.kernel.behind(by_walls.distances(near, x))
    left = jnp.prod(1 - part, axis=0)
    steeper = left[None] * slope / (1 - part)  # a part is at most a half: walls are kept at a distance
    return 1 - left, [(steeper * normal).sum(0) for normal in near.normal]


def _corrected(
    settings: FluidSettings, neighbours: Neighbours, near: Near, x: list[Float[Array, "P"]]
) -> tuple[list[Float[Array, "P"]], Float[Array, "P"], Float[Array, "K P"]]:
    """How particles are to be moved, m; minus lambda, m^2; and the kernels."""
    found = _pairs(settings, neighbours, x)
    behind, outwards = behind_walls(settings, near, x)
    excess = jnp.maximum(found.weight.sum(0) + behind - 1, 0.0)
    own = [one.sum(0) + wall for one, wall in zip(found.gradient, outwards, strict=True)]
    squares = sum((one * one).sum(0) for one in found.gradient) + sum(one * one for one in own)
    push = excess / (squares + RELAXATION / settings.spacing**2)
    both = push[None] + take(push, neighbours.index)
    # a wall presses back as the fluid presses it
    shift = [
        -((both * one).sum(0) + 2 * push * wall) for one, wall in zip(found.gradient, outwards, strict=True)
    ]
    return shift, push, found.weight


def _smoothed(
    settings: FluidSettings,
    neighbours: Neighbours,
    weight: Float[Array, "K P"],
    walls: Walls,
    near: Near,
    positions: Float[Array, "P D"],
    velocities: Float[Array, "P D"],
) -> Float[Array, "P D"]:
    """Velocities drawn towards those around (XSPH), and those of walls, which fluid sticks to.

    By the kernels of the last iteration: the last move changes them little.
    """
    x = [positions[:, axis] for axis in range(settings.dimensions)]
    part, _ = settings.kernel.behind(by_walls.distances(near, x))
    moving = by_walls.velocities(walls, near)
    found = []
    for axis, wall in enumerate(moving):
        own = velocities[:, axis]
        fluid = (weight * (take(own, neighbours.index) - own)).sum(0)
        found.append(own + settings.smoothing * (fluid + (part * (wall - own)).sum(0)))
    return jnp.stack(found, axis=1)
