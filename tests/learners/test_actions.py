"""What learners see of continuous actions: samples, or what the environment executes."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch
from airl_runs import make

from irlcli.configs import AIRLConfig, PPOConfig
from irlcli.configs.relevance import relevant_airl
from irlcli.errors import UsageError
from irlcli.interventions import parse_settings
from irlcli.learners.airl import AIRL
from irlcli.learners.gail import GAIL
from irlcli.learners.selection import log_likelihood
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import make_worlds

REACHER = "reacher"
SETTINGS = parse_settings(REACHER, "gravity=0.5x,2x")
PPO = PPOConfig(n_envs=2, n_steps=160, batch_size=64, log_std_init=0.5)
CONFIG = AIRLConfig(updates_per_round=3, batch_size=32, ppo=PPO)


@pytest.fixture(scope="module")
def demos():
    with closing(make_worlds(REACHER, SETTINGS, 2)) as worlds:
        policy = PPOTrainer(worlds, PPO, 10_000, 3, "expert").policy
    return [roll_out(REACHER, s, policy, 3, 0, f"{s}") for s in SETTINGS]


def further_out(demos):
    """The same demonstrations, asking for twice as much where that does nothing more."""
    return [
        [replace(t, actions=np.where(abs(t.actions) > 1, 2 * t.actions, t.actions)) for t in group]
        for group in demos
    ]


def learned(demos, actions, policy_reward):
    trainer, learner = make(
        demos, CONFIG, REACHER, SETTINGS, actions=actions, policy_reward=policy_reward
    )
    for index in range(2):
        learner.update(index, trainer.train_round(index, learner), trainer.policy)
    return trainer, learner


def tensors(trainer, learner):
    # A Bullet world has 28 MiB, and SB3's callbacks refer to it in a circle.
    trainer.model.get_env().close()
    return {**trainer.policy.state_dict(), **learner.model.state_dict()}


@pytest.mark.parametrize("policy_reward", ["f", "f-log-pi"])
def test_what_lies_beyond_the_bounds_changes_nothing_that_is_learned_from_executed_actions(
    demos, policy_reward
):
    once, twice = (
        tensors(*learned(d, "executed", policy_reward)) for d in (demos, further_out(demos))
    )
    assert all(torch.equal(once[name], twice[name]) for name in once)
    sampled = [tensors(*learned(d, "sampled", policy_reward)) for d in (demos, further_out(demos))]
    assert not all(torch.equal(sampled[0][name], sampled[1][name]) for name in once)


def test_a_policy_is_rewarded_for_the_actions_that_were_executed(demos):
    """Where actions are sampled, noise beyond the bounds is worth a whole nat of -log pi."""
    trainer, learner = learned(demos, "executed", "f-log-pi")
    (rollout,) = trainer.train_round(2, learner)
    further = replace(
        rollout, actions=np.where(abs(rollout.actions) > 1, 9 * rollout.actions, rollout.actions)
    )
    assert (abs(rollout.actions) > 1).any()
    rewards = learner.rewards(rollout, trainer.policy)
    np.testing.assert_array_equal(rewards, learner.rewards(further, trainer.policy))


@pytest.mark.parametrize("kind", [AIRL, GAIL])
def test_rewards_of_actions_beyond_the_bounds_are_those_of_the_bounds(demos, kind):
    """g(s, a) of a challenger, and of GAIL's policy."""
    trainer, learner = make(
        demos, CONFIG, REACHER, SETTINGS, kind=kind, actions="executed", logit="f", shaping=False
    )
    (rollout,) = trainer.train_round(0, learner)
    beyond = abs(rollout.actions) > 1
    further = replace(rollout, actions=np.where(beyond, 9 * rollout.actions, rollout.actions))
    assert beyond.any()
    paid = {
        AIRL: learner.challenger_rewards,
        GAIL: lambda r: learner.rewards(r, trainer.policy),
    }[kind]
    np.testing.assert_array_equal(paid(rollout), paid(further))
    trainer.model.get_env().close()


def test_likelihoods_of_held_out_episodes_are_of_the_same_actions(demos):
    trainer, learner = learned(demos, "executed", "f")
    one, other = (
        log_likelihood(trainer.policy, learner.view, d) for d in (demos, further_out(demos))
    )
    assert one == other


def test_executed_actions_of_another_size_are_named(demos):
    wider = [[replace(t, actions=np.repeat(t.actions, 3, axis=1)) for t in g] for g in demos]
    with pytest.raises(ValueError, match=r"demonstrations have actions of shape \[6\]"):
        make(wider, CONFIG, REACHER, SETTINGS, actions="executed")


def test_discrete_actions_have_no_bounds():
    with pytest.raises(UsageError, match=r"airl\.actions = executed needs continuous actions"):
        relevant_airl(AIRLConfig(actions="executed"), discrete_actions=True)


def test_a_cloned_policy_of_discrete_actions_has_no_bounds_either(irl, smoke_store):
    line = ["train-airl", "--demos", "demos", "--method", "bc", "--set", "airl.actions=executed"]
    done = irl(*line, "--profile", "smoke", "--store", smoke_store.path)
    assert done.code == 2 and "airl.actions = executed needs continuous actions" in done.err
