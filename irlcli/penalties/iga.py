"""IGA: the variance of the gradients of the settings' risks.

Koyama and Yamaguchi (2020), "When is invariance useful in an out-of-distribution generalization
problem?" (arXiv 2008.01883), inter-environmental gradient alignment: in an invariant predictor the
gradients of all settings' risks are equal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from irlcli.penalties import PenaltyOptions, Samples
from irlcli.penalties.risk import cross_entropy

if TYPE_CHECKING:
    import torch


def discriminator(samples: Samples, options: PenaltyOptions) -> torch.Tensor:
    """trace Var_e(G_e) = mean_e ||G_e - mean G||^2 of the gradients G_e of the E risks, a scalar.

    The plain variance is biased upwards by the noise of a batch's gradients. The unbiased estimate
    is the covariance of the gradients on even and on odd samples. B must be even then, and the
    estimate may be negative.
    """
    if not options.unbiased:
        deviation = deviations(samples.risks, samples.parameters)
        return (deviation**2).sum(-1).mean()
    even = deviations(cross_entropy(samples.logits[..., ::2]), samples.parameters)
    odd = deviations(cross_entropy(samples.logits[..., 1::2]), samples.parameters)
    return (even * odd).sum(-1).mean()


def deviations(risks: torch.Tensor, parameters: tuple[torch.Tensor, ...]) -> torch.Tensor:
    """G_e - mean G [E, P]: each of the ``risks`` [E] pulls the P weights away from the others."""
    import torch

    gradients = torch.stack(
        [
            torch.cat(
                [g.flatten() for g in torch.autograd.grad(risk, parameters, create_graph=True)]
            )
            for risk in risks
        ]
    )
    return gradients - gradients.mean(0)
