"""Tasks by name: doojax's own, those of other packages, and those that a program registers.

A package makes its tasks known to every command of doojax by an entry point, in its pyproject.toml::

    [project.entry-points."doojax.tasks"]
    pushing = "my_package.pushing:Pushing"

What stands there, and what `register` is given, is called with ``phase`` and ``crowd`` and returns a `Task`
of that name. A name means one thing: nothing can be put in the place of another task.
"""

from collections.abc import Callable
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any

from doojax.tasks.base import Phase, Task, check_phase
from doojax.tasks.dual_gripper import DualGripper
from doojax.tasks.engine_bay import EngineBay
from doojax.tasks.planar_pushing import PlanarPushing
from doojax.tasks.rope_dragging import RopeDragging
from doojax.tasks.toy import Toy
from doojax.tasks.watering import Watering

GROUP = "doojax.tasks"

Factory = Callable[..., Any]
"""``factory(phase="constrained", crowd=1)`` makes a task."""

TASKS: MappingProxyType[str, Factory] = MappingProxyType(
    {
        "rope_dragging": RopeDragging.of,
        "dual_gripper": DualGripper.of,
        "engine_bay": EngineBay.of,
        "planar_pushing": PlanarPushing.of,
        "watering": Watering.of,
        "watering_2d": Watering.flat,
        "toy": Toy.of,
    }
)
_registered: dict[str, Factory] = {}  # by this process, see register


class Registration:
    """A name that is taken, until `forget` is called or the ``with`` block that began with it ends."""

    def __init__(self, name: str, factory: Factory):
        """Use `register`."""
        self._name, self._factory = name, factory

    def forget(self) -> None:
        """The name means nothing again."""
        if _registered.get(self._name) == self._factory:
            del _registered[self._name]

    def __enter__(self) -> "Registration":
        return self

    def __exit__(self, *_: Any) -> None:
        self.forget()


def register(name: str, factory: Factory) -> Registration:
    """Make a task known to `make_task` in this process; or for a block, ``with register(name, factory):``.

    Registering the same factory again changes nothing.

    Args:
        name: that of the tasks that the factory makes.
        factory: called with ``phase`` and ``crowd``; see the module.

    Raises:
        ValueError: the name is another task's.
    """
    taken = TASKS.get(name) or _registered.get(name)
    if taken is None and name in {point.name for point in entry_points(group=GROUP)}:
        taken = "an installed package's"
    if taken not in (None, factory):
        raise ValueError(f"there is a task called {name!r} already ({taken}): choose another name")
    _registered[name] = factory
    return Registration(name, factory)


def make_task(name: str, *, phase: Phase = "constrained", crowd: int = 1) -> Task:
    """The task called ``name``.

    Args:
        name: rope_dragging, dual_gripper, engine_bay, planar_pushing, watering, watering_2d, toy, or a task
            that a package or `register` adds.
        phase: unconstrained (nothing in the way) or constrained (everything that can be).
        crowd: how many times as many obstacles as usual; walls and tables are not multiplied.

    Raises:
        ValueError: for a name that does not exist, and the message lists those that do; an unknown phase; a
            crowd below 1; or a task that calls itself otherwise.
    """
    installed = {point.name: point for point in entry_points(group=GROUP)}
    known = [*TASKS, *sorted({*installed, *_registered} - set(TASKS))]
    if name not in known:
        raise ValueError(f"unknown task {name!r}, expected one of {', '.join(known)}")
    check_phase(phase)
    if crowd < 1:
        raise ValueError(f"crowd is {crowd}, expected at least 1: the task's own number of obstacles")
    factory = TASKS.get(name) or _registered.get(name) or installed[name].load()
    task: Task = factory(phase=phase, crowd=crowd)
    if task.name != name:
        raise ValueError(f"the task {name!r} calls itself {task.name!r}: both names must be one")
    return task
