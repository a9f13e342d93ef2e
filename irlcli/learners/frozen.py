"""A learned reward as it leaves training: what it gives step by step, and per episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from irlcli.data.descriptions import Reward
from irlcli.errors import UsageError
from irlcli.learners.actions import ActionView, Policy
from irlcli.learners.airl import episode_reward, policy_reward
from irlcli.learners.reward_model import RewardModel
from irlcli.trajectories import ActionSpace, Rollout, Trajectory, transitions


class FrozenReward:
    """g divided by its standard deviation on training data; nothing is centred.

    Args:
        model: the reward model.
        origin: its description.
        horizon: time limit of the environment [steps].
        gamma: discount of the policy that is trained on it.
        where: environment and setting, for messages.
        observation_size: D of that setting.
        actions: its actions.

    Raises:
        UsageError: the reward takes other observations or actions.
    """

    def __init__(
        self,
        model: RewardModel,
        origin: Reward,
        horizon: int,
        gamma: float,
        where: str,
        observation_size: int,
        actions: ActionSpace,
    ):
        network = origin.network
        if observation_size != network.observation_size:
            raise UsageError(
                f"the reward takes observations of size {network.observation_size}, but {where} "
                f"has size {observation_size}",
                "a goal (goal-y, direction) is part of the observation: name a setting with the "
                "same kind of intervention as in training",
            )
        if (network.discrete, network.action_size) != (actions.discrete, actions.size):
            raise UsageError(
                f"the reward takes {_actions(network)}, but {where} has {_actions(actions)}",
                "a reward belongs to the environment it was learned in",
            )
        self._model = model
        self._scale = origin.scale
        self._horizon = horizon
        self._gamma = gamma
        self._absorbing = origin.airl.fixed_horizon
        self._view = ActionView(origin.airl.actions, actions)

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The reward [T, N] of every step; what ``policy`` does elsewhere does not matter."""
        data = self._view.of(rollout.transitions(slice(None), self._horizon))
        log_probs = torch.as_tensor(rollout.log_probs.ravel())
        g = policy_reward(self._model, data, log_probs, "g", self._absorbing, self._gamma)
        return (g / self._scale).numpy().reshape(rollout.terminated.shape)

    def of_episode(self, trajectory: Trajectory) -> float:
        """The undiscounted learned return of a whole episode.

        Where absorbing states were learned, the final one counts up to the horizon.
        """
        data = self._view.of(transitions([trajectory], self._horizon))
        return episode_reward(self._model, data, self._absorbing) / self._scale


def _actions(described: Any) -> str:
    """A reward network's or an environment's actions in words."""
    size = getattr(described, "action_size", None) or described.size
    return f"{size} discrete actions" if described.discrete else f"actions of size {size}"
