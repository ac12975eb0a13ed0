"""A cable that is to be plugged into a computer on a rack, and hangs in the rack's shelves (thesis 5.5.2).

Sizes, the goal and what is random are those of the thesis's released code. What differs: the rack's width is
set by moving boxes, so that all scenes are one model; shelves are two boxes each that overlap. The computer
stands anywhere on the rack from where a taut cable still reaches the goal. The cable begins straight, from
the wall on the left into the rack, and falls; the right hand then takes its end.
"""

import numpy as np

from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Obstacle, Scene
from doojax.tasks.arms import BASE, ArmTask, Drawn, armed_scene, box, polyline_of
from doojax.topology.skeletons import rectangle

LINKS, LENGTH = 11, 1.0  # m
HALF_WIDTHS = (0.2, 0.4)  # m, of the rack
FRONT, BACK = 0.51, 1.01  # m, y of the posts
SHELVES = {"rack1_bottom": (-0.415, 0.0, 0.29, 0.03), "rack2_bottom": (0.085, 0.0, 0.25, 0.03)}
SHELVES |= {"rack2_top": (0.535, 0.02, 0.29, 0.05)}  # height, more half width, half depth, half thickness; m
LEVELS = {"rack1": (-0.415, 0.085), "rack2": (0.085, 0.585)}  # m, between which a loop runs, base's frame
POSTS = [(level, side, y) for level in LEVELS for side in (-1, 1) for y in (FRONT, BACK)]


def _shelf_halves() -> list[Obstacle]:
    most = HALF_WIDTHS[1]
    return [
        box(f"{name}_{side}", (most + more) / 2, depth, thick)
        for name, (_, more, depth, thick) in SHELVES.items()
        for side in ("left", "right")
    ]


def scene() -> Scene:
    """A cable of 11 links, fastened to the wall; arms; a rack of two shelves and a top."""
    return armed_scene(
        "untangling",
        LINKS,
        # 0.36 kg, and 0.1 kg of the root's body; 0.04 N m/rad and 0.015 N m s/rad at joints 9.1 cm apart
        RopeParameters(LENGTH, 0.01, 0.46, bending_stiffness=3.6e-3, bending_damping=1.4e-3, friction=1.0),
        (
            *_shelf_halves(),
            *(box(f"post{index}", 0.04, 0.04, 0.25) for index in range(len(POSTS))),
            box("box", 0.14, 0.04, 0.10),
            box("computer", 0.10, 0.15, 0.20),
            box("left_wall", 0.01, 2.5, 1.0),
            box("back_wall", 2.5, 0.01, 1.0),
            Obstacle("attach", ()),
        ),
    )


def draw(task: ArmTask, rng: np.random.Generator) -> Drawn:
    """One attempt, see the module."""
    half = rng.uniform(*HALF_WIDTHS)
    most, up = HALF_WIDTHS[1], BASE[2]
    centres: dict[str, np.ndarray] = {}
    for name, (z, more, _, _) in SHELVES.items():
        own = half + more - (most + more) / 2
        centres |= {f"{name}_{s}": np.array([i * own, 0.76, z + up]) for s, i in (("left", -1), ("right", 1))}
    for index, (level, side, y) in enumerate(POSTS):
        centres[f"post{index}"] = np.array([side * half, y, sum(LEVELS[level]) / 2 + up])
    spare = max(half - 0.04 - 0.14, 0.0)  # of the box between the posts
    centres["box"] = np.array([rng.uniform(-spare, spare), rng.uniform(0.60, 0.92), 0.185 + up + 0.03])
    computer = rng.uniform(-half + 0.05, half - 0.05)
    centres["computer"] = np.array([computer, 0.64, 0.785 + up])
    wall = -(half + 0.30)
    centres["left_wall"] = np.array([wall, 0, 0.53 + up])
    centres["back_wall"] = np.array([0, 1.36, 0.53 + up])
    attach = np.array([wall + 0.035, 0.71 + rng.uniform(-0.05, 0.05), 0.23 + rng.uniform(-0.05, 0.05) + up])
    centres["attach"] = attach
    along = polyline_of(np.tile([1.0, 0, 0], (LINKS, 1)), attach, LENGTH / LINKS)
    wobble = np.deg2rad(rng.uniform(-5, 5, 2))
    joints = {
        "torso_yaw": np.deg2rad(-30) + wobble[0],
        "torso_pitch": np.deg2rad(35) + wobble[1],
        "left_shoulder_1": np.deg2rad(-30),
        "right_shoulder_1": np.deg2rad(-30),
    }
    goal = np.array([computer - 0.04, 0.45, 0.835 + up])
    return Drawn(centres, along, joints, goal, np.array([np.nan, 1.0]))


def loops(centres: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The rack's sides, fronts and backs, world frame: each goes through four posts' and shelves' middles.

    Shelves themselves are no loops, as in the thesis's code.
    """
    half = abs(centres["post0"][0])
    found = {}
    for level, (low, high) in LEVELS.items():
        middle, up = (low + high) / 2 + BASE[2], (0, 0, (high - low) / 2)
        for name, side in (("right", 1), ("left", -1)):
            centre = (side * half, (FRONT + BACK) / 2, middle)
            found[f"{level}_{name}"] = rectangle(centre, (0, (BACK - FRONT) / 2, 0), up)
        for name, y in (("front", FRONT), ("back", BACK)):
            found[f"{level}_{name}"] = rectangle((0, y, middle), (half, 0, 0), up)
    return found


def untangling() -> ArmTask:
    """The task."""
    return ArmTask("untangling", scene(), 1.0, 0.04, 300, draw, loops)
