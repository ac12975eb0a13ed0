"""Train a policy by trying, and measure it: `doojax train policy`."""

import importlib.metadata
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from doojax.commands import command_line
from doojax.datasets.progress import progress_bar
from doojax.environments.base import Environment, make_environment
from doojax.environments.ppo import PURPOSE, Ppo, PpoSettings
from doojax.environments.returns import episodes as run_episodes
from doojax.environments.returns import random_acts
from doojax.experiments.reports.provenance import digests, note_command
from doojax.experiments.reports.rows import Row
from doojax.experiments.reports.statistics import bootstrap, success_rate
from doojax.experiments.reports.summary import publish_rows, row, show
from doojax.files import alone_in
from doojax.keys import check_seed, stream
from doojax.learning.checkpoints import Header, load_model
from doojax.learning.provenance import SAW
from doojax.learning.runs import RunDirectory
from doojax.models.policy import Policy
from doojax.tasks.base import Phase

SETTINGS = PpoSettings()
UPDATE, RETURN, ENDED = "epoch", "episode_return", "episodes"


def train_policy(
    task: str,
    /,
    *,
    out: Path,
    phase: Phase = "constrained",
    engine: str = "auto",
    ppo: PpoSettings = SETTINGS,
    episodes: int = 256,
    seed: int = 0,
    json: bool = False,
    publish: Path | None = None,
) -> None:
    """Train a policy of a task by proximal policy optimisation, and measure it beside a random one.

    A run that was killed goes on where it was when the same command is given again, and one that is done with
    more steps: how many they are to be in all changes nothing of those before. `doojax evaluate` takes
    the folder above that by --models: the method policy then stands beside planners.

    Args:
        task: rope_dragging, dual_gripper, toy or another.
        out: the run's folder; new, empty, or the same run unfinished.
        phase: unconstrained (nothing in the way) or constrained.
        engine: mujoco, mjx, warp or auto.
        ppo: how it learns.
        episodes: that no training saw, by which the policy and a random one are measured, in the same starts.
        seed: of everything that is random.
        json: print the rows as JSON instead of a table.
        publish: the folder of results whose summary.json gets the figures, such as results/ecosystem; by
            default they are only shown.

    Raises:
        ValueError: for an unknown task or engine, settings that train nothing, no episodes, or a folder that
            holds something else.
        ModuleNotFoundError: brax is missing; the message says what brings it.
    """
    check_seed(seed)
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}, expected at least 1")
    command = command_line(train_policy, locals())
    environment = make_environment(task, engine=engine, phase=phase)
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    config = {"what": "policy", "task": task, "phase": phase, "engine": engine, "seed": seed}
    settings = {name: value for name, value in asdict(ppo).items() if name != "steps"}
    with alone_in(out), progress_bar(console) as progress:
        run, begun, minutes = RunDirectory.open(out, config | {"ppo": settings}), time.perf_counter(), None
        if _trained_steps(run) != ppo.whole_steps:
            bar = progress.add_task(f"policy of {task}", total=ppo.updates, note="compiling")
            learner = Ppo(environment, ppo, seed)
            whole = _trained(run, learner, config, lambda **shown: progress.update(bar, **shown))
            minutes = (time.perf_counter() - begun) / 60 if whole else None
    policy, header = load_model(out, task=task, kind="policy")
    console.print(f"measuring it in {episodes} episodes, and a random one")
    tags = {"task": task, "steps": header.about["steps"], "policy": "ppo"}
    rows = return_rows(environment, policy, tags, episodes, ppo.episode, seed)
    if minutes is not None:  # else it was trained in more than one go
        rows.append(row("policy_minutes", tags, minutes, "min"))
    note_command(out, command, seed, {})
    publish_rows(publish, command=command, seed=seed, rows=rows, inputs=digests({"policy": out}))
    show(rows, json)


def _trained_steps(run: RunDirectory) -> int | None:
    """What the policy that is there was trained for, control periods."""
    return load_model(run.path)[1].about.get("steps") if run.finished else None


def _trained(run: RunDirectory, ppo: Ppo, config: dict[str, Any], tell: Any) -> bool:
    """Train to the end, from where the run was; whether that was the beginning."""
    settings = ppo.settings
    done, learner = run.resume(ppo.begin())
    if done > settings.updates:
        had = done * settings.environments * settings.unroll
        raise ValueError(f"{run.path} has had {had} steps already, more than {settings.steps}: ask for more")
    for number in range(done, settings.updates):
        learner, ended = ppo.update(learner, number)
        gained = float(ended.mean()) if len(ended) else 0.0
        run.log({UPDATE: number + 1, RETURN: gained, ENDED: len(ended)})
        tell(completed=number + 1, note=f"return of an episode {gained:.2f}")
        run.save(number + 1, learner)
    about = {"steps": settings.whole_steps, **{name: config[name] for name in ("seed", "phase", "engine")}}
    task = ppo.environment.task.name
    about |= {SAW: [{"stream": "/".join(PURPOSE), "seed": config["seed"], "task": task}]}
    about |= {"brax": importlib.metadata.version("brax")}
    run.finish(Header("policy", task, asdict(ppo.config), about), ppo.policy(learner))
    return not done


def return_rows(
    environment: Environment, policy: Policy, tags: dict[str, Any], count: int, steps: int, seed: int
) -> list[Row]:
    """Returns and successes of a policy and a random one from the same starts, and by how much it gains more.

    Args:
        environment: of both.
        policy: that was trained.
        tags: of the rows.
        count: of episodes.
        steps: control periods of one, at most.
        seed: of starts, goals and random actions.
    """
    mode = jax.jit(jax.vmap(policy))
    learned, chance = (
        run_episodes(
            environment, acts, stream(seed, "measure", "policy", environment.task.name), count, steps
        )
        for acts in (lambda seen, _: mode(seen), random_acts(environment))
    )
    rows = []
    for found, own in ((learned, tags), (chance, tags | {"policy": "random", "steps": 0})):
        for metric, at in (
            ("policy_return", bootstrap(found.gained)),
            ("policy_reached", success_rate(found.reached)),
        ):
            rows.append(row(metric, own, at.value, "", at.low, at.high, at.n))
    more = bootstrap(np.asarray(learned.gained - chance.gained))
    return [
        *rows,
        row("policy_gain", tags | {"against": "random"}, more.value, "", more.low, more.high, more.n),
    ]
