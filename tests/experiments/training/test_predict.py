"""Predictions along recorded trajectories: errors and mistakes that can be worked out by hand."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.experiments.training.predict import predict, recorded
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.records import Look, PredictionRecord
from doojax.learning.checkpoints import Header, save_model
from doojax.learning.data import Trajectories
from doojax.models.builders import BUILDERS
from doojax.types import Judgement, Obstacles, RopeState
from doojax.viewer.examples import write_dataset

ERROR = 0.01  # m, by which each predicted step goes too far along x
TRAJECTORIES, LENGTH = 3, 7


class TooFar(eqx.Module):
    """Moves everything by the action, and a centimetre more."""

    def __call__(self, obstacles, state, action):
        shift = action[0] + jnp.array([ERROR, 0.0, 0.0])
        return RopeState(state.points + shift, state.grippers + shift), jnp.zeros(())


class Left(eqx.Module):
    """Accepts ropes that end to the left of a place."""

    threshold: float

    def __call__(self, obstacles, transition):
        score = transition.next_state.points[0, 0]
        return Judgement(score, score < self.threshold, jnp.array(True))


def trajectories():
    """Ropes that go along x by 10 cm a step, the k-th from x = k on."""
    x = np.arange(TRAJECTORIES)[:, None] + 0.1 * np.arange(LENGTH + 1)
    points = np.zeros((TRAJECTORIES, LENGTH + 1, 2, 3), np.float32)
    points[..., 0], points[..., 1, 1] = x[..., None], 1.0
    actions = np.zeros((TRAJECTORIES, LENGTH, 1, 3), np.float32)
    actions[..., 0] = 0.1
    obstacles = Obstacles(
        kind=jnp.zeros((TRAJECTORIES, 1), jnp.int32),
        centre=jnp.arange(TRAJECTORIES, dtype=jnp.float32)[:, None, None] * jnp.ones(3),
        quaternion=jnp.tile(jnp.array([1.0, 0, 0, 0]), (TRAJECTORIES, 1, 1)),
        half_size=jnp.ones((TRAJECTORIES, 1, 3)),
        active=jnp.ones((TRAJECTORIES, 1), bool),
    )
    states = RopeState(jnp.asarray(points), jnp.asarray(points[:, :, 1:]))
    return Trajectories(states, jnp.asarray(actions), obstacles, jnp.array([4, 5, 9]))


def record(judge, **more):
    fields = recorded(TooFar(), judge, "classifier", trajectories(), every=5, horizon=4)
    return PredictionRecord(task="toy", look=Look(0.01), rows=np.array([4, 5, 9]), **fields, **more)


def test_a_prediction_goes_on_for_its_horizon_or_to_the_end_of_its_trajectory():
    found = record(None, error_threshold=0.025)
    assert found.start.tolist() == [0, 5, 8, 13, 16, 21]  # of trajectories of 8 states
    assert [found.trajectory(p) for p in range(6)] == [0, 0, 1, 1, 2, 2]
    expected = ERROR * np.arange(5)
    for p, error in enumerate(found.rms_errors()):
        known = 5 if p % 2 == 0 else 3
        np.testing.assert_allclose(error[:known], expected[:known], atol=1e-5)
        assert np.isnan(error[known:]).all()
    assert found.obstacles_of(2).centre[0, 0] == 2
    assert not found.scores and found.accepted is None


def test_mistakes_are_counted_where_the_prediction_was_still_right():
    # error 1, 2, 3, 4 cm; wrong from the third step on, and what follows that is not counted
    found = record(Left(2.31), error_threshold=0.025)
    counted = found.counted()
    assert counted[0].tolist() == [False, True, True, True, False]
    assert counted[1].tolist() == [False, True, True, False, False]
    accepts, rejects = found.mistaken()
    assert np.argwhere(accepts).tolist() == [[0, 3], [2, 3]]
    assert np.argwhere(rejects).tolist() == [[5, 1], [5, 2]]  # at 2.61 and 2.72 m, 1 and 2 cm off
    scores = found.scores["accept probability"]
    np.testing.assert_allclose(scores[4, 1:], 2 + 0.11 * np.arange(1, 5), atol=1e-5)


def test_it_comes_back_from_its_file(tmp_path):
    found = record(Left(2.31), error_threshold=0.025)
    save_record(tmp_path / "one.npz", found)
    again = load_record(tmp_path / "one.npz")
    np.testing.assert_array_equal(again.begins, [0, 8, 16])
    np.testing.assert_array_equal(again.accepted, found.accepted)
    np.testing.assert_array_equal(again.mistaken()[0], found.mistaken()[0])
    assert again.thresholds == {"accept probability": pytest.approx(2.31)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small data set, and dynamics that have learned nothing."""
    folder = tmp_path_factory.mktemp("made")
    write_dataset(folder / "data", 640, states=4)  # 10 scenes
    config = {"members": 1, "points": 10, "grippers": 1, "origin": "gripper", "width": 4, "depth": 1}
    header = Header("dynamics", "rope_dragging", config, {"threshold_m": 0.02})
    save_model(folder / "model.eqx", header, BUILDERS["dynamics"](config))
    return folder


def test_the_command_writes_what_the_page_reads_and_says_what_it_found(made, tmp_path, capsys):
    out = tmp_path / "deep" / "predictions.npz"
    predict(made / "data", dynamics=made / "model.eqx", classifier="always", out=out, trajectories=2)
    said = capsys.readouterr().out
    found = load_record(out)
    assert isinstance(found, PredictionRecord) and found.error_threshold == 0.02
    assert len(found.begins) == 2 and found.predicted_points.shape == (2, 4, 10, 3)
    accepts, rejects = found.mistaken()
    assert f"{accepts.sum():,} of those were wrong" in said and "0 right ones were rejected" in said
    assert not rejects.any() and f"doojax view {out}" in " ".join(said.split())
    with pytest.raises(FileExistsError, match="is there already"):
        predict(made / "data", dynamics=made / "model.eqx", out=out)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"every": 0}, "every is 0, expected at least 1"),
        ({"classifier": "always", "deviation": "x"}, "one judge at a time"),
        ({"out": "x.json"}, "a record ends in .npz"),
    ],
)
def test_what_cannot_be_predicted_is_refused(made, tmp_path, options, said):
    given = {"dynamics": made / "model.eqx", "out": tmp_path / "x.npz"} | {
        name: type(tmp_path)(value) if name in ("out", "deviation") else value
        for name, value in options.items()
    }
    with pytest.raises(ValueError, match=said):
        predict(made / "data", **given)
