"""Where rope and grippers sit in a model's arrays, what is read off them, and how grippers are commanded."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.crossing import enters
from doojax.geometry.sdf import signed_distance
from doojax.simulation.rope import link_name
from doojax.simulation.scenes import Scene
from doojax.types import Obstacles, RopeState

if TYPE_CHECKING:
    import mujoco

MOST_STEPS = 10


@dataclass(frozen=True, eq=False)
class Layout:
    """Index arrays into a model of one scene."""

    links: np.ndarray  # [N] body ids
    link_geom: int  # one of the links' capsules or spheres: all are alike
    grippers: np.ndarray  # [G] body ids
    gripper_qpos: np.ndarray  # [G, D] addresses of the world coordinates; D is 2 in a planar scene
    hold_sites: np.ndarray  # [G] on the rope

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    @property
    def _values(self) -> tuple:
        return tuple((np.shape(value), np.asarray(value).tobytes()) for value in vars(self).values())

    @classmethod
    def of(cls, scene: Scene, model: "mujoco.MjModel") -> "Layout":
        """Look the names up once."""
        axes = "xy" if scene.planar else "xyz"
        count = range(len(scene.grippers))
        return cls(
            links=np.array([model.body(link_name(i)).id for i in range(scene.rope_model.links)]),
            link_geom=model.geom(link_name(0)).id,
            grippers=np.array([model.body(f"gripper{g}").id for g in count], dtype=int),
            gripper_qpos=np.array(
                [[model.joint(f"gripper{g}_{a}").qposadr[0] for a in axes] for g in count], dtype=int
            ).reshape(len(scene.grippers), len(axes)),
            hold_sites=np.array([model.site(f"gripper{g}_hold").id for g in count], dtype=int),
        )


class Observation(eqx.Module):
    """Poses of rope and grippers, world frame, metres."""

    rope: RopeState
    half_links: Float[Array, "*b N 3"]  # from a link's centre to where its front cap begins
    hold_points: Float[Array, "*b G 3"]  # the points of the rope that the grippers hold
    radius: Float[Array, "*b"]  # of the rope


def read_observation(
    layout: Layout,
    geom_size: Float[Array, "*b geoms 3"],
    xpos: Float[Array, "*b bodies 3"],
    xmat: Float[Array, "*b bodies 3 3"],
    site_xpos: Float[Array, "*b sites 3"],
) -> Observation:
    """Read rope and grippers off MuJoCo's sizes, body and site poses; batch axes first."""
    half_length = geom_size[..., layout.link_geom, 1][..., None, None]  # zero for spheres
    return Observation(
        rope=RopeState(points=xpos[..., layout.links, :], grippers=xpos[..., layout.grippers, :]),
        half_links=xmat[..., layout.links, :, :][..., 0] * half_length,
        hold_points=site_xpos[..., layout.hold_sites, :],
        radius=geom_size[..., layout.link_geom, 0],
    )


def read_sensors(
    scene: Scene,
    half_length: Float[Array, "*b"],
    radius: Float[Array, "*b"],
    values: Float[Array, "*b sensors"],
) -> Observation:
    """Read rope and grippers off the sensors of a model built ``with_sensors``."""
    links, grippers = scene.rope_model.links, len(scene.grippers)
    at = values.reshape(*values.shape[:-1], -1, 3)
    points, axes, hands, holds = jnp.split(at, np.cumsum([links, links, grippers]), axis=-2)
    return Observation(RopeState(points, hands), axes * half_length[..., None, None], holds, radius)


def clearance(scene: Scene, obstacles: Obstacles, seen: Observation) -> Float[Array, ""]:
    """Least distance between rope or grippers and the obstacles, metres; negative when inside.

    Links are sampled at their centre, ends and half way: an edge between two samples is missed by less than
    pitch^2 / (128 radius), 1 mm for the thickest link here.
    """
    points, radii = _samples(scene, seen)
    return jnp.min(signed_distance(obstacles, points) - radii)


def watch(
    scene: Scene, obstacles: Obstacles, seen: Observation, periods: int
) -> tuple[Float[Array, "B T1"], Bool[Array, "B T"]]:
    """What happened between the states of T control periods, from K = T n + 1 looks at equal intervals.

    Args:
        scene: of all elements.
        obstacles: [B, M].
        seen: [B, K].
        periods: T.

    Returns:
        `clearance` at the first look, then the least in each period (m), its end included; and whether
        something entered an obstacle in the period by more than its own radius, or went right through: a
        sample of `clearance`, moved straight from one look to the next, meets an obstacle. The least is then
        at most minus the radius, even if the looks saw it on either side.
    """
    points, radii = jax.vmap(jax.vmap(lambda one: _samples(scene, one)))(seen)  # [B, K, P, 3], [B, K, P]
    distance = jax.vmap(signed_distance)(obstacles, points)
    near = jnp.min(distance - radii, axis=-1)
    least = near[:, 1:].reshape(len(near), periods, -1).min(-1)
    way = jnp.linalg.norm(points[:, 1:] - points[:, :-1], axis=-1)
    # who goes to an obstacle and away again has gone at least both distances; hardly ever anybody might have
    possible = distance[:, :-1] + distance[:, 1:] < way
    entered = jax.lax.cond(
        possible.any(),
        lambda: jax.vmap(enters)(obstacles, points[:, :-1], points[:, 1:]).any(-1),
        lambda: jnp.zeros(near[:, 1:].shape, dtype=bool),
    )
    entered = entered.reshape(len(near), periods, -1).any(-1)
    least = jnp.where(entered, jnp.minimum(least, -radii.min((1, 2))[:, None]), least)
    return jnp.concatenate([near[:, :1], least], axis=1), entered


def look_every(scene: Scene) -> int:
    """Physics steps between two looks of `watch`: a divisor of a period's, at most `MOST_STEPS`."""
    return max(steps for steps in range(1, MOST_STEPS + 1) if scene.substeps % steps == 0)


def _samples(scene: Scene, seen: Observation) -> tuple[Float[Array, "P 3"], Float[Array, "P"]]:
    """Points on the links' axes and the grippers' centres, and the radius around each."""
    steps = jnp.linspace(-1.0, 1.0, 5)[:, None, None]
    links = (seen.rope.points + steps * seen.half_links).reshape(-1, 3)
    radii = jnp.array([gripper.radius for gripper in scene.grippers], dtype=links.dtype)
    return (
        jnp.concatenate([links, seen.rope.grippers]),
        jnp.concatenate([jnp.full(len(links), seen.radius), radii]),
    )


def stretch(scene: Scene, holding: Bool[Array, "G"], seen: Observation) -> Float[Array, ""]:
    """By what fraction of its length the rope is too long, the gaps to the grippers that hold it included."""
    length = scene.rope.length
    gaps = jnp.where(holding, jnp.linalg.norm(seen.hold_points - seen.rope.grippers, axis=-1), 0.0).sum()
    if scene.rope_model.kind != "point_masses":
        return gaps / length  # the links of a chain are rigid
    pitch = length / scene.rope_model.links
    steps = jnp.linalg.norm(seen.rope.points[1:] - seen.rope.points[:-1], axis=-1)
    return (gaps + (steps - pitch).sum()) / length


def gripper_targets(scene: Scene, hand: Any, commanded: Any, action: Any, xp: Any = jnp) -> Any:
    """Where each gripper is sent at each of S physics steps of a control period, ``[*b, S, G, D]``, metres.

    The target moves by the action, in a straight line at the gripper's maximum speed, and then stays. It sets
    out from where the gripper was last sent, so that a load that keeps the hand from getting there quite does
    not make it sink from action to action; but it leads the hand, along each axis, by no more than the
    controller's greatest force needs: a hand held back by an obstacle turns round at once.

    Args:
        scene: whose grippers.
        hand: ``[*b, G, D]``, where the grippers are, m.
        commanded: ``[*b, G, D]``, where they were last sent, m.
        action: ``[*b, G, D]``, displacements, m.
        xp: jax.numpy or numpy.
    """
    lead = xp.array([[gripper.lead] for gripper in scene.grippers], dtype=hand.dtype)
    start = xp.clip(commanded, hand - lead, hand + lead)
    square = (action**2).sum(-1)
    short = square < 1e-18  # m^2; at zero the square root has no derivative
    distance = xp.where(short, 1e-9, xp.where(short, 1.0, square) ** 0.5)
    speed = xp.array([gripper.max_speed for gripper in scene.grippers], dtype=hand.dtype)
    elapsed = xp.arange(1, scene.substeps + 1, dtype=hand.dtype) * scene.timestep
    fraction = xp.minimum(elapsed[:, None] * (speed / distance)[..., None, :], 1.0)
    return start[..., None, :, :] + fraction[..., None] * action[..., None, :, :]
