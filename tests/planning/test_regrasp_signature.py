"""The signature of arms that hold a fastened rope: rings around arm, rope and tether."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.planning.regrasp_signature import grasps_of, signatures_of
from doojax.robots import dual_arm, link_poses, tool_poses
from doojax.topology.skeletons import make_skeleton

ROBOT = dual_arm()
JOINTS = ROBOT.zero
TOOLS = np.asarray(jax.jit(tool_poses)(ROBOT, JOINTS)[0])
NOTHING = float("nan")
FASTENED = np.array([0.0, 1.5, 0.5])


def ring(centre, normal, radius=0.06):
    """A closed ring about a direction."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    angles = np.linspace(0, 2 * np.pi, 13)[:, None]
    around = np.cos(angles) * first + np.sin(angles) * np.cross(normal, first)
    around[-1] = around[0]
    return np.asarray(centre) + radius * around


@pytest.fixture(scope="module")
def vectors():
    """Vectors of the signature with rings about the left tool's link, the rope's middle, and the tether."""
    elbow, _ = jax.jit(link_poses)(ROBOT, JOINTS)
    chain = ROBOT.chain(ROBOT.tool_links[0])
    wrist = np.asarray(elbow)[chain[-1]]
    rings = {
        "left_arm": ring((wrist + TOOLS[0]) / 2, TOOLS[0] - wrist),
        "rope": ring((FASTENED + TOOLS[0]) / 2, FASTENED - TOOLS[0]),
        "tether": ring([0, 1.5, 0.0], [0, 0, 1]),
        "elsewhere": ring([1.0, 1.0, 1.0], [0, 0, 1]),
    }
    skeleton = make_skeleton(rings)

    @jax.jit
    def compiled(rope, places):
        return signatures_of(ROBOT, JOINTS[None], rope, places, FASTENED_, skeleton)

    def inner(places, end=TOOLS[0]):
        rope = np.linspace(FASTENED, end, 9)
        found = compiled(jnp.asarray(rope, jnp.float32)[None], jnp.asarray(places, jnp.float32)[None])
        return jax.tree.map(lambda leaf: leaf[0], found).vectors

    return inner


FASTENED_ = jnp.asarray(FASTENED, jnp.float32)


def test_nobody_holding_the_rope_there_is_no_loop(vectors):
    assert vectors((NOTHING, NOTHING)) == ()


def test_the_loop_runs_along_the_arm_the_rope_and_the_tether(vectors):
    assert vectors((1.0, NOTHING)) == ((1, 1, 1, 0),)


def test_the_other_arm_makes_a_loop_that_misses_the_first(vectors):
    assert vectors((NOTHING, 1.0), end=TOOLS[1]) == ((0, 0, 1, 0),)


def test_a_second_hand_at_the_fastening_that_is_linked_with_nothing_changes_nothing():
    rope = jnp.linspace(FASTENED_, TOOLS[1].astype(np.float32), 9)
    nothing = make_skeleton({})

    @jax.jit
    def compiled(places):
        return signatures_of(ROBOT, JOINTS[None], rope[None], places, FASTENED_, nothing)

    def vectors(places):
        return jax.tree.map(lambda leaf: leaf[0], compiled(jnp.array([places]))).vectors

    assert vectors((NOTHING, 1.0)) == vectors((0.0, 1.0)) == vectors((0.5, 1.0)) == ((),)


def test_the_path_of_an_arm_begins_at_the_base_and_ends_at_its_tool():
    rope = jnp.linspace(FASTENED_, TOOLS[0].astype(np.float32), 5)
    grasps = grasps_of(ROBOT, JOINTS, rope, jnp.array([0.3, NOTHING]), FASTENED_)
    np.testing.assert_allclose(grasps.gripper_paths[:, -1], TOOLS, atol=1e-6)
    assert grasps.gripping.tolist() == [True, False] and not grasps.base.any()
    assert grasps.attachment_paths.shape == (1, 3, 3)
    np.testing.assert_allclose(grasps.attachment_paths[0, :, 2], [-0.8, -0.8, 0.5], atol=1e-6)
