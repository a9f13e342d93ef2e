"""GAIL: its discriminator and its reward, in closed form."""

import numpy as np
import torch
from airl_runs import make, random_episodes
from torch.nn.functional import softplus

from irlcli.learners.airl import AIRL
from irlcli.learners.gail import GAIL
from irlcli.learners.reward_model import RewardModel
from irlcli.learners.scoring import transformed_reward
from irlcli.trajectories import Transitions

PLAIN = {"kind": GAIL, "logit": "f", "shaping": False, "policy_reward": "f"}


def a_step(terminated):
    """One transition of four."""
    return Transitions(
        observations=np.ones((4, 3), np.float32),
        actions=np.zeros((4, 2), np.float32),
        next_observations=np.full((4, 3), 2.0, np.float32),
        terminated=np.full(4, terminated),
        remaining=np.full(4, 5),
    )


def test_the_reward_is_minus_the_logarithm_of_what_the_discriminator_gives_the_policy():
    model = RewardModel(3, 2, False, False, [8], "tanh", 0.9, shaping=False)
    data = a_step(terminated=False)
    with torch.no_grad():
        g = model.reward(torch.ones(4, 3), torch.zeros(4, 2))
        expected = -torch.log(1.0 - g.sigmoid())
    torch.testing.assert_close(transformed_reward(model, data, softplus, True, 0.9), expected)


def test_an_episode_that_ends_earns_the_series_of_its_absorbing_state():
    model = RewardModel(3, 2, False, False, [8], "tanh", 0.9, shaping=False)
    data = a_step(terminated=True)
    with torch.no_grad():
        here = model.reward(torch.ones(4, 3), torch.zeros(4, 2))
        there = model.reward(torch.full((4, 3), 2.0), torch.zeros(4, 2))
    rewards = [-torch.log(1.0 - g.sigmoid()) for g in (here, there)]
    found = transformed_reward(model, data, softplus, absorbing=True, gamma=0.9)
    torch.testing.assert_close(found, rewards[0] + 9.0 * rewards[1])
    torch.testing.assert_close(transformed_reward(model, data, softplus, False, 0.9), rewards[0])


def test_a_student_earns_what_is_never_negative_and_does_not_depend_on_its_likelihood():
    trainer, learner = make(random_episodes(2), **PLAIN)
    (rollout,) = trainer.train_round(0, learner)
    rewards = learner.rewards(rollout, trainer.policy)
    assert rewards.shape == rollout.terminated.shape and (rewards >= 0.0).all()
    rollout.log_probs[:] = 7.0
    assert np.array_equal(learner.rewards(rollout, trainer.policy), rewards)


def test_the_discriminator_learns_as_airls_does_from_logits_without_log_pi():
    demos = random_episodes(2)
    states = []
    for kind in (AIRL, GAIL):
        trainer, learner = make(demos, **{**PLAIN, "kind": kind})
        rollouts = trainer.train_round(0, learner)
        learner.update(0, rollouts, trainer.policy)
        states.append(learner.model.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not any(name.startswith("h") for name in states[0])
