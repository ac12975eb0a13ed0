"""Other ropes than a task's own: named by what differs, and carried by states as data."""

from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from doojax.simulation.build import with_parameters
from doojax.simulation.rope import RopeParameters
from doojax.simulation.scenes import Scene
from doojax.simulation.state import SimState
from doojax.tasks.base import Task


@dataclass(frozen=True)
class OtherRope:
    """What of a rope differs from that of a task's scene; see `doojax.simulation.rope.RopeParameters`."""

    length: float | None = None  # m, end to end
    radius: float | None = None  # m
    mass: float | None = None  # kg, the whole rope
    bending_stiffness: float | None = None  # EI, N m^2
    twisting_stiffness: float | None = None  # GJ, N m^2
    bending_damping: float | None = None  # N m^2 s
    friction: float | None = None  # Coulomb coefficient against floor and obstacles

    @property
    def given(self) -> dict[str, float]:
        """What differs, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @property
    def reshapes(self) -> bool:
        """Would a start of the scene's own rope not be one of this?"""
        return self.length is not None or self.radius is not None

    def parameters(self, scene: Scene) -> RopeParameters:
        """All parameters. Raises ValueError for values without a physical meaning."""
        return replace(scene.rope_part.parameters, **self.given)


OWN = OtherRope()
"""The rope of the scene itself."""


def with_rope[T: Task](task: T, rope: OtherRope) -> T:
    """A task with another rope in its scene: starts are drawn and settled with it, and compiled anew.

    Raises:
        ValueError: for values without a physical meaning, or a task without physics.
    """
    if not rope.given:
        return task
    _require_physics(task)
    changed: Any = task
    return replace(changed, scene=replace(task.scene, rope=rope.parameters(task.scene)))


def carrying(task: Task, states: SimState, rope: OtherRope) -> SimState:
    """A batch of states of the task's scene that carry another rope with them, for any engine.

    Raises:
        ValueError: for values without a physical meaning, or a task without physics.
    """
    if not rope.given:
        return states
    _require_physics(task)
    count = len(states.qpos)
    fields = {
        name: jnp.tile(jnp.asarray(values, jnp.float32), (count, *[1] * (values.ndim - 1)))
        for name, values in with_parameters(task.scene, [rope.parameters(task.scene)]).items()
    }
    drawn = jax.tree.map(jnp.asarray, states)  # scenes that were drawn are NumPy's
    return replace(drawn, model_fields=fields)


def task_of(config: dict[str, Any]) -> Task:
    """The task that a data set's config names, with the rope that it was collected with."""
    from doojax.tasks import make_task

    return with_rope(
        make_task(config["task"], phase=config.get("phase", "constrained")),
        OtherRope(**config.get("rope", {})),
    )


def _require_physics(task: Task) -> None:
    if task.name == "toy":
        raise ValueError("the rope of toy has no physics: its parameters would change nothing")
