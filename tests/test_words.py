"""Commands that show no bar say what they are at before they begin with what takes long."""

from functools import partial
from pathlib import Path

import pytest

from doojax.experiments.trials.plan import plan
from doojax.experiments.trials.scenes import scenes


class Slow(Exception):
    """Raised in place of what takes long."""


def slow(*_, **__):
    raise Slow


@pytest.mark.parametrize(
    ("command", "what_is_slow", "word"),
    [
        (partial(plan, "toy", method="oracle"), "plan.run_trials", "planning in toy with oracle"),
        (partial(scenes, "toy", count=3), "scenes.draw_scenes", "drawing 3 easy scenes of toy"),
    ],
)
@pytest.mark.slow
def test_a_word_comes_before_the_wait(monkeypatch, tmp_path, capsys, command, what_is_slow, word):
    monkeypatch.setattr(f"doojax.experiments.trials.{what_is_slow}", slow)
    suffix = "npz" if "plan" in what_is_slow else "scenes"
    with pytest.raises(Slow):
        command(out=Path(tmp_path / f"out.{suffix}"))
    assert capsys.readouterr().err.startswith(word)
