"""What the training benchmark compares is the same thing twice."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.benchmarks import training as bench
from doojax.benchmarks.flax_peer import peer_state, peer_step
from doojax.experiments.reports.summary import read_summary
from doojax.learning.fit import FitConfig, epoch, start
from doojax.learning.losses import DynamicsProblem
from doojax.learning.presets import dynamics_preset
from doojax.tasks import make_task

RATE, BATCH = 1e-3, 16


@pytest.mark.parametrize("preset", ["thesis", "quick"])
@pytest.mark.slow
def test_a_step_in_flax_ends_with_our_loss_and_our_weights(preset):
    task = make_task("toy")
    data = bench.random_trajectories(task, BATCH, 3, key=jax.random.key(1))
    network = replace(dynamics_preset(preset, task).network, width=32)
    problem = DynamicsProblem(data, data, network, preset != "thesis")
    config = FitConfig(epochs=9, batch_size=BATCH, learning_rate=RATE, schedule="constant")
    state, static = start(problem, config, None, key=jax.random.key(0))
    model = problem.init(None, key=jax.random.split(jax.random.fold_in(jax.random.key(0), 0), 1)[0])
    before = jax.tree.map(np.asarray, model.network.layers)
    peer, constants = peer_state(model, RATE)
    copied = [np.asarray(peer.params[f"Dense_{i}"]["kernel"]).T for i in range(3)]
    for layer, mine, weight in zip(before, state.weights.network.layers, copied, strict=True):
        np.testing.assert_array_equal(mine.weight[0], layer.weight)
        np.testing.assert_array_equal(weight, layer.weight)

    settings = (problem, static, None, jax.random.split(jax.random.key(2), 1), config)
    state, measured = epoch(settings, state)
    peer, loss = peer_step(peer, constants, data, jnp.arange(BATCH))
    np.testing.assert_allclose(measured["train_loss"][0], loss, rtol=1e-5)
    for i, (old, mine) in enumerate(zip(before, state.weights.network.layers, strict=True)):
        theirs = np.asarray(peer.params[f"Dense_{i}"]["kernel"]).T
        moved = np.abs(np.asarray(mine.weight[0]) - old.weight)
        assert np.median(moved) == pytest.approx(RATE, rel=0.01)  # as Adam's first step is
        # where a gradient all but vanishes its sign, and so Adam's step, is a matter of rounding
        apart = np.abs(np.asarray(mine.weight[0]) - theirs)
        assert (apart < 0.01 * RATE).mean() > 0.999
        np.testing.assert_allclose(mine.bias[0], peer.params[f"Dense_{i}"]["bias"], atol=0.01 * RATE)


def test_ratios_are_of_the_times_measured(monkeypatch, tmp_path):
    def seconds(runs):
        assert list(runs) == ["one", "all", "flax"]
        return {"one": np.full(11, 2.0), "all": np.full(11, 14.0), "flax": np.full(11, 1.0)}

    monkeypatch.setattr(bench, "take_turns", seconds)
    for name in ("our_epochs", "flax_epochs", "DynamicsProblem"):
        monkeypatch.setattr(bench, name, lambda *_: None)
    bench.training(task="toy", publish=tmp_path)
    found = {
        (row.metric, row.tags.get("library"), row.tags.get("members")): row.value
        for row in read_summary(tmp_path / "summary.json").rows
        if row.tags["preset"] == "thesis"
    }
    assert found[("ensemble_cost_ratio", None, 8)] == 7
    assert found[("throughput_ratio", None, None)] == 0.5
    assert found[("train_steps_per_s", "doojax", 8)] == 16 / 14
    assert found[("train_steps_per_s", "flax", 1)] == 16
