"""Cups that are shaken keep their fluid, and walls that came through it would be told."""

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.benchmarks import shaken_fluid
from doojax.benchmarks.shaken_fluid import shaken_rows


@pytest.mark.slow
def test_a_few_cups_keep_their_fluid(monkeypatch):
    monkeypatch.setattr(shaken_fluid, "STEPS", 40)
    found = {row.metric: row for row in shaken_rows(trajectories=3, count=20)}
    assert found["passed_walls"].value == 0 and found["passed_walls"].n == 3
    assert found["nearest_wall"].value >= 0.999  # of a radius
    assert found["faulty"].value == 0


def test_a_wall_moves_as_its_cup_turns():
    """Half a radian a second about the middle of the floor: what is above it goes to +x."""
    walls = shaken_fluid._moving(jnp.zeros(3), jnp.array([0.1, -0.2, 0.5]))
    centre, speed = np.asarray(walls.obstacles.centre), np.asarray(walls.velocity)
    np.testing.assert_allclose(speed[:, 0], 0.1 + 0.5 * centre[:, 2], atol=1e-6)
    np.testing.assert_allclose(speed[:, 2], -0.2 - 0.5 * centre[:, 0], atol=1e-6)
    assert np.ptp(speed[:, 0]) > 0.01 and (walls.spin[:, 1] == 0.5).all()
