"""What the page and the terminal say of what cannot be shown; and that the page lives on."""

import http.client
import re
import socket
import subprocess
import sys

import numpy as np
import pytest

from doojax.datasets import Dataset
from doojax.datasets.files import chunk_file
from doojax.learning.runs import RunDirectory
from doojax.viewer.examples import write_dataset
from doojax.viewer.plots import axis

STATES = 6


def run_directory(path, epochs):
    """A run of two networks that was cut short."""
    run = RunDirectory.open(path, {"task": "rope_dragging", "learning_rate": 0.001})
    run.log({"epoch": 1, "loss": [2.0, 3.0]})
    for epoch in range(2, epochs + 1):
        run.log({"epoch": epoch, "loss": [2.0 / epoch, 3.0 / epoch]})
    if not epochs:
        (path / "metrics.jsonl").write_text("")


def nothing(path):
    return "there is nothing at"


def a_folder_of_something_else(path):
    path.mkdir()
    (path / "notes.txt").write_text("to do")
    return "holds nothing that can be shown, but notes.txt"


def another_file(path):
    path.write_text("to do")
    return "cannot be shown: expected a folder with manifest.json"


def an_empty_set(path):
    write_dataset(path, 150, states=STATES, shards=0)
    return re.compile("is empty: none of its 3 shards is complete yet")


def a_damaged_manifest(path):
    write_dataset(path, 10, states=STATES)
    (path / "manifest.json").write_text("{")
    return "manifest.json"


def a_link_to_elsewhere(path):
    write_dataset(path, 10, states=STATES)
    (path / "more").symlink_to("/etc")
    return "leads out of"


def a_record_that_is_none(path):
    path.mkdir()
    (path / "trial.npz").write_bytes(b"PK and nothing else")
    return "trial.npz"


def a_run_without_epochs(path):
    run_directory(path, 0)
    return "is empty: no epoch has been trained yet"


def a_damaged_run(path):
    run_directory(path, 3)
    (path / "config.json").write_text("{")
    return "config.json is not the config of a run"


BAD = [nothing, a_folder_of_something_else, another_file, an_empty_set, a_damaged_manifest]
BAD += [a_link_to_elsewhere, a_record_that_is_none, a_run_without_epochs, a_damaged_run]


@pytest.mark.parametrize("make", BAD)
def test_what_cannot_be_shown_is_said_in_the_page_and_on_the_terminal(make, view, tmp_path, capfd):
    said = make(tmp_path / "bad")
    look, _ = view(tmp_path / "bad")
    look.wait_for(said)
    terminal = capfd.readouterr().err
    assert "doojax view: " in terminal and re.search(said, terminal)
    assert "Traceback" not in terminal


def test_once_it_is_mended_it_is_shown(view, tmp_path):
    look, _ = view(tmp_path / "towed")
    look.wait_for("there is nothing at")
    write_dataset(tmp_path / "towed", 10, states=STATES)
    look.page.get_by_role("button", name="Read again").click()
    look.wait_for(re.compile("^trajectory 0"))
    assert look.page.get_by_text("there is nothing at").count() == 0


def test_an_unfinished_set_shows_what_there_is(view, tmp_path):
    write_dataset(tmp_path / "towed", 150, states=STATES, shards=1)
    look, _ = view(tmp_path / "towed")
    look.wait_for("unfinished: 64 of 150 trajectories so far")
    look.wait_for(re.compile("^trajectory 0"))
    look.press("k")
    look.wait_for(re.compile("^trajectory 1"))
    look.wait_for("unfinished: 64 of 150 trajectories so far")


def test_a_damaged_shard_is_said_where_it_is_and_the_others_are_shown(view, tmp_path, capfd):
    path = tmp_path / "towed"
    write_dataset(path, 150, states=STATES)
    dataset = Dataset.open(path)
    file = path / chunk_file("points", 4, 1)
    file.write_bytes(file.read_bytes()[:100])
    assert dataset["points"][140].shape == (STATES, 10, 3)
    look, app = view(path)
    look.wait_for(re.compile("^trajectory 0"))
    look.enter("Trajectory", 70)
    look.wait_for("trajectory 70 cannot be read")
    look.wait_for(re.compile("shard 1, field 'points'"))
    assert "shard 1, field 'points'" in capfd.readouterr().err
    assert app._content._shown == []
    look.enter("Trajectory", 140)
    look.wait_for(re.compile("^trajectory 140"))
    look.until(lambda: look.page.get_by_text("shard 1, field").count() == 0)
    np.testing.assert_array_equal(app._content._shown[0].points, dataset["points"][140])


def test_a_training_run_shows_its_curves_and_that_it_goes_on(view, tmp_path):
    run_directory(tmp_path / "run", 3)
    look, _ = view(tmp_path / "run")
    look.wait_for("training run, 3 epochs")
    look.wait_for("unfinished: 3 epochs so far")
    look.wait_for("network 1")
    look.tab("About")
    look.wait_for("learning_rate")
    (tmp_path / "run" / "model.eqx").touch()
    look.page.get_by_role("button", name="Read again").click()
    look.until(lambda: look.page.get_by_text("unfinished").count() == 0)
    look.wait_for("training run, 3 epochs")


def test_numbers_at_a_plot_tell_small_values_apart(view, tmp_path):
    run = RunDirectory.open(tmp_path / "run", {"task": "rope_dragging"})
    for epoch in range(1, 4):
        run.log({"epoch": epoch, "loss": [0.0004 / epoch], "gain": [0.00031 - 0.0003 * epoch]})
    look, _ = view(tmp_path / "run")
    look.wait_for("training run, 3 epochs")
    look.until(lambda: len(look.ticks()) == 2)
    for places, texts in look.ticks():
        assert 2 <= len(set(texts)) == len(texts) <= 7
        np.testing.assert_allclose([float(text) for text in texts], places, atol=1e-6)
    logarithmic, linear = (texts for _, texts in look.ticks())
    assert "0.0002" in logarithmic
    assert "-0.0002" in linear and "0" in linear


@pytest.mark.parametrize(
    ("low", "high", "logarithmic", "texts"),
    [
        (0.0, 4e-4, False, ("0", "0.0001", "0.0002", "0.0003", "0.0004")),
        (-3.0, 130.0, False, ("0", "50", "100")),
        (99.99, 100.01, False, ("99.99", "99.995", "100", "100.005", "100.01")),
        (9e-8, 3e-5, True, ("1e-07", "1e-06", "1e-05")),
        (0.09, 0.6, True, ("0.1", "0.2", "0.5")),
    ],
)
def test_numbers_at_an_axis_are_round_and_short(low, high, logarithmic, texts):
    found = axis(low, high, logarithmic)
    assert found["values"] == texts
    np.testing.assert_allclose(found["splits"], [float(text) for text in texts])


@pytest.mark.parametrize(
    ("host", "everybody"), [(None, False), pytest.param("0.0.0.0", True, marks=pytest.mark.slow)]
)
def test_only_this_machine_can_look_unless_told_otherwise(tmp_path, host, everybody):
    command = [sys.executable, "-m", "doojax.cli", "view", str(tmp_path), "--port", "0"]
    command += [] if host is None else ["--host", host]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            found = re.search(r"is shown at http://(127\.0\.0\.1|localhost):(\d+) \(Ctrl-C ends\)", line)
            assert found, line
            if everybody:
                assert "everybody who can reach this machine can look" in process.stdout.readline()
            with socket.socket() as other:
                other.settimeout(10)
                # 127.0.0.2 is another address of this machine
                assert (other.connect_ex(("127.0.0.2", int(found[2]))) == 0) == everybody
        finally:
            process.kill()  # an interrupt would not do: who runs tests in the background ignores it
            process.communicate(timeout=30)


@pytest.mark.parametrize(
    "path", ["/../../../../../../../../etc/passwd", "/%2e%2e/%2e%2e/%2e%2e/etc/passwd", "data"]
)
def test_no_file_is_served(view, contents, path, server):
    view(contents / "towed")
    secret = contents / "towed" / "manifest.json"
    path = str(secret) if path == "data" else path
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.request("GET", path)
    response = connection.getresponse()
    body = response.read()
    connection.close()
    assert response.status >= 400 or body.lstrip().lower().startswith(b"<!doctype html")
    assert b"root:" not in body and secret.read_bytes() not in body
