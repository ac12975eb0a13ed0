"""Does fluid stay where walls hold it, and how soon is a pour computed? For `doojax bench fluid`."""

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.summary import row
from doojax.geometry.sdf import signed_distances
from doojax.keys import numbered, stream
from doojax.simulation.fluid import Container, Fluid, FluidSettings, Walls, at_rest, boxes_of, filled, step
from doojax.simulation.fluid.walls import coordinates
from doojax.tasks import make_task

CUP = Container(0.1, 0.1, 0.15)
SHIFT, TURN, FREQUENCY = 0.05, 0.4, 8.0  # m, rad and rad/s, of the shaking
STEPS = 160  # of each trajectory: 0.4 s
AT_ONCE = 50
POURS = ((0.18, 0.0, 0.0), (0.0, 0.0, 2.5))  # of the timed transitions


def shaken_rows(trajectories: int = 1000, count: int = 60) -> list[Row]:
    """Cups that are shaken and turned at random: how deep a particle's centre ever lies in a wall.

    Args:
        trajectories: how many cups.
        count: particles in each.
    """
    settings = FluidSettings(spacing=0.01, dimensions=2, viscosity=1e-3)
    begin = at_rest(jnp.asarray(filled(CUP, (0.0, 0.0, 0.0), count, settings)))
    shaken = jax.jit(jax.vmap(partial(_shaken, settings, begin)))
    gaps, faults = [], 0
    for first in range(0, trajectories, AT_ONCE):
        numbers = range(first, min(first + AT_ONCE, trajectories))
        gap, faulty = shaken(numbered(stream(0, "shaken fluid"), numbers))
        gaps.append(np.asarray(gap))
        faults += int(faulty.sum())
    nearest = np.concatenate(gaps)
    tags = {"experiment": "shaken", "dimensions": 2}
    return [
        row("passed_walls", tags, float((nearest < 0).sum()), "", n=trajectories),
        row("nearest_wall", tags, float(nearest.min() / settings.radius), "", n=trajectories),
        row("faulty", tags, float(faults / trajectories), "", n=trajectories),
    ]


def _shaken(settings: FluidSettings, begin: Fluid, key: Array) -> tuple[Float[Array, ""], Array]:
    """How near a centre comes to a wall's surface, m, negative inside; and was there a fault?"""
    phase_key, amount_key = jax.random.split(key)
    phases = jax.random.uniform(phase_key, (3,), maxval=2 * jnp.pi)
    amounts = jax.random.uniform(amount_key, (3,), minval=0.5) * jnp.array([SHIFT, SHIFT, TURN])

    def one(fluid: Fluid, number: Array) -> tuple[Fluid, tuple[Array, Array]]:
        now = (number + 1) * settings.time_step
        pose = amounts * (jnp.sin(FREQUENCY * now + phases) - jnp.sin(phases))
        rate = amounts * FREQUENCY * jnp.cos(FREQUENCY * now + phases)
        walls = _moving(pose, rate)
        found = step(settings, walls, fluid)
        gap = signed_distances(walls.obstacles, jnp.stack(coordinates(found.fluid.positions), axis=1))
        return found.fluid, (gap.min(), found.dropped | found.too_fast | found.entered)

    _, (gaps, faulty) = jax.lax.scan(one, begin, jnp.arange(STEPS))
    return gaps.min(), faulty.any()


def _moving(pose: Float[Array, "3"], rate: Float[Array, "3"]) -> Walls:
    place = jnp.stack([pose[0], jnp.zeros(()), pose[1]])
    boxes = boxes_of(CUP, place, pose[2])
    arm = boxes.centre - place
    speed = [rate[0] + rate[2] * arm[:, 2], 0 * arm[:, 0], rate[1] - rate[2] * arm[:, 0]]
    spin = jnp.zeros_like(boxes.centre).at[:, 1].set(rate[2])
    return Walls(boxes, jnp.stack(speed, axis=1), spin)


def transition_rows(task: str, elements: int = 4) -> list[Row]:
    """Seconds of a transition of a watering task: by the clock, and of all processors together."""
    made: Any = make_task(task)
    simulator = made.simulator()
    states = jax.vmap(simulator.reset)(numbered(stream(0, "timed pours"), range(elements)))
    actions = jnp.tile(jnp.array(POURS)[None, :, None], (elements, 1, 1, 1))
    jax.block_until_ready(simulator.rollout(states, actions))
    begun, spent = time.perf_counter(), time.process_time()
    _, seen = jax.block_until_ready(simulator.rollout(states, actions))
    count = elements * len(POURS)
    clock, work = (time.perf_counter() - begun) / count, (time.process_time() - spent) / count
    tags = {"task": task, "particles": made.scene.particles}
    return [
        row("transitions_per_s", tags, 1 / clock, "1/s", n=count),
        row("transition_work", tags, work, "s", n=count),
        row("faulty", tags, float((np.asarray(seen.faults) != 0).any(-1).mean()), "", n=elements),
    ]
