"""Training on robots: continuous actions, normalisation, cloning, progress, workers."""

import math
import multiprocessing

import gymnasium
import numpy as np
import pytest
import torch
from falling import Falling

from irlcli.configs import PPOConfig, load_config
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.envs.registration import make
from irlcli.envs.registry import environment
from irlcli.envs.vector import VectorWorlds
from irlcli.errors import StageFailed
from irlcli.interventions import parse_setting, parse_settings
from irlcli.learners.actions import ActionView
from irlcli.learners.cloning import clone
from irlcli.rl.loop import Training
from irlcli.rl.policy import describe, load_policy
from irlcli.rl.ppo import PPOTrainer, TrueReward
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import action_space, make_worlds
from irlcli.seeds import derive
from irlcli.stages import collect_experts, train_airl
from irlcli.stages.base import From
from irlcli.trajectories import Transitions

SETTINGS = parse_settings("reacher", "gravity=0.5x,2x")
PPO = {"n_envs": 2, "n_steps": 160, "batch_size": 128, "n_epochs": 1, "net_arch": (16, 16)}
NORMALISED = {"normalise_observations": True, "normalise_rewards": True}


class Reward:
    """Rewards by a function of the rollout."""

    def __init__(self, function):
        self._function = function

    def rewards(self, rollout, policy):
        return self._function(rollout)


def make_trainer(worlds=None, seed=0, keep_moments=False, **changes):
    ppo = PPOConfig(**{**PPO, **changes})
    worlds = worlds or make_worlds("reacher", SETTINGS, ppo.n_envs)
    return PPOTrainer(worlds, ppo, 1000, seed, "test", keep_moments)


def test_the_action_seen_by_all_is_the_unclipped_sample():
    trainer = make_trainer(log_std_init=1.0, **NORMALISED)
    rollouts = []

    def reward(rollout):
        # Called before the update: the policy is still the one that acted.
        observations = torch.as_tensor(rollout.observations).flatten(0, 1)
        actions = torch.as_tensor(rollout.actions).flatten(0, 1)
        log_probs = trainer.policy.log_prob(observations, actions).numpy()
        np.testing.assert_allclose(rollout.log_probs.ravel(), log_probs, atol=1e-4)
        rollouts.append(rollout)
        return rollout.true_rewards

    trainer.train_round(0, Reward(reward))
    (rollout,) = rollouts
    assert np.abs(rollout.actions).max() > 2.0
    # The world moved by the clipped one.
    _, first, _ = derive("test", 0, 0, 3)
    world = make("reacher", SETTINGS[0])
    observation, _ = world.reset(seed=first)
    for t in range(20):
        np.testing.assert_array_equal(rollout.observations[t, 0], observation)
        observation, paid, *_ = world.step(np.clip(rollout.actions[t, 0], -1.0, 1.0))
        assert rollout.true_rewards[t, 0] == paid


def test_the_cap_on_the_deviation_holds_after_every_round():
    """A reward for large actions raises the deviation, at this learning rate in one round."""
    deviations = {}
    for cap in (None, -0.5):
        trainer = make_trainer(log_std_init=-0.6, log_std_max=cap, learning_rate=0.05, n_epochs=4)
        for index in range(3):
            trainer.train_round(index, Reward(lambda rollout: (rollout.actions**2).sum(-1)))
        deviations[cap] = trainer.model.policy.log_std.detach().numpy()
    assert deviations[None].max() > -0.5
    assert deviations[-0.5].max() == np.float32(-0.5)


def demonstrated(observations, actions):
    count = len(observations)
    return Transitions(
        observations=observations.astype(np.float32),
        actions=actions.astype(np.float32),
        next_observations=observations.astype(np.float32),
        terminated=np.zeros(count, dtype=bool),
        remaining=np.zeros(count, dtype=np.int64),
    )


def test_a_clone_is_the_maximum_likelihood_fit():
    """Actions drawn from one Gaussian wherever the robot is: the fit has its mean and deviation."""
    trainer = make_trainer(keep_moments=True, **NORMALISED)
    rng = np.random.default_rng(0)
    observations = rng.normal(3.0, 2.0, (4096, 9)).astype(np.float32)
    actions = rng.normal([0.5, -0.3], [0.2, 0.6], (4096, 2)).astype(np.float32)
    view = ActionView("sampled", action_space(trainer.model.action_space))
    before = trainer.policy.state_dict()["value_net.weight"].clone()
    clone(trainer, demonstrated(observations, actions), view, 150, 0)
    mean, deviation = trainer.policy.gaussian(torch.as_tensor(observations))
    np.testing.assert_allclose(mean.mean(0), actions.mean(0), atol=0.02)
    np.testing.assert_allclose(deviation[0], actions.std(0), rtol=0.05)
    # The moments are those of the demonstrations, and the value network is unchanged.
    network = trainer.policy.network
    np.testing.assert_allclose(
        network.features_extractor.normaliser.mean, observations.mean(0), atol=1e-4
    )
    assert torch.equal(trainer.policy.state_dict()["value_net.weight"], before)
    capped = make_trainer(log_std_max=-1.0, **NORMALISED)
    clone(capped, demonstrated(observations, actions), view, 5, 0)
    assert capped.policy.network.log_std.max() == -1.0


def test_demonstrations_hold_the_unclipped_sample():
    policy = make_trainer(log_std_init=1.0).policy
    (trajectory,) = roll_out("reacher", SETTINGS[0], policy, 1, seed=4, purpose="test")
    assert np.abs(trajectory.actions).max() > 2.0
    world = make("reacher", SETTINGS[0])
    observation, _ = world.reset(seed=trajectory.seed)
    progress = 0.0
    for t in range(len(trajectory)):
        np.testing.assert_array_equal(trajectory.observations[t], observation)
        clipped = np.clip(trajectory.actions[t], -1.0, 1.0)
        observation, paid, _, _, info = world.step(clipped)
        assert trajectory.rewards[t] == paid
        progress += info["progress"]
    assert trajectory.progress == pytest.approx(progress)
    assert trajectory.error is None


def test_observations_are_normalised_by_the_moments_of_all_rollouts_so_far():
    trainer = make_trainer(rollouts_per_round=2, **NORMALISED)
    seen = [
        r.observations.reshape(-1, 9)
        for i in range(2)
        for r in trainer.train_round(i, TrueReward())
    ]
    extractor = trainer.model.policy.features_extractor
    together = np.concatenate(seen).astype(np.float64)
    np.testing.assert_allclose(extractor.normaliser.mean, together.mean(0), atol=1e-9)
    np.testing.assert_allclose(extractor.normaliser.variance, together.var(0), atol=1e-9)
    assert extractor.normaliser.count == len(together)
    normal = extractor(torch.as_tensor(seen[-1]))
    expected = (seen[-1] - together.mean(0)) / np.sqrt(together.var(0) + 1e-8)
    np.testing.assert_allclose(normal, np.clip(expected, -10, 10), atol=1e-3)


def test_rewards_are_divided_by_the_deviation_of_their_discounted_sums():
    trainer = make_trainer(gamma=0.9, gae_lambda=0.0, normalise_rewards=True)
    (rollout,) = trainer.train_round(0, TrueReward())
    rewards, sums = rollout.true_rewards, []
    for world in range(2):
        total = 0.0
        for t in range(160):
            total = 0.9 * total + rewards[t, world]
            sums.append(total)
            if rollout.truncated[t, world]:
                total = 0.0
    paid = trainer.model.rollout_buffer.rewards
    # A truncated step is paid the value of what would have followed as well.
    expected = np.clip(rewards / np.std(sums), -10, 10)
    plain = ~rollout.truncated
    np.testing.assert_allclose(paid[plain], expected[plain], rtol=1e-4)


def test_a_discounted_sum_ends_with_a_fall():
    """Five steps that each pay 1, again and again: the sums are 1, 1.9, 2.71, ..."""
    worlds = VectorWorlds([Falling(), Falling()], 50)
    trainer = make_trainer(worlds, gamma=0.9, normalise_rewards=True)
    trainer.train_round(0, TrueReward())
    sums = np.cumsum(0.9 ** np.arange(5))
    paid = trainer.model.rollout_buffer.rewards
    np.testing.assert_allclose(paid, 1.0 / np.std(sums), rtol=1e-4)


def test_a_resumed_robot_equals_an_uninterrupted_one_and_evaluation_leaves_it_alone():
    def train(trainer, rounds):
        for index in rounds:
            trainer.train_round(index, TrueReward())
        return to_bytes(trainer.state_dict())

    sde = {"use_sde": True, "sde_sample_freq": 4, "log_std_init": -1.0}
    through = make_trainer(**NORMALISED, **sde)
    first = make_trainer(**NORMALISED, **sde)
    stored = train(first, [0])
    roll_out("reacher", SETTINGS[0], first.policy, 1, seed=0, purpose="test")
    assert to_bytes(first.state_dict()) == stored
    resumed = make_trainer(**NORMALISED, **sde)
    resumed.load_state_dict(from_bytes(stored))
    assert train(resumed, [1, 2]) == train(through, [0, 1, 2])


def test_a_saved_robot_acts_as_before_in_a_goal_setting():
    setting = parse_setting("half-cheetah", "direction=-10..0")
    worlds = make_worlds("half-cheetah", [setting], 2)
    trainer = make_trainer(worlds, n_steps=64, use_sde=True, activation="relu", **NORMALISED)
    trainer.train_round(0, TrueReward())
    stored = from_bytes(to_bytes(trainer.policy.state_dict()))
    policy = load_policy("half-cheetah", setting, describe(trainer.ppo), stored)
    observations = np.random.default_rng(0).normal(size=(20, 19)).astype(np.float32)
    np.testing.assert_array_equal(
        policy.act(observations, deterministic=True),
        trainer.policy.act(observations, deterministic=True),
    )


def test_the_noise_of_gsde_has_the_reported_likelihood():
    trainer = make_trainer(use_sde=True, sde_sample_freq=4, log_std_init=-0.5)
    observation = np.full((20_000, 9), 0.3, dtype=np.float32)
    torch.manual_seed(0)
    actions = trainer.policy.act(observation)
    distribution = trainer.policy.network.get_distribution(torch.as_tensor(observation[:1]))
    deviation = distribution.distribution.stddev.detach().numpy()[0]
    mean = distribution.mode().detach().numpy()[0]
    np.testing.assert_allclose(actions.mean(0), mean, atol=4 * deviation.max() / 140)
    np.testing.assert_allclose(actions.std(0), deviation, rtol=0.03)


class Exploding(gymnasium.Env):
    """Reports progress 2 a step; its state stops being finite at every 7th."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, explodes):
        self.explodes = explodes

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        observation = np.full(1, self.steps, dtype=np.float32)
        if self.explodes and self.steps == 7:
            return observation, 0.0, False, True, {"error": "the state is not finite"}
        return observation, 1.0, False, False, {"progress": 2.0}


def test_an_exploded_world_is_named_and_training_continues():
    warnings = []
    worlds = VectorWorlds([Exploding(False), Exploding(True)], 16)
    trainer = make_trainer(worlds)
    settings = ["mass=1x", "mass=10x"]
    training = Training(trainer, TrueReward(), settings)
    rows = training.run(lambda *_: None, warnings.append)
    assert len(rows) == 2 * trainer.rounds
    calm, wild = rows[:2]
    assert (calm["true_return"], calm["progress"], calm["episode_length"]) == (16.0, 32.0, 16.0)
    assert (wild["true_return"], wild["progress"], wild["episode_length"]) == (6.0, 12.0, 7.0)
    assert "mass=10x, world 1, round 0: the state is not finite" in warnings[0]
    assert not any("mass=1x" in warning for warning in warnings)


def test_environments_without_progress_report_none():
    worlds = make_worlds("lunar-lander", [parse_setting("lunar-lander", "default")], 1)
    worlds.max_episode_steps = 3
    worlds.reset([0])
    ended = [end for _ in range(3) for end in worlds.step(np.zeros(1, dtype=np.int64))[2]]
    assert math.isnan(ended[0].progress) and ended[0].error is None


@pytest.mark.parametrize("rounds", [0, 1])
def test_a_killed_worker_is_a_named_failure(rounds):
    """Also before the first round, while the trainer is made."""
    worlds = make_worlds("reacher", SETTINGS, 2, workers=2)
    trainer = make_trainer(worlds) if rounds else None
    if trainer is not None:
        trainer.train_round(0, TrueReward())
    (worker, *_) = multiprocessing.active_children()
    worker.kill()
    with pytest.raises(StageFailed, match=r"worker . .* died: signal 9") as caught:
        (trainer or make_trainer(worlds)).train_round(1, TrueReward())
    assert caught.value.hint
    assert not multiprocessing.active_children()
    worlds.close()


@pytest.mark.parametrize("env", ["ant", "half-cheetah", "reacher"])
@pytest.mark.parametrize("profile", ["smoke", "standard", "paper"])
def test_every_intervention_of_the_settings_can_be_learned_from(env, profile):
    config = load_config(env, profile)
    assert set(config.interventions) == set(environment(env).knobs)
    for knob, values in config.interventions.items():
        settings = parse_settings(env, f"{knob}={','.join(values.id)}")
        demos = collect_experts.request(env, settings, config)
        train_airl.request(From(demos), env, settings, config.airl)
        parse_settings(env, f"{knob}={','.join(values.ood)}")


def test_the_cap_on_the_deviation_holds_in_the_first_round():
    trainer = make_trainer(log_std_init=1.0, log_std_max=-0.5, **NORMALISED)
    acted = []

    def reward(rollout):
        # Called before the first update.
        acted.append(trainer.model.policy.log_std.max().item())
        return rollout.true_rewards

    trainer.train_round(0, Reward(reward))
    assert acted[0] == -0.5


@pytest.mark.parametrize(("field", "value"), [("use_sde", True), ("sde_sample_freq", 7)])
def test_the_library_has_the_configs_values_of_gsde(field, value):
    trainer = make_trainer(use_sde=True, sde_sample_freq=7, **NORMALISED)
    assert getattr(trainer.model, field) == value
