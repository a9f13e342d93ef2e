"""A learned reward as it leaves training: what it pays a policy, step by step or per episode."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import torch

from irlcli.checkpoints import load_reward_file
from irlcli.errors import UsageError
from irlcli.interventions import environment
from irlcli.irl import airl
from irlcli.rl import Rollout
from irlcli.stages.actions import SeenActions
from irlcli.stages.adversary import rollout_transitions
from irlcli.trajectories import Trajectory, transitions


class FrozenReward:
    """g divided by its standard deviation on training data; nothing is centred.

    Args:
        path: a ``reward.pt``.
        env: where it pays.
        where: that environment and setting, for messages.
        observations: the setting's observation space.
        actions: its action space.

    Raises:
        UsageError: the reward takes other observations or actions.
        IntegrityError: ``path`` is damaged, foreign or hostile.
    """

    def __init__(
        self,
        path: Path,
        env: str,
        where: str,
        observations: gymnasium.Space,
        actions: gymnasium.Space,
    ):
        self._model, self.origin = load_reward_file(path)
        size, learned = observations.shape[0], self.origin.network.observation_size
        if size != learned:
            raise UsageError(
                f"the reward takes observations of size {learned}, those of {where} have size "
                f"{size}",
                "a goal (goal-y, direction) is part of the observation: name a setting with the "
                "same kind of intervention as in training",
            )
        discrete = isinstance(actions, gymnasium.spaces.Discrete)
        count = int(actions.n) if discrete else actions.shape[0]
        network = self.origin.network
        if (network.discrete, network.action_size) != (discrete, count):
            raise UsageError(
                f"the reward takes {_actions(network.discrete, network.action_size)}, those of "
                f"{where} are {_actions(discrete, count)}",
                "a reward belongs to the environment it was learned in",
            )
        self._horizon = environment(env).max_episode_steps
        self._absorbing = self.origin.airl.fixed_horizon
        self._actions = SeenActions(self.origin.airl, actions)

    def of_steps(self, rollout: Rollout, gamma: float) -> np.ndarray:
        """What each step [T, N] earns a policy that discounts by ``gamma``."""
        data = self._actions.of(rollout_transitions(rollout, slice(None), self._horizon))
        log_probs = torch.as_tensor(rollout.log_probs.ravel())
        g = airl.policy_reward(self._model, data, log_probs, "g", self._absorbing, gamma)
        return (g / self.origin.scale).numpy().reshape(rollout.terminated.shape)

    def of_episode(self, trajectory: Trajectory) -> float:
        """What a whole episode earns, undiscounted.

        Where absorbing states were learned, the one that it ended in pays up to the horizon.
        """
        data = self._actions.of(transitions([trajectory], self._horizon))
        return airl.episode_reward(self._model, data, self._absorbing) / self.origin.scale


def _actions(discrete: bool, count: int) -> str:
    return f"{count} discrete actions" if discrete else f"actions of size {count}"
