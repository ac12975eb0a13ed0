"""The tasks, by name."""

from collections.abc import Callable

from doojax.tasks.base import Phase as Phase
from doojax.tasks.base import Task as Task
from doojax.tasks.dual_gripper import DualGripper as DualGripper
from doojax.tasks.rope_dragging import RopeDragging as RopeDragging
from doojax.tasks.toy import Toy as Toy

TASKS: dict[str, Callable[[], Task]] = {
    "rope_dragging": RopeDragging,
    "dual_gripper": DualGripper,
    "toy": Toy,
}


def make_task(name: str) -> Task:
    """The task called ``name``.

    Raises:
        ValueError: for a name that does not exist; the message lists those that do.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}, expected one of {', '.join(TASKS)}")
    return TASKS[name]()
