"""What one sees of why: mistaken predictions, plans that were left, many trials, runs over each other."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv

from doojax.experiments.trials.record_files import load_record, save_record
from doojax.experiments.trials.why import why
from doojax.learning.runs import RunDirectory
from doojax.viewer import colours, replan, trial_page
from doojax.viewer.app import App, tunnel_hint
from doojax.viewer.examples import trial_record, write_evaluation, write_long_list
from doojax.viewer.text import shortened
from doojax.viewer.trial_table import chosen, read_rows

from .conftest import SIZE
from .test_page import coloured

SCENES, METHODS = 4, ("classifier", "no_classifier")


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("evaluation")
    write_evaluation(folder, SCENES, METHODS)
    return folder


def warm(pixels: np.ndarray) -> int:
    """Pixels of the colours of errors of 5 to 7 cm, between the rope's orange and green."""
    hue, saturation, _ = np.moveaxis(rgb_to_hsv(pixels / 255), -1, 0)
    return int(((saturation > 0.5) & (hue * 360 > 42) & (hue * 360 < 62)).sum())


def test_a_prediction_page_goes_through_worst_steps_and_mistakes_of_the_judge(view, contents):
    look, _ = view(contents / "prediction.npz")
    record = load_record(contents / "prediction.npz")
    error = record.rms_errors()
    look.wait_for(re.compile("^prediction 0, from state 0"))
    worst = np.unravel_index(np.nanargmax(error), error.shape)
    pale = warm(look.pixels())
    look.press("n")
    look.wait_for(re.compile(f"^prediction {worst[0]}, from state {record.start[worst[0]]}"))
    look.until(lambda: look.number("Steps ahead") == worst[1])
    look.wait_for(f"error {100 * error.max():.1f} cm")
    look.until(lambda: warm(look.pixels()) > pale + 20)  # the predicted rope has the colours of its errors
    accepts, rejects = (np.argwhere(one) for one in record.mistaken())
    assert len(accepts) and not len(rejects)
    look.choose("Go through", f"false accepts ({len(accepts)})")
    place = max(accepts.tolist(), key=lambda at: error[tuple(at)])
    look.wait_for(re.compile(f"^prediction {place[0]}, "))
    look.until(lambda: look.number("Steps ahead") == place[1])
    look.wait_for("accepted, but wrong: a false accept")
    look.choose("Go through", "false rejects (0)")
    look.wait_for("there are no false rejects")


def test_a_trial_shows_where_the_plan_expected_the_rope_and_why_it_ended(view, contents):
    look, app = view(contents / "trial.npz")
    record = load_record(contents / "trial.npz")
    look.wait_for(f"why: {why(record)}")
    plan = record.plans[1]
    look.enter("State", plan.step + 1)
    look.wait_for(f"plan 2, step 1 of {len(plan.path) - 1}: 0.0 cm off what it expected")
    shown = app._page.drawing._handles["expected/rope"].vertices
    ends = plan.points[plan.path[1]][[0, -1]]
    assert all(np.linalg.norm(shown - end, axis=-1).min() < 3 * record.look.rope_radius for end in ends)
    stuck = record.events[3].step
    look.enter("State", stuck + 1)
    look.until(lambda: look.labelled("Event").first.input_value().startswith("4. "))
    assert look.labelled("Event").first.input_value() == f"4. state {stuck}: recover {record.events[3].text}"
    for mark in ("search", "recovery", "accepted", "threshold"):
        look.wait_for(re.compile(f"^{mark}$"))


def test_a_tree_that_was_not_kept_is_said_to_be_absent(view, tmp_path):
    record = trial_record(seed=2, nodes=64)
    bare = []
    for plan in record.plans:
        nodes = np.arange(len(plan.path))
        kept = {name: getattr(plan, name)[plan.path] for name in ("points", "grippers", "accepted", "score")}
        bare.append(replace(plan, parent=nodes - 1, path=nodes, **kept))
    text = "solved, 1.0 cm from the goal; 30 of 63 extensions accepted"
    events = tuple(replace(one, text=text) if one.kind == "plan" else one for one in record.events)
    save_record(tmp_path / "bare.npz", replace(record, plans=tuple(bare), events=events))
    look, _ = view(tmp_path / "bare.npz")
    look.tab("Search")
    look.wait_for("doojax evaluate --keep-trees records all that was tried")
    assert look.page.get_by_text("tree, by depth").count() == 0


def test_trials_are_filtered_and_gone_through_by_key(view, evaluation):
    look, app = view(evaluation)
    look.wait_for(f"{2 * SCENES} trials, 2 methods")
    look.wait_for("100 % (51 to 100)")  # Wilson's, of 4 of 4
    look.wait_for("50 % (15 to 85)")
    look.wait_for("rope dragging · classifier · seed 0")
    look.press("k")
    look.wait_for("rope dragging · no_classifier · seed 0")
    look.choose("Show", "failed only")
    look.wait_for("rope dragging · no_classifier · seed 1")
    assert look.page.locator(".trials").get_by_role("row").filter(has_text="failed").count() == 2
    look.press("k")
    look.wait_for("rope dragging · no_classifier · seed 3")
    look.choose("Show", "classifier reached, no_classifier did not")
    look.until(
        lambda: look.page.locator(".trials").get_by_role("row").filter(has_text="reached").count() == 2
    )
    look.wait_for("rope dragging · no_classifier · seed 3")  # it stays while it passes the filter
    other = app._page.drawing._handles["others/classifier/rope"]
    assert tuple(other._meshes[0].color) == colours.METHODS["classifier"]
    assert tuple(app._page.drawing._handles["now/rope"]._meshes[0].color) == colours.METHODS["no_classifier"]
    look.until(lambda: coloured(look.pixels(), "blue").sum() > 60)
    look.choose("Show", "no_classifier reached, classifier did not")
    look.wait_for("no trial passes the filter")


def test_methods_stand_side_by_side_and_lie_over_each_other_in_one_scene(view, evaluation, tmp_path):
    folder = tmp_path / "moved"
    shutil.copytree(evaluation, folder)
    other = load_record(folder / "classifier" / "00001.npz")
    moved = np.array([0.0, 0.2, 0.0], np.float32)  # m, lest the ropes of both lie in each other
    other = replace(other, points=other.points + moved, grippers=other.grippers + moved)
    save_record(folder / "classifier" / "00001.npz", other)
    look, app = view(folder)
    look.wait_for("rope dragging · classifier · seed 0")
    look.press("k", "k", "k")
    look.wait_for("rope dragging · no_classifier · seed 1")
    look.wait_for("in scene 1:")
    lines = look.page.locator(".beside tr")
    look.until(lambda: lines.count() == 2)
    error = 100 * other.about["final_error_m"]
    for line, method, outcome in zip(lines.all(), METHODS, ("reached", "failed"), strict=True):
        assert method in line.inner_text() and f"{outcome}, {error:.1f} cm away" in line.inner_text()
        dot = "e => getComputedStyle(e).backgroundColor"
        assert line.locator("span").first.evaluate(dot) == f"rgb{colours.METHODS[method]}"
    assert lines.locator("a").inner_text() == "classifier"  # the one that is not shown

    def blue() -> int:
        """Of the other method's rope, how many places are seen in that method's colour."""
        pixels = look.pixels()
        size = pixels.shape[1::-1]
        columns, rows = look.projected(app._page.view(*size), *size, other.points[0, 1:9])
        return int(coloured(pixels[rows.round().astype(int), columns.round().astype(int)], "blue").sum())

    look.until(lambda: blue() >= 5)
    look.labelled("Other methods").first.click(force=True)
    look.until(lambda: blue() <= 1)  # where the way of the plan may be, which is as blue
    assert lines.count() == 2


def test_a_narrow_table_of_trials_says_all_that_a_wide_one_says(view, evaluation):
    look, _ = view(evaluation)
    look.wait_for("rope dragging · classifier · seed 0")
    line = read_rows(evaluation)[0].line
    said = look.page.get_by_text(f"{line.searches} searches, {line.actions} actions, {line.plan_s:.1f} s: ")
    ends = "all => all.filter(e => e.offsetWidth > 0).map(e => e.getBoundingClientRect().right)"
    heads = look.page.locator(".trials th")
    assert len(heads.evaluate_all(ends)) == 7 and not said.first.is_visible()
    try:
        look.page.set_viewport_size({"width": 390, "height": 844})
        look.until(said.first.is_visible)
        panel = look.page.locator(".trials").bounding_box()
        shown = heads.evaluate_all(ends)
        assert len(shown) == 4 and max(shown) <= panel["x"] + panel["width"]
    finally:
        look.page.set_viewport_size(SIZE)


def test_an_address_leads_to_one_trial_state_and_camera(view, evaluation, new_look, server):
    look, _ = view(evaluation)
    look.wait_for("rope dragging · classifier · seed 0")
    query = "?method=no_classifier&scene=2&state=3&eye=0.500,-1.000,2.000&at=0.100,0.000,0.000"
    other = new_look()
    other.page.goto(other.page.url.split("?")[0] + query + "&fixedDpr=1")
    other.wait_for("rope dragging · no_classifier · seed 2")
    other.until(lambda: other.number("State") == 3)
    client = max(server.get_clients().values(), key=lambda one: one.client_id)
    other.until(lambda: np.allclose(client.camera.position, [0.5, -1.0, 2.0], atol=1e-3))
    np.testing.assert_allclose(client.camera.look_at, [0.1, 0.0, 0.0], atol=1e-3)
    other.tab("View")
    other.press("l")
    other.until(lambda: other.number("State") == 4)
    other.page.get_by_role("button", name="Address of this view").click()
    other.until(lambda: "state=4" in other.page.url)
    said = parse_qs(urlparse(other.page.url).query)
    assert said["scene"] == ["2"] and said["method"] == ["no_classifier"]
    np.testing.assert_allclose([float(x) for x in said["eye"][0].split(",")], [0.5, -1, 2], atol=2e-3)
    other.page.goto(other.page.url.split("?")[0] + "?scene=77")
    other.wait_for("there is no trial of any method in scene 77")
    other.page.close()


def test_ten_thousand_trials_are_listed_without_opening_one(tmp_path, server, opened):
    write_long_list(tmp_path / "many", 10_000)  # whose other files are no records: not to be read
    while opened:
        opened.pop().close()
    opened.append(App(server, tmp_path / "many"))
    server.flush()
    rows = opened[0]._content._rows
    assert len(rows) == 10_000
    assert len(chosen(rows, "failed only", "all", "error", True)) == 3334


def test_what_is_tried_while_one_looks_appears(view, evaluation, tmp_path):
    folder = tmp_path / "growing"
    shutil.copytree(evaluation, folder)
    last = folder / "no_classifier" / "00003.npz"
    content = last.read_bytes()
    last.unlink()
    look, _ = view(folder)
    look.wait_for(f"{2 * SCENES - 1} trials, 2 methods")
    last.write_bytes(content)
    look.wait_for(f"{2 * SCENES} trials, 2 methods", 20)
    assert len(read_rows(folder)) == 2 * SCENES


def test_an_evaluation_that_has_just_begun_is_shown_once_a_trial_is_finished(view, evaluation, tmp_path):
    folder = tmp_path / "begun"
    (folder / "classifier").mkdir(parents=True)
    for name in ("config.json", "classifier/method.json"):
        shutil.copy(evaluation / name, folder / name)
    look, _ = view(folder)
    look.wait_for("is empty: no trial is finished yet")
    for number in (0, 1):
        record = (evaluation / "classifier" / f"{number:05d}.npz").read_bytes()
        (folder / "classifier" / "new").write_bytes(record)
        (folder / "classifier" / "new").rename(folder / "classifier" / f"{number:05d}.npz")
        with (folder / "classifier" / "trials.jsonl").open("a") as file:
            file.write('{"trial": 1, "reach')  # half a line, of one that is not finished or was killed
        look.wait_for(f"{number + 1} trials, 1 methods", 20)
    assert look.page.get_by_text("is empty").count() == 0
    look.wait_for("rope dragging · classifier · seed 0")


def test_what_comes_to_a_folder_while_one_looks_is_offered(view, contents, tmp_path):
    shutil.copy(contents / "trial.npz", tmp_path / "a.npz")
    look, _ = view(tmp_path)
    look.wait_for("reached the goal: goal reached")
    look.enter("State", 3)
    shutil.copy(contents / "prediction.npz", tmp_path / "b.tmp")
    (tmp_path / "b.tmp").rename(tmp_path / "b.npz")
    look.until(lambda: look.page.get_by_text("Show", exact=True).count() == 1, 20)
    assert look.number("State") == 3  # what is shown stays as it is
    look.choose("Show", "b.npz · prediction")
    look.wait_for(re.compile("^prediction 0"))
    look.choose("Show", "a.npz · goal reached")
    look.wait_for("reached the goal: goal reached")


def test_runs_lie_over_each_other_and_grow_while_training_goes_on(view, tmp_path):
    runs = {
        name: RunDirectory.open(tmp_path / name, {"width": width}) for name, width in (("a", 4), ("b", 8))
    }
    for epoch in range(1, 4):
        for name, run in runs.items():
            run.log({"epoch": epoch, "loss": [2.0 / epoch, 4.0 / epoch if name == "a" else 3.0 / epoch]})
    look, _ = view(tmp_path)
    look.wait_for("training run, 3 epochs")
    look.wait_for("network 1")
    look.tab("Beside")
    look.labelled("b").first.click(force=True)
    look.tab("Curves")
    look.wait_for(re.compile("^b$"))
    with (tmp_path / "b" / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 4, "lo')  # half a line
    runs["a"].log({"epoch": 4, "loss": [0.5, 1.0]})
    look.wait_for("training run, 4 epochs")
    drawn = (
        "Object.values(window.__viserTestpoints.uplots ?? {}).map(plot => plot.chart.data.map(d => [...d]))"
    )
    look.until(lambda: any(len(data[0]) == 4 for data in look.page.evaluate(drawn)))
    _, a, b = look.page.evaluate(drawn)[0]
    np.testing.assert_allclose(a, [3.0, 1.5, 1.0, 0.75])  # the means of two networks
    np.testing.assert_allclose(np.array(b[:3], float), [2.5, 1.25, 2.5 / 3], rtol=1e-6)


def test_who_comes_by_ssh_is_told_how_to_look():
    there = {"SSH_CONNECTION": "10.0.0.7 50000 10.0.0.9 22", "USER": "ada"}
    assert "ssh -N -L 8080:localhost:8080 ada@10.0.0.9" in tunnel_hint("127.0.0.1", 8080, there)
    assert tunnel_hint("127.0.0.1", 8080, {}) == "" == tunnel_hint("0.0.0.0", 8080, there)


def test_a_long_path_loses_its_middle():
    path = "/home/somebody/experiments/2026/november/trials/classifier/00007.npz"
    assert len(shortened(path)) == 44
    assert shortened(path).startswith("/home/somebody") and shortened(path).endswith("classifier/00007.npz")
    assert shortened("short.npz") == "short.npz"


def test_a_goal_is_moved_and_planned_to_again(view, contents, tmp_path, monkeypatch):
    record = load_record(contents / "trial.npz")
    command = "doojax plan rope_dragging --seed 4 --method collision_checker"
    save_record(tmp_path / "plan.npz", replace(record, about={"command": command}))
    asked = []

    def plan(task, **options):
        asked.append((task, options))
        moved = replace(
            record, goal=np.array(options["goal"]), about={"command": command}, method="planned anew"
        )
        save_record(options["out"], moved)

    monkeypatch.setattr(replan, "plan", plan)
    monkeypatch.setattr(replan, "planned_by", lambda _: {"task": "rope_dragging", "seed": 4, "goal": None})
    monkeypatch.setattr(trial_page, "planned_by", replan.planned_by)
    look, app = view(tmp_path / "plan.npz")
    look.wait_for("made up · seed 2")
    look.tab("Goal")
    handle = app._page.server.scene.get_handle_by_name("/goal handle")
    x, y, _ = record.goal
    width, height = look.pixels().shape[1::-1]
    arrow = np.array([x + 1.6 * record.goal_radius, y, record.goal[2]])
    for place in (record.goal, arrow):
        column, row = look.projected(app._page.view(width, height), width, height, place)
    look.page.mouse.move(float(column), float(row))
    look.page.wait_for_timeout(200)
    look.page.mouse.down()
    look.page.mouse.move(float(column) + 60, float(row), steps=6)
    look.page.mouse.up()
    look.until(lambda: abs(handle.position[0] - x) > 0.01)
    assert handle.position[1] == pytest.approx(y, abs=1e-6)  # along its arrow
    look.page.get_by_role("button", name="Plan again").click()
    look.wait_for("planned anew · seed 2")
    ((task, options),) = asked
    assert task == "rope_dragging" and options["seed"] == 4 and options["out"] == tmp_path / "plan_1.npz"
    np.testing.assert_allclose(options["goal"], handle.position, atol=1e-3)


def test_only_what_doojax_plan_made_is_planned_again(contents):
    record = load_record(contents / "trial.npz")
    for command, known in (
        ("doojax plan toy --seed 3 --goal 0.1 0.2 0.01", True),
        ("doojax evaluate toy --methods oracle --out x", False),
        ("rm -r /", False),
        ("doojax plan toy && doojax plan toy", False),
    ):
        found = replan.planned_by(replace(record, about={"command": command}))
        assert (found is not None) == known
    assert replan.planned_by(record) is None
