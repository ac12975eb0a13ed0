"""Policies: brax's networks as ours, trials that one acts in, and how one is trained."""

from dataclasses import asdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from doojax.environments import make_environment
from doojax.environments.returns import episodes, random_acts
from doojax.experiments.trials.methods import make_method, needed_models
from doojax.experiments.trials.setting import TrialSettings
from doojax.experiments.trials.trial import NOT_EXECUTED, run_trials
from doojax.learning.checkpoints import Header, save_model
from doojax.models.policy import Policy, PolicyConfig
from doojax.planning import RrtSettings
from tests.experiments.trials.toy_trials import SIMULATOR, TOY, trials

ENVIRONMENT = make_environment("toy")
CONFIG = PolicyConfig(ENVIRONMENT.observation_size, ENVIRONMENT.action_size, 8, 2)
HEADING = PolicyConfig(CONFIG.observation, 2, 8, 0)


def heading_for_the_goal() -> Policy:
    """Its numbers are those of the observation that say the way to the goal in the plane, made large."""
    policy = Policy(HEADING, key=jax.random.key(0))
    (layer,) = policy.network.layers
    weight = jnp.zeros_like(layer.weight).at[jnp.arange(2), jnp.arange(-3, -1)].set(100.0)
    return eqx.tree_at(
        lambda p: (p.network.layers[0].weight, p.network.layers[0].bias), policy, (weight, jnp.zeros(2))
    )


def test_a_policy_stands_beside_the_planners(tmp_path):
    """One that heads straight for the goal: nothing is planned, and every step is what it says."""
    file = tmp_path / "model.eqx"
    save_model(file, Header("policy", "toy", asdict(HEADING)), heading_for_the_goal())
    method = make_method("policy", TOY, SIMULATOR, {"policy": file})
    given = (TOY, SIMULATOR, method, RrtSettings(), TrialSettings(actions=40), trials())
    records = run_trials(*given)
    for record in records:  # what the policy says, by hand
        way = record.goal - record.points[0, 0]
        move = TOY.actions.longest * np.append(np.tanh(100 * way[:2]), 0.0)
        move *= min(1.0, TOY.actions.longest / np.linalg.norm(move))
        stays = np.abs(record.grippers[0, 0, :2] + move[:2]).max() > 0.5  # out of the hand's reach
        np.testing.assert_allclose(record.replay["actions"][0, 0], 0 if stays else move, atol=1e-5)
    assert all(not record.plans and record.method == "policy" for record in records)
    assert all(record.reached or record.about["end"] == "40 actions did not suffice" for record in records)
    kept = run_trials(*given, execute=False)
    assert all(record.about["end"] == NOT_EXECUTED and len(record.points) == 1 for record in kept)
    with pytest.raises(ValueError, match="method 'policy' needs models of kind policy"):
        needed_models("policy", {})


@pytest.mark.slow
def test_returns_are_those_of_one_episode_after_another():
    """Heading for the goal: each start's return, added up step by step; chance gets less."""
    policy, key = heading_for_the_goal(), lambda: jax.random.key(5)
    acts = jax.jit(jax.vmap(policy))
    found = episodes(ENVIRONMENT, lambda seen, _: acts(seen), key(), 5, 12)
    starts = jax.vmap(jax.random.fold_in, (None, 0))(jax.random.split(key())[0], jnp.arange(5))
    reset, step = jax.jit(ENVIRONMENT.reset), jax.jit(ENVIRONMENT.step)
    for start, gained, reached in zip(starts, *found, strict=True):
        state, total = reset(start), 0.0
        for _ in range(12):
            state = step(state, acts(state.observation[None])[0])
            total += float(state.reward)
            if state.done:
                break
        assert gained == pytest.approx(total, abs=1e-4) and reached == bool(state.reached)
    chance = episodes(ENVIRONMENT, random_acts(ENVIRONMENT), key(), 5, 12)
    assert chance.gained.mean() < found.gained.mean()


def test_braxs_policy_gives_the_same_numbers_as_ours():
    pytest.importorskip("brax")
    from brax.training.acme import running_statistics, specs
    from brax.training.agents.ppo import networks

    from doojax.environments.ppo import policy_of

    made = networks.make_ppo_networks(
        CONFIG.observation,
        CONFIG.action,
        preprocess_observations_fn=running_statistics.normalize,
        policy_hidden_layer_sizes=(8, 8),
    )
    parameters = made.policy_network.init(jax.random.key(1))
    batch = 3 * jax.random.normal(jax.random.key(2), (16, CONFIG.observation)) + 1
    scaling = running_statistics.init_state(specs.Array((CONFIG.observation,), jnp.dtype("float32")))
    scaling = running_statistics.update(scaling, batch)
    theirs, _ = networks.make_inference_fn(made)((scaling, parameters), deterministic=True)(
        batch, jax.random.key(3)
    )
    ours = jax.vmap(policy_of(CONFIG, scaling, parameters))(batch)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.slow
def test_episodes_of_training_end_in_time_and_others_begin():
    """Three periods of episodes of two: what ended, what its return was, and what goes on."""
    pytest.importorskip("brax")
    from doojax.environments.ppo import Ppo, PpoSettings

    with pytest.raises(ValueError, match="environments is 6, expected a multiple of 4"):
        Ppo(ENVIRONMENT, PpoSettings(environments=6), 0)
    with pytest.raises(ValueError, match="unroll is 0, expected more than 0"):
        PpoSettings(unroll=0)
    ppo = Ppo(ENVIRONMENT, PpoSettings(environments=4, episode=2, width=8, depth=1), 0)
    first = learner = ppo.begin()
    rewards, cut = [], []
    for period in range(3):
        learner, row, over, gained = ppo._period(learner, jax.random.key(period))
        rewards.append(np.asarray(row.reward))
        cut.append(np.asarray(row.extras["state_extras"]["truncation"]))
        np.testing.assert_array_equal(row.discount, 1.0 - over)
        if period == 0:
            arrived = over  # only the goal ends an episode so soon
            assert not cut[0].any()
        if period == 1:
            assert over[~arrived].all() and not over[arrived & (cut[1] == 1)].any()
            np.testing.assert_allclose(gained[~arrived], sum(rewards)[~arrived], rtol=1e-5)
            assert (np.abs(learner.states.observation - row.next_observation).max(1) > 0.01)[over].all()
    np.testing.assert_array_equal(np.asarray(learner.lasted)[~arrived], 1)
    np.testing.assert_array_equal(np.asarray(learner.begun)[~arrived], 2)
    assert (np.abs(learner.states.observation - first.states.observation).max(1) > 0.01).all()


def test_the_shim_makes_copies_with_a_first_axis_and_leaves_nothing_behind():
    from doojax.environments.brax_shim import brax_runs

    there = hasattr(jax, "device_put_replicated")
    with brax_runs():
        tree = jax.device_put_replicated({"a": jnp.arange(3.0)}, jax.devices()[:1])
    np.testing.assert_array_equal(tree["a"], [[0.0, 1.0, 2.0]])
    assert hasattr(jax, "device_put_replicated") == there


@pytest.mark.slow
def test_braxs_own_training_takes_the_face():
    pytest.importorskip("brax")
    from brax.training.agents.ppo.train import train

    from doojax.environments.brax_env import BraxEnvironment
    from doojax.environments.brax_shim import brax_runs

    with brax_runs():
        _, parameters, metrics = train(
            BraxEnvironment(ENVIRONMENT),
            num_timesteps=64,
            num_envs=8,
            episode_length=4,
            unroll_length=4,
            batch_size=4,
            num_minibatches=2,
            num_evals=2,
            num_eval_envs=8,
        )
    assert len(parameters) == 3 and np.isfinite(metrics["eval/episode_reward"])
