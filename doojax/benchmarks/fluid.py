"""How right the fluid is, and how fast: `doojax bench fluid`."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.benchmarks.dense_fluid import dense_step
from doojax.benchmarks.shaken_fluid import shaken_rows, transition_rows
from doojax.benchmarks.stages import stages
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.simulation.fluid import (
    Container,
    Fluid,
    FluidSettings,
    Walls,
    at_rest,
    boxes_of,
    density,
    filled,
    step,
    still,
)

# Martin and Moyce (1952), table 2: the front of a column twice as high as wide, by the column's width, at
# times in units of (width / 2 g)^(1/2); the wall that held it is away at once.
TIMES = (0.41, 0.84, 1.19, 1.43, 1.63, 1.83, 1.98, 2.20, 2.32, 2.51, 2.65, 2.83, 2.98, 3.11, 3.33)
FRONTS = (1.11, 1.22, 1.44, 1.67, 1.89, 2.11, 2.33, 2.56, 2.78, 3.00, 3.22, 3.44, 3.67, 3.89, 4.11)
COLUMN = 0.05715  # m, its width there
TALL = Container(0.1, 0.1, 0.4)  # of the column at rest
VISCOSITIES = (1e-4, 3e-4, 1e-3, 3e-3)  # m^2/s
STEPS = 60  # timed
MOST_BY_PAIRS = 1000  # particles
SIZES = (128, 510, 1000, 2000, 4000)


def fluid(
    *,
    sizes: tuple[int, ...] = SIZES,
    dense: bool = True,
    seed: int = 0,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure the fluid: columns at rest, a dam that breaks, shaken cups; pours and steps per second.

    Args:
        sizes: particles, of which steps are timed.
        dense: also time the same steps by all pairs, up to 1,000 particles.
        seed: of nothing but the record.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures; by default they are only shown.
    """
    command = command_line(fluid, locals())
    rows: list[Row] = []
    cases: list[tuple[str, Callable[[], list[Row]]]] = [
        ("a column at rest in the plane", lambda: column_rows(2)),
        ("a column at rest in space", lambda: column_rows(3)),
        ("a dam that breaks", front_rows),
        ("viscosities", viscosity_rows),
        ("cups that are shaken", shaken_rows),
        ("pours in the plane", lambda: transition_rows("watering_2d")),
        ("pours in space", lambda: transition_rows("watering")),
    ]
    for count in sizes:
        pairs = dense and count <= MOST_BY_PAIRS
        cases.append((f"{count} particles", partial(speed_rows, count, pairs)))
    for case in stages("fluid", cases):
        rows += case()
    publish_rows(publish, command=command, seed=seed, rows=rows)
    show(rows, json)


def walls_of(container: Container) -> Walls:
    """A container that stands at the origin."""
    return still(boxes_of(container, jnp.zeros(3), jnp.zeros(())))


def column_rows(dimensions: int, steps: int = 800) -> list[Row]:
    """Density and pressure of a column of 14 cm at rest, and how much it still moves."""
    settings = FluidSettings(spacing=0.01, dimensions=dimensions)  # type: ignore[arg-type]
    narrow = replace(TALL, depth=0.06)
    count = 140 if dimensions == 2 else 10 * 6 * 14
    around = walls_of(narrow)
    begin = at_rest(jnp.asarray(filled(narrow, (0.0, 0.0, 0.0), count, settings)))
    last, pressure = _run(settings, around, begin, steps)
    depth = 0.14 - np.asarray(last.positions)[:, -1]
    within = depth > settings.kernel.reach
    found = np.asarray(density(settings, around, last.positions))[within]
    slope = np.polyfit(depth, np.asarray(pressure[-steps // 4 :]).mean(0), 1)[0]
    weight = settings.density * settings.gravity
    speed = float(jnp.sqrt((last.velocities**2).sum(1).mean()))
    tags = {"dimensions": dimensions}
    return [
        row("density_error", tags, abs(float(found.mean()) - 1), "", n=len(found)),
        row("density_spread", tags, float(found.std()), "", n=len(found)),
        row("pressure_slope_error", tags, abs(float(slope) / weight - 1), "", n=count),
        row("rest_speed", tags, speed, "m/s", n=count),
    ]


def front_rows(across: int = 20) -> list[Row]:
    """How far the front of a falling column is off the experiment's, in the mean over its times."""
    spacing = COLUMN / across
    settings = FluidSettings(spacing=spacing, dimensions=2, viscosity=1e-6, time_step=5e-4)
    tank = Container(6 * COLUMN, 0.1, 0.2)
    left = -tank.width / 2
    dam = Container(COLUMN, 0.1, 2 * COLUMN)
    place = filled(dam, (left + COLUMN / 2, 0.0, 0.0), across * 2 * across, settings)
    unit = (COLUMN / (2 * settings.gravity)) ** 0.5
    steps = int(np.ceil(TIMES[-1] * unit / settings.time_step))
    fronts = _fronts(settings, walls_of(tank), at_rest(jnp.asarray(place)), steps)
    found = np.interp(
        np.array(TIMES) * unit,
        (np.arange(steps) + 1) * settings.time_step,
        (np.asarray(fronts) + settings.radius - left) / COLUMN,
    )
    errors = np.abs(found / np.array(FRONTS) - 1)
    tags = {"experiment": "martin_moyce_1952", "particles": len(place)}
    rows = [
        row("front_error", tags, float(errors.mean()), "", n=len(errors)),
        row("front_error_most", tags, float(errors.max()), "", n=len(errors)),
    ]
    chosen = (0, 4, 9, 14)
    return rows + [row("front", tags | {"time": TIMES[i]}, float(found[i]), "") for i in chosen]


def viscosity_rows() -> list[Row]:
    """How far a column's front is after 0.15 s, by viscosity."""
    tank, dam = Container(0.5, 0.1, 0.2), Container(0.06, 0.1, 0.2)
    rows = []
    for viscosity in VISCOSITIES:
        settings = FluidSettings(spacing=0.01, dimensions=2, viscosity=viscosity)
        place = filled(dam, (-0.22, 0.0, 0.0), 72, settings)
        fronts = _fronts(settings, walls_of(tank), at_rest(jnp.asarray(place)), 60)
        rows.append(row("viscous_front", {"viscosity": viscosity}, float(fronts[-1]) + 0.25, "m"))
    return rows


def speed_rows(count: int, dense: bool) -> list[Row]:
    """Milliseconds of a step in space, from a column in a container as wide as it takes."""
    settings = FluidSettings(spacing=0.0132)
    across = int(np.ceil(count ** (1 / 3)))
    side = across * settings.spacing + 1e-4
    box = Container(side, side, 2 * side)
    around = walls_of(box)
    begin = at_rest(jnp.asarray(filled(box, (0.0, 0.0, 0.0), count, settings)))
    tags: dict[str, Any] = {"particles": count}
    ours = _seconds(lambda some: _run(settings, around, some, STEPS)[0], begin) / STEPS
    rows = [row("step_s", tags | {"method": "neighbours"}, ours, "s", n=STEPS)]
    if dense:
        theirs = _seconds(lambda some: _dense_run(settings, around, some, STEPS // 6), begin) / (STEPS // 6)
        rows.append(row("step_s", tags | {"method": "all_pairs"}, theirs, "s", n=STEPS // 6))
        rows.append(row("over_all_pairs", tags, theirs / ours, ""))
    return rows


def _seconds(function: Callable[[Fluid], Any], begin: Fluid, times: int = 3) -> float:
    jax.block_until_ready(function(begin))
    found = []
    for _ in range(times):
        begun = time.perf_counter()
        jax.block_until_ready(function(begin))
        found.append(time.perf_counter() - begun)
    return float(np.median(found))


@partial(jax.jit, static_argnums=(0, 3))
def _run(settings: FluidSettings, around: Walls, begin: Fluid, steps: int) -> tuple[Fluid, Array]:
    def one(now: Fluid, _: None) -> tuple[Fluid, Array]:
        found = step(settings, around, now)
        return found.fluid, found.pressure

    return jax.lax.scan(one, begin, None, length=steps)


@partial(jax.jit, static_argnums=(0, 3))
def _fronts(settings: FluidSettings, around: Walls, begin: Fluid, steps: int) -> Float[Array, "T"]:
    def one(now: Fluid, _: None) -> tuple[Fluid, Array]:
        after = step(settings, around, now).fluid
        return after, after.positions[:, 0].max()

    return jax.lax.scan(one, begin, None, length=steps)[1]


@partial(jax.jit, static_argnums=(0, 3))
def _dense_run(settings: FluidSettings, around: Walls, begin: Fluid, steps: int) -> Fluid:
    """The same steps by all pairs of particles, with the same walls: what neighbour lists are to beat."""
    return jax.lax.scan(lambda now, _: (dense_step(settings, around, now), None), begin, None, length=steps)[
        0
    ]
