"""IRMv1: the squared gradient of a setting's risk by a scale w at w = 1.

Arjovsky et al. (2019), as the paper's Eqs. 4-5 and 9 use it: a predictor is invariant if
rescaling its output lowers the risk of no setting.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from irlcli.penalties import Occupancies, PenaltyOptions, Samples

if TYPE_CHECKING:
    import torch


def discriminator(samples: Samples, options: PenaltyOptions) -> torch.Tensor:
    """mean_e (d R_e / d w)^2 at w = 1 over the E risks, a scalar.

    With ``scaling = "logit"`` w multiplies the whole logit, with ``"reward"`` only f: log pi is
    not learned. The plain square is biased upwards by the variance of the batch's gradient; the
    unbiased estimate is the product of the gradients on even and on odd samples. B must be even
    then, and the estimate may be negative.
    """
    logits = samples.logits
    scaled = logits if options.scaling == "logit" else samples.f
    if not options.unbiased:
        return (scale_gradient(logits, scaled) ** 2).mean()
    even = scale_gradient(logits[..., ::2], scaled[..., ::2])
    odd = scale_gradient(logits[..., 1::2], scaled[..., 1::2])
    return (even * odd).mean()


def scale_gradient(logits: torch.Tensor, scaled: torch.Tensor) -> torch.Tensor:
    """d/dw BCE per risk [E] at w = 1, where d logits / dw = ``scaled`` (both [E, 2, B]).

    In closed form (sigmoid(l) - y) * scaled, so that differentiating it once gives the gradient
    of the penalty: no double backward.
    """
    probabilities = logits.sigmoid()
    return 0.5 * (
        (probabilities[:, 0] * scaled[:, 0]).mean(-1)
        + ((probabilities[:, 1] - 1.0) * scaled[:, 1]).mean(-1)
    )


def occupancy(at: Occupancies) -> tuple[np.ndarray, np.ndarray]:
    """(sum_s phi(s) gap(s))^2 [R, K], and its gradient with respect to phi [R, K, S].

    The sum is the likelihood's gradient with respect to psi at psi = 1; this is its square (paper Eq. 9),
    differentiated with the gap held fixed. :mod:`irlcli.penalties.irmv1_full` does not hold it
    fixed.
    """
    gradient_by_psi = np.einsum("rs,rks->rk", at.phi, at.gap)
    return gradient_by_psi**2, 2.0 * gradient_by_psi[..., None] * at.gap
