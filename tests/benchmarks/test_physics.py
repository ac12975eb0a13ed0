"""Closed forms beside numbers worked by hand, and groups of cases on ropes of a few links."""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from doojax.benchmarks import physics as bench
from doojax.benchmarks.physics import closed_forms, table
from doojax.benchmarks.physics.cases import (
    Case,
    Finding,
    Settings,
    bent_qpos,
    engine_of,
    fitted_frequency,
    state_of,
)
from doojax.benchmarks.physics.contact import capstan, plates
from doojax.benchmarks.physics.energy import energy
from doojax.benchmarks.physics.engines import agreement, random_data, random_states
from doojax.benchmarks.physics.fall import fall
from doojax.benchmarks.physics.friction import lying, pushed
from doojax.benchmarks.physics.statics import twists
from doojax.benchmarks.physics.swing import hanging
from doojax.experiments.reports.summary import read_summary
from doojax.types import RopeState, Trajectory
from tests.simulation.test_equivalence import needs_warp

PLAIN = Settings("default", converged=True)


def test_closed_forms_are_those_of_the_books():
    # 1.2024 sqrt(g / L) rad/s for a chain of 1 m; 3.516 sqrt(EI / (mu L^4)); exp(0.3 pi)
    assert closed_forms.hanging_chain_frequency(1, 1.0, 9.81) == pytest.approx(0.59938, rel=1e-4)
    assert closed_forms.hanging_chain_frequency(2, 1.0, 9.81) == pytest.approx(1.37583, rel=1e-4)
    assert closed_forms.cantilever_frequency(0.5, 1.0, 0.05) == pytest.approx(7.0783, rel=1e-4)
    assert closed_forms.cantilever_deflection(0.5, 1.0, 0.4905) == pytest.approx(7.664e-3, rel=1e-3)
    assert closed_forms.twist_angle(0.5, 0.01, 5e-3) == pytest.approx(0.25)
    assert closed_forms.capstan_ratio(0.3, math.pi) == pytest.approx(2.5663, rel=1e-4)
    assert closed_forms.capstan_friction(2.5663, math.pi) == pytest.approx(0.3, rel=1e-4)
    assert closed_forms.stopping_distance(2.0, 0.1, 10.0) == pytest.approx(2.0)


def test_a_fit_finds_the_frequency_of_a_slow_sinusoid_among_few_samples():
    times = np.arange(40) * 0.1
    signal = 0.3 * np.sin(2 * np.pi * 1.234 * times + 0.4) + 2.0
    assert fitted_frequency(times, signal, 1.0) == pytest.approx(1.234, rel=1e-5)
    assert math.isnan(fitted_frequency(times, signal * np.nan, 1.0))


def test_a_bent_rope_lies_where_its_inclinations_say():
    scene = hanging(PLAIN, 4)
    shape = np.array([0.0, np.pi / 2, np.pi / 2, 0.0])  # along x, twice down, along x; links of 0.2 m
    states = state_of(scene, bent_qpos(scene, np.array([1.0, 0.0, 3.0]), shape)[None])
    seen = engine_of(scene, "mujoco").observations(states)
    expected = [[1.1, 0, 3.0], [1.2, 0, 2.9], [1.2, 0, 2.7], [1.3, 0, 2.6]]
    np.testing.assert_allclose(seen.state.points[0], expected, atol=1e-6)
    np.testing.assert_allclose(seen.state.grippers[0], [[1.0, 0, 3.0]], atol=1e-6)
    with pytest.raises(ValueError, match="3 inclinations for a capsule_chain of 4 links"):
        bent_qpos(scene, np.zeros(3), np.zeros(3))


def test_energy_is_that_of_a_falling_and_turning_rod():
    scene = hanging(PLAIN, 4)
    state = state_of(scene, bent_qpos(scene, np.array([0.0, 0.0, 2.0]), np.full(4, np.pi / 2))[None])
    at_rest = energy(scene, [state])[0, 0]
    assert at_rest == pytest.approx(0.2 * 9.81 * (2.0 - 0.4), rel=1e-5)
    moving = state.qvel.at[0, 0].set(3.0)  # all of it along x
    assert energy(scene, [replace(state, qvel=moving)])[0, 0] - at_rest == pytest.approx(0.9, rel=1e-3)
    middle = 0.1  # m from the root link's centre to the rope's
    spinning = state.qvel.at[0, 4].set(2.0)  # about the root link's y
    inertia = 0.2 * (0.8**2 / 12 + middle**2)
    gained = energy(scene, [replace(state, qvel=spinning)])[0, 0] - at_rest
    assert gained == pytest.approx(inertia * 2.0**2 / 2, rel=1e-3)


def test_a_limp_rope_falls_as_a_stone_does():
    found = list(fall(PLAIN, "mujoco", links=10))
    assert found[0].tags["bending_stiffness"] == 1e-3
    assert found[0].value == pytest.approx(9.81, rel=1e-3)


def test_a_rope_pushed_along_itself_slides_as_coulomb_says_on_contacts():
    scene = lying(PLAIN, "capsule_chain", 4, 0.5)
    slid = pushed(scene, "mujoco", 2.0, np.zeros(1), 0.8)
    assert slid[0, 0] == pytest.approx(closed_forms.stopping_distance(2.0, 0.5, 9.81), rel=0.05)
    assert abs(slid[0, 1]) < 0.01


def test_a_torque_twists_a_rope_of_four_links_by_what_their_joints_let_through():
    (found,) = twists(PLAIN, "mujoco", links=(10,))
    assert found.expected == pytest.approx(0.25)
    assert found.value == pytest.approx(0.25, rel=0.12)


def test_verdicts_and_rows_follow_from_errors():
    case = Case("mujoco", PLAIN)
    right = case.found("a", 1.02, 1.0, "m")
    off = case.found("a", 0.001, 0.0, "m", scale=1.0, within=1e-4, tags={"x": 1})
    burst = case.found("a", np.nan, 1.0, "m", tags={"x": 2})
    refused = case.found("a", np.nan, 1.0, "m", tags={"x": 3}, note="refused: too stiff")
    assert [table.verdict(one) for one in (right, off, burst, refused)] == [
        "right",
        "off",
        "burst",
        "refused",
    ]
    rows = list(table.rows([right, off, burst, refused]))
    assert [one.metric for one in rows] == ["a", "a_error", "a", "a_error"] + ["a_without_value"] * 2
    assert rows[1].value == pytest.approx(0.02) and rows[3].value == pytest.approx(0.001)


def test_the_command_writes_what_it_found_and_names_what_it_does_not_know(tmp_path, monkeypatch):
    def group(settings, engine):
        yield Case(engine, settings).found("a", 2.0, 1.0, "m")

    monkeypatch.setitem(bench.GROUPS, "fall", (group, ("default",)))
    bench.physics(("fall",), tasks=("default",), publish=tmp_path)
    rows = read_summary(tmp_path / "summary.json").rows
    assert {(row.metric, row.tags["settings"], row.value) for row in rows} == {
        ("a", "task", 2.0), ("a", "converged", 2.0), ("a_error", "task", 1.0), ("a_error", "converged", 1.0)
    }  # fmt: skip
    with pytest.raises(ValueError, match="unknown group 'flow'"):
        bench.physics(("flow",), publish=tmp_path)
    with pytest.raises(ValueError, match="unknown task 'boats'"):
        bench.physics(("fall",), tasks=("boats",), publish=tmp_path)


def test_a_rope_around_a_post_shows_its_friction():
    found = next(capstan(Settings("default"), "mujoco", links=30))
    assert found.tags["friction"] == 0.1
    assert found.value == pytest.approx(0.1, rel=0.15)


def test_a_slow_rope_is_stopped_by_a_thick_plate_and_a_fast_one_is_noticed():
    fastest, unnoticed = plates(Settings("default"), "mujoco", thicknesses=(0.02,))
    assert fastest.value >= 0.5
    assert unnoticed.value == 0.0


def trajectories(rng: np.random.Generator, count: int, depth: float) -> Trajectory:
    """Made-up ones whose ropes are anywhere, and by ``depth`` (m) nearer to obstacles than others."""
    points, hands = rng.normal(size=(count, 3, 4, 3)), np.zeros((count, 3, 1, 3))
    clearance = rng.uniform(0.0, 0.1, (count, 3)) - depth
    return Trajectory(
        RopeState(jnp.asarray(points), jnp.asarray(hands)),
        actions=jnp.zeros((count, 2, 1, 3)),
        faults=jnp.zeros((count, 2), dtype=jnp.int32),
        clearance=jnp.asarray(clearance),
        stretch=jnp.zeros((count, 3)),
    )


def test_engines_agree_where_only_chance_differs_and_not_where_one_sinks_in():
    rng = np.random.default_rng(0)
    one, other, sunk = (trajectories(rng, 128, depth) for depth in (0.0, 0.0, 0.03))
    assert agreement(one, other) > 0.01
    assert agreement(one, sunk) < 1e-3


RANDOM = [
    ("rope_dragging", "mujoco", (64, 8)),
    ("dual_gripper", "mujoco", (64, 8)),
    ("rope_dragging", "mjx", (64, 8)),
    ("dual_gripper", "mjx", (32, 6)),
    pytest.param("rope_dragging", "warp", (8, 3), marks=needs_warp),
    pytest.param("dual_gripper", "warp", (8, 3), marks=needs_warp),
]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "engine", "size"), RANDOM)
def test_random_data_stay_out_of_obstacles_and_are_like_those_of_mujoco(task, engine, size):
    """In contact: at least a tenth of the trajectories end within 2 cm of an obstacle."""
    found = {one.case: one for one in random_data(Settings(task), engine, {engine: size})}
    assert found["deeper_than_2mm"].value == 0.0
    assert found["deeper_than_2mm"].tags["states"] == size[0] * size[1]
    assert found["faulty_trajectories"].right
    assert engine == "mujoco" or found["unlike_mujoco"].right
    seen = random_states(task, "mujoco", *size)
    assert (np.asarray(seen.clearance)[:, -1] < 0.02).mean() > 0.1


def test_no_random_data_of_a_plain_scene():
    assert list(random_data(Settings("default"), "mujoco")) == []


def test_findings_are_told_in_a_terminal_of_80_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    tags = {"engine": "mujoco", "task": "rope_dragging", "settings": "converged", "rope": "planar_chain"}
    tags |= {"links": 40, "bending_stiffness": 0.0125, "friction": 0.25}
    one = Finding("slide_over_coulomb_longest_of_all", tags, 0.336, 0.351, "rad/s^2")
    table.show([one, Finding("plate", tags, math.nan, 1.0, "m", note="refused: too stiff")])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    first = next(line.split() for line in lines if "slide_" in line)
    assert first == [one.case, "0.336", "rad/s^2", "0.351", "-4.27%", "right" if one.right else "off"]
