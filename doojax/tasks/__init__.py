"""The tasks, by name."""

from typing import Any

from doojax.tasks.base import Phase as Phase
from doojax.tasks.base import Task as Task
from doojax.tasks.dual_gripper import DualGripper as DualGripper
from doojax.tasks.rope_dragging import RopeDragging as RopeDragging
from doojax.tasks.toy import Toy as Toy

TASKS: dict[str, Any] = {
    "rope_dragging": RopeDragging,
    "dual_gripper": DualGripper,
    "toy": Toy,
}


def make_task(name: str, *, crowd: int = 1) -> Task:
    """The task called ``name``.

    Args:
        name: rope_dragging, dual_gripper or toy.
        crowd: how many times as many obstacles as usual; walls and tables are not multiplied.

    Raises:
        ValueError: for a name that does not exist, and the message lists those that do; or a crowd below 1.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}, expected one of {', '.join(TASKS)}")
    if crowd < 1:
        raise ValueError(f"crowd is {crowd}, expected at least 1: the task's own number of obstacles")
    return TASKS[name]() if crowd == 1 else TASKS[name].crowded(crowd)
