"""Environments stepped together behave like environments stepped alone."""

import gymnasium
import numpy as np
import pytest

from irlcli.envs.vector import VectorWorlds
from irlcli.interventions import parse_settings
from irlcli.rl.worlds import make_worlds
from irlcli.trajectories import world_settings

SETTINGS = parse_settings("lunar-lander", "engine-power=1x,1.5x")


def test_equals_single_environments_with_resets_and_time_limit():
    worlds = make_worlds("lunar-lander", SETTINGS, 4)
    worlds.max_episode_steps = 60
    single = [
        gymnasium.make("irlcli/LunarLander-v0", engine_power=p).unwrapped for p in (1, 1, 1.5, 1.5)
    ]
    observations = worlds.reset([1, 2, 3, 4])
    np.testing.assert_array_equal(
        observations, [env.reset(seed=s)[0] for s, env in enumerate(single, 1)]
    )
    rng = np.random.default_rng(0)
    returns, lengths, episodes = np.zeros(4), np.zeros(4, dtype=int), 0
    for _ in range(200):
        actions = rng.integers(4, size=4)
        observations, rewards, ended = worlds.step(actions)
        ends = {end.world: end for end in ended}
        for i, env in enumerate(single):
            observation, reward, terminated, _, _ = env.step(int(actions[i]))
            returns[i] += reward
            lengths[i] += 1
            assert rewards[i] == reward
            if terminated or lengths[i] == 60:
                end = ends.pop(i)
                np.testing.assert_array_equal(end.final_observation, observation)
                assert (end.terminated, end.length) == (terminated, lengths[i])
                assert end.episode_return == pytest.approx(returns[i], abs=1e-9)
                observation, _ = env.reset()
                returns[i], lengths[i] = 0.0, 0
                episodes += 1
            np.testing.assert_array_equal(observations[i], observation)
        assert not ends
    assert episodes >= 8


class Breaking(gymnasium.Env):
    """Reports progress from its second step on, and an error in its third."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        info = {"progress": 1.5} if self.steps > 1 else {}
        if self.steps == 3:
            info["error"] = "the simulation broke"
        return np.zeros(1, np.float32), 1.0, False, self.steps == 3, info


def test_the_error_that_ended_an_episode_is_kept():
    worlds = VectorWorlds([Breaking()], max_episode_steps=9)
    worlds.reset([0])
    (end,) = [end for _ in range(4) for end in worlds.step(np.zeros(1, int))[2]]
    assert (end.length, end.terminated, end.error) == (3, False, "the simulation broke")
    assert end.progress == 3.0


def test_settings_have_equal_shares_in_order():
    worlds = make_worlds("lunar-lander", SETTINGS, 6)
    assert [env.engine_power for env in worlds.envs] == [1.0] * 3 + [1.5] * 3
    np.testing.assert_array_equal(world_settings(6, 2), [0, 0, 0, 1, 1, 1])
