"""Many poses at once: those that the present joints do not lead to get more starts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.robots import IkSettings, read_robot, solve_poses, tool_poses

from .test_kinematics import ODD_MODEL, within_limits

ODD = read_robot(ODD_MODEL, ("tip",))
SETTINGS = IkSettings(starts=12, iterations=20)
COUNT = 100
PLACES = jax.jit(jax.vmap(lambda q: tool_poses(ODD, q)[0][0]))


def test_more_starts_solve_more_and_what_was_solved_stays():
    joints = within_limits(ODD, COUNT, 1)
    places = PLACES(joints)
    alone = solve_poses(ODD, "tip", places, ODD.zero, jax.random.key(0), settings=replace(SETTINGS, starts=1))
    found = solve_poses(ODD, "tip", places, ODD.zero, jax.random.key(0), settings=SETTINGS)
    before, after = np.asarray(alone.solved[:, 0]), np.asarray(found.solved[:, 0])
    assert before.mean() < 0.9 < 0.98 <= after.mean()
    assert np.array_equal(alone.joints[before], found.joints[before])
    there = PLACES(np.asarray(found.joints[:, 0]))
    off = np.linalg.norm(np.asarray(there - places), axis=-1)
    assert off == pytest.approx(np.asarray(found.error[:, 0]), abs=1e-5)
    best = np.asarray(found.joints[:, 0])
    assert (best >= np.asarray(ODD.low)).all() and (best <= np.asarray(ODD.high)).all()
    with pytest.raises(ValueError, match="unknown tool 'hand'"):
        solve_poses(ODD, "hand", jnp.zeros((1, 3)), ODD.zero, jax.random.key(0))
