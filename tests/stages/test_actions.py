"""What AIRL sees of continuous actions: the samples, or what the environment clips them to."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import msgspec
import numpy as np
import pytest
import torch

from irlcli.configs import AIRLConfig, PPOConfig
from irlcli.data.demonstrations import Demonstrations
from irlcli.errors import UsageError
from irlcli.interventions import parse_settings
from irlcli.learners import selection
from irlcli.learners.actions import SeenActions
from irlcli.learners.adversary import Adversary
from irlcli.rl import ppo as rl
from irlcli.stages import train_airl
from irlcli.stages.base import Source

SETTINGS = parse_settings("reacher", "gravity=0.5x,2x")
PPO = PPOConfig(n_envs=4, n_steps=160, batch_size=64, log_std_init=0.5)


@pytest.fixture(scope="module")
def demos():
    worlds = rl.make_worlds("reacher", SETTINGS, 2)
    policy = rl.PPOTrainer(worlds, PPO, 10_000, 3, "expert").policy
    groups = {str(s): tuple(rl.roll_out("reacher", s, policy, 3, 0, f"{s}")) for s in SETTINGS}
    return Demonstrations("reacher", groups, {})


def further_out(demos):
    """The same demonstrations, asking for twice as much where that does nothing more."""
    groups = {
        text: tuple(
            replace(t, actions=np.where(abs(t.actions) > 1, 2 * t.actions, t.actions))
            for t in group
        )
        for text, group in demos.trajectories.items()
    }
    return Demonstrations(demos.env, groups, {})


def learned(demos, actions, policy_reward):
    config = AIRLConfig(
        actions=actions, policy_reward=policy_reward, updates_per_round=3, batch_size=32, ppo=PPO
    )
    trainer = rl.PPOTrainer(rl.make_worlds("reacher", SETTINGS, 4), PPO, 10_000, 0, "test")
    adversary = Adversary(demos, config, trainer._venv.worlds, 0)
    for index in range(2):
        reward = partial(adversary.reward, policy=trainer.policy)
        adversary.train_round(index, trainer.train_round(index, reward), trainer.policy)
    return trainer, adversary


def tensors(trainer, adversary):
    return {**trainer.policy.state_dict(), **adversary.model.state_dict()}


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


def test_a_policy_is_paid_for_the_actions_that_were_executed(demos):
    """Noise beyond the bounds is worth a whole nat of -log pi where actions are sampled."""
    trainer, adversary = learned(demos, "executed", "f-log-pi")
    (rollout,) = trainer.train_round(2)
    further = replace(
        rollout, actions=np.where(abs(rollout.actions) > 1, 9 * rollout.actions, rollout.actions)
    )
    assert (abs(rollout.actions) > 1).any()
    paid = adversary.reward(rollout, trainer.policy)
    np.testing.assert_array_equal(paid, adversary.reward(further, trainer.policy))


def test_likelihoods_of_held_out_episodes_are_of_the_same_actions(demos):
    trainer, adversary = learned(demos, "executed", "f")
    score = partial(selection.log_likelihood, trainer.policy, adversary.actions)
    assert score(demos.trajectories) == score(further_out(demos).trajectories)


def test_sampled_is_what_unset_means():
    source = Source(Path("demos"), "0" * 64)
    unset, sampled, executed = (
        train_airl.request(source, "reacher", SETTINGS, AIRLConfig(ppo=PPO, actions=actions))
        for actions in (msgspec.UNSET, "sampled", "executed")
    )
    assert unset.parameters == sampled.parameters != executed.parameters


def test_discrete_actions_have_no_bounds():
    with pytest.raises(UsageError, match=r"airl\.actions = executed needs continuous actions"):
        SeenActions(AIRLConfig(actions="executed"), gymnasium.spaces.Discrete(4))
