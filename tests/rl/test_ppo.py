"""Rounds of PPO: recorded transitions, replaced rewards, seeds, resuming, saved policies."""

from operator import attrgetter

import numpy as np
import pytest
import torch

from irlcli.configs import PPOConfig
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.interventions import parse_setting, parse_settings
from irlcli.rl.policy import describe, load_policy
from irlcli.rl.ppo import PPOTrainer, TrueReward
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import make_worlds

SETTINGS = parse_settings("lunar-lander", "engine-power=1x,1.25x")
PPO = PPOConfig(n_envs=4, n_steps=128, batch_size=128, n_epochs=2, rollouts_per_round=2)


def make_trainer(seed=0, limit=None, **changes):
    ppo = PPOConfig(**{**{f: getattr(PPO, f) for f in PPO.__struct_fields__}, **changes})
    worlds = make_worlds("lunar-lander", SETTINGS, ppo.n_envs)
    if limit is not None:
        worlds.max_episode_steps = limit
    return PPOTrainer(worlds, ppo, 8192, seed, "test")


class Reward:
    """Rewards by a function of the rollout."""

    def __init__(self, function):
        self._function = function

    def rewards(self, rollout, policy):
        return self._function(rollout)


def same(a, b):
    return to_bytes(a.state_dict()) == to_bytes(b.state_dict())


@pytest.mark.parametrize(("changes", "eps"), [({}, 1e-8), ({"adam_eps": 1e-5}, 1e-5)])
def test_adams_eps_is_that_of_the_config(changes, eps):
    assert make_trainer(**changes).model.policy.optimizer.param_groups[0]["eps"] == eps


def test_rollouts_hold_true_successors_and_the_sampling_policys_log_probs():
    trainer = make_trainer(limit=50)
    seen = []

    def reward(rollout):
        # Called before the update: the policy is still the one that acted.
        observations = torch.as_tensor(rollout.observations).flatten(0, 1)
        actions = torch.as_tensor(rollout.actions).flatten()
        log_probs = trainer.policy.log_prob(observations, actions).numpy()
        np.testing.assert_allclose(rollout.log_probs.ravel(), log_probs, atol=1e-5)
        seen.append(rollout)
        return rollout.true_rewards

    trainer.train_round(0, Reward(reward))
    assert len(seen) == 2
    for rollout in seen:
        ends = rollout.terminated | rollout.truncated
        assert ends.any() and not (rollout.terminated & rollout.truncated).any()
        np.testing.assert_array_equal(ends, rollout.lengths > 0)
        assert rollout.lengths.max() <= 50
        assert (rollout.lengths[rollout.truncated] == 50).all()
        moved = ~ends[:-1]
        np.testing.assert_array_equal(
            rollout.next_observations[:-1][moved], rollout.observations[1:][moved]
        )
        # Where an episode ended, the successor is its last observation, not the next one's first.
        changed = rollout.next_observations[:-1][ends[:-1]] != rollout.observations[1:][ends[:-1]]
        assert changed.any(-1).all()


def test_moments_change_after_the_update_only():
    """Otherwise the policy that is updated would not be the one that acted."""
    trainer = make_trainer(normalise_observations=True)
    normaliser = trainer.model.policy.features_extractor.normaliser
    counts = []
    update = trainer.model.train

    def train():
        counts.append(float(normaliser.count))
        update()

    trainer.model.train = train
    trainer.train_round(0, TrueReward())
    before = counts[0]
    assert counts == [before, before + PPO.n_envs * PPO.n_steps]
    assert float(normaliser.count) == before + 2 * PPO.n_envs * PPO.n_steps


def test_returns_are_those_of_whole_episodes():
    rollout = make_trainer(limit=40).train_round(0, TrueReward())[0]
    world = 1
    ends = np.flatnonzero(rollout.lengths[:, world])
    start = 0
    for end in ends:
        assert rollout.lengths[end, world] == end - start + 1
        total = rollout.true_rewards[start : end + 1, world].sum()
        assert rollout.returns[end, world] == pytest.approx(total)
        start = end + 1


@pytest.mark.parametrize("gamma", [0.99, 0.5])
def test_training_on_true_rewards_handed_in_equals_training_on_the_environments(gamma):
    # Truncations (limit 50) and terminations both occur, so bootstrapping is compared as well.
    plain, replaced = (make_trainer(limit=50, gamma=gamma) for _ in range(2))
    plain.train_round(0, TrueReward())
    replaced.train_round(0, Reward(lambda rollout: rollout.true_rewards.copy()))
    for a, b in zip(
        plain.policy.state_dict().values(), replaced.policy.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)


def test_same_seed_same_bytes_other_seed_other_bytes():
    a, b, c = make_trainer(1), make_trainer(1), make_trainer(2)
    for trainer in (a, b, c):
        trainer.train_round(0, TrueReward())
    assert same(a, b)
    assert not same(a, c)


def test_every_round_starts_other_episodes():
    trainer = make_trainer()
    first, second = (trainer.train_round(i, TrueReward())[0].observations[0] for i in range(2))
    assert (first != second).any(-1).all()


def test_a_resumed_trainer_equals_an_uninterrupted_one():
    through, first = make_trainer(), make_trainer()
    for index in range(3):
        through.train_round(index, TrueReward())
    first.train_round(0, TrueReward())
    stored = to_bytes(first.state_dict())
    resumed = make_trainer()
    resumed.load_state_dict(from_bytes(stored))
    for index in (1, 2):
        resumed.train_round(index, TrueReward())
    assert same(through, resumed)
    assert resumed.steps == 3 * resumed.steps_per_round


def test_linear_schedules_fall_to_zero():
    trainer = make_trainer(
        learning_rate_schedule="linear", clip_range_schedule="linear", ent_coef_schedule="linear"
    )
    rates, bonuses = [], []
    for index in range(trainer.rounds):
        trainer.train_round(index, TrueReward())
        rates.append(trainer.model.policy.optimizer.param_groups[0]["lr"])
        bonuses.append(trainer.model.ent_coef)
    remaining = np.arange(trainer.rounds)[::-1] / trainer.rounds
    assert rates == pytest.approx(PPO.learning_rate * remaining)
    assert bonuses == pytest.approx(PPO.ent_coef * remaining)


@pytest.mark.parametrize(("kind", "half"), [("constant", 0.13), ("linear", 0.065)])
def test_the_clip_range_is_that_of_the_config(kind, half):
    model = make_trainer(clip_range=0.13, clip_range_schedule=kind).model
    # Half of the training is left.
    assert model.clip_range(0.5) == pytest.approx(half)


def test_policies_survive_saving():
    trainer = make_trainer()
    trainer.train_round(0, TrueReward())
    stored = from_bytes(to_bytes(trainer.policy.state_dict()))
    policy = load_policy("lunar-lander", SETTINGS[0], describe(trainer.ppo), stored)
    observations = np.random.default_rng(0).normal(size=(20, 8)).astype(np.float32)
    np.testing.assert_array_equal(
        policy.act(observations, deterministic=True),
        trainer.policy.act(observations, deterministic=True),
    )
    actions = torch.as_tensor(policy.act(observations))
    torch.testing.assert_close(
        policy.log_prob(torch.as_tensor(observations), actions),
        trainer.policy.log_prob(torch.as_tensor(observations), actions),
    )


@pytest.mark.parametrize("agent", ["random", "idle"])
def test_roll_out_is_reproducible_and_whole(agent):
    first, second = (
        roll_out("lunar-lander", SETTINGS[0], agent, 3, 5, "test", parallel=2) for _ in range(2)
    )
    assert len({t.seed for t in first}) == 3
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.observations, b.observations)
        np.testing.assert_array_equal(a.actions, b.actions)
        assert a.terminated != a.truncated
    if agent == "idle":
        assert all((t.actions == 0).all() for t in first)


@pytest.mark.parametrize(
    ("env", "knob"), [("lunar-lander", "bounce=0.1"), ("reacher", "gravity=1x")]
)
def test_noise_replaces_that_share_of_a_policys_actions(env, knob):
    """The idle agent's actions are zero, so each of the others is one that was replaced."""
    place = parse_setting(env, knob)
    shares = []
    for noise in (0.0, 0.25, 1.0):
        episodes = roll_out(env, place, "idle", 4, 0, "test", noise=noise)
        actions = np.concatenate([t.actions for t in episodes])
        replaced = (actions != 0).reshape(len(actions), -1).any(-1)
        shares.append(replaced.mean() / (0.75 if env == "lunar-lander" else 1.0))
    assert shares[0] == 0.0
    assert shares[1] == pytest.approx(0.25, abs=0.08)
    assert shares[2] == pytest.approx(1.0, abs=0.12)


def test_noise_reaches_a_policy_that_acts_without_the_cue():
    """With nothing but noise, the four actions are equally likely."""
    cue = parse_setting("lunar-lander", "cue-strength=0.8")
    episodes = roll_out("lunar-lander", cue, make_trainer().policy, 4, 0, "test", True, noise=1.0)
    actions = np.concatenate([t.actions for t in episodes])
    assert np.bincount(actions) / len(actions) == pytest.approx(0.25, abs=0.08)


def test_idle_episode_equals_gymnasiums():
    import gymnasium

    (trajectory,) = roll_out("lunar-lander", SETTINGS[1], "idle", 1, seed=9, purpose="test")
    env = gymnasium.make("irlcli/LunarLander-v0", engine_power=1.25)
    observation, _ = env.reset(seed=trajectory.seed)
    total = 0.0
    for t in range(len(trajectory)):
        np.testing.assert_array_equal(trajectory.observations[t], observation)
        observation, reward, terminated, truncated, _ = env.step(0)
        total += reward
    assert terminated or truncated
    assert trajectory.episode_return == pytest.approx(total)


def test_not_a_number_in_the_rewards_is_a_named_failure():
    from irlcli.errors import StageFailed

    trainer = make_trainer()
    with pytest.raises(StageFailed, match="not finite after an update in round 0"):
        trainer.train_round(0, Reward(lambda rollout: np.full(rollout.terminated.shape, np.nan)))


@pytest.mark.parametrize(
    ("field", "value", "attribute"),
    [
        ("n_epochs", 3, "n_epochs"),
        ("gamma", 0.7, "gamma"),
        ("gae_lambda", 0.6, "gae_lambda"),
        ("ent_coef", 0.2, "ent_coef"),
        ("vf_coef", 0.3, "vf_coef"),
        ("max_grad_norm", 0.4, "max_grad_norm"),
        ("batch_size", 64, "batch_size"),
        ("n_steps", 64, "n_steps"),
        ("ortho_init", False, "policy.ortho_init"),
        ("net_arch", (8, 9), "policy.net_arch"),
    ],
)
def test_the_library_has_the_configs_value(field, value, attribute):
    found = attrgetter(attribute)(make_trainer(**{field: value}).model)
    assert (tuple(found) if isinstance(value, tuple) else found) == value
