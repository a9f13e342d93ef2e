"""Images of discriminator samples under an environment's symmetries.

Experts show one of several equally good behaviours: on the Ant, walking with one of its sides ahead.
A reward learned from them pays for that side, and a new policy that happens to begin with another
earns little, however well it walks. The images show the discriminator every side, of experts and of
policies alike.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from irlcli.learners.pools import Minibatch
from irlcli.symmetries import Symmetries


class Images:
    """Draws an image for each sample, every element of the group with the same probability."""

    def __init__(self, symmetries: Symmetries):
        self._observations = torch.as_tensor(symmetries.observations)
        self._actions = torch.as_tensor(symmetries.actions)
        self._quaternion = symmetries.quaternion

    def of(self, batch: Minibatch, generator: torch.Generator) -> Minibatch:
        """``batch`` with each sample replaced by an image: s, a and s' by the same element."""
        elements = self._drawn(batch.terminated.shape, generator)
        return replace(
            batch,
            observations=self._turned(batch.observations, elements),
            actions=_mapped(self._actions, batch.actions, elements),
            next_observations=self._turned(batch.next_observations, elements),
        )

    def of_observations(
        self, observations: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """An image of each of ``observations`` [B, D]."""
        return self._turned(observations, self._drawn(observations.shape[:1], generator))

    def _drawn(self, shape: torch.Size, generator: torch.Generator) -> torch.Tensor:
        return torch.randint(len(self._observations), shape, generator=generator)

    def _turned(self, observations: torch.Tensor, elements: torch.Tensor) -> torch.Tensor:
        found = _mapped(self._observations, observations, elements)
        if self._quaternion is not None:
            quaternion = found[..., self._quaternion]
            # The identity keeps what a policy that turned by more than half a circle has.
            opposite = (quaternion[..., -1:] < 0.0) & (elements > 0).unsqueeze(-1)
            found[..., self._quaternion] = torch.where(opposite, -quaternion, quaternion)
        return found


def _mapped(maps: torch.Tensor, values: torch.Tensor, elements: torch.Tensor) -> torch.Tensor:
    """``maps`` [K, D, D] of ``elements`` [...] applied to ``values`` [..., D]."""
    return torch.matmul(maps[elements], values.unsqueeze(-1)).squeeze(-1)
