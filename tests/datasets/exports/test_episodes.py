"""Episodes stand in the order of their splits, those without values are left out, numbers have names."""

import numpy as np
import pytest

from doojax.datasets import Dataset, DatasetWriter
from doojax.datasets.exports.episodes import coordinates, episodes_of

from .conftest import UNSTABLE, K, T


def test_episodes_are_those_of_the_splits_in_their_order_but_for_what_has_no_values(dataset, known):
    episodes = episodes_of(dataset)
    for name, part in episodes.splits.items():
        expected = [row for row in dataset.split(name) if row != UNSTABLE]
        assert episodes.trajectory[part.start : part.stop].tolist() == expected
        assert all(episodes.split_of(number) == name for number in part)
    assert sorted([*episodes.trajectory.tolist(), UNSTABLE]) == list(range(K))
    assert (len(episodes), episodes.steps, episodes.left_out) == (K - 1, T, 1)
    np.testing.assert_array_equal(episodes.arrays["points"], known["points"][episodes.trajectory])
    assert "initial_qpos" not in episodes.arrays


@pytest.mark.parametrize(
    ("name", "shape", "unit", "expected"),
    [
        ("points", (2, 3), "m", ["point0_x", "point0_y", "point0_z", "point1_x", "point1_y", "point1_z"]),
        ("hand", (3,), "m", ["hand_x", "hand_y", "hand_z"]),
        ("obstacle_quaternion", (1, 4), "1", [f"obstacle_quaternion0_{axis}" for axis in "wxyz"]),
        ("actions", (3,), "m", ["action0", "action1", "action2"]),
        ("actions", (1, 3), "m", ["action0_x", "action0_y", "action0_z"]),
        ("joints", (3,), "1", ["joints0", "joints1", "joints2"]),
        ("angle", (), "rad", ["angle"]),
    ],
)
def test_every_number_has_a_name(name, shape, unit, expected):
    assert coordinates(name, shape, unit) == expected


def test_what_has_no_splits_or_no_values_is_refused(tmp_path, dataset, known):
    def written(name, arrays, shards):
        fields = dataset.manifest.fields
        writer = DatasetWriter.open(tmp_path / name, config=dataset.config, schema=fields, n=K, shard_size=4)
        for shard in shards:
            rows = writer.manifest.rows(shard)
            writer.write(shard, {field: values[rows.start : rows.stop] for field, values in arrays.items()})
        return tmp_path / name

    unfinished = written("unfinished", known, [0])
    with pytest.warns(UserWarning, match="unfinished"), pytest.raises(ValueError, match="has no splits yet"):
        episodes_of(Dataset.open(unfinished))
    broken = written("broken", known | {"points": np.full_like(known["points"], np.nan)}, range(3))
    with pytest.raises(ValueError, match=r"no trajectory of .*broken has values throughout"):
        episodes_of(Dataset.open(broken))
