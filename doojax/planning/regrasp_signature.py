"""The grasp loop signature of arms that hold a rope which is fastened somewhere. Frames: the base's, m."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from doojax.robots import Robot, link_poses, tool_poses
from doojax.topology.grasp_loops import Grasps, signature
from doojax.topology.signatures import Signature
from doojax.topology.skeletons import Skeleton

AFTER = 1e-5  # along the rope
UNDERGROUND = -0.8  # m, below which the loop from the base to where a rope is fastened runs, as in the thesis


def grasps_of(
    robot: Robot,
    joints: Float[Array, "J"],
    rope: Float[Array, "N1 3"],
    places: Float[Array, "G"],
    fastened: Float[Array, "3"],
) -> Grasps:
    """The graph of a state. The path of an arm goes through the origins of its links to its tool.

    Args:
        robot: with G tools.
        joints: rad.
        rope: where its equal links meet; it is fastened by its beginning.
        places: along the rope, that each tool holds; NaN for nothing.
        fastened: where.
    """
    links, _ = link_poses(robot, joints)
    tools, _ = tool_poses(robot, joints)
    chains = [robot.chain(link) for link in robot.tool_links]
    longest = max(map(len, chains))
    rows = np.array([[*chain, *([chain[-1]] * (longest - len(chain)))] for chain in chains])
    paths = jnp.concatenate([links[rows], tools[:, None]], axis=1)
    under = jnp.array([[0.0, 0.0, UNDERGROUND]])
    below = fastened[None].at[:, 2].set(UNDERGROUND)
    holds = ~jnp.isnan(places)
    return Grasps(
        rope=rope,
        base=jnp.zeros(3),
        gripper_paths=paths,
        # a hand at the fastening comes after it along the rope: else its loop with the next hand would be one
        # of the fastening's, and two hands that are linked with nothing would count as another signature
        gripper_locations=jnp.where(holds, jnp.maximum(places, AFTER), 0),
        gripping=holds,
        attachment_paths=jnp.concatenate([under, below, fastened[None]])[None],
        attachment_locations=jnp.zeros(1),
        attached=jnp.ones(1, bool),
    )


def signatures_of(
    robot: Robot,
    joints: Float[Array, "C J"],
    rope: Float[Array, "C N1 3"],
    places: Float[Array, "C G"],
    fastened: Float[Array, "3"],
    skeleton: Skeleton,
) -> Signature:
    """Of C states in one scene."""

    def one(joints: Array, rope: Array, places: Array) -> Signature:
        return signature(grasps_of(robot, joints, rope, places, fastened), skeleton)

    return jax.vmap(one)(joints, rope, places)
