"""What `doojax bench package` measures: seconds of the processor, a wheel, a sweep whose cells can be run."""

import pytest

from doojax.benchmarks import package
from doojax.experiments.sweeps.spec import cells_of, read_spec


def test_seconds_are_those_of_the_processor():
    asleep, busy = "import time; time.sleep(0.6)", "import time\nwhile time.process_time() < 0.6: pass"
    assert package._seconds(asleep) < 0.4 < 0.59 < package._seconds(busy)


def test_a_wheel_is_as_large_as_its_file_and_needs_sources(monkeypatch, tmp_path):
    row = package.wheel_row()
    assert row.unit == "MB" and 0.1 < row.value < 20
    monkeypatch.setattr(package, "SOURCES", tmp_path)
    with pytest.raises(FileNotFoundError, match="run this in a clone of doojax"):
        package.wheel_row()


def test_cells_a_minute_are_those_of_a_whole_sweep(monkeypatch):
    asked = []

    def sweep(spec, *, out, executor, workers):
        asked.append((cells_of(read_spec(spec)), executor, workers))

    clock = iter([100.0, 130.0])
    monkeypatch.setattr(package, "sweep", sweep)
    monkeypatch.setattr(package.time, "perf_counter", lambda: next(clock))
    row = package.sweep_row("ray", 100, 2)
    ((cells, executor, workers),) = asked
    assert len(cells) == 100 and (executor, workers) == ("ray", 2) and row.value == 200.0
    assert row.tags == {"executor": "ray", "workers": 2}
