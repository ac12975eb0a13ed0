"""What of candidates is computed at once for all of them, compiled: signatures, and terms of equation 5.3."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.experiments.regrasping.world import World
from doojax.planning import regrasp_costs as costs
from doojax.planning.regrasp_signature import signatures_of
from doojax.robots import Robot
from doojax.simulation.state import SimState
from doojax.topology.signatures import Blocklist, Signature, same
from doojax.topology.skeletons import Skeleton


@eqx.filter_jit
def signatures_here(
    robot: Robot, joints: Array, rope: Array, places: Array, fastened: Array, skeleton: Skeleton
) -> Signature:
    """`signatures_of`, compiled."""
    return signatures_of(robot, joints, rope, places, fastened, skeleton)


def signature_now(world: World, state: SimState) -> Signature:
    """Of one state."""
    seen = world.seen_one(state)
    places = np.array(world.places(state), np.float32)
    many = signatures_here(
        world.robot,
        jnp.asarray(seen.joints[None]),
        jnp.asarray(seen.rope[None]),
        jnp.asarray(places[None]),
        jnp.asarray(world.fastened),
        world.skeleton,
    )
    return jax.tree.map(lambda leaf: leaf[0], many)


@eqx.filter_jit
def priced(
    places: Float[Array, "C G"],
    keypoint: Float[Array, ""],
    before: Float[Array, "N 3"],
    after: Float[Array, "C N 3"],
    weights: costs.RegraspWeights,
) -> tuple[Float[Array, "C"], Float[Array, "C"]]:
    """By how far from the keypoint hands are, and by how far the rope moves."""
    geodesics = jax.vmap(lambda own: costs.far_from_keypoint(own, keypoint, weights))(places)
    return geodesics, jax.vmap(lambda own: costs.rope_motion(before, own, weights))(after)


@eqx.filter_jit
def blocklisted(
    signatures: Signature, blocklist: Blocklist, weights: costs.RegraspWeights
) -> Float[Array, "C"]:
    """By whether signatures were tried."""
    return jax.vmap(lambda one: costs.blocklisted(one, blocklist, weights))(signatures)


@eqx.filter_jit
def off_goal(signatures: Signature, goal: Signature, weights: costs.RegraspWeights) -> Float[Array, "C"]:
    """By how far signatures are from the one that is wanted."""
    return jax.vmap(lambda one: costs.other_signature(one, goal, weights))(signatures)


@eqx.filter_jit
def fitting(signatures: Signature, goal: Signature) -> Bool[Array, "C"]:
    """Which signatures are the one that is wanted, for sure."""
    return jax.vmap(lambda one: same(one, goal) & ~one.touching)(signatures)


class Clock:
    """Seconds by name."""

    def __init__(self):
        """Start."""
        self.seconds: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, name: str) -> None:
        """Since the last one."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now
