"""The study of watering: what is alike is said by geometry; what cannot be studied is refused."""

import jax
import jax.numpy as jnp
import pytest

from doojax.experiments.sweeps.watering import WateringStudySettings, alike_steps, watering_study
from doojax.keys import numbered, stream
from doojax.learning.data import Trajectories
from doojax.learning.pieces import cut
from doojax.tasks import make_task
from doojax.types import PouringState

CASES = [  # x and z of the container, the action, is that alike?
    ((-0.05, 0.3), (0.1, 0.0, 0.0), True),  # far from the plant
    ((0.25, 0.25), (0.0, 0.0, 2.5), True),  # poured below the canopy
    ((0.3, 0.85), (0.0, 0.0, 2.5), False),  # poured over it
    ((0.0, 0.3), (0.18, 0.2, 0.0), False),  # into the canopy
    ((0.0, 0.85), (0.5, 0.0, 0.0), True),  # past it, above
    ((0.0, 0.6), (0.6, 0.0, 0.0), False),  # through it: the ends are clear
]


def test_what_is_alike_keeps_clear_of_the_plant():
    task = make_task("watering_2d")
    start = jax.vmap(task.simulator().reset)(numbered(stream(0, "test"), range(len(CASES))))
    obstacles = jax.vmap(task.simulator().obstacles)(start)
    place = jnp.array([[x, 0.0, z] for (x, z), _, _ in CASES])
    actions = jnp.array([[[list(action)]] for _, action, _ in CASES])
    count = len(CASES)
    states = PouringState(
        jnp.stack([place, place], axis=1),
        jnp.zeros((count, 2)),
        jnp.broadcast_to(jnp.array([0.5, 0.0, 0.02]), (count, 2, 3)),
        jnp.broadcast_to(jnp.array([0.0, 1.0]), (count, 2, 2)),
        jnp.broadcast_to(jnp.array([0.141, 0.13]), (count, 2, 2)),
    )
    data = Trajectories(states, actions, obstacles, jnp.arange(count))
    assert alike_steps(cut(data, 1)).tolist() == [alike for *_, alike in CASES]


def test_what_cannot_be_studied_is_refused(tmp_path):
    with pytest.raises(ValueError, match="seeds is 0, expected at least 1"):
        watering_study(out=tmp_path, seeds=0)
    with pytest.raises(ValueError, match="methods are ; expected some of focus"):
        watering_study(out=tmp_path, methods=())
    with pytest.raises(ValueError, match="epochs is 0, expected at least 1"):
        WateringStudySettings(epochs=0)
