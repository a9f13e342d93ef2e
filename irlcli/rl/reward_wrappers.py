"""Wrappers that give a learned reward in place of the true one, for any training algorithm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn, VecEnvWrapper

# reward(obs [B, D], act [B], [B, K] or [B, A], next_obs [B, D], done [B]) -> [B]
Reward = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class RewardWrapper(gymnasium.Wrapper):
    """A Gymnasium environment that gives ``reward``; ``info["true_reward"]`` has the true one.

    Observations of any shape are flattened for the reward. A truncated step is not terminated.

    Args:
        env: an environment of the kind that the reward was learned in.
        reward: what :func:`irlcli.load_reward` returns, or any function of that form.

    Raises:
        ValueError: a learned reward of other observations or actions.
    """

    def __init__(self, env: gymnasium.Env, reward: Reward):
        super().__init__(env)
        _check_spaces(reward, env)
        self._reward = reward
        self._observation = np.empty(0)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        observation, info = self.env.reset(**options)
        self._observation = _flat(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act; the reward is the learned one."""
        observation, true_reward, terminated, truncated, info = self.env.step(action)
        following = _flat(observation)
        learned = self._reward(
            self._observation[None],
            _vectors(np.asarray(action)[None], self.action_space),
            following[None],
            np.array([terminated]),
        )
        self._observation = following
        info = {**info, "true_reward": float(true_reward)}
        return observation, float(learned[0]), terminated, truncated, info


class RewardVecEnvWrapper(VecEnvWrapper):
    """A vectorised environment of stable-baselines3 that gives ``reward``.

    ``infos[i]["true_reward"]`` has the true one. The successor of a step that ended an episode is
    its ``terminal_observation``; one that a time limit ended is not terminated.

    Args:
        venv: environments of the kind that the reward was learned in.
        reward: what :func:`irlcli.load_reward` returns, or any function of that form.

    Raises:
        ValueError: a learned reward of other observations or actions.
    """

    def __init__(self, venv: VecEnv, reward: Reward):
        super().__init__(venv)
        _check_spaces(reward, venv)
        self._reward = reward
        self._observations = np.empty(0)
        self._actions = np.empty(0)

    def reset(self) -> Any:
        """Start an episode in every environment."""
        observations = self.venv.reset()
        self._observations = _rows(observations).copy()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions: the reward depends on them."""
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """The step's result with learned rewards [N] float32."""
        observations, true_rewards, dones, infos = self.venv.step_wait()
        following = _rows(observations).copy()
        successors, terminated = following.copy(), dones.astype(bool)
        infos = [
            {**info, "true_reward": float(r)} for info, r in zip(infos, true_rewards, strict=True)
        ]
        for world in np.flatnonzero(dones):
            successors[world] = _flat(infos[world]["terminal_observation"])
            terminated[world] = not infos[world].get("TimeLimit.truncated", False)
        actions = _vectors(self._actions, self.action_space)
        learned = self._reward(self._observations, actions, successors, terminated)
        self._observations = following
        return observations, learned.astype(np.float32), dones, infos


def _check_spaces(reward: Reward, env: gymnasium.Env | VecEnv) -> None:
    # Only a learned reward knows which spaces it takes.
    check = getattr(reward, "check_spaces", None)
    if check is not None:
        check(env.observation_space, env.action_space)


def _flat(observation: Any) -> np.ndarray:
    # A copy: the environment may return one array in every step.
    return np.array(observation, dtype=np.float32).reshape(-1)


def _vectors(actions: np.ndarray, space: gymnasium.Space) -> np.ndarray:
    """Actions [B], [B, K] or [B, A], whatever the shape of one is; the first index is 0."""
    if isinstance(space, Discrete | MultiDiscrete):
        actions = actions - space.start
    return actions.reshape(len(actions), -1) if actions.ndim > 2 else actions


def _rows(observations: Any) -> np.ndarray:
    return np.asarray(observations, dtype=np.float32).reshape(len(observations), -1)
