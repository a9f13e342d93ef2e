"""The risk of adversarial learners. Some penalties compute it on halves of a batch too."""

from __future__ import annotations

import torch
from torch.nn.functional import softplus


def cross_entropy(logits: torch.Tensor) -> torch.Tensor:
    """Binary cross-entropy [E] of ``logits`` [E, 2, B], labels weighted equally.

    Paper Eq. 3 with its sign corrected: expert = 1, policy = 0, to be minimised.
    """
    return 0.5 * (softplus(logits[:, 0]).mean(-1) + softplus(-logits[:, 1]).mean(-1))
