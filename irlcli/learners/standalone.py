"""A frozen reward as one torch module that needs nothing else: what leaves the package."""

from __future__ import annotations

import torch
from torch import nn

from irlcli.learners.reward_model import RewardModule, absorbed
from irlcli.learners.scoring import absorbing_value


class StandaloneReward(nn.Module):
    """min(g, ceiling) / scale, with the value of an absorbing state where one was learned.

    Args:
        model: the reward model.
        scale: standard deviation of g on training data.
        absorbing: whether a terminated step also earns its absorbing state's discounted rewards.
        gamma: discount of the policy that is trained on it.
        ceiling: bound of g; infinite: none.
        low, high: bounds [A] to which continuous actions are clipped; None: as they are.
    """

    low: torch.Tensor | None
    high: torch.Tensor | None

    def __init__(
        self,
        model: RewardModule,
        scale: float,
        absorbing: bool,
        gamma: float,
        ceiling: float,
        low: torch.Tensor | None,
        high: torch.Tensor | None,
    ):
        super().__init__()
        self.model = model
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self._scale, self._ceiling = scale, ceiling
        self._absorbing, self._gamma = absorbing, gamma

    def forward(
        self,
        observations: torch.Tensor,
        actions: torch.Tensor,
        next_observations: torch.Tensor,
        terminated: torch.Tensor,
        ends: bool = True,
    ) -> torch.Tensor:
        """The reward [B] float32 of B steps.

        Args:
            observations, next_observations: [B, D] float32.
            actions: [B, A] float32, or [B] or [B, K] int64 indices. The reward of an index that no
                action has is NaN.
            terminated: [B] bool; a time limit is no termination.
            ends: False if no step terminated, which saves computing g of absorbing states. An
                exported module has no such argument and no branch on the data.
        """
        if self.low is not None and self.high is not None:
            actions = actions.clamp(self.low, self.high)
        vectors = self.model.encode(actions)
        reward = self.model.reward(observations, vectors).clamp(max=self._ceiling)
        if self._absorbing and ends:
            final = absorbed(self.model, next_observations).clamp(max=self._ceiling)
            reward = reward + absorbing_value(final, terminated.float(), self._gamma)
        if self.model.discrete:
            known = vectors.sum(-1) == (len(self.model.choices) or 1)
            reward = torch.where(known, reward, torch.nan)
        return reward / self._scale
