"""Files altered by rule, read by the doojax command: one line and status 2, or the file was as good.

Every rule alters one thing of a sound file: a JSON value, or some bytes. Nothing may end in a traceback (an
exception of another kind than `doojax.cli.main` reports would leave the call), and what a command depends on
may not be altered without its saying so.
"""

import copy
import io
import json
import os
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from doojax import cli
from doojax.datasets.collect import collect
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.scenes import draw_scenes, save_scenes
from doojax.learning.checkpoints import Header, save_model
from doojax.models.builders import classifier
from doojax.topology.describe import THREADING
from tests.experiments.reports.test_compare import record
from tests.planning.problems import TOY

DEEP = "[" * 100_000
VALUES = [None, True, -1, 0, 2.5, 1e400, 10**15, 10**30, "64", "../outside", "", [], {}, [[[]]], DEEP]
SMALL = {"grippers": 1, "origin": "gripper", "width": 8, "layers": 1, "moments": 2, "midpoints": False}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sound file of every kind."""
    folder = tmp_path_factory.mktemp("sound")
    collect("toy", phase="constrained", trajectories=3, states=3, out=folder / "data")
    (folder / "scene.json").write_bytes(THREADING.read_bytes())
    save_record(folder / "trial.npz", record("oracle", 0, 0.01))
    save_scenes(folder / "toy.scenes", draw_scenes(TOY, 2, 0))
    save_model(folder / "model.eqx", Header("classifier", "toy", SMALL), classifier(SMALL))
    run = folder / "run"
    (run / "oracle").mkdir(parents=True)
    (run / "oracle" / "method.json").write_text("{}")
    (run / "oracle" / "seconds.jsonl").write_text('{"trials": 1, "seconds": 2.0}\n')
    (run / "oracle" / "00000.npz").write_bytes((folder / "trial.npz").read_bytes())
    (run / "config.json").write_text(json.dumps({"task": "toy", "seed": 3}))
    (run / "all.scenes").write_bytes((folder / "toy.scenes").read_bytes())
    return folder


@pytest.fixture(autouse=True)
def no_cache_folder_of_the_user(monkeypatch, tmp_path):
    monkeypatch.setenv(
        "JAX_COMPILATION_CACHE_DIR", os.environ.get("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    )


def run(*arguments: object) -> tuple[int, str]:
    """Status and standard error of a command."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        patch.setattr("sys.stdout", io.StringIO())
        patch.setattr("sys.stderr", said)
        return cli.main(list(map(str, arguments))), said.getvalue()


def places(value, path=()):
    """The path of every value in a tree of JSON."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*path, key))


@st.composite
def altered(draw, content):
    """A path, and the content with the value there gone or another one."""
    path = draw(st.sampled_from([path for path in places(content) if path]))
    content = copy.deepcopy(content)
    *parents, last = path
    item = content
    for key in parents:
        item = item[key]
    if draw(st.integers(0, 5)) == 0:
        del item[last]
        return path, json.dumps(content)
    value = draw(st.sampled_from(VALUES))
    item[last] = "DEEP" if value is DEEP else value
    return path, json.dumps(content).replace('"DEEP"', DEEP).replace("Infinity", "1e400")


fuzz = settings(
    max_examples=100, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
)


def check_refused(status: int, said: str, path: Path) -> None:
    assert status == 2, f"an altered {path} was taken"
    assert said.startswith("doojax: error: ") and "Traceback" not in said
    assert len(said) < 4000


def test_manifests(folder):
    file = folder / "data" / "manifest.json"
    sound = file.read_text()
    said_before = run("inspect", folder / "data")
    assert said_before[0] == 0

    @fuzz
    @given(change=altered(json.loads(sound)))
    def check(change):
        path, text = change
        file.write_text(text)
        status, said = run("inspect", folder / "data")
        free = path[0] in ("config", "versions") or path[-1] in ("unit", "description", "may_be_missing")
        same = json.loads(text) == json.loads(sound) if DEEP not in text else False
        if status != 0 or not (free or same):
            check_refused(status, said, file)

    try:
        check()
    finally:
        file.write_text(sound)


@pytest.mark.slow
def test_described_scenes(folder):
    file = folder / "scene.json"
    sound = json.loads(file.read_text())

    @fuzz
    @given(change=altered(sound))
    def check(change):
        path, text = change
        file.write_text(text)
        status, said = run("signature", file)
        numbers = isinstance(path[-1], int) or path[-1] == "location"  # other numbers are other scenes
        if status != 0 or not (numbers or path[0] in ("attachments", "skeleton", "grippers")):
            check_refused(status, said, file)

    try:
        check()
    finally:
        file.write_text(json.dumps(sound))


def test_evaluations(folder):
    file = folder / "run" / "config.json"
    sound = json.loads(file.read_text())
    assert run("compare", folder / "run")[0] == 0

    @settings(fuzz, max_examples=25)
    @given(change=altered(sound))
    def check(change):
        path, text = change
        file.write_text(text)
        status, said = run("compare", folder / "run")
        if path == ("task",) or status != 0:
            check_refused(status, said, file)

    try:
        check()
    finally:
        file.write_text(json.dumps(sound))


READERS = {
    "trial.npz": ["render", "trial.npz", "--out", "picture.png", "--index", 0],  # refused: a trial has none
    "toy.scenes": ["evaluate", "toy", "--methods", "none", "--out", "out", "--scenes", "toy.scenes"],
    "model.eqx": ["evaluate-model", "model.eqx", "--data", "data", "--out", "out"],
}


@pytest.mark.parametrize("name", READERS)
def test_bytes(folder, name, monkeypatch):
    """Bytes that are cut off, altered or put in between; what is sound ends with status 2, too, but later."""
    monkeypatch.chdir(folder)
    file = folder / name
    sound = file.read_bytes()

    @settings(fuzz, max_examples=60)
    @given(
        at=st.integers(0, len(sound) - 1),
        new=st.binary(max_size=8),
        what=st.sampled_from(["cut", "alter", "insert"]),
    )
    def check(at, new, what):
        rest = {"cut": b"", "alter": sound[at + len(new) :], "insert": sound[at:]}[what]
        file.write_bytes(sound[:at] + new + rest)
        status, said = run(*READERS[name])
        check_refused(status, said, file)
        assert not (folder / "out").exists() and not (folder / "picture.png").exists()

    try:
        check()
    finally:
        file.write_bytes(sound)


@pytest.mark.parametrize("name", ["trial.npz", "toy.scenes"])
def test_headers_of_archives(folder, name, monkeypatch):
    """What stands in the JSON beside the arrays."""
    monkeypatch.chdir(folder)
    file = folder / name
    sound = file.read_bytes()
    with np.load(file) as stored:
        arrays = {key: stored[key] for key in stored.files}
    header = json.loads(arrays.pop("header").tobytes())

    @settings(fuzz, max_examples=60)
    @given(change=altered(header))
    def check(change):
        np.savez(file.with_suffix(".npz"), header=np.frombuffer(change[1].encode(), np.uint8), **arrays)
        os.replace(file.with_suffix(".npz"), file)
        status, said = run(*READERS[name])
        check_refused(status, said, file)

    try:
        check()
    finally:
        file.write_bytes(sound)
    assert name != "trial.npz" or load_record(file).reached


def test_headers_of_models(folder, monkeypatch):
    monkeypatch.chdir(folder)
    file = folder / "model.eqx"
    sound = file.read_bytes()
    line, _, leaves = sound.partition(b"\n")

    @settings(fuzz, max_examples=60)
    @given(change=altered(json.loads(line)))
    def check(change):
        file.write_bytes(change[1].encode() + b"\n" + leaves)
        status, said = run(*READERS["model.eqx"])
        check_refused(status, said, file)

    try:
        check()
    finally:
        file.write_bytes(sound)
