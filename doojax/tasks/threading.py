"""A cable that is to be threaded through three fixtures on a wall, and then plugged in (thesis 5.5.3).

Sizes, the goal and what is random are those of the thesis's released code. What differs: where the cable
hangs at first. It hangs from where it is fastened to the right hand, which is drawn before the first fixture,
as a chain at rest does, and swings no more; the thesis's code scripts how it is picked up.
"""

import numpy as np
from jaxtyping import Float

from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Obstacle, Scene, Shape
from doojax.tasks.arms import BASE, ArmTask, Drawn, armed_scene, box
from doojax.topology.skeletons import rectangle
from doojax.types import ShapeKind

LINKS, LENGTH = 14, 2.0  # m
FASTENED, GOAL = (0.75, 0.62, 0.9), (-0.55, 0.59, 0.4)  # m, base's frame
WALL = (0.0, 0.7, 0.4)
FIXTURES = {"loop1": (0.27, 0.63, 0.3), "loop2": (0.0, 0.63, 0.5), "loop3": (-0.26, 0.63, 0.4)}
SPREAD = (0.06, 0.10)  # m, x and z of each fixture, either way
TURNED = -np.pi / 2 - 0.5  # rad, of fixtures about z: their x points away from the wall, and to the left
# of a fixture, its own frame: two bars out of the wall, and one that joins them
BARS = {"bottom": (0.05, 0.0, -0.04), "top": (0.05, 0.0, 0.12), "front": (0.14, 0.0, 0.04)}
HALVES = {"bottom": (0.10, 0.01, 0.01), "top": (0.10, 0.01, 0.01), "front": (0.01, 0.01, 0.08)}
BACK = -0.05  # m, of a fixture's frame: where bars end within the wall
HELD = (0.93, 0.96)  # along the cable
TORSO = {"torso_yaw": (-0.7, 0.0), "torso_pitch": (-0.2, 0.2)}  # rad
HAND = ((0.35, 0.50), (0.35, 0.50), (0.15, 0.45))  # m, base's frame: where the right hand is at first


def scene() -> Scene:
    """A cable of 14 links, fastened to a wall; arms that hold it rigidly; three fixtures."""
    bars = tuple(Shape(ShapeKind.BOX, HALVES[name], BARS[name]) for name in BARS)
    return armed_scene(
        "threading",
        LINKS,
        # 0.69 kg, and 0.1 kg of the root's body; 0.1 N m/rad and 0.015 N m s/rad at joints 14.3 cm apart
        RopeParameters(LENGTH, 0.01, 0.79, bending_stiffness=1.43e-2, bending_damping=2.1e-3, friction=1.0),
        (box("wall", 1.0, 0.05, 1.0), *(Obstacle(name, bars) for name in FIXTURES), Obstacle("attach", ())),
        grasp_hold="rigid",
    )


def draw(task: ArmTask, rng: np.random.Generator) -> Drawn:
    """One attempt, see the module."""
    up = np.array(BASE)
    centres = {"wall": np.array(WALL) + up, "attach": np.array(FASTENED) + up}
    for name, place in FIXTURES.items():
        x, z = (rng.uniform(-most, most) for most in SPREAD)
        centres[name] = np.array(place) + up + [x, 0, z]
    joints = {name: rng.uniform(*limits) for name, limits in TORSO.items()}
    hand = np.array([rng.uniform(*limits) for limits in HAND]) + up
    place = rng.uniform(*HELD)
    return Drawn(
        centres,
        hanging(centres["attach"], hand, place),
        joints,
        np.array(GOAL) + up,
        np.array([np.nan, place]),
        yaws=dict.fromkeys(FIXTURES, TURNED),
        taken_at_once=True,
    )


def hanging(
    begin: Float[np.ndarray, "3"], hand: Float[np.ndarray, "3"], place: float
) -> Float[np.ndarray, "N1 3"]:
    """Where the links of a limp cable meet that hangs between two points (m) at rest.

    The hand holds it at ``place``; what lies beyond goes on as the held link does, since the hold is rigid.
    Links weigh alike, so the steps of their slopes are equal: tan of link i is (i - low) steep. These two
    numbers make it end at the hand.
    """
    pitch, along = LENGTH / LINKS, place * LINKS
    across = np.array([*(hand - begin)[:2], 0.0])
    width, drop = np.linalg.norm(across), hand[2] - begin[2]
    parts = np.minimum(np.maximum(along - np.arange(LINKS), 0), 1) * pitch  # of each link before the hand

    def ends(low: float, steep: float) -> np.ndarray:
        slopes = (np.arange(LINKS) - low) * steep
        level = 1 / np.sqrt(1 + slopes**2)
        return np.array([(parts * level).sum(), (parts * level * slopes).sum()])

    low = 0.0
    steep = 1.0
    for _ in range(30):  # by turns: each is a bisection of a monotonic function
        low = _root(lambda value, s=steep: drop - ends(value, s)[1], -1.0 * LINKS, 2.0 * LINKS)
        steep = _root(lambda value, m=low: ends(m, value)[0] - width, 1e-3, 1e3)
    slopes = (np.arange(LINKS) - low) * steep
    steps = np.stack([across / width] * LINKS) + slopes[:, None] * [0, 0, 1.0]
    steps *= pitch / np.linalg.norm(steps, axis=1, keepdims=True)
    return begin + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _root(function, low: float, high: float) -> float:
    """Where a function that goes from positive to negative or back is zero."""
    rising = function(high) > function(low)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if (function(middle) > 0) == rising else (middle, high)
    return (low + high) / 2


def loops(centres: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Around each fixture's opening, world frame: through the middles of its bars, and the wall.

    Right-handed fields go through them from where the cable is fastened to the goal, to the left.
    """
    return {name: opening(centres[name]) for name in FIXTURES}


def opening(centre: np.ndarray) -> Float[np.ndarray, "5 3"]:
    """The loop of a fixture whose frame begins at ``centre``."""
    outwards = np.array([np.cos(TURNED), np.sin(TURNED), 0.0])
    front, (bottom, top) = BARS["front"][0], (BARS[name][2] for name in ("bottom", "top"))
    middle = centre + (front + BACK) / 2 * outwards + [0, 0, (bottom + top) / 2]
    return rectangle(middle, (front - BACK) / 2 * outwards, (0, 0, (top - bottom) / 2))


def threading() -> ArmTask:
    """The task."""
    return ArmTask("threading", scene(), 1.0, 0.065, 325, draw, loops, tuple(FIXTURES))
