"""The setting of any task, and the thesis's own numbers for it."""

from doojax.augmentation.examples import Bounds, Setting
from doojax.augmentation.projection import ProjectionConfig
from doojax.augmentation.pushing import PushingSetting
from doojax.augmentation.ropes import RopeSetting
from doojax.tasks.base import Task


def setting_of(task: Task, bounds: Bounds = Bounds()) -> Setting:  # noqa: B008
    """What augmentations need to know of a task.

    Raises:
        ValueError: bounds that move nothing there.
    """
    return (PushingSetting if task.scene.cylinders else RopeSetting).of(task, bounds)


def usual(task: Task) -> tuple[Bounds, ProjectionConfig]:
    """The bounds and the projection of the thesis's released code: pushed bodies are small and close."""
    if task.scene.cylinders:
        return Bounds((0.15, 0.15, 0.0), (0.0, 0.0, 0.5)), ProjectionConfig(distance_tolerance=0.005)
    return Bounds(), ProjectionConfig()
