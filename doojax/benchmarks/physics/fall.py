"""Ropes that fall: by half g t squared, whatever their stiffness."""

from collections.abc import Iterator

import numpy as np

from doojax.benchmarks.physics.cases import (
    GRAVITY,
    Case,
    Finding,
    Settings,
    bent_qpos,
    engine_of,
    points_of,
    record,
    refused,
    state_of,
    still_hand,
)
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Scene

STIFFNESSES = (1e-3, 1.0, 10.0)  # EI, N m^2
LINKS, SECONDS, PERIOD = 25, 0.6, 0.06


def fall(settings: Settings, engine: str, links: int = LINKS) -> Iterator[Finding]:
    """The acceleration of a rope of 1 m and 0.2 kg that nothing holds."""
    case = Case(engine, settings)
    for stiffness in STIFFNESSES:
        rope = RopeParameters(1.0, 0.01, 0.2, stiffness, stiffness, bending_damping=0.1 * stiffness)
        scene = Scene(
            "fall", RopeModel("capsule_chain", links), rope, (still_hand(0),), floor=False, gravity=GRAVITY
        )
        scene = settings.of(scene, PERIOD)
        tags = {"bending_stiffness": stiffness}
        try:
            start = state_of(scene, bent_qpos(scene, np.array([0, 0, 9.0]), np.zeros(links))[None], False)
        except ValueError as error:
            yield refused(case, "fall_acceleration", GRAVITY, "m/s^2", error, tags)
            continue
        states = list(record(engine_of(scene, engine), start, round(SECONDS / PERIOD)))
        height = points_of(scene, states)[:, 0, :, 2].mean(-1)
        times = np.arange(len(states)) * scene.control_period
        found = 2 * (height[0] - height[-1]) / (times[-1] * (times[-1] + scene.timestep))
        yield case.found("fall_acceleration", found, GRAVITY, "m/s^2", tags=tags)
