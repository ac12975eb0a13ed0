"""Training on a problem whose answer is known: lines through points."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doojax.learning.buffer import Buffer, weighted
from doojax.learning.fit import FitConfig, balanced, fit, shuffled
from doojax.learning.runs import METRICS, RunDirectory


class Line(eqx.Module):
    slope: jax.Array
    offset: jax.Array


class LineProblem(eqx.Module):
    """y = 2 x - 1, scaled by each member's own factor."""

    x: jax.Array
    scale: jax.Array

    def init(self, member, *, key):
        return Line(jax.random.normal(key), jnp.zeros(()))

    def batches(self, member, batch_size, *, key):
        return shuffled(len(self.x), batch_size, key=key)

    def loss(self, model, rows, member):
        x = self.x[rows]
        y = self.scale * member * (2 * x - 1)
        return ((model.slope * x + model.offset - y) ** 2).mean()

    def validate(self, model, member):
        return {"loss": self.loss(model, jnp.arange(len(self.x)), member)}


CONFIG = FitConfig(epochs=40, batch_size=8, members=2, learning_rate=0.2)
SCALES = jnp.array([1.0, -3.0])


def problem(scale=1.0):
    return LineProblem(jnp.linspace(-1.0, 1.0, 64), jnp.asarray(scale))


def train(path, config=CONFIG, report=lambda number, epochs, metrics: None, scale=1.0):
    run = RunDirectory.open(path, {"what": "lines"})
    return run, fit(problem(scale), config, seed=3, run=run, members=SCALES, report=report)


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    return train(tmp_path_factory.mktemp("fit") / "run")


def test_every_member_finds_its_own_line(whole):
    _, lines = whole
    np.testing.assert_allclose(lines.slope, 2 * SCALES, atol=1e-3)
    np.testing.assert_allclose(lines.offset, -SCALES, atol=1e-3)


def test_every_epoch_is_logged_with_a_figure_a_member(whole):
    run, _ = whole
    assert [epoch["epoch"] for epoch in run.metrics] == list(range(1, 41))
    losses = np.array([epoch["validation_loss"] for epoch in run.metrics])
    assert losses.shape == (40, 2)
    assert (losses[-1] < 1e-4 * losses[0]).all()


@pytest.mark.parametrize("torn", [b"", b'{"epoch": 14, "train_lo'])
def test_a_run_that_was_killed_ends_with_the_same_bits(whole, tmp_path, torn):
    def kill(number, epochs, metrics):
        if number == 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "run", report=kill)
    with (tmp_path / "run" / METRICS).open("ab") as file:
        file.write(torn)  # killed while writing a line
    run, lines = train(tmp_path / "run")
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), lines, whole[1]))
    assert run.metrics == whole[0].metrics


def test_checkpoints_that_are_rarer_repeat_epochs_to_the_same_bits(whole, tmp_path):
    config = FitConfig(**{**vars(CONFIG), "checkpoint_every": 5})

    def kill(number, epochs, metrics):
        if number == 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "run", config, kill)
    seen = []
    _, lines = train(tmp_path / "run", config, lambda number, epochs, metrics: seen.append(number))
    assert seen[0] == 11
    assert (lines.slope == whole[1].slope).all()


def test_the_best_epochs_weights_are_kept(tmp_path):
    # a learning rate that overshoots: the last epoch is not the best one
    config = FitConfig(epochs=12, batch_size=8, members=2, learning_rate=0.8, schedule="constant")
    run, lines = train(tmp_path / "run", config)
    best = np.array([epoch["validation_loss"] for epoch in run.metrics]).min(0)
    loss = [
        float(problem().validate(jax.tree.map(lambda leaf, i=i: leaf[i], lines), SCALES[i])["loss"])
        for i in range(2)
    ]
    np.testing.assert_allclose(loss, best, rtol=1e-5)
    assert (best < np.array(run.metrics[-1]["validation_loss"])).any()


def test_the_last_epochs_weights_are_kept_if_they_are_wanted():
    config = FitConfig(
        epochs=12, batch_size=8, members=2, learning_rate=0.8, schedule="constant", keep="last"
    )
    losses = []
    lines = fit(
        problem(),
        config,
        seed=3,
        members=SCALES,
        report=lambda number, epochs, metrics: losses.append(metrics["validation_loss"]),
    )
    found = [
        float(problem().validate(jax.tree.map(lambda leaf, i=i: leaf[i], lines), SCALES[i])["loss"])
        for i in range(2)
    ]
    np.testing.assert_allclose(found, losses[-1], rtol=1e-5)
    assert (np.min(losses, 0) < losses[-1]).any()  # they are not the best


class Counting(LineProblem):
    """Its validation loss is how much it was told that was seen."""

    seen: jax.Array

    def after(self, progress):
        return eqx.tree_at(lambda one: one.seen, self, progress.examples + 0.001 * progress.steps)

    def validate(self, model, member):
        return {"loss": self.seen}


@pytest.mark.parametrize("batch_size", [8, 32])
def test_a_scheduled_problem_is_told_how_much_was_seen_even_after_a_kill(batch_size, tmp_path):
    counting = Counting(jnp.linspace(-1.0, 1.0, 64), jnp.ones(()), jnp.zeros(()))
    config = FitConfig(epochs=4, batch_size=batch_size, members=2)

    def run(report=lambda number, epochs, metrics: None):
        folder = RunDirectory.open(tmp_path, {})
        fit(counting, config, seed=0, run=folder, members=SCALES, report=report)
        return folder

    def kill(number, epochs, metrics):
        if number == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(kill)
    told = [epoch["validation_loss"] for epoch in run().metrics]
    seen = 64 * np.arange(1, 5)
    np.testing.assert_allclose(np.array(told)[:, 1], seen + 0.001 * seen / batch_size, rtol=1e-6)


def test_training_stops_when_no_member_got_better_for_so_long(tmp_path):
    config = FitConfig(
        epochs=500, batch_size=8, members=2, learning_rate=0.8, schedule="constant", patience=4
    )
    run, _ = train(tmp_path / "run", config)
    losses = np.array([epoch["validation_loss"] for epoch in run.metrics])
    assert len(losses) < 500
    assert len(losses) == losses.argmin(0).max() + 1 + 4


def test_a_loss_that_is_not_finite_names_member_and_epoch(tmp_path):
    with pytest.raises(ValueError, match=r"train_loss of member 0, 1 is not finite in epoch 1; lower the"):
        train(tmp_path / "run", scale=jnp.nan)
    assert RunDirectory.open(tmp_path / "run", {"what": "lines"}).metrics == []


def test_another_run_is_not_gone_on_with(whole):
    with pytest.raises(ValueError, match='what: "lines" -> "circles"'):
        RunDirectory.open(whole[0].path, {"what": "circles"})


def test_too_few_examples_for_a_batch():
    with pytest.raises(ValueError, match="5 examples do not fill a batch of 8"):
        shuffled(5, 8, key=jax.random.key(0))


def test_a_rare_class_fills_half_of_every_batch():
    positive = jnp.arange(1000) < 7
    negative = (jnp.arange(1000) >= 7) & (jnp.arange(1000) < 900)
    rows = np.asarray(balanced(positive, negative, 1000, 64, key=jax.random.key(1)))
    assert rows.shape == (15, 64)
    assert ((rows < 7).sum(1) == 32).all()
    assert rows.max() < 900  # those of neither class are never drawn
    assert set(rows[rows < 7]) == set(range(7))


@pytest.mark.parametrize("name", ["epochs", "batch_size", "members", "checkpoint_every"])
def test_settings_that_train_nothing(name):
    with pytest.raises(ValueError, match=f"{name} is 0, expected at least 1"):
        FitConfig(**{"epochs": 1, "batch_size": 1, name: 0})


def test_epochs_after_the_first_compile_nothing(tmp_path):
    traced = []

    class Counted(LineProblem):
        def validate(self, model, member):
            traced.append(member)
            return super().validate(model, member)

    config = FitConfig(epochs=3, batch_size=16, members=2)
    lines = Counted(jnp.linspace(-1.0, 1.0, 32), jnp.asarray(1.0))
    fit(lines, config, seed=0, run=RunDirectory.open(tmp_path, {}), members=SCALES)
    assert len(traced) == 1


def test_the_learning_rate_falls_along_a_cosine_to_zero_at_the_last_step():
    config = FitConfig(epochs=10, batch_size=1, learning_rate=0.1)
    gradient = jnp.ones(())
    optimiser = config.optimiser(steps=4)
    memory, moves = optimiser.init(gradient), []
    for _ in range(40):
        change, memory = optimiser.update(gradient, memory)
        moves.append(-float(change))
    # with a gradient that never changes Adam moves by the learning rate
    expected = 0.1 * (1 + np.cos(np.pi * np.arange(40) / 40)) / 2
    np.testing.assert_allclose(moves, expected, rtol=1e-4, atol=1e-7)


def test_learning_goes_on_from_models_of_before(whole):
    _, lines = whole
    losses = []
    again = fit(
        problem(),
        FitConfig(epochs=1, batch_size=8, members=2, learning_rate=1e-6),
        seed=5,
        members=SCALES,
        begin=lines,
        report=lambda number, epochs, metrics: losses.append(metrics["validation_loss"]),
    )
    np.testing.assert_allclose(again.slope, lines.slope, atol=1e-4)
    assert (losses[0] < 1e-5).all()  # a fresh line errs by about one
    with pytest.raises(ValueError, match="expected 3 members"):
        fit(problem(), FitConfig(epochs=1, batch_size=8, members=3), seed=5, members=jnp.ones(3), begin=lines)


class Streamed(LineProblem):
    """Lines through the points of a buffer, in epochs of eight steps."""

    points: Buffer

    def batches(self, member, batch_size, *, key):
        return self.points.drawn(8, batch_size, key=key)

    def loss(self, model, rows, member):
        x, y = self.points.items
        return ((model.slope * x[rows] + model.offset - y[rows]) ** 2).mean()

    def validate(self, model, member):
        TRACED.append(member)
        return {"loss": ((model.slope * self.x + model.offset - self.scale * (2 * self.x - 1)) ** 2).mean()}


TRACED = []


def test_a_buffer_grows_without_compiling_anything_anew():
    x = jnp.linspace(-1.0, 1.0, 64)
    points = Buffer.like((x, x), capacity=48)
    models, config = None, FitConfig(epochs=6, batch_size=8, learning_rate=0.1)
    for first in (0, 24, 40):  # 24, then 40, and then more than there are places
        part = x[first : first + 24][:16] if first else x[:24]
        points = points.added((part, 2 * part - 1))
        models = fit(Streamed(x, jnp.ones(()), points), config, seed=1, begin=models)
    assert len(TRACED) == 1
    assert int(points.count) == 56 and float((points.weight > 0).sum()) == 48
    np.testing.assert_allclose([models.slope[0], models.offset[0]], [2, -1], atol=0.2)


def test_a_buffer_of_examples_draws_no_empty_place():
    points = Buffer.of(jnp.array([3.0, 4.0, 5.0]), 8)
    assert points.items.tolist() == [3, 4, 5, 0, 0, 0, 0, 0]
    assert set(np.asarray(points.drawn(4, 32, key=jax.random.key(0))).ravel().tolist()) == {0, 1, 2}
    assert Buffer.of(jnp.ones(3)).capacity == 3
    for examples, places in ((jnp.ones(9), 8), (jnp.ones(0), 8)):
        with pytest.raises(ValueError, match=f"there are {len(examples)} examples for 8 places"):
            Buffer.of(examples, places)


def test_a_full_buffer_keeps_the_newest():
    points = Buffer.like(jnp.zeros((1, 2)), capacity=3)
    for value in (1.0, 2.0, 3.0, 4.0):
        points = points.added(jnp.full((1, 2), value))
    assert sorted(points.items[:, 0].tolist()) == [2, 3, 4]
    with pytest.raises(ValueError, match="4 examples are more than the buffer's 3 places"):
        points.added(jnp.zeros((4, 2)))
    with pytest.raises(ValueError, match="capacity is 0, expected at least 1"):
        Buffer.like(jnp.zeros((1, 2)), capacity=0)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.5, 1.0, 3.0]), min_size=1, max_size=20), st.integers(0, 2**31 - 1))
def test_examples_are_drawn_in_proportion_to_their_weights(weights, seed):
    weight = jnp.array([*weights, 1.0])
    rows = np.asarray(weighted(weight, 40, 100, key=jax.random.key(seed))).ravel()
    share = np.asarray(weight / weight.sum())
    found = np.bincount(rows, minlength=len(weight)) / len(rows)
    assert (found[share == 0] == 0).all()
    assert (np.abs(found - share) <= 6 * np.sqrt(share * (1 - share) / len(rows))).all()
