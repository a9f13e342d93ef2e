"""Images of discriminator samples under an environment's symmetries.

Experts show one of several equally good behaviours: an Ant walks with one of its four sides ahead. A
reward learned from them favours that side, and a new policy that begins with another side ahead earns
little, however well it walks. With images the discriminator sees all sides, of experts and of policies
alike, so the reward is nearly the same for a state and its images.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from irlcli.learners.pools import Minibatch
from irlcli.symmetries import Symmetries

# Mapped at a time. 4096 matrices of 105 x 105, those of MuJoCo's Ant, are 181 MB.
_ROWS = 4096


class Images:
    """Draws an image of each sample, every element of the group with the same probability.

    Args:
        symmetries: None: each sample is its only image.
    """

    def __init__(self, symmetries: Symmetries | None):
        self._group = symmetries
        if symmetries is not None:
            self._observations = torch.as_tensor(symmetries.observations)
            self._actions = torch.as_tensor(symmetries.actions)

    def of(self, batch: Minibatch, generator: torch.Generator) -> Minibatch:
        """``batch`` with each sample replaced by an image: s, a and s' by the same element."""
        if self._group is None:
            return batch
        elements = self._drawn(batch.terminated.shape, generator)
        # The input after the action marks absorbing states.
        action, other = batch.actions.tensor_split([self._actions.shape[-1]], -1)
        return replace(
            batch,
            observations=self._seen(batch.observations, elements),
            actions=torch.cat([_mapped(self._actions, action, elements), other], -1),
            next_observations=self._seen(batch.next_observations, elements),
        )

    def of_observations(
        self, observations: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """An image of each of ``observations`` [B, D]."""
        if self._group is None:
            return observations
        return self._seen(observations, self._drawn(observations.shape[:1], generator))

    def _drawn(self, shape: torch.Size, generator: torch.Generator) -> torch.Tensor:
        return torch.randint(len(self._observations), shape, generator=generator)

    def _seen(self, observations: torch.Tensor, elements: torch.Tensor) -> torch.Tensor:
        found = _mapped(self._observations, observations, elements)
        if self._group is not None and self._group.quaternion is not None:
            columns = self._group.quaternion
            quaternion = found[..., columns]
            # The identity keeps the sign, which tells how often a policy has turned.
            opposite = (quaternion[..., -1:] < 0.0) & (elements > 0).unsqueeze(-1)
            found[..., columns] = torch.where(opposite, -quaternion, quaternion)
        return found


def _mapped(maps: torch.Tensor, values: torch.Tensor, elements: torch.Tensor) -> torch.Tensor:
    """``maps`` [K, D, D] of ``elements`` [...] applied to ``values`` [..., D]."""
    # In parts: each row has a matrix of its own.
    rows = zip(elements.flatten().split(_ROWS), values.flatten(0, -2).split(_ROWS), strict=True)
    found = [torch.matmul(maps[e], v.unsqueeze(-1)).squeeze(-1) for e, v in rows]
    return torch.cat(found).reshape(values.shape)
