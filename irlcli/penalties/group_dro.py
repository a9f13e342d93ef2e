"""Group DRO: risk minimisation in the worst mixture of settings.

Sagawa et al. (2020), "Distributionally robust neural networks for group shifts", Algorithm 1, with
the shares of the settings computed anew from every batch instead of accumulated over batches:

    q_e = exp(lambda R_e) / sum exp(lambda R)

The minimised sum q_e R_e has the gradient of log(mean exp(lambda R)) / lambda, a soft maximum.
Lambda is the step size of the shares: at 0 all settings weigh the same, at infinity the worst has
all the weight. To first order in lambda the loss's gradient is that of V-REx at lambda / 2.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from irlcli.penalties import Occupancies, PenaltyOptions, Samples

if TYPE_CHECKING:
    import torch


def discriminator(samples: Samples, options: PenaltyOptions) -> torch.Tensor:
    """sum_e (q_e - w_e) R_e / lambda, a scalar: the loss's sum w R plus lambda times this is sum q R.

    The shares q are held fixed. Where settings have unequal weights w, q is proportional to
    w exp(lambda R). Zero at lambda = 0, and where no setting has a weight (``airl.challenger.share``
    = 1).
    """
    risks, weights = samples.risks, samples.weights
    if options.weight == 0.0 or not weights.any():
        return 0.0 * risks.sum()
    shares = weights.sum() * (weights.log() + options.weight * risks.detach()).softmax(0)
    return ((shares - weights) * risks).sum() / options.weight


def occupancy(at: Occupancies) -> tuple[np.ndarray, np.ndarray]:
    """(q_k / w_k - 1) L_k / lambda [R, K] of the risks L_k, and its gradient with respect to phi [R, K, S].

    Their weights w are the shares at lambda = 0, so that q is proportional to w exp(lambda L). The
    shares q are held fixed.
    """
    weight = at.weight[:, None]
    tilt = np.exp(weight * (at.risks - at.risks.max(-1, keepdims=True)))
    relative = tilt / (at.weights * tilt).sum(-1, keepdims=True)
    excess = np.divide(relative - 1.0, weight, out=np.zeros_like(tilt), where=weight > 0.0)
    return excess * at.risks, -excess[..., None] * at.gap
