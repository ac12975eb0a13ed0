"""A film of a container that pours: what is to be seen is in its pictures."""

import jax
import numpy as np
import pytest

from doojax.keys import stream
from doojax.simulation.fluid.pouring import split
from doojax.tasks import make_task
from doojax.viewer.pictures import frames
from doojax.viewer.pouring import LEAVES, WATER, Flow, film_from


def near(picture, colour, within):
    """How many pixels have about a colour."""
    return int((np.abs(picture.astype(int) - np.array(colour)).max(-1) < within).sum())


def cup(places, pose):
    """A flow of one moment in the plane."""
    return Flow(make_task("watering_2d").scene, np.insert(places, 1, 0.0, axis=2), pose)


@pytest.mark.slow
def test_fluid_and_plant_are_in_the_picture():
    task = make_task("watering_2d")
    simulator = task.simulator()
    start = simulator.reset(stream(0, "test"))
    flow, pose = (np.asarray(leaf)[None] for leaf in split(task.scene, start.qpos))
    obstacles = simulator.obstacles(start)
    (seen,) = frames(film_from(cup(flow, pose), obstacles, "a cup"), [0.0])
    gone = jax.tree.map(lambda leaf: leaf[:5], obstacles)
    (bare,) = frames(film_from(cup(flow[:, :1] + 5.0, pose), gone, "a cup"), [0.0])
    assert near(seen, WATER, 60) > near(bare, WATER, 60) + 50
    green = [int((one[..., 1].astype(int) > one[..., 0].astype(int) + 30).sum()) for one in (seen, bare)]
    assert LEAVES[1] > LEAVES[0] + 30 and green[0] > green[1] + 1000
