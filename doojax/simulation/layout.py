"""Where the parts of a scene are in a model's arrays, and what is read off them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from doojax.geometry.crossing import enters
from doojax.geometry.sdf import signed_distance
from doojax.simulation.parts.base import Places, Turn, split
from doojax.simulation.scenes import Scene
from doojax.types import ArmsState, Obstacles, PushingState, RopeState

if TYPE_CHECKING:
    import mujoco

MOST_STEPS = 10


@dataclass(frozen=True, eq=False)
class Layout:
    """Index arrays into a model of one scene, by the names of its parts, in their order."""

    nq: int
    nv: int
    places: dict[str, Places]
    driver: str  # the name of the part that actions move

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and self._values == other._values

    def __hash__(self) -> int:
        return hash(self._values)

    @property
    def _values(self) -> tuple:
        every = ((name, *vars(own).items()) for name, own in self.places.items())
        return self.nq, self.nv, *((name, *((f, _bytes(a)) for f, a in fields)) for name, *fields in every)

    @classmethod
    def of(cls, scene: Scene, model: "mujoco.MjModel") -> "Layout":
        """Look the names up once."""
        places = {part.name: part.find(model) for part in scene.parts}
        return cls(model.nq, model.nv, places, scene.driver.name)

    @property
    def links(self) -> np.ndarray:
        """Body ids of the rope's links, [N]."""
        return self.places["rope"].frames[0]

    @property
    def driven(self) -> np.ndarray:
        """Addresses in qpos of what actions move: of hands their world coordinates, [G, D]."""
        return self.places[self.driver].qpos

    @property
    def holds(self) -> np.ndarray:
        """Ids of the equalities that `SimState.holding` switches, [G]."""
        return self._joined("holds")

    @property
    def coordinates(self) -> np.ndarray:
        """What is seen of (qpos, qvel), [C]."""
        return self._joined("coordinates")

    @property
    def sizes(self) -> np.ndarray:
        """Ids of the geoms whose sizes are seen, [Z]."""
        return self._joined("sizes")

    def _joined(self, field: str) -> np.ndarray:
        return np.concatenate([getattr(one, field) for one in self.places.values()]).astype(int)


def _bytes(array: Any) -> Any:
    if isinstance(array, tuple):
        return tuple(_bytes(one) for one in array)
    return array.shape, array.tobytes()


class Observation(eqx.Module):
    """What is seen of a state, world frame, metres: what learners and planners see, and a rope's shape."""

    state: Any  # such as a `doojax.types.RopeState`
    hands: Float[Array, "*b G 3"]
    hold_points: Float[Array, "*b H 3"]  # the points of the rope that hands hold
    half_links: Float[Array, "*b N 3"]  # from a link's centre to where its front cap begins
    radius: Float[Array, "*b"]  # of the rope; 0 where there is none


def read_frames(
    scene: Scene,
    layout: Layout,
    xpos: Float[Array, "bodies 3"],
    xmat: Float[Array, "bodies 3 3"],
    site_xpos: Float[Array, "sites 3"],
) -> Float[Array, "K 3"]:
    """All parts' frames, off MuJoCo's poses of bodies and sites: the sensors of a model ``with_sensors``."""
    found = []
    for part in scene.parts:
        for frames, ids in zip(part.frames(), layout.places[part.name].frames, strict=True):
            if frames.kind == "axis":
                found.append(xmat[ids][..., 0])
            else:
                found.append((site_xpos if frames.kind == "site" else xpos)[ids])
    return jnp.concatenate(found)


def observe(
    scene: Scene,
    layout: Layout,
    vectors: Float[Array, "*b K 3"],
    coordinates: Float[Array, "*b C"],
    sizes: Float[Array, "*b Z 2"],
) -> Observation:
    """What is seen.

    Args:
        scene: of all elements.
        layout: the scene's.
        vectors: see `read_frames`.
        coordinates: those of `Layout.coordinates`.
        sizes: the first two sizes of `Layout.sizes`: radius and half length of a capsule.
    """
    places = [layout.places[part.name] for part in scene.parts]
    own = split(vectors, [len(ids) for one in places for ids in one.frames], axis=-2)
    values = split(coordinates, [len(one.coordinates) for one in places], axis=-1)
    measured = split(sizes, [len(one.sizes) for one in places], axis=-2)
    seen: dict[str, Array] = {}
    for part, place, value, size in zip(scene.parts, places, values, measured, strict=True):
        seen |= part.see([own.pop(0) for _ in place.frames], value, size)
    hands, batch = seen.pop("grippers"), vectors.shape[:-2]
    shape = {
        "hold_points": seen.pop("hold_points"),
        "half_links": seen.pop("half_links", jnp.zeros((*batch, 0, 3), vectors.dtype)),
        "radius": seen.pop("radius", jnp.zeros(batch, vectors.dtype)),
    }
    if scene.cylinders:
        return Observation(PushingState(hand=hands[..., 0, :], **seen), hands, **shape)
    kind = ArmsState if "joints" in seen else RopeState
    return Observation(kind(grippers=hands, **seen), hands, **shape)


def moved(
    scene: Scene, qpos: Float[Array, "nq"], qvel: Float[Array, "nv"], turn: Turn
) -> tuple[Float[Array, "nq"], Float[Array, "nv"]]:
    """Positions and velocities of all parts, moved rigidly; obstacles stay."""
    for part in scene.parts:
        qpos, qvel = part.moved(scene.layout.places[part.name], qpos, qvel, turn)
    return qpos, qvel


def clearance(scene: Scene, obstacles: Obstacles, seen: Observation) -> Float[Array, ""]:
    """Least distance between what moves and the obstacles, metres; negative when inside."""
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
    """Points of all parts that may touch an obstacle, and the radius around each."""
    points, radii = zip(*(one for part in scene.parts for one in part.samples(seen)), strict=True)
    return jnp.concatenate(points), jnp.concatenate(radii)


def stretch(scene: Scene, holding: Bool[Array, "G"], seen: Observation) -> Float[Array, ""]:
    """By what fraction of its length a rope is too long, the gaps to the grippers that hold it included."""
    if scene.rope is None:
        return jnp.zeros((), seen.hands.dtype)
    length, model = scene.rope.length, scene.rope_part.model
    holds = np.array([g for g, gripper in enumerate(scene.grippers) if gripper.link is not None], dtype=int)
    own = holding[: len(holds)]  # others are grasps anywhere
    gaps = jnp.where(own, jnp.linalg.norm(seen.hold_points - seen.hands[holds], axis=-1), 0.0).sum()
    if model.kind != "point_masses":
        return gaps / length  # the links of a chain are rigid
    pitch = length / model.links
    steps = jnp.linalg.norm(seen.state.points[1:] - seen.state.points[:-1], axis=-1)
    return (gaps + (steps - pitch).sum()) / length
