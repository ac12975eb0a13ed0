"""Trials of a container: what was poured and spilled, what touches, and in which words."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.trials.records import Look, TrialRecord
from doojax.experiments.trials.touching import gaps
from doojax.experiments.trials.volumes import said_of, volumes_of
from doojax.keys import stream
from doojax.tasks import make_task
from doojax.types import Obstacles, PouringState
from doojax.viewer.episodes import no_obstacles
from tests.records import record_of


def seen(poured, kept, x=0.1):
    """A state whose container is upright at a height of 30 cm."""
    size = jnp.array([0.141, 0.13])
    place, volumes = jnp.array([x, 0.0, 0.3]), jnp.array([poured, kept])
    return PouringState(place, jnp.zeros(()), jnp.array([0.5, 0.0, 0.02]), volumes, size)


def record(*states, **more) -> TrialRecord:
    bodies = np.stack([np.asarray(state.bodies()) for state in states])
    goal = make_task("watering_2d").sample_goal(stream(0, "goal"), no_obstacles())
    return record_of(
        bodies[:, :3],
        look=Look.of(make_task("watering_2d").scene),
        goal=np.asarray(goal.targets[0]),
        goal_point=0,
        grippers=bodies[:, 3:],
        about={"more_targets": np.asarray(goal.targets[1:]).tolist()},
        **more,
    )


def test_volumes_are_read_from_the_gauges():
    found = volumes_of(record(seen(0.0, 1.0), seen(0.5, 0.4), seen(0.76, 0.2)))
    np.testing.assert_allclose(found, [[0.0, 0.0], [0.5, 0.1], [0.76, 0.04]], atol=1e-5)
    assert said_of(0.76, 0.04) == "76 % poured, 4 % spilled"


def test_a_rope_pours_nothing():
    with pytest.raises(ValueError, match="pours nothing, expected one of a container"):
        volumes_of(record_of(np.zeros((2, 3, 3))))


def test_what_touches_is_the_container_and_no_gauge():
    one = record(seen(0.0, 1.0))
    beside = [0.1 + 0.141 / 2 + 0.05, 0.0, 0.35]  # 5 cm right of its right wall
    gauge = [0.5, -1.0, 0.02]
    obstacles = Obstacles(
        jnp.zeros(2, int),
        jnp.array([beside, gauge]),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (2, 1)),
        jnp.full((2, 3), 0.02),
        jnp.ones(2, bool),
    )
    found = gaps(obstacles, one.points[0], one.grippers[0], one.look)
    assert found[0] == pytest.approx(0.03 - one.look.rope_radius, abs=1e-5)
    assert found[1] > 0.5 and one.shown_point == 2
