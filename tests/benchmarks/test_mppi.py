"""The bench of MPPI controls one pendulum, told in two libraries, with ours and with theirs."""

import numpy as np
import pytest

from doojax.benchmarks import mppi as bench


def test_the_pendulum_is_gymnasiums():
    # by hand: 1 rad from upright at 2 rad/s, with a torque of 0.5 N m
    angle, speed = bench.swing(np.array([1.0, 2.0]), np.array([0.5]), np)
    expected = 2.0 + 0.05 * (15 * np.sin(1.0) + 3 * 0.5)
    assert speed == pytest.approx(expected) and angle == pytest.approx(1.0 + 0.05 * expected)
    assert bench.swing(np.array([1.0, 7.9]), np.array([9.0]), np)[1] == 8.0
    assert bench.price(np.array([2 * np.pi - 0.5, 2.0]), np) == pytest.approx(0.25 + 0.4)


def test_ours_costs_less_than_doing_nothing():
    begin = bench.start(0)
    nothing, _ = bench.control(lambda state: 0.0, begin, 100)
    cost, seconds = bench.control(bench.ours(0), begin, 100)
    assert cost < 0.7 * nothing and len(seconds) == 100 and (seconds > 0).all()


def test_rows_are_means_over_starts_and_medians_of_plans():
    theirs = [(13.0, np.full(4, 1e-2)), (18.0, np.full(4, 1e-2))]
    found = {"doojax": [(10.0, np.full(4, 1e-3)), (20.0, np.full(4, 3e-3))], "pytorch-mppi": theirs}
    more, cost, plans, *_ = bench.rows_of(found)
    assert more.metric == "closed_loop_cost_difference" and (more.value, more.low, more.high) == (-0.5, -3, 2)
    assert (cost.metric, cost.value, cost.n) == ("closed_loop_cost", 15.0, 2)
    assert (plans.metric, plans.value, plans.unit) == ("mppi_ms", pytest.approx(2.0), "ms")
    assert plans.tags == {"task": "pendulum", "implementation": "doojax"}
    with pytest.raises(ValueError, match="there are 1 seeds, expected at least 2"):
        bench.mppi(seeds=1)
