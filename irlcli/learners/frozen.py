"""A learned reward as it leaves training: what it gives step by step, and per episode."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from irlcli.data.descriptions import Reward
from irlcli.errors import UsageError
from irlcli.learners.actions import ActionView, Policy
from irlcli.learners.reward_model import RewardModule
from irlcli.learners.scoring import episode_reward, level_of
from irlcli.learners.standalone import StandaloneReward
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
        ceiling: a step's reward is at most this quantile of g on the demonstrations; None: g has
            no bound, as it was learned. A step that ends the episode also earns the series of its
            absorbing state, each term bounded.

    Raises:
        UsageError: the reward takes other observations or actions.
    """

    def __init__(
        self,
        model: RewardModule,
        origin: Reward,
        horizon: int,
        gamma: float,
        where: str,
        observation_size: int,
        actions: ActionSpace,
        ceiling: float | None = None,
    ):
        network = origin.network
        if observation_size != network.observation_size:
            raise UsageError(
                f"the reward takes observations of size {network.observation_size}, but {where} "
                f"has size {observation_size}",
                "a goal (goal-y, direction) or a cue is part of the observation: name a setting with "
                "the same kind of intervention as in training",
            )
        theirs = (actions.discrete, actions.size, actions.choices)
        ours = (network.discrete, network.action_size, network.choices)
        if ours != theirs:
            raise UsageError(
                f"the reward takes {actions_in_words(*ours)}, but {where} has {actions_in_words(*theirs)}",
                "a reward belongs to the environment it was learned in",
            )
        self._ceiling = math.inf if ceiling is None else level_of(origin.quantiles, ceiling)
        self._model = model
        self._scale = origin.scale
        self._horizon = horizon
        self._gamma = gamma
        self._absorbing = origin.airl.fixed_horizon
        self._view = ActionView(origin.airl.actions, actions)
        #: :meth:`of_steps` of tensors.
        self.module = StandaloneReward(
            model, self._scale, self._absorbing, gamma, self._ceiling, *self._view.bounds()
        )

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The reward [T, N] of every step; what ``policy`` does elsewhere does not matter."""
        data = rollout.transitions(slice(None), self._horizon)
        steps = data.observations, data.actions, data.next_observations, data.terminated
        return self.of_steps(*steps).reshape(rollout.terminated.shape)

    def of_steps(self, *steps: np.ndarray) -> np.ndarray:
        """The reward [B] float32 of observations, actions, successors and terminations [B, ...]."""
        with torch.no_grad():
            return self.module(*map(torch.as_tensor, steps), bool(steps[-1].any())).numpy()

    def g_over_scale(
        self, observations: np.ndarray, actions: np.ndarray, next_observations: np.ndarray
    ) -> np.ndarray:
        """g / scale [B] of single steps, without ceiling. It does not depend on the successors."""
        seen = self._view.seen(actions)
        with torch.no_grad():
            vectors = self._model.encode(torch.as_tensor(seen))
            g = self._model.reward(torch.as_tensor(observations), vectors)
        return g.double().numpy() / self._scale

    def of_episode(self, trajectory: Trajectory) -> float:
        """The undiscounted learned return of a whole episode, each step under the ceiling.

        Where absorbing states were learned, the final one counts up to the horizon.
        """
        data = self._view.of(transitions([trajectory], self._horizon))
        return episode_reward(self._model, data, self._absorbing, self._ceiling) / self._scale

    def discounted(self, trajectory: Trajectory) -> float:
        """The discounted learned return of an episode: what a policy's training maximises.

        Where absorbing states were learned, the final one has its infinite series. What would follow
        the time limit is left out.
        """
        data = transitions([trajectory], self._horizon)
        steps = data.observations, data.actions, data.next_observations, data.terminated
        return float(self._gamma ** np.arange(len(trajectory)) @ self.of_steps(*steps))


def actions_in_words(discrete: bool, size: int, choices: Sequence[int]) -> str:
    """Actions as :class:`irlcli.trajectories.ActionSpace` describes them, for messages."""
    if choices:
        return f"discrete actions of {' x '.join(map(str, choices))} choices"
    return f"{size} discrete actions" if discrete else f"actions of size {size}"
