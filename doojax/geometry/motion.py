"""Rigid motions about a stated centre, and the six numbers that one is searched for by."""

import equinox as eqx
from jaxtyping import Array, Float

from doojax.geometry.frames import quaternion_from_rotation_vector, rotate, same_rank


class RigidMotion(eqx.Module):
    """Turn about ``centre``, then move: a point x goes to centre + R (x - centre) + translation."""

    quaternion: Float[Array, "*b 4"]  # (w, x, y, z)
    translation: Float[Array, "*b 3"]  # m
    centre: Float[Array, "*b 3"]  # m, world frame

    @classmethod
    def of(cls, parameters: Float[Array, "6"], centre: Float[Array, "3"]) -> "RigidMotion":
        """The motion of translation (m) and rotation vector (rad), both along the world's axes."""
        return cls(quaternion_from_rotation_vector(parameters[3:]), parameters[:3], centre)

    def points(self, points: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """Places, m."""
        # differences, so that no motion at all leaves every digit
        points, centre, translation = same_rank(points, self.centre, self.translation)
        offset = points - centre
        return points + (rotate(self.quaternion, offset) - offset) + translation

    def vectors(self, vectors: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """Directions, velocities, displacements: turned only. What becomes of gripper displacements."""
        return rotate(self.quaternion, vectors)

    @property
    def about_origin(self) -> Float[Array, "3"]:
        """The translation (m) of the same motion when the turn is about the world's origin."""
        return self.centre + self.translation - rotate(self.quaternion, self.centre)
