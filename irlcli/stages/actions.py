"""The actions that AIRL sees: the policy's samples, or what the environment makes of them."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import torch

from irlcli.errors import UsageError
from irlcli.irl import airl
from irlcli.rl import Policy
from irlcli.settings import AIRLSettings
from irlcli.trajectories import Transitions


class SeenActions:
    """Actions and their log pi(a|s) as ``airl.actions`` asks for; ``clipped`` if ``executed``.

    ``sampled``: the policy's samples, also beyond the action space's bounds. ``executed``: clipped
    to them, so that two actions that do the same are the same to g and as likely under pi.

    Args:
        config: AIRL settings.
        space: the environment's actions.

    Raises:
        UsageError: ``executed``, where actions are discrete.
    """

    def __init__(self, config: AIRLSettings, space: gymnasium.Space):
        self.clipped = config.actions == "executed"
        if self.clipped and isinstance(space, gymnasium.spaces.Discrete):
            raise UsageError(
                "airl.actions = executed needs continuous actions", "leave airl.actions unset"
            )
        self._space = space

    def of(self, data: Transitions) -> Transitions:
        """``data`` with the actions that AIRL sees."""
        if not self.clipped:
            return data
        return replace(data, actions=np.clip(data.actions, self._space.low, self._space.high))

    def log_prob(self, policy: Policy, data: Transitions, gradient: bool = False) -> torch.Tensor:
        """log pi(a|s) [B] of the transitions of ``of``."""
        observations = torch.as_tensor(data.observations)
        actions = torch.as_tensor(data.actions)
        if not self.clipped:
            return policy.log_prob(observations, actions, gradient)
        mean, std = policy.gaussian(observations, gradient)
        low, high = torch.as_tensor(self._space.low), torch.as_tensor(self._space.high)
        return airl.clipped_log_prob(mean, std, actions, low, high)
