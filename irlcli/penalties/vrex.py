"""V-REx: the variance of the settings' risks.

Krueger et al. (2021), "Out-of-distribution generalization via risk extrapolation", Eq. 8: a
predictor whose risk is the same in every setting keeps it in mixtures beyond them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from irlcli.penalties import Occupancies, PenaltyOptions, Samples
from irlcli.penalties.risk import cross_entropy

if TYPE_CHECKING:
    import torch


def discriminator(samples: Samples, options: PenaltyOptions) -> torch.Tensor:
    """Var_e(R_e) = mean_e (R_e - mean R)^2 of the E risks, a scalar.

    The plain variance is biased upwards by the noise of a batch's risks. The unbiased estimate is
    the covariance of the risks on even and on odd samples. B must be even then, and the estimate
    may be negative.
    """
    if not options.unbiased:
        return samples.risks.var(unbiased=False)
    even = cross_entropy(samples.logits[..., ::2])
    odd = cross_entropy(samples.logits[..., 1::2])
    return ((even - even.mean()) * (odd - odd.mean())).mean()


def occupancy(at: Occupancies) -> tuple[np.ndarray, np.ndarray]:
    """(L_k - sum w L)^2 [R, K] of the risks L_k, and its gradient with respect to phi [R, K, S].

    The sum of the values, weighted by w, is the variance, and that of the gradients its exact
    gradient: what the mean adds to them cancels. The risks are negative log-likelihoods, so
    settings in which the experts act more randomly count as worse whatever the reward.
    """
    mean = (at.weights * at.risks).sum(-1, keepdims=True)
    excess = at.risks - mean
    return excess**2, -2.0 * excess[..., None] * at.gap
