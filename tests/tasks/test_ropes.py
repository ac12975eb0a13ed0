"""Other ropes than a task's own, compiled into a scene or carried by states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.commands import parsed
from doojax.datasets.collect import collect
from doojax.datasets.inspect import inspect
from doojax.datasets.replay import replay
from doojax.datasets.store import Dataset
from doojax.tasks import make_task
from doojax.tasks.ropes import OWN, OtherRope, carrying, task_of, with_rope

ROUGH = OtherRope(friction=0.3)


@pytest.mark.slow
def test_a_rope_that_states_carry_moves_as_one_that_was_compiled():
    task = make_task("rope_dragging")
    own, rough = task.simulator("mujoco"), with_rope(task, ROUGH).simulator("mujoco")
    starts = jax.vmap(own.reset)(jax.random.split(jax.random.key(0), 2))
    actions = jnp.tile(jnp.array([0.1, 0.05, 0.0]), (2, 3, 1, 1))
    _, plain = own.rollout(carrying(task, starts, OWN), actions)
    _, carried = own.rollout(carrying(task, starts, ROUGH), actions)
    _, compiled = rough.rollout(starts, actions)
    gap = np.abs(np.asarray(carried.states.points) - np.asarray(compiled.states.points)).max()
    assert gap < 1e-4  # single precision of what is carried
    assert np.abs(np.asarray(carried.states.points) - np.asarray(plain.states.points)).max() > 10 * gap


@pytest.mark.slow
def test_a_data_set_of_another_rope_is_replayed_bit_for_bit(tmp_path, capsys):
    given = {"phase": "constrained", "states": 4, "engine": "mujoco", "out": tmp_path / "rough"}
    collect("rope_dragging", trajectories=8, rope=ROUGH, **given)
    replay(tmp_path / "rough", trajectory=1)
    assert "the replay equals what was stored, bit for bit" in capsys.readouterr().out
    dataset = Dataset.open(tmp_path / "rough")
    assert task_of(dataset.config).scene.rope.friction == 0.3
    inspect(tmp_path / "rough")
    said = capsys.readouterr().out
    (line,) = [line for line in said.splitlines() if line.startswith("made by ")]
    ((function, arguments),) = parsed(line.removeprefix("made by "))
    assert function is collect and arguments["rope"] == ROUGH and arguments["trajectories"] == 8
    assert {name: arguments[name] for name in given} == given
    with pytest.raises(ValueError, match=r"rope.friction: 0.3 -> "):
        collect("rope_dragging", trajectories=8, rope=OtherRope(friction=0.2), **given)


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match=r"the rope of toy has no physics"):
        with_rope(make_task("toy"), ROUGH)
    with pytest.raises(ValueError, match=r"rope mass is -1.0, expected > 0"):
        with_rope(make_task("rope_dragging"), OtherRope(mass=-1.0))
