"""A rope that swings from a hand that stands still: frequencies and energy."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import j0, jn_zeros

from doojax.benchmarks.physics.cases import (
    GRAVITY,
    Case,
    Finding,
    Settings,
    bent_qpos,
    engine_of,
    fitted_frequency,
    points_of,
    record,
    state_of,
    still_hand,
)
from doojax.benchmarks.physics.closed_forms import hanging_chain_frequency
from doojax.benchmarks.physics.energy import energy
from doojax.simulation.rope import RopeModel
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState
from doojax.tasks import make_task

PERIOD = 0.1  # s between the states that are looked at
LINKS, SECONDS = 25, 12.0
HELD = np.array([0.0, 0.0, 2.0])  # m, where the rope hangs
MODES = 3
SMALL = 5.0  # degrees from the vertical
SETTLED = 0.5  # s: until then the grip takes up the load
SLIGHT = 1e-5  # N m^2 s, a bending damping that takes a tenth of the small swing's energy
STEPS = (0.002, 0.004, 0.005, 0.006)  # s
ANGLES = (45.0, 60.0)  # degrees
COMPILES_ONCE = ("mjx", "warp")  # minutes for every scene


def swing(settings: Settings, engine: str, links: int = LINKS, seconds: float = SECONDS) -> Iterator[Finding]:
    """First frequencies of a hanging chain, and the energy of small and large swings over 12 s.

    A change of energy is relative to what lies above that of the rope at rest.
    """
    case, scene = Case(engine, settings), hanging(settings, links)
    states = swung(scene, engine, (SMALL,), seconds)
    times = np.arange(len(states)) * scene.control_period
    above = 1 - (np.arange(links) + 0.5) / links  # heights of the links' centres, the free end at 0
    across = points_of(scene, states)[:, 0, :, 0]
    for mode, zero in enumerate(jn_zeros(0, MODES), start=1):
        exact = hanging_chain_frequency(mode, scene.rope_part.parameters.length, GRAVITY)
        own = fitted_frequency(times, across @ j0(zero * np.sqrt(above)), exact)
        yield case.found("swing_frequency", own, exact, "Hz", tags={"mode": mode})
    yield from gained(case, scene, states, (SMALL,), "swing_energy")
    if engine in COMPILES_ONCE:
        return
    damped = replace(
        scene, rope=replace(scene.rope_part.parameters, bending_damping=SLIGHT), integrator="euler"
    )
    states = swung(damped, engine, (SMALL,), seconds)
    yield from gained(case, damped, states, (SMALL,), "damped_swing_energy")
    for step in STEPS:
        own = replace(settings, timestep=step)
        case, scene = Case(engine, own, {"step_ms": step * 1e3}), hanging(own, links)
        states = swung(scene, engine, ANGLES, seconds / 2)
        yield from gained(case, scene, states, ANGLES, "swing_energy")


def hanging(settings: Settings, links: int) -> Scene:
    """The rope of `dual_gripper`, without any damping, in a hand that stands still."""
    rope = replace(make_task("dual_gripper").scene.rope_part.parameters, bending_damping=0.0)
    hand = still_hand(0)
    chain = RopeModel("capsule_chain", links)
    scene = Scene("swing", chain, rope, (hand,), floor=False, gravity=GRAVITY, integrator="rk4")
    return settings.of(scene, PERIOD)


def swung(scene: Scene, engine: str, angles: tuple[float, ...], seconds: float) -> list[SimState]:
    """States of straight ropes let go at these angles (degrees) from the vertical."""
    shapes = [np.full(scene.links, np.pi / 2 - np.radians(angle)) for angle in angles]
    start = state_of(scene, np.stack([bent_qpos(scene, HELD, shape) for shape in shapes]))
    return list(record(engine_of(scene, engine), start, round(seconds / scene.control_period)))


def gained(
    case: Case, scene: Scene, states: list[SimState], angles: tuple[float, ...], name: str
) -> Iterator[Finding]:
    """The largest change of energy, with its sign; of a damped swing the largest gain."""
    rope = scene.rope_part.parameters
    rest = rope.mass * scene.gravity * (HELD[2] - rope.length / 2)
    for own, angle in zip(energy(scene, states).T, angles, strict=True):
        begun = own[round(SETTLED / scene.control_period)]
        change = ((own - begun) / (begun - rest))[round(SETTLED / scene.control_period) :]
        if np.isfinite(change).all():
            worst = change.max() if rope.bending_damping else change[np.argmax(np.abs(change))]
            note = ""
        else:
            worst, note = np.nan, "burst"
        yield case.found(name, worst, 0.0, "", scale=1.0, tags={"degrees": angle}, note=note)
