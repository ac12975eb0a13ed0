"""Model files: there and back, and damaged in every way that a copy can be."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.learning.checkpoints import Header, load_model, read_header, save_model
from doojax.models.builders import BUILDERS

CONFIG = {"points": 2, "grippers": 1, "origin": "gripper", "width": 4, "members": 2}
HEADER = Header("dynamics", "toy", CONFIG, {"threshold_m": 0.01})


@pytest.fixture
def file(tmp_path):
    save_model(tmp_path / "model.eqx", HEADER, BUILDERS["dynamics"](CONFIG))
    return tmp_path / "model.eqx"


def altered(file, **changes):
    """Write the file anew with another first line."""
    line, arrays = file.read_bytes().split(b"\n", 1)
    header = {**json.loads(line), **changes}
    file.write_bytes(json.dumps({k: v for k, v in header.items() if v is not None}).encode() + b"\n" + arrays)


def test_there_and_back(file):
    model, header = load_model(file, task="toy", kind="dynamics")
    assert header == HEADER
    expected = BUILDERS["dynamics"](CONFIG)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(np.array_equal(a, b)), model, expected))
    assert load_model(file.parent)[1] == HEADER  # a run's folder
    changed = jax.tree.map(lambda leaf: leaf + 1 if isinstance(leaf, jnp.ndarray) else leaf, model)
    save_model(file, HEADER, changed)
    again, _ = load_model(file)
    assert np.array_equal(again.members.input_mean, np.ones((2, 12), np.float32))


def test_every_truncation_is_noticed(file):
    whole = file.read_bytes()
    start = whole.index(b"\n") + 1
    for length in [start, start + 1, (start + len(whole)) // 2, len(whole) - 1]:
        file.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="is damaged"):
            load_model(file)
    file.write_bytes(whole + b"x")
    with pytest.raises(ValueError, match="there is more in it than the model's arrays"):
        load_model(file)


@pytest.mark.parametrize("content", [b"", b"\n", b"[]\n", b"null\n", b"\x00\xff\xfe", b"PK\x03\x04", b"{\n"])
def test_what_is_no_model(file, content):
    file.write_bytes(content)
    with pytest.raises(ValueError, match="is not a model of doojax"):
        load_model(file)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "other"}, "is not a model of doojax"),
        ({"format_version": 2}, "has format version 2, this doojax reads 1"),
        ({"kind": "oracle"}, "unknown kind of model 'oracle'"),
        ({"config": {**CONFIG, "width": 5}}, "does not fit the model that it names"),
        ({"config": {**CONFIG, "colour": 1}}, "no dynamics can be built"),
        ({"config": None}, "has a damaged header"),
        ({"arrays": {}}, "does not fit the model that it names"),
    ],
)
def test_headers_that_do_not_fit(file, changes, message):
    altered(file, **changes)
    with pytest.raises(ValueError, match=message):
        load_model(file)


def test_other_tasks_and_kinds_are_refused(file):
    with pytest.raises(ValueError, match="was trained for the task 'toy', not for 'rope_dragging'"):
        load_model(file, task="rope_dragging")
    with pytest.raises(ValueError, match="a model of kind 'dynamics', expected one of kind 'classifier'"):
        load_model(file, kind="classifier")
    with pytest.raises(FileNotFoundError, match="there is no model at"):
        read_header(file.with_name("none.eqx"))
