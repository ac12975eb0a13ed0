"""Seeing through, from the top, in section; what is taken home of it; small screens."""

import io
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from doojax.experiments.trials.record_files import load_record
from doojax.viewer.examples import prediction_record
from doojax.viewer.prediction_page import corners_of_predictions
from doojax.viewer.trial_view import apart

from .test_page import coloured


@pytest.fixture
def trial(view, contents):
    look, app = view(contents / "trial.npz")
    look.wait_for("reached the goal: goal reached")
    look.tab("View")
    return look, app, load_record(contents / "trial.npz")


def test_the_words_at_obstacles_lead_away_from_each_other():
    left, right, behind = np.array([[-0.1, 0, 0.2], [0.1, 0, 0.2], [0, 0.3, 0.2]])
    assert apart(np.stack([right, left])) == ["top-left", "top-right"]
    assert apart(np.stack([left, right, behind])) == ["top-right", "top-left", "bottom-left"]
    assert apart(np.zeros((0, 3))) == [] and apart(left[None]) == ["top-left"]


def test_a_prediction_that_leaves_what_happened_is_in_sight_but_not_one_that_explodes():
    record = prediction_record()
    happened = corners_of_predictions(replace(record, predicted_points=record.predicted_points * np.nan))
    low, high = happened.min(0), happened.max(0)
    away, room = record.predicted_points.copy(), (high - low).max() / 2
    away[-1, 1, 0] = high + np.array([0.8 * room, 0, 0])
    away[-1, 2, 0] = low - np.array([0, 1e6, 0])
    found = corners_of_predictions(replace(record, predicted_points=away))
    assert found[:, 0].max() == pytest.approx(high[0] + 0.8 * room, rel=1e-5)
    assert found[:, 1].min() == pytest.approx(low[1] - room, rel=1e-5)
    assert found[:, 2].min() <= low[2] and len(found) == 8


def grey(pixels: np.ndarray) -> int:
    """Pixels of obstacles, whatever is seen through them."""
    return int((np.abs(pixels - np.array([139, 152, 173])).max(-1) < 60).sum())


def test_obstacles_fade_and_vanish(trial):
    look, app, _ = trial
    before = grey(look.pixels())
    look.enter("Obstacles", 1.0)
    look.until(lambda: app._page.drawing._handles["obstacles/0"].opacity is None)
    look.enter("Obstacles", 0)
    look.until(lambda: grey(look.pixels()) < 0.7 * before)
    assert not any(name.startswith("obstacles") for name in app._page.drawing._handles)


def test_from_the_top_and_in_section(trial, server):
    look, _, _ = trial
    look.page.get_by_role("button", name="Top", exact=True).click()
    clients = server.get_clients().values()
    look.until(lambda: any(one.camera.position[2] > 1 for one in clients))

    def is_above(one) -> bool:
        away = one.camera.position - one.camera.look_at
        return bool(np.linalg.norm(away[:2]) < 0.01 * away[2])

    look.until(lambda: any(map(is_above, clients)))
    boxes = grey(look.pixels())
    look.enter("Cut at", 0.1)  # above the ropes, but through the boxes
    look.until(lambda: any(one.camera.near > 0.5 for one in clients))
    look.page.wait_for_timeout(300)
    assert grey(look.pixels()) != boxes
    look.page.get_by_role("button", name="Usual", exact=True).click()
    look.until(lambda: all(one.camera.near < 0.1 for one in clients))


@pytest.mark.parametrize("ending", ["PNG", pytest.param("GIF", marks=pytest.mark.slow), "HTML"])
def test_what_is_shown_can_be_taken_home(view, contents, ending):
    look, _ = view(contents / "prediction.npz")
    look.enter("Steps ahead", 9)  # at first the prediction lies over what happened, and hides it
    look.until(lambda: coloured(look.pixels(), "orange").sum() > 50)
    look.tab("View")
    with look.page.expect_download(timeout=60_000) as download:
        look.page.get_by_role("button", name=ending, exact=True).click()
    content = Path(download.value.path()).read_bytes()
    if ending == "HTML":
        assert content[:15].lower() == b"<!doctype html>" and len(content) > 100_000
    else:
        frames = imageio.imread(io.BytesIO(content), extension=f".{ending.lower()}", index=None)
        assert frames.ndim == 3 if ending == "PNG" else len(frames) > 5  # of a film, the first axis is time
        last = (frames if ending == "PNG" else frames[-1])[..., :3].astype(int)
        assert coloured(last, "orange").sum() > 50 and coloured(last, "violet").sum() > 30


def test_on_a_small_screen_the_controls_do_not_hide_the_rope(view, contents, new_look, server):
    view(contents / "trial.npz")
    small = new_look(width=390, height=844)
    small.wait_for("reached the goal: goal reached")
    record = load_record(contents / "trial.npz")
    client = max(server.get_clients().values(), key=lambda one: one.client_id)
    small.until(lambda: (client.camera.image_width, client.camera.image_height) == (390, 844))
    panel = small.page.get_by_text("doojax", exact=True).first.bounding_box()

    def uncovered() -> bool:
        eye = client.camera.position, client.camera.look_at
        column, row = small.projected(eye, 390, 844, record.points[0])
        return bool(
            (row < panel["y"]).all() and (row > 0).all() and (column > 0).all() and (column < 390).all()
        )

    small.until(uncovered)
    small.until(lambda: coloured(small.pixels()[: int(panel["y"])], "orange").sum() > 30)
    small.page.close()
