"""Where rope and grippers sit in a model's arrays, what is read off them, and how grippers are commanded."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.sdf import signed_distance
from doojax.simulation.rope import link_name
from doojax.simulation.scenes import Scene
from doojax.types import Obstacles, RopeState

if TYPE_CHECKING:
    import mujoco


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


def clearance(scene: Scene, obstacles: Obstacles, seen: Observation) -> Float[Array, ""]:
    """Least distance between rope or grippers and the obstacles, metres; negative when inside.

    Links are sampled at their centre, ends and half way: an edge between two samples is missed by less than
    pitch^2 / (128 radius), 1 mm for the thickest link here.
    """
    steps = jnp.linspace(-1.0, 1.0, 5)[:, None, None]
    samples = (seen.rope.points + steps * seen.half_links).reshape(-1, 3)
    rope = jnp.min(signed_distance(obstacles, samples)) - seen.radius
    radii = jnp.array([gripper.radius for gripper in scene.grippers])
    return jnp.minimum(rope, jnp.min(signed_distance(obstacles, seen.rope.grippers) - radii, initial=jnp.inf))


def stretch(scene: Scene, holding: Bool[Array, "G"], seen: Observation) -> Float[Array, ""]:
    """By what fraction of its length the rope is too long, the gaps to the grippers that hold it included."""
    length = scene.rope.length
    gaps = jnp.where(holding, jnp.linalg.norm(seen.hold_points - seen.rope.grippers, axis=-1), 0.0).sum()
    if scene.rope_model.kind != "point_masses":
        return gaps / length  # the links of a chain are rigid
    pitch = length / scene.rope_model.links
    steps = jnp.linalg.norm(seen.rope.points[1:] - seen.rope.points[:-1], axis=-1)
    return (gaps + (steps - pitch).sum()) / length


def gripper_targets(scene: Scene, start: Any, action: Any, xp: Any = jnp) -> Any:
    """Commands of one control period, ``[*b, S, G D]``, from gripper positions and actions ``[*b, G, D]``.

    The target moves in a straight line at the gripper's maximum speed and then stays. ``xp`` is
    jax.numpy or numpy.
    """
    distance = xp.maximum((action**2).sum(-1) ** 0.5, 1e-9)
    speed = xp.array([gripper.max_speed for gripper in scene.grippers])
    elapsed = xp.arange(1, scene.substeps + 1) * scene.timestep
    fraction = xp.minimum(elapsed[:, None] * (speed / distance)[..., None, :], 1.0)
    targets = start[..., None, :, :] + fraction[..., None] * action[..., None, :, :]
    return targets.reshape(*targets.shape[:-2], -1)
