"""Several environments stepped together in this process, with automatic resets.

Gymnasium's own vector environments deep-copy infos and merge dictionaries every step, which
costs as much as a LunarLander step; this one moves arrays only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gymnasium
import numpy as np


@dataclass(frozen=True)
class Ended:
    """An episode that ended in this step.

    ``progress`` is the sum of ``info["progress"]``, NaN if the environment reports none;
    ``error`` is ``info["error"]`` of the last step, what ended an episode that cannot go on.
    """

    world: int
    final_observation: np.ndarray
    terminated: bool
    episode_return: float
    length: int
    progress: float
    error: str | None


class VectorWorlds:
    """N environments, one action array in, one observation array out.

    Args:
        envs: environments of equal observation and action spaces.
        max_episode_steps: time limit after which an episode is truncated.
    """

    def __init__(self, envs: Sequence[gymnasium.Env], max_episode_steps: int):
        if not envs:
            raise ValueError("at least one environment is needed")
        self.envs = list(envs)
        self.max_episode_steps = max_episode_steps
        self.observation_space = envs[0].observation_space
        self.action_space = envs[0].action_space
        self._discrete = isinstance(self.action_space, gymnasium.spaces.Discrete)
        self._lengths = np.zeros(len(self.envs), dtype=np.int64)
        self._returns = np.zeros(len(self.envs), dtype=np.float64)
        self._progress = np.full(len(self.envs), np.nan)

    def __len__(self) -> int:
        return len(self.envs)

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start a fresh episode in every environment; observations [N, D] float32."""
        self._lengths[:] = 0
        self._returns[:] = 0.0
        self._progress[:] = np.nan
        return np.stack(
            [env.reset(seed=int(seed))[0] for env, seed in zip(self.envs, seeds, strict=True)]
        )

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Ended]]:
        """Advance every environment by one action of ``actions`` [N] or [N, A].

        Returns observations [N, D] (already those of the next episode where one ended), true
        rewards [N] float64, and the episodes that ended.
        """
        observations = np.empty((len(self.envs), *self.observation_space.shape), dtype=np.float32)
        rewards = np.empty(len(self.envs), dtype=np.float64)
        ended: list[Ended] = []
        choices = actions.tolist() if self._discrete else actions
        self._lengths += 1
        for i, env in enumerate(self.envs):
            observation, reward, terminated, truncated, info = env.step(choices[i])
            rewards[i] = reward
            self._returns[i] += reward
            if "progress" in info:
                before = 0.0 if self._lengths[i] == 1 else self._progress[i]
                self._progress[i] = before + info["progress"]
            if terminated or truncated or self._lengths[i] >= self.max_episode_steps:
                ended.append(
                    Ended(
                        i,
                        np.asarray(observation, dtype=np.float32),
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
