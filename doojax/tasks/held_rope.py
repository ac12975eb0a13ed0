"""A rope that two free hands hold by its ends: what a table's and an engine bay's scene have in common."""

from functools import partial

from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Gripper, Obstacle, Scene, SolverSettings

LINKS, LENGTH, RADIUS = 25, 0.8, 0.01
MIDPOINT = 12
MAX_GAP = {"unconstrained": 0.70, "constrained": 0.78}  # m between the grippers
MAX_ACTION = 0.10  # m, each gripper


def held_rope_scene(
    name: str, obstacles: tuple[Obstacle, ...], *, bending_damping: float, friction: float
) -> Scene:
    """25 links of 3.2 cm between two grippers, among obstacles.

    Args:
        name: of the scene.
        obstacles: what else there is.
        bending_damping: of the rope, N m^2 s.
        friction: of the rope.
    """
    hold = partial(Gripper, radius=0.01, max_force=5.0, max_speed=0.15)
    return Scene(
        name=name,
        rope_model=RopeModel("capsule_chain", LINKS),
        rope=RopeParameters(
            length=LENGTH,
            radius=RADIUS,
            mass=0.2,
            bending_stiffness=5e-5,
            twisting_stiffness=5e-5,
            bending_damping=bending_damping,
            friction=friction,
        ),
        grippers=(hold(link=0, end=-1), hold(link=LINKS - 1, end=1)),
        obstacles=obstacles,
        timestep=0.006,
        substeps=150,
        viscosity=0.15,  # else the rope still swings at the end of a period, 8 mm RMS in the next
        solver=SolverSettings(contact_time=0.012, max_contact_points=64),  # 56 were met at once
    )
