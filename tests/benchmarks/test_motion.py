"""The rack's two collision checks agree, paths are checked where they should be, and OMPL plans the same."""

from itertools import pairwise

import numpy as np
import pytest

from doojax.benchmarks import motion as bench
from doojax.benchmarks.rack import BOXES, MujocoCheck, rack
from doojax.robots import dual_arm

CHECK = MujocoCheck()
ROBOT = dual_arm()


def posture(**joints: float) -> np.ndarray:
    found = np.zeros(20)
    for name, value in joints.items():
        found[ROBOT.joints.index(name)] = value
    return found


def clipped(joints: np.ndarray) -> np.ndarray:
    return np.clip(joints, ROBOT.low, ROBOT.high)


def drawn(count: int, seed: int) -> list[np.ndarray]:
    """Joints within their limits."""
    return [clipped(joints) for joints in np.random.default_rng(seed).uniform(-1, 1, (count, 20))]


def test_mujoco_sees_the_rack_the_floor_and_the_robot():
    assert CHECK.model.ngeom == len(BOXES) + 1 + 1 + len(ROBOT.capsule_links)
    assert CHECK.is_free(np.zeros(20))  # the tools are in front of the box on the rack
    inward = posture(left_shoulder_3=-1.0, right_shoulder_3=1.0)
    assert not CHECK.is_free(inward)  # the arms meet
    assert 5 < sum(map(CHECK.is_free, drawn(200, 0))) < 195


@pytest.mark.slow
def test_both_checks_agree():
    import jax

    from doojax.robots import clearance

    joints = np.clip(np.random.default_rng(1).uniform(-1.5, 1.5, (200, 20)), ROBOT.low, ROBOT.high)
    ours = jax.jit(jax.vmap(lambda one: clearance(ROBOT, one, rack(), -0.445)))(joints.astype(np.float32))
    for one, distance in zip(joints, np.asarray(ours), strict=True):
        if abs(distance) > 1e-4:
            assert CHECK.is_free(one) == (distance > 0)


def test_a_path_is_checked_between_its_waypoints():
    free = [joints for joints in drawn(400, 2) if CHECK.is_free(joints)]
    verdicts = set()
    for begin, end in pairwise(free):
        before = CHECK.count
        verdict = bench.is_path_free(np.stack([begin, end]), CHECK)
        verdicts.add(verdict)
        expected = all(CHECK.is_free(begin + f * (end - begin)) for f in np.linspace(0, 1, 22))
        assert verdict == expected
        if verdict:
            assert CHECK.count - before == 44
    assert verdicts == {True, False}


def test_ompl_finds_a_way_that_mujoco_calls_free():
    pytest.importorskip("ompl")
    random, free = np.random.default_rng(3), []
    while len(free) < 2:
        joints = clipped(random.uniform(-1, 1, 20))
        joints[[n for n, name in enumerate(ROBOT.joints) if "finger" in name]] = 0
        if CHECK.is_free(joints):
            free.append(joints)
    found = bench.Ompl().solve(*free)
    assert found.solved and found.checks > len(found.path)
    assert all(CHECK.is_free(joints) for joints in found.path)
    fingers = [n for n, name in enumerate(ROBOT.joints) if "finger" in name]
    assert np.abs(found.path[:, fingers]).max() == 0
    np.testing.assert_allclose(found.path[[0, -1]], np.stack(free), atol=1e-6)


def test_too_few_queries_are_refused():
    with pytest.raises(ValueError, match="there are 1 queries, expected at least 2"):
        bench.motion(queries=1)
