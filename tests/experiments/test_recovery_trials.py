"""Which recovery frees ropes sooner, counted on the toy task with judges that are known."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.datasets.collect import collect
from doojax.datasets.store import Dataset
from doojax.experiments.recovery_trials import MOST_ACTIONS, recovery_rows
from doojax.learning.data import load_split, open_dataset
from doojax.models.recovery import carried_along
from doojax.planning.recovery import RandomRecovery

TAGS = {"task": "toy"}


class Carried(eqx.Module):
    """Dynamics: the rope goes along with the gripper."""

    def __call__(self, obstacles, state, action):
        return carried_along(state, action), jnp.zeros(())


class Above(eqx.Module):
    """Accepts what ends above some y: ropes far below are stuck until they have come near."""

    threshold: float

    def __call__(self, obstacles, state, action, next_state, uncertainty):
        return next_state.grippers[0, 1]


class Along(eqx.Module):
    """A recovery that prefers to go up or down."""

    direction: float

    def __call__(self, obstacles, state, action):
        return self.direction * action[0, 1]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy") / "data"
    collect("toy", phase="constrained", trajectories=512, states=4, out=folder)
    return open_dataset(folder)


def measured(data: Dataset, recovery, above: float = 0.0) -> dict:
    rows = recovery_rows(data, load_split(data, "test"), Carried(), Above(above), recovery, TAGS, seed=0)
    return {(row.metric, row.tags.get("policy"), row.tags.get("actions")): row for row in rows}


def test_going_towards_what_is_accepted_frees_sooner_than_chance_and_away_later(data):
    up, down = measured(data, Along(1.0)), measured(data, Along(-1.0))
    for most in (1, MOST_ACTIONS):
        learned, chance, wrong = (
            found["unstuck_probability", policy, most].value
            for found, policy in ((up, "learned"), (up, "random"), (down, "learned"))
        )
        assert learned > chance > wrong
    assert up["unstuck_ratio", None, None].value > 1
    assert up["actions_until_unstuck", "learned", None].value < 0.7 * MOST_ACTIONS
    # 0.1 m an action at most, from 0.5 m below: five straight up would do
    assert up["unstuck_probability", "learned", MOST_ACTIONS].value == 1


def test_a_recovery_that_is_random_is_as_good_as_random(data):
    found = measured(data, RandomRecovery())
    for metric in ("unstuck_probability", "actions_until_unstuck"):
        for (name, policy, actions), row in found.items():
            if name == metric and policy == "learned":
                assert row.value == found[metric, "random", actions].value
    assert found["unstuck_ratio", None, None].value == pytest.approx(1)


def test_one_stuck_state_a_trajectory_counts(data):
    found = measured(data, RandomRecovery())
    test = load_split(data, "test")
    height = np.asarray(test.states.grippers)[:, :-1, 0, 1]
    # 32 sampled actions of at most 0.1 m: what lies more than that below the line is stuck for sure
    assert found["stuck_fraction", None, None].value >= (height < -0.1).mean()
    assert found["stuck_fraction", None, None].value <= (height < 0).mean()
    assert found["unstuck_probability", "random", 1].n >= (height < -0.1).any(1).sum()


def test_where_nothing_is_stuck_there_is_nothing_to_measure(data):
    with pytest.raises(ValueError, match="no state of the test split is stuck"):
        measured(data, RandomRecovery(), above=-9.0)
