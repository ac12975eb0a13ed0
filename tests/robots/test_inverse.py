"""Inverse kinematics: reachable poses of both arms, limits, ranking, and answers where there are none."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.robots import IkSettings, dual_arm, inverse_kinematics, tool_poses

from .test_kinematics import within_limits

ARMS = dual_arm()
PRESENT = jnp.zeros(20)
COUNT = 1000


@partial(jax.jit, static_argnums=0)
def solved(tool, positions, quaternions, keys):
    def one(position, quaternion, key):
        return inverse_kinematics(ARMS, tool, position, PRESENT, key, quaternion)

    return jax.vmap(one)(positions, quaternions, keys)


@partial(jax.jit, static_argnums=0)
def reached(tool, positions, keys):
    return jax.vmap(lambda position, key: inverse_kinematics(ARMS, tool, position, PRESENT, key))(
        positions, keys
    )


@jax.jit
def tools_at(joints):
    return jax.vmap(lambda q: tool_poses(ARMS, q))(joints)


def keys():
    return jax.random.split(jax.random.key(0), COUNT)


def check(found, tool, places, turns=None):
    """At least 98 % are solved, what is said of them is so, and the best come first."""
    done, travel = np.asarray(found.solved), np.asarray(found.travel)
    assert done[:, 0].mean() >= 0.98, done[:, 0].mean()
    best = np.asarray(found.joints[:, 0])
    assert (best >= ARMS.low).all() and (best <= ARMS.high).all()
    index = ARMS.tool(tool)
    others = np.setdiff1d(np.arange(20), ARMS.chain(ARMS.tool_links[index]))
    assert (best[:, others] == 0).all()  # what does not carry the tool stays
    there, turned = (np.asarray(values[:, index]) for values in tools_at(best))
    off = np.linalg.norm(there - places, axis=-1)
    assert off == pytest.approx(np.asarray(found.error[:, 0]), abs=1e-5)
    assert off[done[:, 0]].max() < 1e-3 + 1e-5
    if turns is not None:
        across = np.linalg.norm(turned - np.sign((turned * turns).sum(-1))[:, None] * turns, axis=-1)
        assert 2 * across[done[:, 0]].max() < 1e-2 + 1e-4  # half of a small angle
    assert (done[:, :-1] >= done[:, 1:]).all()
    assert (travel[:, :-1] <= travel[:, 1:])[done[:, :-1] & done[:, 1:]].all()
    assert travel[:, 0] == pytest.approx(np.linalg.norm(best, axis=-1), abs=1e-4)


@pytest.mark.parametrize("tool", ["left", pytest.param("right", marks=pytest.mark.slow)])
def test_reachable_places_are_reached(tool):
    places = np.asarray(tools_at(within_limits(ARMS, COUNT, 3))[0][:, ARMS.tool(tool)])
    check(reached(tool, places, keys()), tool, places)


@pytest.mark.parametrize("tool", [pytest.param("left", marks=pytest.mark.slow), "right"])
def test_reachable_poses_are_reached(tool):
    places, turns = (np.asarray(v[:, ARMS.tool(tool)]) for v in tools_at(within_limits(ARMS, COUNT, 4)))
    check(solved(tool, places, turns, keys()), tool, places, turns)


def test_an_unreachable_place_is_an_answer():
    found = reached("left", np.tile(np.array([0, 9.0, 0.3], np.float32), (COUNT, 1)), keys())
    assert not found.solved.any() and jnp.isfinite(found.joints).all()
    assert (found.error[:, :-1] <= found.error[:, 1:] + 1e-6).all()
    assert 7.5 < float(found.error.min()) < 8.6  # stretched towards it
    with pytest.raises(
        ValueError, match=r"1000 of 1000 poses are not reached: .* stays [78]\.\d+ m and 0 rad"
    ):
        found.check()


def test_joints_already_there_stay():
    found = reached("left", np.tile(tools_at(np.zeros((1, 20)))[0][0, 0], (COUNT, 1)), keys())
    found.check()
    assert float(found.travel[:, 0].max()) < 1e-4


def test_bad_input_is_told():
    with pytest.raises(ValueError, match="unknown tool 'hand', expected one of left, right"):
        inverse_kinematics(ARMS, "hand", jnp.zeros(3), PRESENT, jax.random.key(0))
    beyond = PRESENT.at[ARMS.joints.index("left_elbow")].set(1.5)
    with pytest.raises(
        ValueError, match=r"joint 'left_elbow' is at 1\.5, expected within its limits, -4 to 1"
    ):
        inverse_kinematics(ARMS, "left", jnp.zeros(3), beyond, jax.random.key(0))
    with pytest.raises(ValueError, match="starts is 0, expected 1 to"):
        IkSettings(starts=0)
    with pytest.raises(ValueError, match=r"damping is 0\.0, expected more than 0"):
        IkSettings(damping=0.0)
