"""Episodes of one length, which the learners of ``imitation`` require."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np


class AbsorbingState(gymnasium.Wrapper):
    """Replaces termination by an absorbing state, so no episode terminates.

    The terminal observation is repeated, actions have no effect, and the reward is 0. A
    ``TimeLimit`` around this wrapper gives the episodes their length.
    """

    _terminal: np.ndarray | None = None

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode."""
        self._terminal = None
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance the environment, or repeat its terminal observation."""
        if self._terminal is not None:
            return self._terminal.copy(), 0.0, False, False, {}
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated:
            self._terminal = observation
        return observation, float(reward), False, truncated, info
