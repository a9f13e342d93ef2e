"""The reward model: g, h and the observation normaliser, as one torch module.

AIRL splits what the discriminator learns into a reward g(s, a) (or g(s)) and a shaping
potential h(s) (paper Eq. 2; Fu et al. 2017). Only g leaves adversarial training.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import nn

from irlcli.networks import ObservationNormaliser, mlp


class RewardModel(nn.Module):
    """g(s, a), h(s) and f = g + gamma h(s') - h(s) (paper Eq. 2).

    Args:
        observation_size: D.
        action_size: A; the number of choices if actions are discrete (fed as one-hot).
        discrete: whether actions are int64 indices [B] or [B, K], or float32 vectors [B, A].
        state_only: g(s) instead of g(s, a).
        hidden: widths of the hidden layers of g and of h.
        activation: ``tanh`` or ``relu``.
        gamma: discount of the shaping term.
        shaping: whether f has a shaping term; otherwise f is g.
        columns: the entries of an observation that g and h see; all if there are none.
        dropout: probability that a hidden unit is left out in training mode
            (``nn.Module.train``).
        choices: number of choices of each of K indices, summing to ``action_size``; empty if there is
            one.
        shared_absorbing: all absorbing states look alike to g, which knows them by an input of their
            own (Kostrikov et al. 2019). Otherwise each keeps its final observation.

    Raises:
        ValueError: an observation has no such column, or other choices.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        discrete: bool,
        state_only: bool,
        hidden: Sequence[int],
        activation: str,
        gamma: float,
        shaping: bool = True,
        columns: Sequence[int] = (),
        dropout: float = 0.0,
        choices: Sequence[int] = (),
        shared_absorbing: bool = False,
    ):
        super().__init__()
        self.observation_size = observation_size
        self.action_size = action_size
        self.discrete = discrete
        self.state_only = state_only
        self.gamma = gamma
        self.normaliser = ObservationNormaliser(observation_size)
        self.choices = tuple(choices)
        if choices and (sum(choices) != action_size or not discrete):
            raise ValueError(f"choices {list(choices)} are not those of {action_size} actions")
        self.columns = list(columns)
        if any(not -observation_size <= column < observation_size for column in columns):
            raise ValueError(
                f"columns {self.columns} are not all entries of an observation of {observation_size}"
            )
        self.shared_absorbing = shared_absorbing
        seen = len(columns) or observation_size
        inputs = seen + (0 if state_only else action_size) + int(shared_absorbing)
        self.g = mlp(inputs, hidden, activation, dropout)
        self.h = mlp(seen, hidden, activation, dropout) if shaping else None

    def encode(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions as vectors [B, A]: one-hot if discrete, those of several indices side by side.

        With ``shared_absorbing`` a zero follows [B, A + 1]: the states are not absorbing.
        """
        vectors = actions
        if self.discrete:
            indices = actions.unbind(-1) if self.choices else (actions,)
            parts = zip(indices, self.choices or (self.action_size,), strict=True)
            # one_hot() of any batch size cannot be exported: it looks at the largest index.
            vectors = torch.cat(
                [part[..., None] == torch.arange(n) for part, n in parts], -1
            ).float()
        if self.shared_absorbing:
            vectors = torch.cat([vectors, torch.zeros_like(vectors[..., :1])], -1)
        return vectors

    def no_actions(self, observations: torch.Tensor) -> torch.Tensor:
        """The action vectors of absorbing states that keep ``observations`` [B, D]."""
        none = observations.new_zeros(*observations.shape[:-1], self.action_size)
        if self.shared_absorbing:
            none = torch.cat([none, torch.ones_like(none[..., :1])], -1)
        return none

    def reward(self, observations: torch.Tensor, action_vectors: torch.Tensor) -> torch.Tensor:
        """g [B] for observations [B, D] and actions as :meth:`encode` gives them."""
        return self.g(self.inputs(observations, action_vectors))[..., 0]

    def inputs(self, observations: torch.Tensor, action_vectors: torch.Tensor) -> torch.Tensor:
        """What the network g sees [B, D] or [B, D + A]: normalised observations, actions.

        With columns, D is their number. With ``shared_absorbing`` one more input is 1 in absorbing
        states, where all others are 0.
        """
        s = self._seen(observations)
        if not self.shared_absorbing:
            return s if self.state_only else torch.cat([s, action_vectors], -1)
        absorbing = action_vectors[..., -1:]
        return torch.cat(
            [s * (1.0 - absorbing), absorbing if self.state_only else action_vectors], -1
        )

    def _seen(self, observations: torch.Tensor) -> torch.Tensor:
        normalised = self.normaliser(observations)
        return normalised[..., self.columns] if self.columns else normalised

    def forward(
        self,
        observations: torch.Tensor,
        action_vectors: torch.Tensor,
        next_observations: torch.Tensor,
        terminated: torch.Tensor,
    ) -> torch.Tensor:
        """f [B]; ``terminated`` [B] in {0, 1} removes the value of the successor."""
        g = self.reward(observations, action_vectors)
        if self.h is None:
            return g
        h = self.h(self._seen(observations))[..., 0]
        h_next = self.h(self._seen(next_observations))[..., 0]
        return g + self.gamma * h_next * (1.0 - terminated) - h

    def absorbing_reward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(g, f) [B] of the absorbing states in which episodes ended with ``observations`` [B, D].

        An absorbing state offers no choice: its action is zero and log pi is zero, so
        f = g + (gamma - 1) h.
        """
        g = absorbed(self, observations)
        if self.h is None:
            return g, g
        h = self.h(self._seen(observations))[..., 0]
        return g, g + (self.gamma - 1.0) * h


class AveragedReward(nn.Module):
    """The mean of g of several reward models: what is frozen if ``airl.averaged_rounds`` says so.

    A policy trained on the last g alone may find what no policy in training was rewarded for at that
    moment. The mean remembers what earlier rounds corrected (the average iterate of a zero-sum game;
    TRIRL, arXiv 2605.11020, averages rewards too). Each member normalises observations by the
    moments of its own round.

    Args:
        members: at least one, of the same shape.
    """

    def __init__(self, members: Sequence[RewardModel]):
        super().__init__()
        self.members = nn.ModuleList(members)
        self.observation_size = members[0].observation_size
        self.action_size = members[0].action_size
        self.discrete = members[0].discrete
        self.choices = members[0].choices

    def no_actions(self, observations: torch.Tensor) -> torch.Tensor:
        """As :meth:`RewardModel.no_actions`."""
        return self._models[0].no_actions(observations)

    def encode(self, actions: torch.Tensor) -> torch.Tensor:
        """As :meth:`RewardModel.encode`."""
        return self._models[0].encode(actions)

    def reward(self, observations: torch.Tensor, action_vectors: torch.Tensor) -> torch.Tensor:
        """The mean of g [B] for observations [B, D] and actions as :meth:`encode` gives them."""
        found = [member.reward(observations, action_vectors) for member in self._models]
        return torch.stack(found).mean(0)

    @property
    def _models(self) -> list[RewardModel]:
        return cast(list[RewardModel], list(self.members))


# What is frozen.
RewardModule = RewardModel | AveragedReward


def absorbed(model: RewardModule, observations: torch.Tensor) -> torch.Tensor:
    """g [B] of the absorbing states in which episodes ended with ``observations`` [B, D]."""
    return model.reward(observations, model.no_actions(observations))


def build(members: int = 1, **shape: Any) -> RewardModule:
    """An untrained reward model of ``shape``, or the mean of several."""
    if members == 1:
        return RewardModel(**shape)
    return AveragedReward([RewardModel(**shape) for _ in range(members)])
