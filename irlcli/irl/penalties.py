"""Invariance penalties: the squared gradient of a setting's loss by a scale w at w = 1.

Arjovsky et al. (2019), as the paper's Eqs. 4-5 use it: a discriminator is invariant if no
setting would rather rescale its output.
"""

from __future__ import annotations

import torch
from torch.nn.functional import softplus


def binary_cross_entropy(logits: torch.Tensor) -> torch.Tensor:
    """BCE per setting [E], labels weighted equally; ``logits`` [E, 2, B].

    Index 0 of the middle axis holds policy samples (label 0), index 1 the expert's (label 1).
    """
    return 0.5 * (softplus(logits[:, 0]).mean(-1) + softplus(-logits[:, 1]).mean(-1))


def scale_gradient(logits: torch.Tensor, scaled: torch.Tensor) -> torch.Tensor:
    """d/dw BCE per setting [E] at w = 1, where d logits / dw = ``scaled`` (both [E, 2, B]).

    ``scaled`` is the whole logit if w multiplies the logit, or f alone if it multiplies only
    the learned part of f - log pi. In closed form (sigmoid(l) - y) * scaled, so differentiating
    it once gives the gradient of the penalty: no double backward.
    """
    probabilities = torch.sigmoid(logits)
    return 0.5 * (
        (probabilities[:, 0] * scaled[:, 0]).mean(-1)
        + ((probabilities[:, 1] - 1.0) * scaled[:, 1]).mean(-1)
    )


def gradient_norm(logits: torch.Tensor, scaled: torch.Tensor) -> torch.Tensor:
    """Penalty per setting [E]: the squared ``scale_gradient`` (paper Eq. 5).

    Biased upwards by the variance of the batch's gradient.
    """
    return scale_gradient(logits, scaled) ** 2


def gradient_norm_unbiased(logits: torch.Tensor, scaled: torch.Tensor) -> torch.Tensor:
    """Unbiased penalty per setting [E]: the product of the gradients on two half-batches.

    Even and odd samples form the halves, each with as many of either label; B must be even.
    May be negative.
    """
    return scale_gradient(logits[..., ::2], scaled[..., ::2]) * scale_gradient(
        logits[..., 1::2], scaled[..., 1::2]
    )
