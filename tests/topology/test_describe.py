"""`doojax signature FILE`: what it prints, the example in the documentation, errors that name the item."""

import doctest
import json
import re
from pathlib import Path

import numpy as np
import pytest

from doojax.topology.describe import THREADING, read_scene, signature

PAGE = Path(__file__).parents[2] / "docs" / "topology.md"
SCENE = {
    "skeleton": {"ring": [[0.5, -1, -1], [0.5, 1, -1], [0.5, 1, 1], [0.5, -1, 1], [0.5, -1, -1]]},
    "rope": [[0, 0, 0], [0.5, 0, 0], [1, 0, 0]],
    "base": [0, -2, 0],
    "grippers": {"right": {"location": 0.9, "path": [[1, -2, 0], [1, -0.1, 0]]}},
    "attachments": {"wall": {"location": 0, "path": []}},
}


def write(tmp_path, content):
    file = tmp_path / "scene.json"
    file.write_text(json.dumps(content))
    return file


def changed(path, value):
    """A copy of the scene in which the item at a path is another, or gone if that is None."""
    scene = json.loads(json.dumps(SCENE))
    *parents, last = path
    item = scene
    for key in parents:
        item = item[key]
    if value is None:
        del item[last]
    else:
        item[last] = value
    return scene


def test_a_scene_is_printed_with_what_its_signature_is_made_of(tmp_path, capsys):
    signature(write(tmp_path, SCENE))
    assert capsys.readouterr().out.splitlines() == [
        "{(1)}",
        "wall - right",
        "  ring: +1, 0.5000 m away",
    ]


def test_threading_is_threaded(capsys):
    signature(THREADING)
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "{(1,0,0),(0,1,1)}"
    assert [line for line in printed[1:] if not line.startswith("  ")] == ["attach1 - right", "right - left"]
    scene = read_scene(THREADING)
    assert scene.holders == ("left", "right", "attach1")
    assert scene.skeleton.names == ("loop1", "loop2", "loop3")
    np.testing.assert_allclose(scene.skeleton.loops[0, 0], [0.2029, 0.5071, 0.42], atol=1e-6)


def test_without_attachments_there_is_no_loop(tmp_path, capsys):
    signature(write(tmp_path, changed(["attachments"], None)))
    assert capsys.readouterr().out == "∅\nno grasp loops\n"


def test_loops_of_grippers_that_are_linked_with_nothing_can_be_kept(tmp_path, capsys):
    grippers = {
        "left": {"location": 0.7, "path": [[1, -1, 0]]},
        "right": {"location": 0.9, "path": [[1, -1, 0]]},
    }
    file = write(tmp_path, changed(["grippers"], grippers))
    signature(file)
    assert capsys.readouterr().out.startswith("{(1)}\n")
    signature(file, keep_empty=True)
    assert capsys.readouterr().out.startswith("{(1),(0)}\n")


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (changed(["rope"], None), "the scene lacks rope"),
        (changed(["ropes"], 1), "the scene has unknown ropes"),
        ([SCENE], r"the scene is \[.*; expected an object"),
        (
            changed(["skeleton"], [1]),
            r"the skeleton loops are \[1\]; expected an object with",
        ),
        (changed(["skeleton", "ring"], SCENE["skeleton"]["ring"][:-1]), "skeleton loop 'ring' is open"),
        (changed(["grippers", "right"], {"location": 1}), "gripper 'right' lacks path"),
        (
            changed(["grippers", "right", "location"], 1.5),
            "the location of gripper 'right' is 1.5; expected",
        ),
        (
            changed(["attachments", "wall", "path"], [[0, 0, "x"]]),
            r"the path of attachment 'wall': \[0\]\[2\] is 'x', expected float",
        ),
        (changed(["rope", 1, 2], float("nan")), "the rope is not finite at point 1"),
    ],
)
def test_a_file_that_describes_no_scene_is_an_error_that_names_the_item(tmp_path, scene, message):
    with pytest.raises(ValueError, match=rf"scene\.json does not describe a scene: {message}"):
        signature(write(tmp_path, scene))


def test_loops_that_touch_are_an_error_with_both_names(tmp_path):
    ring = np.add(SCENE["skeleton"]["ring"], [0, 0, 1]).tolist()
    with pytest.raises(ValueError, match="grasp loop wall - right and skeleton loop 'ring' touch"):
        signature(write(tmp_path, changed(["skeleton", "ring"], ring)))


def test_a_file_that_is_missing_or_no_json_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        signature(tmp_path / "nothing.json")
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    with pytest.raises(ValueError, match=r"broken\.json does not describe a scene: Expecting"):
        signature(broken)


def test_the_python_of_the_documentation_runs_and_gives_what_it_says(capsys):
    first, second = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    for example in doctest.DocTestParser().get_examples(first):
        exec(example.source, names)
    assert names["linking_number"](names["rope"], names["frame"]) == int(example.want)
    exec(second, names)
    assert capsys.readouterr().out.strip().endswith(second.strip().split("# ")[-1])


def test_the_documentation_shows_a_scene_and_what_is_printed_for_it(tmp_path, capsys):
    page = PAGE.read_text(encoding="utf-8")
    scene = json.loads(re.search(r"```json\n(.*?)```", page, re.DOTALL)[1])
    shown = re.search(r"\$ doojax signature scene.json\n(.*?)```", page, re.DOTALL)[1]
    signature(write(tmp_path, scene))
    assert capsys.readouterr().out == shown
