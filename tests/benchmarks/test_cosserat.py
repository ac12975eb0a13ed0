"""doojax as a solver of cosseratbench: it simulates what the scenario says, and refuses what it cannot."""

from dataclasses import replace

import numpy as np
import pytest
from cosseratbench import EndCondition, Material, Plane, PointLoad, Rod, Scenario
from cosseratbench.experiment import run
from cosseratbench.registry import load_experiment
from cosseratbench.scenario import Cylinder

from doojax.benchmarks import cosserat as bench
from doojax.benchmarks.cosserat import DoojaxSolver
from doojax.experiments.reports.summary import read_summary

SOFT = Material(youngs_modulus=1e6, shear_modulus=3e5, density=1000.0)
FREE = Rod(((0.0, 0.0, 1.0), (0.4, 0.0, 1.0)), radius=0.01, material=SOFT)
FALLING = Scenario((FREE,), duration=0.2, gravity=(0.0, 0.0, -9.81), self_contact=False)


def test_a_free_rod_falls_with_its_directors_unchanged():
    seen = DoojaxSolver().run(FALLING, n_elements=4, n_frames=5)
    np.testing.assert_allclose(seen.positions[0][0], FREE.nodes(4), atol=1e-9)
    np.testing.assert_allclose(seen.positions[0][-1, :, 2], 1.0 - 9.81 * 0.2**2 / 2, atol=5e-3)
    np.testing.assert_allclose(seen.directors[0], np.broadcast_to([0.0, 0.0, 1.0], (5, 4, 3)), atol=1e-4)


def test_a_load_at_the_end_bends_a_clamped_rod_as_beam_theory_says():
    force, stiffness = 2e-3, 1e6 * np.pi * 0.01**4 / 4
    rod = replace(FREE, start=EndCondition.CLAMPED, loads=(PointLoad((0.0, 0.0, -force)),))
    scenario = Scenario((rod,), duration=4.0, quasi_static=True, self_contact=False)
    seen = DoojaxSolver().run(scenario, n_elements=20, n_frames=3).positions[0][-1]
    assert 1.0 - seen[-1, 2] == pytest.approx(force * 0.4**3 / (3 * stiffness), rel=0.08)
    np.testing.assert_allclose(seen[0], [0.0, 0.0, 1.0], atol=1e-4)


def test_a_rod_lies_on_a_cylinder_across_it():
    cylinder = Cylinder((0.2, 0.0, 0.9), (0.0, 1.0, 0.0), radius=0.09, length=0.2, friction=0.5)
    seen = DoojaxSolver().run(replace(FALLING, obstacles=(cylinder,)), n_elements=9, n_frames=3)
    middle = seen.positions[0][-1, 4:6].mean(0)  # of the link that lies on top
    assert middle[2] == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"rods": (FREE, FREE)}, "one rod"),
        ({"self_contact": True}, "does not reach itself"),
        ({"obstacles": (Plane((0, 0, 0), (0, 0, 1)),)}, "cylinders only"),
        ({"gravity": (1.0, 0.0, -9.81)}, "points down"),
        ({"rods": (replace(FREE, centerline=((0, 0, 1), (0, 1, 1))),)}, "vertical plane along x"),
    ],
)
def test_what_it_does_not_model_is_refused(change, complaint):
    with pytest.raises(NotImplementedError, match=complaint):
        DoojaxSolver().run(replace(FALLING, **change), n_elements=4, n_frames=3)


def test_it_bends_at_least_as_truly_as_the_adapter_that_comes_with_the_package():
    result = run(load_experiment("cantilever"), DoojaxSolver())
    assert result.outcome == "completed" and result.settings["time_step"] <= 0.004
    assert result.metrics["tip_deflection_error"] <= 0.0741


def test_both_solvers_are_scored_in_one_run(monkeypatch, tmp_path):
    small = replace(load_experiment("cantilever"), n_elements=5, n_frames=5)
    monkeypatch.setattr(bench, "load_experiment", lambda name: small)
    bench.cosserat(experiments=("cantilever",), publish=tmp_path)
    rows = read_summary(tmp_path / "summary.json").rows
    assert {(row.metric, row.tags["solver"]) for row in rows} == {
        (metric, solver)
        for metric in ("cosserat_tip_deflection_error", "cosserat_s")
        for solver in ("doojax", "mujoco")
    }
    with pytest.raises(ValueError, match="unknown experiment 'twist'"):
        bench.cosserat(experiments=("twist",), publish=tmp_path)
