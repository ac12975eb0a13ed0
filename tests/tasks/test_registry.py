"""Tasks by name, from other packages too."""

from dataclasses import dataclass

import pytest

from doojax.tasks import Toy, make_task, register
from doojax.tasks.base import check_phase


@dataclass(frozen=True)
class Mine(Toy):
    """The toy task under another name."""

    name: str = "mine"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a task, as pip installs it."""
    (tmp_path / "other_tasks.py").write_text(
        "from dataclasses import dataclass\n"
        "from doojax.tasks import Toy\n"
        "@dataclass(frozen=True)\n"
        "class Elsewhere(Toy):\n"
        "    name: str = 'elsewhere'\n"
    )
    about = tmp_path / "other_tasks-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: other-tasks\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[doojax.tasks]\nelsewhere = other_tasks:Elsewhere.of\nmisnamed = other_tasks:Elsewhere.of\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    return "elsewhere"


def test_a_task_of_an_installed_package_is_found_by_name(package):
    task = make_task(package, phase="unconstrained", crowd=2)
    assert (task.name, task.phase, len(task.scene.obstacles)) == ("elsewhere", "unconstrained", 2)
    with pytest.raises(
        ValueError,
        match=r"expected one of rope_dragging, dual_gripper, .*, watering_2d, toy, elsewhere",
    ):
        make_task("knots")
    with pytest.raises(ValueError, match="'misnamed' calls itself 'elsewhere'"):
        make_task("misnamed")
    with pytest.raises(ValueError, match="a task called 'elsewhere' already"):
        register("elsewhere", Mine.of)


def test_without_the_package_there_is_no_such_task():
    with pytest.raises(ValueError, match=r"unknown task 'elsewhere', expected one of .*toy$"):
        make_task("elsewhere")


def test_a_registered_task_lasts_as_long_as_its_block():
    with register("mine", Mine.of):
        register("mine", Mine.of)  # the same again changes nothing
        assert isinstance(make_task("mine"), Mine)
        with pytest.raises(ValueError, match="a task called 'mine' already"):
            register("mine", Toy.of)
    with pytest.raises(ValueError, match="unknown task 'mine'"):
        make_task("mine")


def test_no_task_of_doojax_can_be_replaced():
    with pytest.raises(ValueError, match="a task called 'toy' already"):
        register("toy", Mine.of)


def test_phases_are_bound_when_a_task_is_made():
    free, cluttered = (make_task("dual_gripper", phase=phase) for phase in ("unconstrained", "constrained"))
    assert free.actions != cluttered.actions and free.trajectory_states != cluttered.trajectory_states
    with pytest.raises(ValueError, match="unknown phase 'free', expected one of unconstrained, constrained"):
        check_phase("free")
