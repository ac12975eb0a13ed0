"""Which recovery frees ropes sooner, counted on the toy task with judges that are known."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from doojax.datasets.collect import collect
from doojax.datasets.store import Dataset
from doojax.experiments.trials.recovery import MOST_ACTIONS, recovery_rows
from doojax.learning.data import load_split, open_dataset
from doojax.models.protocols import above
from doojax.models.recovery import carried_along
from doojax.planning.recovery import RandomRecovery

pytestmark = pytest.mark.slow

TAGS = {"task": "toy"}
NEAR = -0.3  # m: ropes below it, to -0.5, are stuck, but an action or two may free them


class Carried(eqx.Module):
    """Dynamics: the rope goes along with the gripper."""

    def __call__(self, obstacles, state, action):
        return carried_along(state, action), jnp.zeros(())


class Above(eqx.Module):
    """Accepts what ends above some y: ropes far below are stuck until they have come near."""

    threshold: Array  # what differs between tests is data, so that what is compiled serves them all

    def __call__(self, obstacles, transition):
        return above(transition.next_state.grippers[0, 1], self.threshold)


class Along(eqx.Module):
    """A recovery that prefers to go up or down."""

    direction: Array

    def __call__(self, obstacles, state, action):
        return self.direction * action[0, 1]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    folder = tmp_path_factory.mktemp("toy") / "data"
    collect("toy", phase="constrained", trajectories=512, states=4, out=folder)
    return open_dataset(folder)


def measured(data: Dataset, recovery, above: float = 0.0, seed: int = 0) -> dict:
    judge, test = Above(jnp.array(above)), load_split(data, "test")
    rows = recovery_rows(data, test, Carried(), judge, recovery, TAGS, seed=seed)
    return {(row.metric, row.tags.get("policy"), row.tags.get("actions")): row for row in rows}


def test_going_towards_what_is_accepted_frees_sooner_than_chance_and_away_later(data):
    up, down = (measured(data, Along(jnp.array(way)), NEAR) for way in (1.0, -1.0))
    for most in (1, MOST_ACTIONS):
        learned, chance, wrong = (
            found["unstuck_probability", policy, most].value
            for found, policy in ((up, "learned"), (up, "random"), (down, "learned"))
        )
        assert learned >= chance > wrong == 0, most
    assert up["unstuck_probability", "learned", 1].value > up["unstuck_probability", "random", 1].value
    assert up["unstuck_ratio", None, None].value > 1
    assert up["actions_until_unstuck", "learned", None].value < 0.7 * MOST_ACTIONS
    # 0.1 m an action at most, from 0.2 m below, and 0.1 m below is near enough: two up do, but for the wall
    assert up["unstuck_probability", "learned", MOST_ACTIONS].value > 0.8


def test_a_recovery_that_is_random_is_as_good_as_random(data):
    """A policy against itself, but each with an own seed: not the same figures, yet figures that agree."""
    found, other = (measured(data, RandomRecovery(), NEAR, seed=seed) for seed in (0, 1))
    assert found["unstuck_probability", "random", 1].value > 0
    for actions in (1, MOST_ACTIONS):
        one, two = (
            found["unstuck_probability", "learned", actions],
            other["unstuck_probability", "random", actions],
        )
        assert one.low <= two.high and two.low <= one.high
    one, two = (rows["actions_until_unstuck", "random", None].value for rows in (found, other))
    assert one != two and one == pytest.approx(two, rel=0.5)
    ratio = found["unstuck_ratio", None, None]
    assert ratio.value == pytest.approx(1)


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
