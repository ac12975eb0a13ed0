"""Settled ropes that come with doojax, so that a task's starts need no simulation.

``banks/TASK.npz`` holds what `doojax.tasks.starts.settle_bank` gives for the task's own scene; tests compare
the two, and ``python -m doojax.tasks.banks`` writes the files anew. Scenes with another rope, other hands or
another solver have their ropes settled when they are asked for.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np

from doojax.files import whole_file
from doojax.reading import read_arrays
from doojax.simulation.scenes import Scene

if TYPE_CHECKING:
    from doojax.tasks.starts import RopeBank

FOLDER = Path(__file__).parent / "banks"
FIELDS = ("qpos", "points", "radius")


def bank_of(scene: Scene, settle: "Callable[[], RopeBank]") -> "RopeBank":
    """The ropes that come with doojax for this scene, whatever its obstacles; else what ``settle`` makes."""
    from doojax.tasks.starts import RopeBank

    file = FOLDER / f"{scene.name}.npz"
    if not file.exists():
        return settle()
    about, arrays = read_arrays(file, "a bank of settled ropes")
    if about != {"scene": digest(scene)}:
        return settle()
    return RopeBank(*(jnp.asarray(arrays[name]) for name in FIELDS))


def digest(scene: Scene) -> str:
    """Of all that settled ropes depend on: the scene but for its obstacles, which are parked meanwhile."""
    return replace(scene, obstacles=()).digest


def save(scene: Scene, bank: "RopeBank") -> None:
    """Write the file of a scene's name."""
    header = np.frombuffer(json.dumps({"scene": digest(scene)}).encode(), np.uint8)
    arrays = {"header": header, **{name: np.asarray(getattr(bank, name)) for name in FIELDS}}
    FOLDER.mkdir(exist_ok=True)
    with whole_file(FOLDER / f"{scene.name}.npz") as file:
        np.savez_compressed(file, **arrays)


if __name__ == "__main__":
    from doojax.tasks.dual_gripper import DualGripper
    from doojax.tasks.engine_bay import EngineBay
    from doojax.tasks.rope_dragging import RopeDragging

    for task in (RopeDragging(), DualGripper(), EngineBay()):
        save(task.scene, task.settled())
