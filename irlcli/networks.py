"""Network parts that policies and reward models share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}

# Normalised observations and rewards are clipped to this, as in SB3's VecNormalize.
CLIP = 10.0


def mlp(inputs: int, hidden: Sequence[int], activation: str, dropout: float) -> nn.Sequential:
    """A perceptron with ``hidden`` layers and one output; [B, inputs] to [B, 1].

    In training each hidden unit is zero with probability ``dropout``. The weights have the same
    names with and without it.
    """
    layers: list[nn.Module] = []
    for width in hidden:
        unit = ACTIVATIONS[activation]()
        if dropout > 0.0:
            unit = nn.Sequential(unit, nn.Dropout(dropout))
        layers += [nn.Linear(inputs, width), unit]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, 1))


def all_finite(module: nn.Module) -> bool:
    """Whether every parameter is finite."""
    return all(bool(torch.isfinite(p).all()) for p in module.parameters())


class ObservationNormaliser(nn.Module):
    """Running mean and variance of observations, applied as (s - mean) / std and clipped.

    Batches are merged by the parallel-variance formula (Chan et al. 1983). The moments are
    buffers: saved with the network, changed only by :meth:`update`.
    """

    mean: torch.Tensor
    variance: torch.Tensor
    count: torch.Tensor

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def update(self, observations: torch.Tensor) -> None:
        """Merge the moments of ``observations`` [B, D]."""
        batch = observations.double()
        count, total = len(batch), self.count + len(batch)
        delta = batch.mean(0) - self.mean
        squares = (
            self.variance * self.count
            + batch.var(0, unbiased=False) * count
            + delta**2 * self.count * count / total
        )
        self.mean += delta * count / total
        self.variance.copy_(squares / total)
        self.count += count

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalised observations [..., D] float32; a constant component stays near zero."""
        std = (self.variance + 1e-8).sqrt().float()
        return ((observations - self.mean.float()) / std).clamp(-CLIP, CLIP)
