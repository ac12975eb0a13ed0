"""A hose on the floor, fastened to a wall, whose head is to come to the robot's feet (thesis 5.5.1).

Sizes, the goal and what is random are those of the thesis's released code, but for two things. The hose has
20 links in place of 34, since each adds its contact with the floor to the physics. And it lies in a random
smooth curve, its head in the box into which the thesis's code shoves it.
"""

import numpy as np

from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Obstacle, Scene
from doojax.tasks.arms import BASE, ArmTask, Drawn, armed_scene, box, polyline_of

LINKS, LENGTH, RADIUS = 20, 3.0, 0.018  # m
DOWN = 4  # links in which the hose comes down from the wall to the floor
HEAD = ((0.5, 1.5), (0.5, 1.5))  # m, x and y of the head
OUT_OF_REACH = 1.0  # m, of the head from the base, at least
KEPT = 0.35  # m, of the hose from the base
CURVES = 256  # that are drawn at once


def scene() -> Scene:
    """A hose of 20 links of 15 cm, fastened to a wall behind the robot's left; arms."""
    return armed_scene(
        "pulling",
        LINKS,
        # 3.88 kg, and 0.5 kg of the root's body; 0.2 N m/rad and 0.02 N m s/rad at joints 8.8 cm apart
        RopeParameters(LENGTH, RADIUS, 4.38, bending_stiffness=1.76e-2, bending_damping=3e-3, friction=1.0),
        (box("wall", 0.05, 2.5, 1.0), Obstacle("attach", ())),
    )


def draw(task: ArmTask, rng: np.random.Generator) -> Drawn:
    """One attempt; curves are drawn until the head is where it shall be."""
    wall = rng.uniform(-0.05, 0.05) - 1
    # 2 cm before the wall, lest the hose's thickness be in it
    attach = np.array(
        [wall + 0.07, 0.5 + rng.uniform(-0.05, 0.05), -0.25 + rng.uniform(-0.05, 0.05) + BASE[2]]
    )
    goal = np.array([rng.uniform(-0.05, 0.05), 0.5 + rng.uniform(-0.05, 0.05), 0.03])
    centres = {"wall": np.array([wall, 0, 0.5 + BASE[2]]), "attach": attach}
    return Drawn(centres, _curve(rng, attach), {}, goal, None)


def _curve(rng: np.random.Generator, attach: np.ndarray) -> np.ndarray:
    """The first of many smooth curves whose head is where it shall be, m."""
    pitch, height = LENGTH / LINKS, RADIUS + 0.002
    down = np.zeros(LINKS)
    down[:DOWN] = np.arcsin(np.clip((attach[2] - height) / (DOWN * pitch), -1, 1))
    along = np.arange(LINKS) / LINKS
    waves = np.sin(np.pi * np.arange(1, 4)[:, None] * along)
    for _ in range(100):
        weights = rng.normal(0, [0.5, 0.25, 0.1], (CURVES, 3))
        heading = weights @ waves + rng.uniform(-0.4, 0.6, (CURVES, 1)) * along
        level = np.cos(down)
        steps = np.stack([np.cos(heading) * level, np.sin(heading) * level, 0 * heading - np.sin(down)], -1)
        flat = attach[:2] + pitch * np.cumsum(steps[..., :2], axis=1)
        head, far = flat[:, -1], np.linalg.norm(flat, axis=-1)
        low, high = np.array(HEAD).T
        good = ((head >= low) & (head <= high)).all(-1) & (far[:, -1] > OUT_OF_REACH) & (far.min(1) > KEPT)
        if good.any():
            return polyline_of(steps[np.argmax(good)], attach, pitch)
    raise RuntimeError(f"no curve of the hose in {100 * CURVES} has its head where it shall be")


def no_loops(centres: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """There are none: every signature is that of loops that are linked with nothing."""
    return {}


def pulling() -> ArmTask:
    """The task."""
    return ArmTask("pulling", scene(), 1.0, 0.07, 300, draw, no_loops)
