"""`doojax train policy`: it goes on where it was killed, says what it gains, and others evaluate its work."""

import json
from dataclasses import replace

import jax.numpy as jnp
import pytest

pytest.importorskip("brax")

from doojax.commands import call, command_line, parsed
from doojax.environments.ppo import Ppo, PpoSettings
from doojax.experiments.training.policy import train_policy
from doojax.experiments.trials.methods import find_models
from doojax.learning.checkpoints import load_model

SMALL = PpoSettings(steps=16, environments=4, episode=4, unroll=2, width=8, depth=1)


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on_to_the_same_weights_and_publishes_what_it_gains(
    tmp_path, monkeypatch, capsys
):
    update, told = Ppo.update, {"episodes": 6, "ppo": SMALL}
    train_policy("toy", out=tmp_path / "whole", **told)

    def killed(self, learner, number):
        if number == 1:
            raise KeyboardInterrupt
        return update(self, learner, number)

    monkeypatch.setattr(Ppo, "update", killed)
    with pytest.raises(KeyboardInterrupt):
        train_policy("toy", out=tmp_path / "models/policy", **told)
    assert (tmp_path / "models/policy/last.eqx").exists()
    monkeypatch.setattr(Ppo, "update", update)
    train_policy("toy", out=tmp_path / "models/policy", episodes=6, ppo=replace(SMALL, steps=8))
    capsys.readouterr()
    train_policy("toy", out=tmp_path / "models/policy", publish=tmp_path, json=True, **told)
    whole, again = (tmp_path / run / "model.eqx" for run in ("whole", "models/policy"))
    assert whole.read_bytes() == again.read_bytes()
    lines = [json.loads(line) for line in (tmp_path / "whole/metrics.jsonl").read_text().splitlines()]
    assert [line["epoch"] for line in lines] == [1, 2]

    with pytest.raises(ValueError, match="has had 16 steps already, more than 8: ask for more"):
        train_policy("toy", out=tmp_path / "whole", episodes=6, ppo=replace(SMALL, steps=8))
    policy, header = load_model(again, task="toy", kind="policy")
    assert header.about["steps"] == 16 and find_models(tmp_path / "models", "toy") == {"policy": again}
    assert policy(jnp.zeros(27)).shape == (2,)
    rows = {(row["metric"], row["tags"]["policy"]): row for row in json.loads(capsys.readouterr().out)}
    ours, chance = rows["policy_return", "ppo"], rows["policy_return", "random"]
    assert ours["tags"] == {"task": "toy", "steps": 16, "policy": "ppo"} and ours["n"] == chance["n"] == 6
    gain = rows["policy_gain", "ppo"]
    assert gain["value"] == pytest.approx(ours["value"] - chance["value"])
    assert gain["low"] <= gain["value"] <= gain["high"]
    published = json.loads((tmp_path / "summary.json").read_text())
    assert len(published["rows"]) == 5 and "doojax train policy toy" in published["command"]


def test_the_command_is_two_words():
    line = command_line(train_policy, {"task": "toy", "out": "policy", "ppo": SMALL})
    assert line.startswith("doojax train policy toy --out policy --ppo.steps 16")
    ((function, arguments),) = parsed(line)
    assert function is train_policy and arguments["ppo"] == SMALL


@pytest.mark.slow
def test_a_policy_learns_and_is_evaluated_by_another_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = [
        "doojax train policy toy --out models/policy --ppo.steps 16384 --episodes 64 --publish measured",
        "doojax scenes toy --count 2 --out toy.scenes",
        "doojax evaluate toy --methods policy --models models --scenes toy.scenes --out trials",
    ]
    for line in lines:
        for function, arguments in parsed(line):
            call(function, arguments)
    rows = json.loads((tmp_path / "measured/summary.json").read_text())["rows"]
    (gain,) = (row for row in rows if row["metric"] == "policy_gain")
    assert gain["low"] > 0
    assert len(list((tmp_path / "trials/policy").glob("*.npz"))) == 2
