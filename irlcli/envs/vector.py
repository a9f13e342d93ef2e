"""Several environments stepped together in this process, with automatic resets.

Gymnasium's own vector environments copy infos deeply and merge dictionaries in every step, which
costs as much as a step of LunarLander. The class here handles arrays only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gymnasium
import numpy as np


@dataclass(frozen=True)
class Ended:
    """An episode that ended in this step.

    Attributes:
        world: index of the environment.
        final_observation: last observation [D] float32.
        terminated: whether the episode terminated; otherwise it was truncated.
        episode_return: sum of the true rewards.
        length: number of steps.
        progress: sum of ``info["progress"]``, or NaN if the environment does not report it.
        error: ``info["error"]`` of the last step, which it ended: why a simulation could not
            continue.
    """

    world: int
    final_observation: np.ndarray
    terminated: bool
    episode_return: float
    length: int
    progress: float
    error: str | None


class VectorWorlds:
    """N environments that take one array of actions and return one array of observations.

    Args:
        envs: at least one; all have equal observation and action spaces.
        max_episode_steps: time limit after which an episode is truncated.
    """

    def __init__(self, envs: Sequence[gymnasium.Env], max_episode_steps: int):
        self.envs = list(envs)
        self.max_episode_steps = max_episode_steps
        self.observation_space = envs[0].observation_space
        self.action_space = envs[0].action_space
        self._shape = (len(self.envs), *(self.observation_space.shape or ()))
        self._discrete = isinstance(self.action_space, gymnasium.spaces.Discrete)
        self._lengths = np.zeros(len(self.envs), dtype=np.int64)
        self._returns = np.zeros(len(self.envs), dtype=np.float64)
        self._progress = np.full(len(self.envs), np.nan)

    def __len__(self) -> int:
        return len(self.envs)

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start an episode in every environment, and return observations [N, D] float32."""
        self._lengths[:] = 0
        self._returns[:] = 0.0
        self._progress[:] = np.nan
        return np.stack(
            [env.reset(seed=int(seed))[0] for env, seed in zip(self.envs, seeds, strict=True)]
        )

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Ended]]:
        """Advance every environment by one action of ``actions`` [N], [N, K] or [N, A].

        Returns observations [N, D] float32, true rewards [N] float64, and the episodes that
        ended. Where an episode ended, the observation is the first one of the next episode.
        """
        observations = np.empty(self._shape, dtype=np.float32)
        rewards = np.empty(len(self.envs), dtype=np.float64)
        ended: list[Ended] = []
        choices = actions.tolist() if self._discrete else actions
        self._lengths += 1
        for i, env in enumerate(self.envs):
            observation, reward, terminated, truncated, info = env.step(choices[i])
            rewards[i] = reward
            self._returns[i] += reward
            if "progress" in info:
                before = 0.0 if np.isnan(self._progress[i]) else self._progress[i]
                self._progress[i] = before + info["progress"]
            if terminated or truncated or self._lengths[i] >= self.max_episode_steps:
                ended.append(
                    Ended(
                        i,
                        # A copy: reset() may write to the same array.
                        np.array(observation, dtype=np.float32),
                        bool(terminated),
                        float(self._returns[i]),
                        int(self._lengths[i]),
                        float(self._progress[i]),
                        info.get("error"),
                    )
                )
                self._lengths[i] = 0
                self._returns[i] = 0.0
                self._progress[i] = np.nan
                observation, _ = env.reset()
            observations[i] = observation
        return observations, rewards, ended

    def close(self) -> None:
        """Close every environment."""
        for env in self.envs:
            env.close()
