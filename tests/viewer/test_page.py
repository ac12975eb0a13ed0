"""The page in a browser: what one sees of a data set, a prediction and a trial, and what one does there."""

import re

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv

from doojax.datasets import Dataset
from doojax.experiments.trials.record_files import load_record, save_record
from doojax.viewer.examples import trial_record

HUES = {"orange": (8, 40), "violet": (250, 310), "green": (150, 185), "blue": (190, 225), "yellow": (44, 56)}


def coloured(pixels: np.ndarray, name: str) -> np.ndarray:
    """Which pixels have a colour, and that hue."""
    hue, saturation, _ = np.moveaxis(rgb_to_hsv(pixels / 255), -1, 0)
    low, high = HUES[name]
    return (saturation > 0.35) & (hue * 360 > low) & (hue * 360 < high)


def rope_at(look, app, place) -> bool:
    """Is the rope seen at a place in the world?"""
    return bool(coloured(look.colour_at(app._page.view, place), "orange"))


@pytest.fixture
def towed(view, contents):
    look, app = view(contents / "towed")
    look.wait_for(re.compile("^trajectory 0"))
    return look, app, Dataset.open(contents / "towed")


def test_a_data_set_opens_with_its_rope_where_it_is(towed):
    look, app, dataset = towed
    rope = dataset["points"][0][0]
    look.until(lambda: all(rope_at(look, app, point) for point in rope[2:8]))
    assert coloured(look.pixels(), "orange").sum() > 300
    assert not rope_at(look, app, rope[5] + np.array([0.0, 0.0, 0.3]))


def test_the_slider_moves_the_rope(towed):
    look, app, dataset = towed
    ropes = dataset["points"][0]
    look.slide("State", 0.7)
    look.until(lambda: look.number("State") > 15)
    state = look.number("State")
    look.until(lambda: rope_at(look, app, ropes[state][5]))
    assert app._content.player.moment == state
    look.enter("State", 3)
    look.until(lambda: rope_at(look, app, ropes[3][5]) and not rope_at(look, app, ropes[state][5]))


def test_a_step_in_time_changes_what_is_there_and_makes_nothing_anew(towed):
    look, app, dataset = towed
    look.enter("State", 12)
    look.until(lambda: rope_at(look, app, dataset["points"][0][12][5]))
    (drawing,) = app._content._drawings
    before = dict(drawing._handles)
    assert {"now/rope", "now/grippers", "trail/ropes", "trail/grippers", "obstacles/0"} <= before.keys()
    look.press("l")
    look.until(lambda: rope_at(look, app, dataset["points"][0][13][1]))
    assert all(drawing._handles[name] is handle for name, handle in before.items())
    assert len(drawing._handles["trail/grippers"].points) == 13  # as many lines as steps
    look.press("Home")
    look.until(lambda: not any(name.startswith("trail") for name in drawing._handles))


def everything_in_sight(look, app, server) -> bool:
    """Are all corners of what is shown inside the scene of the latest to come, as its own camera sees it?"""
    client = max(server.get_clients().values(), key=lambda client: client.client_id)
    height, width = look.pixels().shape[:2]
    if (client.camera.image_width, client.camera.image_height) != (width, height):
        return False
    eye = client.camera.position, client.camera.look_at
    column, row = look.projected(eye, width, height, app._content._shown[0].corners())
    inside = (column > 0) & (column < width) & (row > 0) & (row < height)
    return bool(inside.all() and (np.ptp(column) > 0.6 * width or np.ptp(row) > 0.6 * height))


@pytest.mark.slow
def test_everything_is_in_sight_in_small_pages_until_the_view_is_turned_by_hand(towed, new_look, server):
    _, app, dataset = towed
    small = new_look(width=800, height=500)
    small.until(lambda: everything_in_sight(small, app, server))
    small.until(lambda: rope_at(small, app, dataset["points"][0][0][5]))
    small.page.set_viewport_size({"width": 1100, "height": 450})
    small.until(lambda: everything_in_sight(small, app, server))
    small.page.mouse.move(200, 200)
    small.page.mouse.down()
    small.page.mouse.move(260, 230, steps=4)
    small.page.mouse.up()
    small.page.wait_for_timeout(500)
    client = max(server.get_clients().values(), key=lambda client: client.client_id)
    turned = client.camera.position
    small.page.set_viewport_size({"width": 800, "height": 600})
    small.until(lambda: client.camera.image_height == 600)
    small.page.wait_for_timeout(500)
    np.testing.assert_allclose(client.camera.position, turned, atol=1e-3)  # the turn had not quite ended
    small.page.close()


def test_another_trajectory_and_several_side_by_side(towed):
    look, app, dataset = towed
    look.enter("Trajectory", 60)
    look.wait_for(re.compile("^trajectory 60"))
    look.until(lambda: rope_at(look, app, dataset["points"][60][0][5]))
    look.press("k")
    look.wait_for(re.compile("^trajectory 61"))
    look.press("i", "i")
    look.wait_for(re.compile("^trajectory 59"))
    one = coloured(look.pixels(), "blue").sum()
    look.tab("Compare")
    look.enter("Shown at once", 4)
    look.until(lambda: coloured(look.pixels(), "blue").sum() > one + 50)  # the colour of the second
    assert len(app._content._shown) == 4
    look.choose("Arrangement", "overlaid")
    second = dataset["points"][60][0]  # in its own place now
    look.until(lambda: any(coloured(look.colour_at(app._page.view, point), "blue") for point in second[2:8]))


def test_a_filter_lets_through_those_that_numpy_counts(towed):
    look, _, dataset = towed
    clearance = 1000 * dataset["clearance"][:].min(1)
    look.tab("Filter and sort")
    look.wait_for("150 of 150 trajectories")
    look.choose("By", "least clearance, mm")
    look.until(lambda: look.labelled("From").first.input_value() not in ("", "0"))
    look.wait_for("150 of 150 trajectories")
    look.enter("From", 100)
    expected = int((clearance >= 100).sum())
    assert 0 < expected < 150
    look.wait_for(f"{expected} of 150 trajectories")
    look.choose("Order", "descending")
    look.wait_for(re.compile(f"^trajectory {np.argmax(clearance)}"))
    look.enter("To", 101 - 1000)
    look.wait_for("0 of 150 trajectories")
    look.wait_for("no trajectory passes the filter")
    look.until(lambda: coloured(look.pixels(), "orange").sum() < 30)  # a few where the axes meet
    look.choose("By", "(none)")
    look.wait_for(re.compile("^trajectory 0"))


def test_the_keyboard_plays_pauses_and_steps(towed):
    look, app, dataset = towed
    ropes = dataset["points"][0]
    look.press(" ")
    look.until(lambda: look.number("State") >= 3)
    look.press(" ")
    look.page.get_by_role("button", name="Play").wait_for()
    paused = look.number("State")
    look.press("l", "l")
    look.until(lambda: look.number("State") == paused + 2)
    look.press("j")
    look.until(lambda: look.number("State") == paused + 1)
    look.press("End")
    look.until(lambda: look.number("State") == len(ropes) - 1)
    look.press("Home")
    look.until(lambda: look.number("State") == 0)
    look.until(lambda: rope_at(look, app, ropes[0][5]))  # where it was: no key has turned the camera


def test_space_after_a_click_on_play_pauses(towed):
    look, app, _ = towed
    look.page.get_by_role("button", name="Play").click()
    pause = look.page.get_by_role("button", name="Pause")
    pause.wait_for()
    look.page.keyboard.press(" ")  # the button has the focus
    look.page.get_by_role("button", name="Play").wait_for()
    look.press("k")
    look.wait_for(re.compile("^trajectory 1"))  # all that the keys did has come by now
    assert not app._content.player.playing


def test_playing_goes_round_or_stops_at_the_end(towed):
    look, _, dataset = towed
    last = dataset["points"].shape[1] - 1
    look.choose("States per second", "16")
    look.enter("State", last - 2)
    look.press(" ")
    look.until(lambda: 0 < look.number("State") < last - 4)
    look.labelled("Loop").first.click(force=True)
    look.page.get_by_role("button", name="Play").wait_for()
    look.until(lambda: look.number("State") == last)


@pytest.mark.slow
def test_two_look_at_the_same_and_a_reload_comes_back_to_it(towed, new_look):
    look, app, dataset = towed
    ropes = dataset["points"][0]
    other = new_look()
    other.until(lambda: rope_at(other, app, ropes[0][1]))
    look.enter("State", 25)
    other.until(lambda: other.number("State") == 25 and rope_at(other, app, ropes[25][1]))
    other.press("l")
    look.until(lambda: look.number("State") == 26 and rope_at(look, app, ropes[26][1]))
    other.page.reload()
    other.wait_for(re.compile("^trajectory 0"), 20)
    other.until(lambda: other.number("State") == 26 and rope_at(other, app, ropes[26][1]))
    other.press("j")
    look.until(lambda: look.number("State") == 25)
    other.page.close()
    look.enter("State", 2)  # it goes on for the one who stays
    look.until(lambda: rope_at(look, app, ropes[2][1]))


def test_a_prediction_shows_ghost_error_score_and_what_the_model_saw(view, contents):
    look, app = view(contents / "prediction.npz")
    record = load_record(contents / "prediction.npz")
    look.wait_for(re.compile("^prediction 0, from state 0"))
    look.enter("Steps ahead", 9)
    error = 100 * np.sqrt((record.errors()[0, 9] ** 2).mean())
    look.wait_for(f"error {error:.1f} cm")
    look.wait_for(f"accept probability {record.scores['accept probability'][0, 9]:.3g} (threshold 0.5)")
    look.until(lambda: rope_at(look, app, record.points[9][3]))
    look.until(lambda: coloured(look.pixels(), "violet").sum() > 30)
    look.tab("Filter and sort")
    look.choose("By", "greatest error, cm")
    look.choose("Order", "descending")
    worst = int(np.nanargmax(np.sqrt((record.errors() ** 2).mean(-1)).max(1)))
    look.wait_for(re.compile(f"^prediction {worst}, from state {record.start[worst]}"))
    look.tab("Model input")
    layer = coloured(look.pixels(), "orange").sum()
    look.choose("Input", "hidden")
    look.until(lambda: coloured(look.pixels(), "orange").sum() < layer - 1000)


def test_a_trial_shows_tree_path_goal_and_jumps_between_events(view, contents):
    look, _ = view(contents / "trial.npz")
    record = load_record(contents / "trial.npz")
    look.wait_for("reached the goal: goal reached")
    look.until(lambda: coloured(look.pixels(), "green").sum() > 100)
    look.until(lambda: coloured(look.pixels(), "blue").sum() > 60)  # the chosen path
    look.until(lambda: look.labelled("Event").first.input_value().startswith("2. state 0: execute"))
    for event in record.events[2:4]:  # the box had followed to the last of those at state 0
        look.press("n")
        look.until(lambda event=event: look.number("State") == event.step)
    recovered = record.events[3]
    assert recovered.kind == "recover"
    look.wait_for(f"last event: recover {recovered.text}")
    look.press("n", "p", "p", "p")
    look.until(lambda: look.number("State") == record.events[1].step)
    look.press("End")
    look.wait_for(f"last event: end {record.end}")
    look.until(lambda: coloured(look.pixels(), "yellow").sum() > 5)  # the way of the recovery
    look.tab("Search")
    by_depth = look.pixels()
    look.choose("Colour by", "score")
    look.until(lambda: (look.pixels() != by_depth).any(-1)[:, :500].sum() > 100)  # beside the panel
    with_tree = look.pixels()
    look.labelled("Tree").first.click(force=True)
    look.until(lambda: (look.pixels() != with_tree).any(-1).sum() > 500)
    look.labelled("Show a node's rope").first.click(force=True)
    look.enter("Node", 7)
    look.until(lambda: (look.pixels() != with_tree).any(-1).sum() > 500)


@pytest.mark.slow
def test_a_tree_of_twenty_thousand_nodes_is_one_object(view, tmp_path):
    record = trial_record(seed=2, nodes=20_000)
    save_record(tmp_path / "large.npz", record)
    look, app = view(tmp_path / "large.npz")
    look.tab("Search")
    look.wait_for("plan 1: 20,000 nodes", 20)
    handle = app._page.drawing._handles["plan/tree"]
    assert len(handle.batched_positions) == 20_000 - 1
    assert sum(name.startswith("plan/tree") for name in app._page.drawing._handles) == 1
    look.press("End")
    look.wait_for("last event: end", 20)


def test_one_goes_from_one_thing_to_another_in_a_folder(view, contents):
    look, _ = view(contents)
    look.wait_for(re.compile("^prediction 0"))
    look.choose("Show", "trial.npz · goal reached")
    look.wait_for("reached the goal: goal reached")
    look.choose("Show", "towed · data set")
    look.wait_for(re.compile("^trajectory 0"))
