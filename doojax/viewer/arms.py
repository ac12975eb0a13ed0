"""Arms in pictures: the capsules and boxes of a robot, with a rope and what stands around."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from doojax.experiments.trials.records import TrialRecord
from doojax.robots import Robot, dual_arm
from doojax.tasks.arms import BASE
from doojax.types import Obstacles
from doojax.viewer import colours
from doojax.viewer.paint import Painting, Pixels, font
from doojax.viewer.raycast import Camera
from doojax.viewer.robots import ends_of, show_robot

TRANSLUCENT = 0.35


def picture_of_arms(
    robot: Robot,
    joints: Float[np.ndarray, "J"],
    base: tuple[float, float, float],
    obstacles: Obstacles,
    rope: Float[np.ndarray, "N 3"],
    goal: Float[np.ndarray, "3"],
    *,
    rope_radius: float,
    goal_radius: float,
    caption: str = "",
    eye: tuple[float, float, float] = (-1.3, -1.6, 2.1),
    target: tuple[float, float, float] = (0.0, 0.5, 0.7),
    size: tuple[int, int] = (640, 520),
) -> Pixels:
    """One moment. Large walls are left out, what stands in front of the rope is seen through."""
    camera = Camera.looking(np.array(eye), np.array(target), np.array([0.0, 0, 1]), *size, None)
    painting = Painting(camera, np.array([-1.6, -1.0, 0]), np.array([1.6, 1.8, 1.8]), 0.0)
    large = np.asarray(obstacles.half_size).max(1) > 0.9
    shown = eqx.tree_at(lambda o: o.active, obstacles, obstacles.active & ~jnp.asarray(large))
    painting.obstacles("obstacles", shown, colour=colours.OBSTACLE, opacity=TRANSLUCENT)
    show_robot(painting, "robot", robot, ends_of(robot, joints), base=base)
    painting.rope("rope", np.asarray(rope), radius=max(rope_radius, 0.012), colour=colours.ROPE)
    painting.spheres("tip", np.asarray(rope)[-1:], radius=0.022, colours=(200, 60, 40))
    painting.spheres("goal", np.asarray(goal)[None], radius=goal_radius, colours=(120, 60, 170), opacity=0.5)
    picture = Image.fromarray(painting.image())
    if caption:
        pen = ImageDraw.Draw(picture)
        pen.text((8, 8), caption, fill=colours.INK, font=font(14))
    return np.asarray(picture)


def strip(record: TrialRecord, out: Path, most: int = 12) -> None:
    """A PNG of a trial of the dual arm: its start, what regrasps led to, and moments between, to the end.

    Raises:
        ValueError: for a record without joints.
    """
    if "joints" not in record.replay:
        raise ValueError("this record holds no joints of arms: only trials of arms have a strip")
    robot, last = dual_arm(), len(record.points) - 1
    marks = {event.step: f"{event.kind}: {event.text}" for event in record.events}
    evenly = np.linspace(0, last, most).astype(int).tolist()
    chosen = sorted({0, last, *[step for step in marks if step]})
    chosen = chosen if len(chosen) <= most else sorted({0, *chosen[-most + 1 :]})
    for step in evenly:
        if len(chosen) < most and min(abs(step - other) for other in chosen) > last / most / 2:
            chosen = sorted({*chosen, step})
    pictures = [
        picture_of_arms(
            robot,
            record.replay["joints"][step],
            BASE,
            record.obstacles,
            record.points[step],
            record.goal,
            rope_radius=record.look.rope_radius,
            goal_radius=record.goal_radius,
            caption=f"{step * record.period:.1f} s  {marks.get(step, '')}",
            size=(520, 420),
        )
        for step in chosen
    ]
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % 4)
    rows = [np.concatenate(pictures[i : i + 4], axis=1) for i in range(0, len(pictures), 4)]
    Image.fromarray(np.concatenate(rows)).save(out, optimize=True)
