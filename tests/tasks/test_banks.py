"""Settled ropes that come with doojax are those that the simulator makes."""

from dataclasses import replace

import numpy as np
import pytest

from doojax.tasks import make_task, starts
from doojax.tasks.banks import FOLDER, bank_of

FEW = 8  # of its ropes, which do not know of each other


@pytest.mark.parametrize("count", [FEW, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", sorted(file.stem for file in FOLDER.glob("*.npz")))
def test_what_comes_along_is_what_is_simulated(name, count, monkeypatch):
    """Where this fails, what ropes do has changed: write the banks anew, and with them all data."""
    settle = starts.settle_bank
    monkeypatch.setattr(starts, "settle_bank", lambda scene, *of: settle(scene, *(one[:count] for one in of)))
    task = make_task(name)
    there, made = bank_of(task.scene, lambda: pytest.fail("it is of another scene")), task.settled()
    assert len(made.qpos) == (count or len(there.qpos))
    for field in ("qpos", "points"):
        np.testing.assert_allclose(getattr(there, field)[:count], getattr(made, field), atol=1e-5)
    np.testing.assert_allclose(there.radius, made.radius)


def test_another_rope_is_settled_and_obstacles_make_no_difference():
    task = make_task("rope_dragging")
    crowded = make_task("rope_dragging", crowd=2)
    stiff = replace(task.scene, rope=replace(task.scene.rope, bending_stiffness=0.02))
    assert bank_of(crowded.scene, lambda: "settled") != "settled"
    assert bank_of(stiff, lambda: "settled") == "settled"
    assert bank_of(replace(task.scene, name="unknown"), lambda: "settled") == "settled"
