"""What does not move by itself: the floor, and obstacles that are placed by data."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from doojax.simulation.parts.base import Part
from doojax.simulation.rope import FLOOR_CONTACT, OBSTACLE_CONTACT
from doojax.simulation.scenes import PARKED_POSITION, PARKED_QUATERNION, Obstacle, Scene, Shape
from doojax.types import ShapeKind

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True)
class Floor(Part):
    """A plane at z = 0 that carries what lies on it; friction is the others' own."""

    def add(self, spec: "mujoco.MjSpec", scene: Scene) -> None:
        """Add the plane."""
        import mujoco

        spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[5, 5, 0.1],
            contype=FLOOR_CONTACT,
            conaffinity=0,
            friction=[0, 0, 0],  # the rope's own counts
        )


@dataclass(frozen=True)
class ObstacleBodies(Part):
    """Mocap bodies, parked at first; `SimState` holds their poses."""

    obstacles: tuple[Obstacle, ...]

    def add(self, spec: "mujoco.MjSpec", scene: Scene) -> None:
        """Add a body for each."""
        for obstacle in self.obstacles:
            body = spec.worldbody.add_body(
                name=obstacle.name, mocap=True, pos=list(PARKED_POSITION), quat=list(PARKED_QUATERNION)
            )
            for index, shape in enumerate(obstacle.shapes):
                kind, size, offset = _geom_of(shape)
                body.add_geom(
                    name=f"{obstacle.name}_{index}",
                    type=kind,
                    size=size,
                    pos=offset,
                    # a plane's normal is +z
                    quat=[0.5**0.5, 0, 0.5**0.5, 0] if shape.wall else [1, 0, 0, 0],
                    contype=OBSTACLE_CONTACT,
                    conaffinity=0,
                    friction=[obstacle.friction, 0, 0],
                )


def _geom_of(shape: Shape) -> tuple["mujoco.mjtGeom", list[float], list[float]]:
    import mujoco

    x, y, z = shape.half_size
    if shape.wall:
        face = [shape.offset[0] + x, shape.offset[1], shape.offset[2]]
        return mujoco.mjtGeom.mjGEOM_PLANE, [z, y, 0.1], face
    if shape.kind == ShapeKind.CAPSULE and z == 0:
        return mujoco.mjtGeom.mjGEOM_SPHERE, [x, 0.0, 0.0], list(shape.offset)
    kinds = {
        ShapeKind.BOX: (mujoco.mjtGeom.mjGEOM_BOX, [x, y, z]),
        ShapeKind.CAPSULE: (mujoco.mjtGeom.mjGEOM_CAPSULE, [x, z, 0.0]),
        ShapeKind.CYLINDER: (mujoco.mjtGeom.mjGEOM_CYLINDER, [x, z, 0.0]),
    }
    kind, size = kinds[shape.kind]
    return kind, size, list(shape.offset)
