"""Executing a recorded trial again: from its first state, by its actions."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doojax.experiments.trials.records import TrialRecord
from doojax.simulation.state import SimState, Simulator
from doojax.simulation.tracking import Tracked, Tracking
from doojax.tasks.base import observed

MODEL = "model/"  # before the names of model fields, which carry another rope
TRACKING = "tracking"  # the name of the random key of a robot's errors
REPLAYED = ("qpos", "qvel", "commanded", "obstacle_position", "obstacle_quaternion", "holding")


def first_state(start: SimState) -> dict[str, np.ndarray]:
    """What of a trial's start a record keeps, by name."""
    return {
        **{name: np.asarray(getattr(start, name)) for name in REPLAYED},
        **{MODEL + name: np.asarray(values) for name, values in start.model_fields.items()},
    }


def start_of(record: TrialRecord) -> SimState:
    """The first state of a trial, as a batch of one.

    Raises:
        ValueError: for a record that does not hold it.
    """
    if not record.replay:
        raise ValueError(
            "this trial cannot be executed again: its record holds no first state and no actions"
        )
    stored = {name: jnp.asarray(record.replay[name])[None] for name in REPLAYED}
    fields = {
        name.removeprefix(MODEL): jnp.asarray(values)[None]
        for name, values in record.replay.items()
        if name.startswith(MODEL)
    }
    return SimState(**stored, faults=jnp.zeros(1, dtype=jnp.int32), model_fields=fields)


def replay(simulator: Simulator, record: TrialRecord) -> Float[np.ndarray, "T1 N 3"]:
    """The passive bodies (m), such as a rope's points, when a trial is executed again from its first state.

    Raises:
        ValueError: for a record that does not hold them.
    """
    simulator, states = _as_known(simulator, record, start_of(record))
    seen = observed(simulator, states)
    points = [np.asarray(seen.bodies()[0, : seen.passive])]
    for action in record.replay["actions"]:
        states, trajectory = simulator.rollout(states, jnp.asarray(action)[None, None])
        points.append(np.asarray(trajectory.states.bodies()[0, -1, : seen.passive]))
    return np.stack(points)


def _as_known(simulator: Simulator, record: TrialRecord, true: SimState) -> tuple[Simulator, SimState]:
    """The robot that executed a trial, and its first state."""
    if TRACKING not in record.replay:
        return simulator, true
    settings = record.about["tracking"]
    camera = settings["camera"]
    robot = Tracked(simulator, Tracking(**{**settings, "camera": camera and tuple(camera)}))
    keys = jax.random.wrap_key_data(jnp.asarray(record.replay[TRACKING], jnp.uint32))[None]
    return robot, robot.begun(true, keys)
