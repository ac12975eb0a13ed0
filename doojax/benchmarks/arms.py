"""MPPI of the dual arm, which holds a cable of 15 links by one tool, on MuJoCo C: how long, and how well.

Beside a command stands what the same physics steps cost by themselves: the samples' controls, given to
`mujoco.rollout` with nothing looked at or priced. Seconds of all processors together (``cpu``) say the same
when others compute, too.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.rollout import Rollout
from rich.console import Console

from doojax.benchmarks.arm_control import METHODS, SEED, SETTINGS, Sampled, Trial, trial
from doojax.benchmarks.arm_records import recorded
from doojax.benchmarks.medians import median_row
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import mcnemar, success_rate
from doojax.experiments.reports.summary import row
from doojax.keys import numbered, stream
from doojax.parts import processors
from doojax.simulation.build import build_model
from doojax.simulation.engines.mujoco import STATE, write_state
from doojax.simulation.state import SimState
from doojax.tasks.arm_reaching import ArmReaching

COMMANDS = 10
TASK = {"task": "arm_reaching"}


def command_rows(commands: int = COMMANDS) -> list[Row]:
    """Milliseconds of a command with either settings, each with the control of the one before executed."""
    rows = []
    for name, (own, settings) in SETTINGS.items():
        task = ArmReaching(own)
        drawn = task.drawn(SEED, 0)
        control, state = Sampled(task, drawn, settings), drawn.state
        bare = Bare(task, settings.samples)
        wall, cpu, floor = np.zeros((3, commands))
        keys = numbered(stream(SEED, "bench", "mppi", "arms"), range(commands + 1))
        for number, key in enumerate(keys):
            begun = time.perf_counter(), time.process_time()
            nominal, report = control.planned(state, key)
            spent = time.perf_counter() - begun[0], time.process_time() - begun[1]
            report.check()
            if number:  # the first compiles
                wall[number - 1], cpu[number - 1] = spent
                actions = np.asarray(control.rollouts.whole(report.samples.controls))
                floor[number - 1] = bare.seconds(state, actions)
            state = task.simulator.step(state, control.rollouts.whole(nominal.controls[0]))
            control.nominal = nominal.advanced()
        tags = {**TASK, "implementation": "doojax", "settings": name}
        rows.append(median_row("mppi_ms", tags, 1e3 * wall, "ms"))
        rows.append(median_row("mppi_cpu_ms", tags, 1e3 * cpu, "ms"))
        tags["implementation"] = "mujoco.rollout alone"
        rows.append(median_row("mppi_cpu_ms", tags, 1e3 * floor, "ms"))
        tags = {**TASK, "settings": name}
        steps = settings.samples * settings.horizon * own.substeps
        rows.append(row("physics_steps", tags, steps, ""))
        rows.append(row("rollout_bytes", tags, steps * bare.bytes_of_step, "B"))
    return rows


class Bare:
    """The physics steps of a command and nothing else."""

    def __init__(self, task: ArmReaching, samples: int):
        """Of so many samples side by side."""
        self._scene, self._layout = task.scene, task.simulator.layout
        self._models = [build_model(task.scene) for _ in range(samples)]
        self._data = [mujoco.MjData(self._models[0]) for _ in range(processors())]
        self._pool = Rollout(nthread=processors())
        self._size = mujoco.mj_stateSize(self._models[0], STATE)

    @property
    def bytes_of_step(self) -> int:
        """What a step leaves in memory at least: the state after it."""
        return 8 * self._size

    def seconds(self, state: SimState, actions: Float[np.ndarray, "K H A"]) -> float:
        """What all processors together spend on them. Targets run ahead of joints as they are commanded."""
        host = jax.tree.map(np.asarray, state)
        for model in self._models:
            write_state(model, self._layout, host)
        now = np.zeros((len(actions), self._size))
        now[:, 1:] = np.concatenate([host.qpos, host.qvel])
        commanded, controls = np.tile(host.commanded.astype(float), (len(actions), 1)), []
        for period in range(actions.shape[1]):
            own, commanded = self._scene.driver.drive(
                self._scene, commanded, commanded, actions[:, period].astype(float), xp=np
            )
            controls.append(own)
        every = np.concatenate(controls, axis=1)
        begun = time.process_time()
        self._pool.rollout(self._models, self._data, now, every, chunk_size=1)
        return time.process_time() - begun


def success_rows(
    scenes: int, methods: Sequence[str] = tuple(METHODS), record: Path | None = None
) -> list[Row]:
    """How often the cable's end comes to its goal, in the same scenes, and after how many commands.

    The scenes are drawn once, with the task's own physics steps: methods that simulate by other steps start
    from the same states.

    Args:
        scenes: how many.
        methods: of `METHODS`; the first is compared with the others.
        record: the folder that gets a record of each trial, for `doojax view`; by default none is kept.
    """
    console, found, own = Console(stderr=True), {}, ArmReaching()
    drawn = [own.drawn(SEED, number) for number in range(scenes)]
    for name in methods:
        method, done = METHODS[name], []
        task = ArmReaching(method.scene)
        for number in range(scenes):
            if record is None:
                done.append(trial(task, drawn[number], number, method))
            else:
                done.append(recorded(task, drawn[number], number, name, record))
            told = f"{'' if done[-1].reached else 'not '}reached after {done[-1].commands} commands"
            console.print(f"{name}: scene {number} {told}", highlight=False)
        found[name] = done
    return rows_of_trials(found)


def rows_of_trials(found: Mapping[str, Sequence[Trial]]) -> list[Row]:
    """Shares that reach their goals, how many commands that takes, and whether the first method differs."""
    rows, reached = [], {name: np.array([one.reached for one in done]) for name, done in found.items()}
    for name, done in found.items():
        tags, share = {**TASK, "method": name}, success_rate(reached[name])
        rows.append(row("success_rate", tags, share.value, "", share.low, share.high, share.n))
        taken = np.array([one.commands for one in done if one.reached], float)
        if taken.size:
            rows.append(median_row("commands_to_goal", tags, taken, ""))
    first, *others = reached
    for name in others:
        p = mcnemar(reached[first], reached[name]).p_value
        tags = {**TASK, "test": "mcnemar", "method": first, "against": name}
        rows.append(row("p_value", tags, p, "", n=len(reached[name])))
    return rows
