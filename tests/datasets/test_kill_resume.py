"""Whatever stops a collection, what it wrote stays sound, and resuming gives an uninterrupted run's bytes."""

import errno
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from doojax import files
from doojax.datasets import Dataset, writer

from . import example_collection
from .example_collection import SCHEMA, collect, folder_bytes, open_writer, shard_arrays

SCRIPT = Path(example_collection.__file__)
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(SCRIPT.parents[2])}


def start(path):
    process = subprocess.Popen(
        [sys.executable, SCRIPT, path], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def check_that_it_is_sound(path):
    """The shards that are shown are whole, whatever else lies in the folder."""
    with pytest.warns(UserWarning, match="is unfinished"):
        dataset = Dataset.open(path)
    dataset.verify()
    for shard in dataset.shards:
        expected = shard_arrays(open_writer(path, n=dataset.manifest.trajectories), shard)
        assert all((values == expected[name]).all() for name, values in dataset.read_shard(shard).items())
    return dataset


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """What nothing interrupted, and how long it took (s)."""
    folder = tmp_path_factory.mktemp("straight") / "data"
    began = time.perf_counter()
    collect(folder, n=120)
    return folder, time.perf_counter() - began


def test_killed_at_a_random_moment(straight, tmp_path):
    """Every other moment at which there is something to lose is below."""
    whole, duration = straight
    with start(tmp_path / "killed") as process:
        time.sleep(random.uniform(0, duration / 4))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    check_that_it_is_sound(tmp_path / "killed")
    collect(tmp_path / "killed", n=120)
    assert folder_bytes(tmp_path / "killed") == folder_bytes(whole)


class Stopped(BaseException):
    """The process ends here, without any clean-up that waits for an Exception."""


def test_stopped_before_every_flush(tmp_path, monkeypatch):
    """A run that dies before its n-th flush, for every n, then resumes."""
    options = {"n": 10, "schema": {name: SCHEMA[name] for name in ("points", "environment")}}
    collect(tmp_path / "straight", **options)
    expected = folder_bytes(tmp_path / "straight")
    left, flush = 0, files.flush

    def flush_or_stop(path):
        nonlocal left
        left -= 1
        if left < 0:
            raise Stopped
        flush(path)

    monkeypatch.setattr(files, "flush", flush_or_stop)
    monkeypatch.setattr(writer, "flush", flush_or_stop)
    for moment in range(1000):
        left = moment
        try:
            collect(tmp_path / "stopped", **options)
            break
        except Stopped:
            pass
        left = 1000
        collect(tmp_path / "stopped", **options)
        assert folder_bytes(tmp_path / "stopped") == expected, f"stopped before flush {moment}"
        shutil.rmtree(tmp_path / "stopped")
    assert 15 < moment < 1000


def test_leftovers_of_a_killed_run_are_replaced(tmp_path):
    collect(tmp_path / "straight")
    collect(tmp_path / "killed", shards=[0])
    # The last shard is short: its leftover must not be read in order to fill up the chunk.
    (tmp_path / "killed" / "points" / "c.4.0.0.0").write_bytes(b"half a chunk")
    (tmp_path / "killed" / "points" / "c.3.0.0.123.partial").write_bytes(b"half a chunk")
    (tmp_path / "killed" / "shards" / "00003.json.77.partial").write_text("{")
    check_that_it_is_sound(tmp_path / "killed")
    collect(tmp_path / "killed")
    assert folder_bytes(tmp_path / "killed") == folder_bytes(tmp_path / "straight")


def test_killed_while_the_manifest_is_written(tmp_path):
    (tmp_path / "manifest.json.77.partial").write_text("{")
    collect(tmp_path)
    assert not list(tmp_path.glob("*.partial"))


def test_a_file_too_large(tmp_path):
    """RLIMIT_FSIZE makes the system refuse a chunk half way, as a full disk does."""
    collect(tmp_path / "straight", shard_size=20)
    collection = open_writer(tmp_path / "full", shard_size=20)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    collection.write(1, shard_arrays(collection, 1))
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))
    try:
        with pytest.raises(
            OSError, match=r"no room left to write to .*full; complete shards are safe"
        ) as caught:
            collection.write(0, shard_arrays(collection, 0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.errno == errno.EFBIG
    with pytest.warns(UserWarning, match="3 of 23 trajectories"):
        Dataset.open(tmp_path / "full").verify()
    collect(tmp_path / "full", shard_size=20)
    assert folder_bytes(tmp_path / "full") == folder_bytes(tmp_path / "straight")


FILL_A_DISK = """
set -e
mount -t tmpfs -o size=600k tmpfs "$1"
dd if=/dev/zero of="$1/ballast" bs=1k count=300 status=none
! "$2" "$3" "$1/data" 2> "$1.error"
cp -r "$1/data" "$1.full"
"""


def test_a_full_disk(straight, tmp_path):
    """A real full file system: a small tmpfs in a mount namespace of its own; then there is room."""
    namespace = ["unshare", "--map-root-user", "--mount"]
    mountable = "mount -t tmpfs tmpfs /mnt"
    if not shutil.which("unshare") or subprocess.run([*namespace, "sh", "-c", mountable]).returncode:
        pytest.skip("this system lets a user mount nothing")
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(
        [*namespace, "sh", "-c", FILL_A_DISK, "sh", disk, sys.executable, SCRIPT], env=ENVIRONMENT, check=True
    )
    error = Path(f"{disk}.error").read_text()
    assert "OSError: [Errno 28] no room left to write to" in error
    assert "complete shards are safe: make room and run the same command again" in error
    assert 0 < len(check_that_it_is_sound(Path(f"{disk}.full")).shards) < 24
    collect(f"{disk}.full", n=120)
    assert folder_bytes(f"{disk}.full") == folder_bytes(straight[0])
