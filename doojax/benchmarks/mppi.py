"""MPPI on a pendulum that is to swing up, beside the pytorch-mppi package.

Both have the dynamics, cost, bounds, samples, horizon, noise and temperature of that package's own example:
the pendulum of gymnasium, 100 samples, 15 controls. Each controls the pendulum from the same ten starts. What
is timed is one plan, and what counts is the cost of the 200 states that come of it.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console

from doojax.benchmarks.arms import command_rows, success_rows
from doojax.benchmarks.medians import median_row
from doojax.commands import command_line
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.keys import generator, numbered, stream
from doojax.planning import Mppi, MppiSettings, rolled_out
from doojax.planning.costs import summed

SEED = 0
SEEDS = 10
SCENES = 25  # of arm_reaching
STEPS = 200
SETTINGS = MppiSettings(samples=100, horizon=15, temperature=1.0, noise=10.0**0.5)
TORQUE, SPEED, PERIOD = 2.0, 8.0, 0.05  # N m, rad/s, s


def mppi(
    task: Literal["pendulum", "arm_reaching"] = "pendulum",
    /,
    *,
    seeds: int | None = None,
    record: Path | None = None,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Measure milliseconds per plan and the cost of control, beside pytorch-mppi.

    Args:
        task: pendulum; or arm_reaching, in which the dual arm brings a cable's end to a place: one command is
            timed, beside the physics alone, and the loop is closed in scenes that can be solved, with our
            settings, with the thesis's, and by a tool that goes straight to where it should.
        seeds: how many starts, at least 2; of arm_reaching, how many scenes. By default 10 and 25.
        record: of arm_reaching, a new or empty folder that gets a record of each trial, for doojax view.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/control; by
            default they are only shown.

    Raises:
        ModuleNotFoundError: pytorch-mppi is not installed; `pip install 'doojax[bench]'` does that.
        ValueError: for fewer seeds, records of a pendulum, or a folder for them that holds something.
    """
    command = command_line(mppi, locals())
    seeds = (SCENES if task == "arm_reaching" else SEEDS) if seeds is None else seeds
    if seeds < 2:
        raise ValueError(f"there are {seeds} seeds, expected at least 2")
    if record is not None and task != "arm_reaching":
        raise ValueError(f"record is {record}, but trials of arm_reaching alone are recorded: leave it out")
    if record is not None and record.exists() and (record.is_file() or any(record.iterdir())):
        raise ValueError(f"{record} is not a new or empty folder: choose another for the records")
    if task == "arm_reaching":
        rows = [*command_rows(), *success_rows(seeds, record=record)]
        publish_rows(publish, command=command, seed=SEED, rows=rows)
        show(rows, json)
        return
    console = Console(stderr=True)
    planners: dict[str, Callable[[int], Plan]] = {"pytorch-mppi": theirs, "doojax": ours}
    controlled = {}
    for name, make in planners.items():
        console.print(f"{seeds} starts with {name}", highlight=False)
        control(make(seeds), start(seeds), 3)  # compiles ours
        controlled[name] = [control(make(seed), start(seed), STEPS) for seed in range(seeds)]
    rows = rows_of(controlled)
    publish_rows(publish, command=command, seed=SEED, rows=rows)
    show(rows, json)


type Plan = Callable[[np.ndarray], float]


def start(seed: int) -> Float[np.ndarray, "2"]:
    """Hanging, more or less: angle from upright (rad) and its speed (rad/s)."""
    return np.array([np.pi, 0]) + generator(SEED, "bench", "mppi", str(seed)).uniform(-0.5, 0.5, 2)


def swing(state: Any, torque: Any, xp: Any) -> Any:
    """Angle and speed after a period, of a rod of 1 kg and 1 m; ``xp`` computes."""
    angle, speed = state[..., 0], state[..., 1]
    torque = xp.clip(torque[..., 0], -TORQUE, TORQUE)
    speed = xp.clip(speed + PERIOD * (15 * xp.sin(angle) + 3 * torque), -SPEED, SPEED)
    return xp.stack([angle + PERIOD * speed, speed], -1)


def price(state: Any, xp: Any) -> Any:
    """Squared angle from upright, and a tenth of the squared speed."""
    angle = xp.remainder(state[..., 0] + np.pi, 2 * np.pi) - np.pi
    return angle**2 + 0.1 * state[..., 1] ** 2


def control(plan: Plan, state: np.ndarray, steps: int) -> tuple[float, np.ndarray]:
    """The cost of all states on the way, and the seconds of each plan."""
    cost, seconds = 0.0, np.zeros(steps)
    for step in range(steps):
        begun = time.perf_counter()
        torque = plan(state)
        seconds[step] = time.perf_counter() - begun
        state = swing(state, np.array([torque]), np)
        cost += float(price(state, np))
    return cost, seconds


# once, so that all seeds share what is compiled
STEP = rolled_out(lambda state, torque: swing(state, torque, jnp))
TERMS = {"swing": summed(lambda state, torque: price(state, jnp))}


@eqx.filter_jit
def _planned(controller: Mppi, nominal: Any, state: Array, key: Array) -> tuple[Any, Array]:
    found, _ = controller(nominal, state, key)
    return found.advanced(), found.controls[0, 0]


def ours(seed: int) -> Plan:
    """Our controller, at its start."""
    controller = Mppi(STEP, TERMS, [-TORQUE], [TORQUE], SETTINGS)
    nominal, key = controller.start(), stream(SEED, "bench", "mppi", str(seed), "samples")
    keys = iter(numbered(key, range(STEPS)))

    def plan(state: np.ndarray) -> float:
        nonlocal nominal
        nominal, torque = _planned(controller, nominal, jnp.asarray(state, jnp.float32), next(keys))
        return float(torque)

    return plan


def theirs(seed: int) -> Plan:
    """The package's controller, at its start."""
    import torch  # pyright: ignore[reportMissingImports]
    from pytorch_mppi import MPPI  # pyright: ignore[reportMissingImports]

    torch.manual_seed(seed)
    peer = MPPI(
        lambda state, torque: swing(state, torque, torch),
        lambda state, torque: price(state, torch),
        2,
        torch.tensor([[SETTINGS.noise**2]]),  # pyright: ignore[reportOperatorIssue]
        num_samples=SETTINGS.samples,
        horizon=SETTINGS.horizon,
        lambda_=SETTINGS.temperature,
        u_min=torch.tensor([-TORQUE]),
        u_max=torch.tensor([TORQUE]),
    )
    return lambda state: float(peer.command(torch.tensor(state, dtype=torch.float32))[0])


def rows_of(controlled: dict[str, list[tuple[float, np.ndarray]]]) -> list[Row]:
    """Medians of plans, means over starts, and by how much ours costs more from the same start."""
    ours, theirs = (np.array([cost for cost, _ in controlled[name]]) for name in ("doojax", "pytorch-mppi"))
    more = bootstrap(ours - theirs, np.mean)
    tags = {"task": "pendulum", "implementation": "doojax", "against": "pytorch-mppi"}
    rows = [row("closed_loop_cost_difference", tags, more.value, "", more.low, more.high, more.n)]
    for name, found in controlled.items():
        tags = {"task": "pendulum", "implementation": name}
        costs = bootstrap(np.array([cost for cost, _ in found]), np.mean)
        rows.append(row("closed_loop_cost", tags, costs.value, "", costs.low, costs.high, costs.n))
        rows.append(
            median_row("mppi_ms", tags, 1e3 * np.concatenate([seconds for _, seconds in found]), "ms")
        )
    return rows
