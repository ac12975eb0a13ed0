"""Scenes, plans and trials with another rope than the task's own."""

from dataclasses import replace

import numpy as np
import pytest

from doojax.commands import parsed
from doojax.experiments.trials.evaluate import with_other_rope
from doojax.experiments.trials.plan import plan
from doojax.experiments.trials.record_files import load_record
from doojax.experiments.trials.replay import replay as executed_again
from doojax.experiments.trials.scenes import FOLDER, load_scenes, save_scenes, scenes
from doojax.experiments.trials.setting import TrialSettings
from doojax.planning import RrtSettings
from doojax.tasks import make_task
from doojax.tasks.ropes import OtherRope

ROUGH = OtherRope(friction=0.3, mass=0.8)
TASK = make_task("rope_dragging")


def test_a_saved_set_keeps_its_rope(tmp_path):
    own = load_scenes(FOLDER / "rope_dragging.scenes")
    rough = with_other_rope(own, TASK, ROUGH)
    save_scenes(tmp_path / "rough.scenes", rough)
    again = load_scenes(tmp_path / "rough.scenes")
    assert again.rope == ROUGH and own.rope == OtherRope()
    assert set(again.starts.model_fields) == set(rough.starts.model_fields) != set()
    assert all(
        np.array_equal(values, rough.starts.model_fields[name])
        for name, values in again.starts.model_fields.items()
    )
    with pytest.raises(ValueError, match=r"the scenes have a rope of their own, .*0.3"):
        with_other_rope(again, TASK, OtherRope(friction=0.1))
    with pytest.raises(ValueError, match=r"doojax scenes rope_dragging --rope.length"):
        with_other_rope(own, TASK, OtherRope(length=0.4))


@pytest.mark.slow
def test_a_trial_with_another_rope_is_executed_again_bit_for_bit(tmp_path):
    plan(
        "rope_dragging",
        method="collision_checker",
        seed=4,
        rope=ROUGH,
        engine="mujoco",
        planning=RrtSettings(lanes=16, extensions=512, shortcuts=0),
        budget=TrialSettings(searches=1, actions=6),
        out=tmp_path / "plan.npz",
    )
    record = load_record(tmp_path / "plan.npz")
    assert len(record.points) > 2 and record.about["rope"] == ROUGH.given
    assert parsed(record.about["command"])[0][1]["rope"] == ROUGH
    assert np.array_equal(executed_again(TASK.simulator("mujoco"), record), record.points)
    plain = replace(record, replay={n: v for n, v in record.replay.items() if not n.startswith("model/")})
    assert np.abs(executed_again(TASK.simulator("mujoco"), plain) - record.points).max() > 1e-4


@pytest.mark.slow
def test_scenes_of_a_longer_rope_carry_it(tmp_path):
    scenes("rope_dragging", count=1, rope=OtherRope(length=0.8, friction=0.2), out=tmp_path / "long.scenes")
    drawn = load_scenes(tmp_path / "long.scenes")
    assert drawn.rope == OtherRope(length=0.8, friction=0.2) and drawn.starts.model_fields
    task = make_task("rope_dragging")
    points = np.asarray(task.simulator("mujoco").observations(drawn.starts).state.points)
    own = task.scene.rope_part.parameters.length
    spans = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum()
    assert spans == pytest.approx(0.8 * (1 - 1 / points.shape[1]), rel=0.05) and own != 0.8
