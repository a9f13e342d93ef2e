"""Rewards divided by the running deviation of their discounted sums, as SB3's VecNormalize does.

Nothing is centred, which would change what the reward asks for. Results are clipped to ±10 as in SB3,
so a rare, large value, such as that of the absorbing state after a late crash, is cut.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd

from irlcli.networks import CLIP


class RunningDeviation:
    """The deviation of the discounted sums of rewards over all steps so far.

    Args:
        gamma: discount of the sums.
        worlds: N, stepped together.
    """

    def __init__(self, gamma: float, worlds: int):
        self._gamma = gamma
        self._sums = np.zeros(worlds)
        # SB3 would begin with a small count of sums that nobody saw.
        self._moments = RunningMeanStd(epsilon=0.0)

    def begin(self) -> None:
        """New episodes start in every world."""
        self._sums[:] = 0.0

    def update(self, rewards: np.ndarray, ended: np.ndarray) -> None:
        """Take in ``rewards`` [T, N]; ``ended`` [T, N] tells where episodes ended."""
        sums = np.empty(rewards.shape)
        for t in range(len(rewards)):
            sums[t] = self._sums = self._gamma * self._sums + rewards[t]
            self._sums = np.where(ended[t], 0.0, self._sums)
        self._moments.update(sums.ravel())

    def normalise(self, rewards: np.ndarray) -> np.ndarray:
        """``rewards`` over the deviation, clipped."""
        return np.clip(rewards / np.sqrt(self._moments.var + 1e-8), -CLIP, CLIP)

    def state(self) -> list[float]:
        """Mean, variance and count of the sums."""
        moments = self._moments
        return [float(moments.mean), float(moments.var), float(moments.count)]

    def load_state(self, state: Any) -> None:
        """Continue from ``state()``."""
        mean, variance, self._moments.count = state
        self._moments.mean, self._moments.var = np.asarray(mean), np.asarray(variance)
