"""The actions that a learner sees: the policy's samples, or what the environment executes."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
import torch

from irlcli.trajectories import ActionSpace, Transitions


class Policy(Protocol):
    """What learners need of a policy: likelihoods, see :class:`irlcli.rl.policy.Policy`."""

    def log_prob(
        self, observations: torch.Tensor, actions: torch.Tensor, gradient: bool = False
    ) -> torch.Tensor:
        """log pi(a|s) [B]."""

    def gaussian(
        self, observations: torch.Tensor, gradient: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and standard deviation [B, A]."""


class ActionView:
    """Actions and their log pi(a|s) as ``airl.actions`` asks for.

    ``sampled``: the policy's samples, also beyond the action space's bounds. ``executed``: clipped
    to them, so that two actions with the same effect look the same to g and have the same
    likelihood.

    Args:
        view: ``sampled`` or ``executed``.
        space: the environment's actions; continuous if ``executed``.
    """

    def __init__(self, view: str, space: ActionSpace):
        self.clipped = view == "executed"
        self._space = space

    def of(self, data: Transitions) -> Transitions:
        """``data`` with the actions that the learner sees."""
        return replace(data, actions=self.seen(data.actions)) if self.clipped else data

    def seen(self, actions: np.ndarray) -> np.ndarray:
        """What the learner sees of ``actions`` [B], [B, K] or [B, A]."""
        return np.clip(actions, self._space.low, self._space.high) if self.clipped else actions

    def bounds(self) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """What actions are clipped to, [A] each; None where they are not."""
        if not self.clipped:
            return None, None
        return torch.as_tensor(self._space.low), torch.as_tensor(self._space.high)

    def log_prob(self, policy: Policy, data: Transitions, gradient: bool = False) -> torch.Tensor:
        """log pi(a|s) [B] of transitions that :meth:`of` returned."""
        observations = torch.as_tensor(data.observations)
        actions = torch.as_tensor(data.actions)
        if not self.clipped:
            return policy.log_prob(observations, actions, gradient)
        mean, std = policy.gaussian(observations, gradient)
        low, high = torch.as_tensor(self._space.low), torch.as_tensor(self._space.high)
        return clipped_log_prob(mean, std, actions, low, high)


def check_fit(data: Transitions, observation_size: int, space: ActionSpace) -> None:
    """Check that demonstrations are of an environment with these observations and actions.

    Args:
        data: as recorded. Clipping them first would broadcast actions of another size.
        observation_size, space: of the environment.

    Raises:
        ValueError: they are not.
    """
    size = data.observations.shape[1]
    if size != observation_size:
        raise ValueError(
            f"the demonstrations have observations of size {size}, the environment "
            f"{observation_size}"
        )
    shape = data.actions.shape[1:]
    if shape != space.shape or (data.actions.dtype == np.int64) != space.discrete:
        raise ValueError(
            f"the demonstrations have actions of shape {list(shape)} and type "
            f"{data.actions.dtype}, the environment has {'int64' if space.discrete else 'float32'} "
            f"of shape {list(space.shape)}"
        )
    if space.discrete and space.outside(data.actions).any():
        last = ", ".join(map(str, np.ravel(space.last)))
        raise ValueError(
            f"the demonstrations have actions below 0 or above {last}, which the environment does not "
            "have"
        )


def clipped_log_prob(
    mean: torch.Tensor,
    std: torch.Tensor,
    actions: torch.Tensor,
    low: torch.Tensor,
    high: torch.Tensor,
) -> torch.Tensor:
    """log pi [B] of a diagonal Gaussian's samples after clipping to [low, high].

    Inside the bounds it is the Gaussian's density, at a bound the mass beyond it. Otherwise how far
    an action lies beyond a bound, which has no effect, would tell the expert from the policy.

    Args:
        mean, std: of the samples, [B, A].
        actions: clipped, [B, A].
        low, high: the bounds, [A].
    """
    inside = torch.distributions.Normal(mean, std).log_prob(actions)
    below = torch.special.log_ndtr((low - mean) / std)
    above = torch.special.log_ndtr((mean - high) / std)
    at_bounds = torch.where(actions <= low, below, above)
    return torch.where((low < actions) & (actions < high), inside, at_bounds).sum(-1)
