"""doojax as a solver of the package cosseratbench, and its scores beside that package's MuJoCo adapter.

The adapter runs a scenario with the solver and the time step that a plain `Scene` has. A pinned end is a
point that a hand holds which gives way to nothing; a clamped end is held rigidly. Where a scenario asks for
an equilibrium, motion is damped in proportion to mass, as the package's own adapters do, and bending a
little; where it asks for motion nothing is damped, and the integrator is the one that needs no damping.
"""

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from cosseratbench import Capability, Scenario, Trajectory
from cosseratbench.experiment import run
from cosseratbench.registry import load_experiment, load_solver
from cosseratbench.scenario import Cylinder, End, EndCondition, Rod
from cosseratbench.solver import Diverged
from jaxtyping import Float
from rich.console import Console

from doojax.benchmarks.physics.cases import bent_qpos, still_hand
from doojax.commands import command_line
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.simulation.build import build_model
from doojax.simulation.layout import Layout
from doojax.simulation.rope import RopeModel, RopeParameters
from doojax.simulation.scenes import Obstacle, Scene, Shape, SolverSettings
from doojax.types import ShapeKind

EXPERIMENTS = {  # and the metric by which each is judged
    "catenary": "sag_error",
    "cantilever": "tip_deflection_error",
    "pendulum": "period_error",
    "capstan": "slide",
}
UNITS = {"slide": "m"}
RETARDATION = 0.05  # s, bending damping over bending stiffness where an equilibrium is sought
TIMESTEP: float = Scene.__dataclass_fields__["timestep"].default


class DoojaxSolver:
    """One rope of rigid links on MuJoCo C; what it lacks is refused with NotImplementedError."""

    name = "doojax"
    backend_version = mujoco.__version__
    capabilities = frozenset({Capability.CYLINDER_CONTACT})

    def __init__(
        self,
        time_step_scale: float = 1.0,
        timestep: float = TIMESTEP,
        solver: SolverSettings | None = None,
    ):
        """The time step is at most ``time_step_scale`` times ``timestep`` (s)."""
        self.timestep = timestep * time_step_scale
        self.solver = SolverSettings() if solver is None else solver

    def settings(self, scenario: Scenario, *, n_elements: int, n_frames: int) -> dict[str, Any]:
        """What depends on numbers and not on physics."""
        scene = self._scene(scenario, n_elements, n_frames)
        return {"time_step": scene.timestep} | vars(self.solver)

    def run(self, scenario: Scenario, *, n_elements: int, n_frames: int) -> Trajectory:
        """Simulate it; see `cosseratbench.Solver`."""
        scene, rod = self._scene(scenario, n_elements, n_frames), scenario.rods[0]
        model = build_model(scene)
        data, layout = mujoco.MjData(model), Layout.of(scene, model)
        nodes = rod.nodes(n_elements)
        data.qpos[:] = bent_qpos(scene, nodes[0], _inclinations(nodes))
        data.ctrl[:] = data.qpos[layout.driven].reshape(-1)
        for obstacle, own in zip(scenario.obstacles, scene.obstacles, strict=True):
            mocap = model.body(own.name).mocapid[0]
            data.mocap_pos[mocap], data.mocap_quat[mocap] = _pose(obstacle)
        mujoco.mj_forward(model, data)

        links = layout.links
        half = scene.rope_part.parameters.length / n_elements / 2
        local = np.einsum("nji,nj->ni", data.xmat[links].reshape(-1, 3, 3), rod.directors(n_elements))
        damping = 2.0 * scenario.slowest_frequency() if scenario.quasi_static else 0.0
        momentum, frames, directors = np.zeros(model.nv), [], []
        for frame in range(n_frames):
            axes = data.xmat[links].reshape(-1, 3, 3)
            ahead = half * axes[:, :, 0]
            frames.append(np.vstack([data.xpos[links] - ahead, data.xpos[links[-1]] + ahead[-1]]))
            directors.append(np.einsum("nij,nj->ni", axes, local))
            if not np.isfinite(data.qpos).all():
                raise Diverged("doojax's rope burst", time=frame * scene.control_period)
            for _ in range(scene.substeps if frame < n_frames - 1 else 0):
                mujoco.mj_step1(model, data)
                data.qfrc_applied[:] = 0.0
                for load in rod.loads:
                    link, side = (links[0], -1) if load.at is End.START else (links[-1], 1)
                    point = data.xpos[link] + side * half * data.xmat[link].reshape(3, 3)[:, 0]
                    force = np.asarray(load.force, dtype=float)
                    mujoco.mj_applyFT(model, data, force, np.zeros(3), point, link, data.qfrc_applied)
                if damping:
                    mujoco.mj_mulM(model, data, momentum, data.qvel)
                    data.qfrc_applied -= damping * momentum
                mujoco.mj_step2(model, data)
            mujoco.mj_kinematics(model, data)
        times = np.linspace(0.0, scenario.duration, n_frames)
        return Trajectory(times, (np.stack(frames),), (np.stack(directors),))

    def _scene(self, scenario: Scenario, links: int, n_frames: int) -> Scene:
        if len(scenario.rods) != 1 or scenario.self_contact:
            raise NotImplementedError("doojax's adapter takes one rod that does not reach itself")
        rod = scenario.rods[0]
        if rod.start_motion or rod.end_motion:
            raise NotImplementedError("doojax's adapter does not move clamped ends")
        if not all(isinstance(one, Cylinder) for one in scenario.obstacles):
            raise NotImplementedError("doojax's adapter knows cylinders only")
        if any(scenario.gravity[:2]):
            raise NotImplementedError("doojax's gravity points down")
        frame = scenario.duration / (n_frames - 1)
        substeps = math.ceil(frame / self.timestep - 1e-9)
        ends = [(rod.start, 0, -1), (rod.end, links - 1, 1)]
        hold = {EndCondition.PINNED: "point", EndCondition.CLAMPED: "rigid"}
        return Scene(
            name="cosserat",
            rope_model=RopeModel("capsule_chain", links),
            rope=_rope(rod, links, RETARDATION if scenario.quasi_static else 0.0),
            grippers=tuple(still_hand(link, end, hold[is_]) for is_, link, end in ends if is_ in hold),
            obstacles=tuple(_obstacle(i, one) for i, one in enumerate(scenario.obstacles)),
            floor=False,
            timestep=frame / substeps,
            substeps=substeps,
            gravity=-scenario.gravity[2],
            integrator="euler" if scenario.quasi_static else "rk4",
            solver=self.solver,
        )


def _rope(rod: Rod, links: int, retardation: float) -> RopeParameters:
    """Inextensible, as long as the rod is where it starts: one that hangs has stretched by then."""
    area_moment = rod.second_moment_of_area
    return RopeParameters(
        length=float(np.linalg.norm(np.diff(rod.nodes(links), axis=0), axis=1).sum()),
        radius=rod.radius,
        mass=rod.material.density * rod.area * rod.length,
        bending_stiffness=rod.material.youngs_modulus * area_moment,
        twisting_stiffness=rod.material.shear_modulus * 2 * area_moment,
        bending_damping=retardation * rod.material.youngs_modulus * area_moment,
        friction=rod.friction,
    )


def _obstacle(index: int, cylinder: Any) -> Obstacle:
    size = (cylinder.radius, cylinder.radius, cylinder.length / 2)
    return Obstacle(f"cylinder{index}", (Shape(ShapeKind.CYLINDER, size),), cylinder.friction)


def _pose(cylinder: Any) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
    """Position (m) and the quaternion (w, x, y, z) that turns z to the cylinder's axis."""
    centre, axis = np.asarray(cylinder.center, dtype=float), cylinder.unit_axis
    turn = np.array([1 + axis[2], -axis[1], axis[0], 0.0])
    length = np.linalg.norm(turn)
    return centre, turn / length if length > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def _inclinations(nodes: Float[np.ndarray, "N1 3"]) -> Float[np.ndarray, "N"]:
    """By how much each segment points below x; they must lie in a vertical plane along x."""
    steps = np.diff(nodes, axis=0)
    if np.abs(steps[:, 1]).max() > 1e-9:
        raise NotImplementedError("doojax's adapter starts from rods in a vertical plane along x")
    return np.unwrap(np.arctan2(-steps[:, 2], steps[:, 0]))


def cosserat(
    *,
    experiments: tuple[str, ...] = tuple(EXPERIMENTS),
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Score doojax and cosseratbench's MuJoCo adapter on that package's validations, in one run.

    Args:
        experiments: some of catenary, cantilever, pendulum and capstan.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/physics; by
            default they are only shown.

    Raises:
        ValueError: for an unknown experiment.
        RuntimeError: if a solver does not get through.
    """
    command = command_line(cosserat, locals())
    console, rows = Console(stderr=True), []
    for name in experiments:
        if name not in EXPERIMENTS:
            raise ValueError(f"unknown experiment {name!r}, expected one of {', '.join(EXPERIMENTS)}")
        for solver in (DoojaxSolver(), load_solver("mujoco")):
            result, metric = run(load_experiment(name), solver), EXPERIMENTS[name]
            if result.failure or result.missing or result.wall_time is None:
                raise RuntimeError(f"{solver.name} on {name}: {result.failure or result.missing}")
            tags, error = {"experiment": name, "solver": solver.name}, result.metrics[metric]
            rows.append(row(f"cosserat_{metric}", tags, error, UNITS.get(metric, "")))
            rows.append(row("cosserat_s", tags, result.wall_time, "s"))
            line = f"{name}, {solver.name}: {metric} {error:.3g} in {result.wall_time:.2f} s"
            console.print(line, highlight=False)
    publish_rows(publish, command=command, seed=None, rows=rows)
    show(rows, json)
