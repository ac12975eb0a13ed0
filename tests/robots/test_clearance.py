"""Distances of the robot beside MuJoCo's between the same shapes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from doojax.robots import (
    DUAL_ARM,
    are_free,
    capsule_ends,
    clearance,
    dual_arm,
    floor_distances,
    is_free,
    obstacle_distances,
    read_robot,
    self_distance,
    travel,
)
from doojax.types import Obstacles

from .test_kinematics import ODD_MODEL, within_limits

ARMS = dual_arm()
BOX = Obstacles(
    jnp.zeros(1, int),
    jnp.array([[0.1, 0.5, 0.3]]),
    jnp.array([[1.0, 0, 0, 0]]),
    jnp.array([[0.2, 0.1, 0.3]]),
    jnp.ones(1, bool),
)
FLOOR = -0.445


@jax.jit
@jax.vmap
def distances(joints):
    return (
        obstacle_distances(ARMS, joints, BOX),
        self_distance(ARMS, joints),
        floor_distances(ARMS, joints, FLOOR),
        clearance(ARMS, joints, BOX, FLOOR),
    )


def test_distances_are_mujocos():
    joints = within_limits(ARMS, 20)
    spec = mujoco.MjSpec.from_file(str(DUAL_ARM))
    kind = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(type=kind, size=BOX.half_size[0], pos=BOX.centre[0], name="box")
    model = spec.compile()
    data = mujoco.MjData(model)
    names = [model.geom(g).name for g in range(model.ngeom) if model.geom_bodyid[g]]
    pairs = [(names[i], names[j]) for i, j in ARMS.pairs]
    links = zip(names, ARMS.capsule_links, strict=True)
    pairs += [(name, "stand") for name, link in links if ARMS.parents[link] >= 0]
    assert len(pairs) > 200
    to_box, to_self, to_floor, least = map(np.asarray, distances(joints))
    apart = 0

    def between(a, b):
        return mujoco.mj_geomDistance(model, data, model.geom(a).id, model.geom(b).id, 10, None)

    for row, values in enumerate(joints):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        expected = np.array([between(name, "box") for name in names])
        outside = expected > 0  # inside, MuJoCo's depth is another one
        assert to_box[row][outside] == pytest.approx(expected[outside], abs=2e-5)
        assert (to_box[row][~outside] <= 1e-5).all()
        own = min(between(*pair) for pair in pairs)
        assert (own > 0) == (to_self[row] > 0)
        if own > 0:
            apart += 1
            assert to_self[row] == pytest.approx(own, abs=2e-5)
        capsules = [(data.geom(name), model.geom(name).size) for name in names]
        lowest = min(geom.xpos[2] - abs(geom.xmat[8]) * size[1] - size[0] for geom, size in capsules)
        assert to_floor[row].min() == pytest.approx(lowest - FLOOR, abs=1e-5)
        parts = to_box[row].min(), to_self[row], to_floor[row].min()
        assert least[row] == pytest.approx(min(parts), abs=1e-6)
    assert apart > 2


def shapes(seed: int) -> Obstacles:
    """Of all kinds, anyhow turned, around the arms; one that counts for nothing is where they are."""
    random = np.random.default_rng(seed)
    turned = random.normal(size=(10, 4))
    centre = random.uniform([-0.8, 0.2, -0.4], [0.8, 1.0, 1.0], (10, 3))
    centre[9] = [0, 0.1, 0.1]
    return Obstacles(
        jnp.arange(10) % 3,
        jnp.asarray(centre, jnp.float32),
        jnp.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True), jnp.float32),
        jnp.asarray(random.uniform(0.03, 0.15, (10, 3)), jnp.float32).at[:, 1].set(0.08).at[:, 0].set(0.08),
        jnp.arange(10) < 9,
    )


def test_what_is_called_free_is_and_little_else_is_not():
    joints = jnp.concatenate([within_limits(ARMS, 90, 2) * 0.4, within_limits(ARMS, 30, 3)])
    exact = np.asarray(jax.jit(jax.vmap(lambda q: clearance(ARMS, q, BOX, FLOOR)))(joints))
    called = np.asarray(jax.jit(jax.vmap(lambda q: is_free(ARMS, q, BOX, 0.01, FLOOR)))(joints))
    assert 10 < called.sum() < 110
    assert exact[called].min() > 0.01
    # the longest axis of a capsule is 0.32 m, of which 1/256 may be missing
    assert exact[~called].max() < 0.01 + 0.32 / 256 + 1e-5


MANY = jax.jit(lambda joints, obstacles, margin: are_free(ARMS, joints, obstacles, margin, FLOOR))


@pytest.mark.slow
def test_many_are_free_where_each_is():
    exact_of = jax.jit(jax.vmap(lambda q, o: clearance(ARMS, q, o, FLOOR), in_axes=(0, None)))
    joints = jnp.concatenate([within_limits(ARMS, 150, 4) * 0.4, within_limits(ARMS, 50, 5) * 0.8])
    for seed in range(3):
        exact = np.asarray(exact_of(joints, shapes(seed)))
        # as far as the capsules of some are from what is around them: what decides is on either side
        margin = np.where(np.arange(200) % 2, np.clip(exact - 2e-4, -0.02, 0.2), 0.01).astype(np.float32)
        called = np.asarray(MANY(joints, shapes(seed), margin))
        assert 40 < called.sum() < 180
        assert (exact > margin)[called].all()
        assert (exact[~called] < margin[~called] + 0.32 / 256 + 1e-5).all()


def test_what_is_deep_inside_is_not_free():
    around = Obstacles(
        jnp.zeros(1, int),
        jnp.zeros((1, 3)),
        jnp.array([[1.0, 0, 0, 0]]),
        jnp.full((1, 3), 9.0),
        jnp.ones(1, bool),
    )
    ten = jnp.broadcast_to(around.half_size, (10, 3))
    inside = Obstacles(
        *(jnp.repeat(leaf, 10, 0) for leaf in (around.kind, around.centre, around.quaternion)),
        ten,
        jnp.arange(10) == 3,
    )
    joints = within_limits(ARMS, 200, 6)
    assert not MANY(joints, inside, np.zeros(200, np.float32)).any()


def test_arms_at_rest_touch_nothing_and_arms_that_meet_do():
    at = ARMS.joints.index
    inward = jnp.zeros(20).at[at("left_shoulder_3")].set(-1.0).at[at("right_shoulder_3")].set(1.0)
    batch = jnp.concatenate([jnp.zeros((19, 20)), inward[None]])
    found = distances(batch)[1]
    assert float(found[0]) > 0 and float(found[-1]) < 0


def test_shapes_that_are_no_capsules_are_covered():
    robot = read_robot(ODD_MODEL, ("tip",))
    assert robot.base.kind.tolist() == [2]
    assert np.asarray(robot.base.half_size[0]) == pytest.approx([0.1, 0.1, 0.2])
    # the box of 0.05, 0.1, 0.02: along its longest side, around the others
    expected = np.array([0.05**2 + 0.02**2, 0.03**2, 0.02**2]) ** 0.5
    assert np.asarray(robot.capsule_radius) == pytest.approx(expected)
    lengths = np.linalg.norm(robot.capsule_ends[1] - robot.capsule_ends[0], axis=-1)
    assert lengths == pytest.approx([0.2, 0, 0], abs=1e-6)


def test_nothing_moves_farther_than_is_said():
    """Ends of capsules of random motions; of one hinge, the tools are at nearly the whole arm's length."""
    begin, end = within_limits(ARMS, 64, seed=1), within_limits(ARMS, 64, seed=2)
    ends = jax.jit(jax.vmap(lambda q: capsule_ends(ARMS, q)))
    moved = np.linalg.norm(np.asarray(ends(end) - ends(begin)), axis=-1).max(1)
    most = np.asarray(travel(ARMS, jnp.asarray(end - begin)))
    assert (moved <= most + 1e-5).all()
    torso = jnp.zeros(len(ARMS.joints)).at[0].set(0.01)
    small = np.linalg.norm(np.asarray(ends(begin + np.asarray(torso)) - ends(begin)), axis=-1).max((0, 1))
    most = np.asarray(travel(ARMS, torso))
    assert 0.3 * most.max() < small.max() and (small <= most + 1e-6).all()
    assert not np.asarray(travel(ARMS, jnp.zeros(len(ARMS.joints)))).any()


@pytest.mark.slow
def test_slack_is_room_for_each_capsule():
    """As much as capsules that are as much thicker; of two that may meet each has its own."""
    joints = within_limits(ARMS, 200, seed=3) * 0.3
    for name, out in (("left_shoulder_2", 0.4), ("right_shoulder_2", -0.4)):  # elbows are near at zero
        joints[:, ARMS.joints.index(name)] += out
    slack = np.random.default_rng(4).uniform(0, 0.015, (200, len(ARMS.capsule_radius))).astype(np.float32)
    found = np.asarray(are_free(ARMS, jnp.asarray(joints), BOX, 0.0, FLOOR, jnp.asarray(slack)))
    one = jax.jit(
        lambda q, more: are_free(
            eqx.tree_at(lambda r: r.capsule_radius, ARMS, ARMS.capsule_radius + more),
            q[None],
            BOX,
            0.0,
            FLOOR,
        )[0]
    )
    thicker = np.array([one(q, more) for q, more in zip(joints, slack, strict=True)])
    assert np.array_equal(found, thicker) and 0.05 < found.mean() < 0.95
