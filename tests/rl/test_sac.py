"""Rounds of SAC: what its replay holds, seeds, resuming, saved policies."""

import gymnasium
import numpy as np
import pytest
import torch
from falling import Falling

from irlcli.configs import SACConfig
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.envs.vector import VectorWorlds
from irlcli.errors import StageFailed
from irlcli.interventions import parse_settings
from irlcli.rl.policy import describe, load_policy
from irlcli.rl.ppo import TrueReward
from irlcli.rl.reward_normaliser import RunningDeviation
from irlcli.rl.rollout import roll_out
from irlcli.rl.sac import SACTrainer
from irlcli.rl.worlds import make_worlds

SETTINGS = parse_settings("reacher", "gravity=0.5x,2x")
SAC = {
    "n_envs": 2,
    "n_steps": 160,
    "train_freq": 16,
    "gradient_steps": 2,
    "learning_starts": 320,
    # Less than three rounds: the oldest transitions are overwritten.
    "buffer_size": 600,
    "batch_size": 32,
    "net_arch": (16, 16),
}


class Reward:
    """Rewards by a function of the rollout."""

    def __init__(self, function):
        self._function = function

    def rewards(self, rollout, policy):
        return self._function(rollout)


def make_trainer(seed=0, worlds=None, **changes):
    sac = SACConfig(**{**SAC, **changes})
    worlds = worlds or make_worlds("reacher", SETTINGS, sac.n_envs)
    return SACTrainer(worlds, sac, 1000, seed, "test")


class Strong(Falling):
    action_space = gymnasium.spaces.Box(-4.0, 2.0, (1,), np.float32)


def test_the_replay_holds_actions_in_units_of_their_bounds():
    trainer = make_trainer(worlds=VectorWorlds([Strong(), Strong()], 50), n_steps=20)
    acted = np.concatenate([r.actions for r in trainer.train_round(0, TrueReward())])
    held = trainer.model.replay_buffer.actions[:20]
    np.testing.assert_allclose(held, (acted + 1.0) / 3.0, atol=1e-6)
    assert acted.min() < -1.5


def test_random_actions_come_first():
    """Those of the first round do not depend on the actor, which does not learn yet; the second's do."""
    trainer, other = make_trainer(), make_trainer(activation="tanh")
    before = [parameter.clone() for parameter in trainer.model.policy.parameters()]
    random, same = (t.train_round(0, TrueReward())[0].actions for t in (trainer, other))
    after = trainer.model.policy.parameters()
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))
    learned, different = (t.train_round(1, TrueReward())[0].actions for t in (trainer, other))
    assert np.abs(random).max() <= 1.0
    assert np.array_equal(random, same) and not np.array_equal(learned, different)
    assert sum(len(r.terminated) for r in trainer.train_round(2, TrueReward())) == 160


def test_the_replay_holds_each_transition_with_its_pay():
    trainer = make_trainer(normalise_rewards=False, buffer_size=1000)
    rollouts = trainer.train_round(0, Reward(lambda r: r.observations[..., 0].astype(float)))
    replay = trainer.model.replay_buffer
    seen = np.concatenate([r.observations for r in rollouts])
    np.testing.assert_array_equal(replay.observations[:160], seen)
    np.testing.assert_array_equal(replay.rewards[:160], seen[..., 0])
    np.testing.assert_array_equal(
        replay.next_observations[:160], np.concatenate([r.next_observations for r in rollouts])
    )
    # The arm's episodes end by their limit of 150 steps, after which the value counts.
    np.testing.assert_array_equal(np.flatnonzero(replay.timeouts[:, 0]), [149])
    sample = replay.sample(500)
    assert float(sample.dones.max()) == 0.0


def test_a_fall_is_not_bootstrapped():
    trainer = make_trainer(worlds=VectorWorlds([Falling(), Falling()], 50), n_steps=20)
    trainer.train_round(0, TrueReward())
    replay = trainer.model.replay_buffer
    valueless = replay.dones[:20, 0] * (1.0 - replay.timeouts[:20, 0])
    np.testing.assert_array_equal(np.flatnonzero(valueless), [4, 9, 14, 19])


def test_every_round_starts_other_episodes():
    trainer = make_trainer()
    first, second = (trainer.train_round(i, TrueReward())[0].observations[0] for i in range(2))
    assert (first != second).any(-1).all()


def test_sampled_rewards_are_in_units_of_the_deviation_of_their_discounted_sums():
    trainer = make_trainer(gamma=0.0, buffer_size=1000)
    rollouts = trainer.train_round(0, Reward(lambda r: 1000.0 * r.observations[..., 0]))
    raw = np.concatenate([r.observations[..., 0] for r in rollouts]) * 1000.0
    sampled = trainer.model.replay_buffer.sample(2000).rewards.numpy()
    assert np.abs(sampled).max() == pytest.approx(np.abs(raw / raw.std()).max(), rel=1e-3)


def test_discounted_sums_of_rewards_end_with_their_episode():
    """The arm's by their limit of 150 steps."""
    trainer = make_trainer(gamma=0.9, buffer_size=1000)
    rollouts = trainer.train_round(0, Reward(lambda r: 1000.0 * r.observations[..., 0]))
    raw = np.concatenate([r.observations[..., 0] for r in rollouts]) * 1000.0
    sums = raw.copy()
    for t in range(1, len(sums)):
        if t != 150:
            sums[t] += 0.9 * sums[t - 1]
    sampled = trainer.model.replay_buffer.sample(2000).rewards.numpy()
    assert np.abs(sampled).max() == pytest.approx(np.abs(raw).max() / sums.std(), rel=1e-3)


def test_rewards_beyond_ten_deviations_are_cut():
    assert RunningDeviation(0.9, 1).normalise(np.array([-1e6, 1e6])).tolist() == [-10.0, 10.0]


def test_the_networks_share_the_moments_of_all_observations():
    trainer = make_trainer()
    rollouts = trainer.train_round(0, TrueReward())
    seen = np.concatenate([r.observations for r in rollouts]).reshape(-1, 9).astype(np.float64)
    for network in (trainer.model.actor, trainer.model.critic, trainer.model.critic_target):
        normaliser = network.features_extractor.normaliser
        np.testing.assert_allclose(normaliser.mean, seen.mean(0), atol=1e-9)
        np.testing.assert_allclose(normaliser.variance, seen.var(0), atol=1e-9)


@pytest.mark.parametrize("changes", [{}, {"ent_coef": 0.1, "normalise_observations": False}])
def test_a_resumed_trainer_equals_an_uninterrupted_one(changes):
    def train(trainer, rounds):
        for index in rounds:
            trainer.train_round(index, TrueReward())
        return to_bytes(trainer.state_dict())

    for done in (1, 3):
        stored = train(make_trainer(**changes), range(done))
        resumed = make_trainer(**changes)
        resumed.load_state_dict(from_bytes(stored))
        assert to_bytes(resumed.state_dict()) == stored
        whole = train(make_trainer(**changes), range(4))
        assert train(resumed, range(done, 4)) == whole
    assert train(make_trainer(1, **changes), range(4)) != whole


def test_a_saved_policy_acts_as_before():
    trainer = make_trainer()
    for index in range(2):
        trainer.train_round(index, TrueReward())
    stored = from_bytes(to_bytes(trainer.policy.state_dict()))
    policy = load_policy("reacher", SETTINGS[0], describe(trainer.sac), stored)
    observations = np.random.default_rng(0).normal(size=(20, 9)).astype(np.float32)
    np.testing.assert_array_equal(
        policy.act(observations, True), trainer.policy.act(observations, True)
    )
    (trajectory,) = roll_out("reacher", SETTINGS[0], policy, 1, seed=0, purpose="test")
    assert np.abs(trajectory.actions).max() <= 1.0


def test_it_climbs_a_reward():
    """Pay for the first torque: the policy learns to apply it."""
    trainer = make_trainer(gamma=0.0, gradient_steps=60, learning_rate=3e-3, ent_coef=0.01)
    pay = Reward(lambda rollout: rollout.actions[..., 0].astype(float))
    means = [
        np.mean([r.actions[..., 0].mean() for r in trainer.train_round(index, pay)])
        for index in range(4)
    ]
    assert abs(means[0]) < 0.15 and means[-1] > 0.7


def test_not_a_number_in_the_rewards_is_a_named_failure():
    trainer = make_trainer(learning_starts=0)
    with pytest.raises(StageFailed, match="not finite after an update in round 0"):
        trainer.train_round(0, Reward(lambda rollout: np.full(rollout.terminated.shape, np.nan)))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tau", 0.1),
        ("learning_rate", 0.02),
        ("gamma", 0.7),
        ("batch_size", 16),
        ("buffer_size", 800),
        ("ent_coef", 0.1),
    ],
)
def test_the_library_has_the_configs_value(field, value):
    assert getattr(make_trainer(**{field: value}).model, field) == value
