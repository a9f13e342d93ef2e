"""Replay and a round's data hold whole episodes only, each with its absorbing steps."""

import numpy as np
import pytest
import torch
from airl_runs import CONFIG, make, random_episodes

from irlcli.configs import PPOConfig
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.learners.pools import make_pool
from irlcli.learners.replay import Replay, starts_by, whole_episodes
from irlcli.learners.reward_model import RewardModel
from irlcli.trajectories import Rollout, Transitions


def episode(length, value, horizon=10):
    """An episode of ``length`` steps whose observations are ``value``; it ends early."""
    return Transitions(
        observations=np.full((length, 2), value, np.float32),
        actions=np.zeros(length, np.int64),
        next_observations=np.full((length, 2), value, np.float32),
        terminated=np.arange(length) == length - 1,
        remaining=np.where(np.arange(length) == length - 1, horizon - length, 0),
    )


def joined(episodes):
    from irlcli.trajectories import join

    numbers = np.concatenate([np.full(len(e), k) for k, e in enumerate(episodes)])
    return join(episodes), numbers


def test_a_round_holds_the_episodes_that_begin_a_horizon_before_its_end():
    """12 steps, horizon 4; episodes begin at 0, 4, 8, 9 and 11."""
    ended = np.zeros((12, 1), bool)
    ended[[3, 7, 8, 10]] = True
    at = np.arange(12, dtype=np.float32).reshape(12, 1)
    zero = np.zeros((12, 1))
    rollout = Rollout(
        observations=at[..., None],
        actions=zero.astype(np.int64),
        next_observations=at[..., None],
        log_probs=zero,
        true_rewards=zero,
        terminated=ended,
        truncated=np.zeros_like(ended),
        lengths=ended.astype(np.int64),
        returns=zero,
        progress=zero,
        errors=(),
    )
    data, _ = whole_episodes([rollout], np.ones(1, bool), 4)
    assert data.observations.ravel().tolist() == list(range(9))


def test_starts_by_keeps_the_episodes_that_began_in_time():
    ended = np.zeros((7, 2), dtype=bool)
    ended[[1, 4], 0] = True  # episodes start at 0, 2, 5
    assert starts_by(ended, 2)[:, 0].tolist() == [True] * 5 + [False] * 2
    assert starts_by(ended, 4)[:, 0].tolist() == [True] * 5 + [False] * 2
    assert starts_by(ended, 5)[:, 0].all()
    assert starts_by(ended, -3)[:, 0].tolist() == [True] * 2 + [False] * 5
    assert starts_by(ended, 0)[:, 1].all()


def test_episodes_that_start_in_time_are_an_unbiased_sample():
    """Half of all episodes take 2 steps, half 10: whole ones at a horizon of 10 show just that."""
    rng = np.random.default_rng(0)
    ended = np.zeros((15, 20_000), dtype=bool)
    for world in range(ended.shape[1]):
        t = -1
        while (t := t + rng.choice([2, 10])) < 15:
            ended[t, world] = True
    short = {}
    for name, kept in (
        ("in time", starts_by(ended, 15 - 10)),
        ("all that end", np.ones_like(ended)),
    ):
        lengths = []
        for world in range(ended.shape[1]):
            ends = np.flatnonzero(ended[:, world] & kept[:, world])
            lengths.append(np.diff(ends, prepend=-1))
        short[name] = np.mean(np.concatenate(lengths) == 2)
    assert short["in time"] == pytest.approx(0.5, abs=0.01)
    assert short["all that end"] > 0.6


def test_no_episode_that_the_discriminator_sees_is_cut():
    demos = random_episodes(2)
    trainer, learner = make(demos, ppo=PPOConfig(n_envs=8, n_steps=1500))
    (rollout,) = trainer.train_round(0, learner)
    for setting in range(2):
        worlds = np.arange(8) * 2 // 8 == setting
        data, numbers = whole_episodes([rollout], worlds, horizon=1000)
        ends = data.terminated.sum()
        # Each episode stands for exactly the horizon: its steps and its absorbing ones.
        assert ends == len(np.unique(numbers)) > 0
        assert len(data) + data.remaining.sum() == ends * 1000
        for number in np.unique(numbers):
            own = data.take(np.flatnonzero(numbers == number))
            # One after the other: each step's successor is the next step.
            np.testing.assert_array_equal(own.next_observations[:-1], own.observations[1:])
            assert own.terminated.tolist() == [False] * (len(own) - 1) + [True]


def test_an_episode_may_span_rollouts_of_one_round():
    demos = random_episodes(2)
    ppo = PPOConfig(n_envs=8, n_steps=40, rollouts_per_round=30)
    trainer, learner = make(demos, ppo=ppo)
    rollouts = trainer.train_round(0, learner)
    data, numbers = whole_episodes(rollouts, np.ones(8, dtype=bool), horizon=1000)
    lengths = np.bincount(np.unique(numbers, return_inverse=True)[1])
    assert lengths.max() > 40
    assert len(data) + data.remaining.sum() == len(lengths) * 1000


def test_every_episode_is_as_likely_to_be_replayed_whatever_its_length():
    """A crash of 2 steps stands for 8 absorbing ones, but is one episode like any other."""
    model = RewardModel(2, 2, True, False, [4], "tanh", 0.9)
    crashes = []
    for seed in range(300):
        replay = Replay(1, per_round=2, capacity=10)
        data, numbers = joined([episode(2, 1.0), episode(10, 2.0), episode(9, 2.0)])
        replay.add(0, data, numbers, np.random.default_rng(seed))
        kept = replay.transitions()[0]
        pool = make_pool(model, kept, torch.zeros(len(kept)), absorbing=True)
        # Two whole episodes of the horizon's 10 steps, absorbing ones included.
        assert len(pool.draw) == 20
        crashes.append(float((pool.observations[pool.draw][:, 0] == 1.0).float().mean()))
    assert np.mean(crashes) == pytest.approx(1 / 3, abs=0.04)


def test_replay_keeps_whole_episodes_within_its_capacity():
    replay = Replay(2, per_round=3, capacity=4)
    rng = np.random.default_rng(0)
    for index in range(5):
        data, numbers = joined([episode(k + 2, 10 * index + k) for k in range(4)])
        replay.add(0, data, numbers, rng)
    kept = replay.transitions()[0]
    assert kept.terminated.sum() == 4
    assert kept.remaining.sum() + len(kept) == 4 * 10
    assert len(replay.transitions()) == 1


def test_a_resumed_replay_is_the_same():
    replay, again = (Replay(2, per_round=2, capacity=5) for _ in range(2))
    data, numbers = joined([episode(3, 1.0), episode(5, 2.0), episode(4, 3.0)])
    replay.add(1, data, numbers, np.random.default_rng(0))
    again.load_state_dict(from_bytes(to_bytes(replay.state_dict())))
    assert to_bytes(again.state_dict()) == to_bytes(replay.state_dict())
    ((kept,), (expected,)) = again.transitions(), replay.transitions()
    np.testing.assert_array_equal(kept.observations, expected.observations)
    for one in (replay, again):
        one.add(1, data, numbers, np.random.default_rng(1))
        one.add(1, data, numbers, np.random.default_rng(2))
    assert to_bytes(again.state_dict()) == to_bytes(replay.state_dict())


def test_no_replay_is_kept_where_none_is_drawn():
    demos = random_episodes(2)
    trainer, learner = make(demos, CONFIG, replay_share=0.0)
    learner.update(0, trainer.train_round(0, learner), trainer.policy)
    assert all(len(own["lengths"]) == 0 for own in learner.state_dict()["replay"]["settings"])


def test_the_replay_keeps_early_episodes_as_likely_as_late_ones():
    """Each of 40 episodes is among the 8 kept in a fifth of all runs."""
    kept = np.zeros(40)
    runs = 400
    for seed in range(runs):
        rng, replay = np.random.default_rng(seed), Replay(1, per_round=2, capacity=8)
        for start in range(0, 40, 2):
            replay.add(0, *joined([episode(3, start), episode(3, start + 1)]), rng)
        (found,) = replay.transitions()
        kept[np.unique(found.observations).astype(int)] += 1
    assert kept.sum() == 8 * runs
    deviation = np.sqrt(0.2 * 0.8 / runs)
    assert np.abs(kept / runs - 0.2).max() < 4 * deviation
