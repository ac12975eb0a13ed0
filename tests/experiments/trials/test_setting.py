"""Budgets that make no sense."""

import pytest

from doojax.experiments.trials.setting import TrialSettings


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("searches", 0, "searches is 0, expected 1 to 1,000,000"),
        ("actions", 0, "actions is 0, expected 1 to 1,000,000"),
        ("replan_distance", 0.0, "replan_distance is 0.0, expected a positive length"),
    ],
)
def test_budgets_of_zero_are_refused(name, value, expected):
    with pytest.raises(ValueError, match=expected):
        TrialSettings(**{name: value})
