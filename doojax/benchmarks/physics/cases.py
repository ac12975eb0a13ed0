"""What every group of cases shares: settings, findings, ropes in given shapes, records, fits."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from doojax.simulation.build import build_model
from doojax.simulation.engines import make_simulator
from doojax.simulation.rope import link_name
from doojax.simulation.scenes import Gripper, Scene, SolverSettings
from doojax.simulation.state import SimState, Simulator
from doojax.tasks import make_task
from doojax.tasks.starts import resting, straight_qpos

GRAVITY = 9.81  # m/s^2
WITHIN = 0.03  # of the closed form
TASKS = ("rope_dragging", "dual_gripper", "default")


@dataclass(frozen=True)
class Settings:
    """How a scene is solved: with a task's solver and time step, or with the defaults; as is or converged."""

    task: str  # one of TASKS; "default" is SolverSettings() and the time step of a plain Scene
    converged: bool = False
    timestep: float | None = None  # s, in place of the task's

    @property
    def name(self) -> str:
        """The tag in a table."""
        return "converged" if self.converged else "task"

    def of(self, scene: Scene, period: float) -> Scene:
        """``scene`` under these settings, in control periods of about ``period`` seconds."""
        if self.task == "default":
            solver, timestep = SolverSettings(), Scene.__dataclass_fields__["timestep"].default
        else:
            solver, timestep = make_task(self.task).scene.solver, make_task(self.task).scene.timestep
        timestep = timestep if self.timestep is None else self.timestep
        solver = replace(solver, contact_time=max(solver.contact_time, 2 * timestep))
        if self.converged:
            solver = replace(
                solver, algorithm="newton", iterations=100, line_search_iterations=50, tolerance=1e-12
            )
        substeps = max(1, round(period / timestep))
        return replace(scene, solver=solver, timestep=timestep, substeps=substeps)


@dataclass(frozen=True)
class Finding:
    """One measured figure beside its closed form."""

    case: str
    tags: dict[str, Any]
    value: float  # NaN: the rope burst; see also `note`
    expected: float
    unit: str
    within: float = WITHIN  # of `scale`: how far off still counts as right
    scale: float | None = None  # what errors are relative to: the closed form itself by default
    note: str = ""

    @property
    def error(self) -> float:
        """(value - closed form) / scale."""
        return (self.value - self.expected) / (self.expected if self.scale is None else self.scale)

    @property
    def right(self) -> bool:
        """Within the limit? NaN is not."""
        return abs(self.error) <= self.within


@dataclass(frozen=True)
class Case:
    """The place of findings in a table: engine, settings, and what a group adds."""

    engine: str
    settings: Settings
    more: dict[str, Any] = field(default_factory=dict)

    def found(self, case: str, value: Any, expected: float, unit: str, **rest: Any) -> Finding:
        """A finding with this place's tags and ``more`` ones."""
        tags = {"engine": self.engine, "settings": self.settings.name, "task": self.settings.task}
        more = self.more | rest.pop("tags", {})
        return Finding(case, tags | more, float(value), float(expected), unit, **rest)


def refused(
    case: Case, name: str, expected: float, unit: str, error: ValueError, tags: dict[str, Any]
) -> Finding:
    """A finding about a scene that doojax would not simulate: no figure, but no wrong one either."""
    return case.found(name, np.nan, expected, unit, tags=tags, note=f"refused: {error}")


def still_hand(link: int, end: Any = -1, hold: Any = "point") -> Gripper:
    """A hand that gives way to nothing: a thousandth of a millimetre per newton."""
    return Gripper(link, end, 0.01, max_force=5e4, max_speed=1.0, inertia=1e3, stiffness=2.5e6, hold=hold)


def engine_of(scene: Scene, engine: str) -> Simulator:
    """``scene`` on an engine, for states that are made by hand."""
    return make_simulator(scene, _no_start, engine)


def _no_start(key: Any) -> SimState:
    raise RuntimeError("a bench makes its own starts")


def bent_qpos(
    scene: Scene, start: Float[np.ndarray, "3"], inclinations: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "nq"]:
    """Generalised positions of a capsule chain in the vertical plane through ``start`` along x.

    Link i points along (cos a_i, 0, -sin a_i), the rope's first end lies at ``start`` (m), and every hand is
    where it holds the rope.

    Raises:
        ValueError: for another kind of rope, or another number of inclinations (rad) than links.
    """
    links, pitch = scene.links, scene.rope_part.parameters.length / scene.links
    if scene.rope_part.model.kind != "capsule_chain" or len(inclinations) != links:
        raise ValueError(
            f"{len(inclinations)} inclinations for a {scene.rope_part.model.kind} of {links} links: expected "
            "one for each link of a capsule_chain"
        )
    model, middle = build_model(scene), links // 2
    along = np.stack([np.cos(inclinations), 0 * inclinations, -np.sin(inclinations)], -1)
    centres = start + pitch * (np.cumsum(along, axis=0) - along / 2)
    qpos = np.array(straight_qpos(scene, 0.0), dtype=float)
    half = inclinations[middle] / 2
    qpos[scene.layout.places["rope"].qpos] = [*centres[middle], np.cos(half), 0.0, np.sin(half), 0.0]
    for link in (i for i in range(links) if i != middle):
        before = link - 1 if link > middle else link + 1
        address = model.joint(f"{link_name(link)}_bend_y").qposadr[0]
        qpos[address] = inclinations[link] - inclinations[before]
    hands = [centres[g.link] + g.end * pitch / 2 * along[g.link] for g in scene.grippers]
    if hands:
        qpos[scene.layout.driven] = hands
    return qpos


def state_of(scene: Scene, qpos: Float[np.ndarray, "B nq"], holding: bool = True) -> SimState:
    """B states at rest with these positions."""
    states = resting(scene, qpos)
    return replace(states, holding=jnp.full_like(states.holding, holding))


def record(simulator: Simulator, states: SimState, periods: int) -> Iterator[SimState]:
    """The B states and those after each of ``periods`` control periods in which no hand is sent anywhere."""
    still = jnp.zeros((states.qpos.shape[0], 1, states.holding.shape[1], 3))
    yield states
    for _ in range(periods):
        states, _ = simulator.rollout(states, still)
        yield states


def stacked(states: list[SimState]) -> SimState:
    """T batches of B states as one batch of T B, the times slowest."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *states)


def fitted_frequency(times: Float[np.ndarray, "T"], signal: Float[np.ndarray, "T"], about: float) -> float:
    """Frequency (Hz) of the sinusoid that fits best, within a factor of 2 of ``about``; NaN if none."""
    if not np.isfinite(signal).all():
        return float("nan")

    def misfit(frequency: float) -> float:
        phase = 2 * np.pi * frequency * times
        basis = np.stack([np.cos(phase), np.sin(phase), np.ones_like(times)], -1)
        return float(np.linalg.norm(signal - basis @ np.linalg.lstsq(basis, signal, rcond=None)[0]))

    tried = np.geomspace(about / 2, about * 2, 801)
    for _ in range(3):
        best = int(np.argmin([misfit(one) for one in tried]))
        low, high = tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]
        tried = np.linspace(low, high, 41)
    return float(tried[np.argmin([misfit(one) for one in tried])])


def points_of(scene: Scene, states: list[SimState]) -> Float[np.ndarray, "T B N 3"]:
    """Centres of the links (m) in T batches of B states."""
    seen = engine_of(scene, "mujoco").observations(stacked(states)).state.points
    return np.asarray(seen, dtype=float).reshape(len(states), -1, *seen.shape[1:])
