"""What the benchmark of classifiers times is what they are, and its rows follow from the times."""

import jax
import numpy as np
import pytest

from doojax.benchmarks import classifiers as bench
from doojax.experiments.reports.summary import read_summary
from doojax.keys import stream
from doojax.learning.presets import classifier_preset
from doojax.models.classifier import DistanceClassifier
from doojax.tasks import make_task
from doojax.types import RopeState

NAMES = [
    (preset, kind, batch)
    for preset in ("quick", "thesis")
    for kind, (_, _, batches) in bench.KINDS.items()
    for batch in batches
]


@pytest.mark.slow
def test_what_is_timed_judges_every_transition_in_its_own_scene():
    task = make_task("toy")
    obstacles, moves = bench.drawn(task, 256, key=jax.random.key(3))
    assert isinstance(moves.state, RopeState)
    np.testing.assert_allclose(moves.next_state.grippers, moves.state.grippers + moves.action, atol=1e-6)
    found = bench.runs_of(task, obstacles, moves)["quick", "classifier", 256]()
    model = DistanceClassifier(
        classifier_preset("quick", task).network, key=stream(bench.SEED, "bench", "network")
    )
    for i in (0, 255):
        scene, one = jax.tree.map(lambda leaf, i=i: leaf[i], (obstacles, moves))
        alone = model(scene, one).score
        np.testing.assert_allclose(found[i], alone, atol=1e-5)


def test_the_best_batch_of_each_counts(monkeypatch, tmp_path):
    def seconds(runs):
        times = {64: 4e-6, 256: 2e-6, 1024: 3e-6, 1: 5e-4, 8: 4e-4, 32: 6e-4}
        return {name: np.full(9, times[name[2]] * (2 if name[0] == "thesis" else 1)) for name in runs}

    monkeypatch.setattr(bench, "take_turns", seconds)
    monkeypatch.setattr(bench, "drawn", lambda *_, key: ())
    monkeypatch.setattr(bench, "runs_of", lambda *_: NAMES)
    bench.classifiers(tasks=("rope_dragging",), publish=tmp_path)
    found = {
        (row.metric, *(row.tags.get(tag) for tag in ("preset", "model", "voxel_preset"))): row.value
        for row in read_summary(tmp_path / "summary.json").rows
    }
    assert found["classifier_us_per_transition", "quick", "classifier", None] == pytest.approx(2)
    assert found["classifier_us_per_transition", "thesis", "voxel_classifier", None] == pytest.approx(800)
    assert found["classifier_best_batch", "quick", "voxel_classifier", None] == 8
    assert found["classifier_speedup", "thesis", None, "thesis"] == pytest.approx(200)
    assert found["classifier_speedup", "quick", None, "thesis"] == pytest.approx(400)
