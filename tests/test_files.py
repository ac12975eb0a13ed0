"""Files are whole or absent, a folder has one user at a time, and what is begun can be gone on with."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from doojax import files
from doojax.files import alone_in, append_line, claim, flush, write_whole
from doojax.learning.runs import RunDirectory

HOLD = """
import sys, time
from pathlib import Path
from doojax.files import alone_in
with alone_in(Path(sys.argv[1])):
    print("in", flush=True)
    time.sleep(600)
"""


def test_a_second_process_is_told_and_a_killed_one_is_forgotten(tmp_path):
    folder = tmp_path / "new" / "data"
    with subprocess.Popen([sys.executable, "-c", HOLD, folder], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "in\n"
        message = "data is in use by another process: wait until that has ended"
        try:
            with pytest.raises(BlockingIOError, match=message), alone_in(folder):
                pass
        finally:
            process.send_signal(signal.SIGKILL)
    with alone_in(folder):
        assert list(folder.iterdir()) == []


def test_a_folder_that_stayed_empty_is_taken_away_and_one_that_holds_something_is_not(tmp_path):
    with pytest.raises(ValueError, match="bad"), alone_in(tmp_path / "a" / "b"):
        raise ValueError("bad")
    assert not (tmp_path / "a").exists()
    with alone_in(tmp_path / "a" / "b"):
        (tmp_path / "a" / "b" / "kept").touch()
    assert (tmp_path / "a" / "b" / "kept").exists()
    (tmp_path / "file").touch()
    message = "file is a file: a new or empty folder was expected"
    with pytest.raises(ValueError, match=message), alone_in(tmp_path / "file"):
        pass


def test_a_file_system_that_refuses_to_flush_folders_still_gets_data(tmp_path, monkeypatch):
    fsync = os.fsync

    def refuse(descriptor):
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", refuse)
    write_whole(tmp_path / "new" / "note.txt", "whole")
    assert (tmp_path / "new" / "note.txt").read_text() == "whole"
    monkeypatch.setattr(os, "fsync", lambda descriptor: os.close(-1))
    with pytest.raises(OSError, match="Bad file descriptor"):
        flush(tmp_path / "new" / "note.txt")


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    write_whole(tmp_path / "note.txt", "old")

    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "flush", full)
    with pytest.raises(OSError, match=r"no room left to write to .*note\.txt; .*: make room and run"):
        write_whole(tmp_path / "note.txt", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]
    assert (tmp_path / "note.txt").read_text() == "old"


@pytest.mark.parametrize("cut_off", ["", "hal", "a half line, é"])
def test_a_line_is_added_after_whole_ones(tmp_path, cut_off):
    file = tmp_path / "lines"
    append_line(file, "one")
    append_line(file, "two, é")
    with file.open("a", encoding="utf-8") as stream:
        stream.write(cut_off)
    append_line(file, "three")
    assert file.read_text(encoding="utf-8").splitlines() == ["one", "two, é", "three"]


def test_of_a_file_that_holds_half_a_line_alone_nothing_stays(tmp_path):
    (tmp_path / "lines").write_text("half")
    append_line(tmp_path / "lines", "whole")
    assert (tmp_path / "lines").read_text() == "whole\n"


def test_a_folder_is_begun_gone_on_with_or_refused(tmp_path):
    claim(tmp_path / "a", "config.json", {"seed": 1, "rope": {"links": 3}}, "run")
    claim(tmp_path / "a", "config.json", {"seed": 1, "rope": {"links": 3}}, "run")
    with pytest.raises(ValueError, match=r"a holds another run \(old -> new\):\n  rope.links: 3 -> 4\n"):
        claim(tmp_path / "a", "config.json", {"seed": 1, "rope": {"links": 4}}, "run")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "config.json.77.partial").write_text("{")  # of a process that was killed
    claim(tmp_path / "b", "config.json", {"seed": 1}, "run")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "thesis.txt").touch()
    with pytest.raises(ValueError, match=r"c holds no run but thesis.txt: choose a new or empty folder"):
        claim(tmp_path / "c", "config.json", {"seed": 1}, "run")


def test_a_run_that_was_killed_before_its_config_was_written_can_be_begun(tmp_path):
    (tmp_path / "environment.json").write_text("{}")
    run = RunDirectory.open(tmp_path, {"seed": 0})
    assert (tmp_path / "config.json").exists()
    run.log({"epoch": 1, "train_loss": [1.0]})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 2, "train_lo')  # while the viewer looks
    assert run.metrics == [{"epoch": 1, "train_loss": [1.0]}]
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('ss": "low"}\n')
    with pytest.raises(ValueError, match=r"metrics.jsonl, line 2, is not an epoch's figures: "):
        _ = run.metrics
