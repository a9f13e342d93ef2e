"""Invariance penalties of tractable maximum-entropy IRL (paper Sec. 4.2, App. A).

With a scalar feature phi(s), psi = 1 and the gap C(s) = rho_E(s) - rho_pi(s) of one setting, the
likelihood's gradient by psi is sum_s phi(s) C(s). Two readings of its squared norm, both with C
held fixed where the paper differentiates by phi:

- ``irmv1``: (sum_s phi(s) C(s))^2, the squared gradient (Eq. 9; Arjovsky et al. 2019).
- ``closed-form``: ||C||^2 ||phi||^2, of which App. A's 2 ||C||^2 phi is the gradient. By
  Cauchy-Schwarz it bounds ``irmv1`` from above, and it is a weight decay of the reward whose
  strength is how badly the setting's occupancy is matched.
"""

from __future__ import annotations

import numpy as np

from irlcli.errors import UsageError, suggest

PENALTIES = ("irmv1", "closed-form")


def penalty(kind: str, phi: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """The penalty of each setting [R, E], for ``phi`` [R, S] and ``gap`` [R, E, S].

    Raises:
        UsageError: an unknown kind.
    """
    _check(kind)
    if kind == "irmv1":
        return np.einsum("rs,res->re", phi, gap) ** 2
    return (gap**2).sum(-1) * (phi**2).sum(-1)[:, None]


def penalty_gradient(kind: str, phi: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """d penalty / d phi(s) with the gap held fixed, [R, E, S].

    Raises:
        UsageError: an unknown kind.
    """
    _check(kind)
    if kind == "irmv1":
        return 2.0 * np.einsum("rs,res->re", phi, gap)[..., None] * gap
    return 2.0 * (gap**2).sum(-1)[..., None] * phi[:, None]


def _check(kind: str) -> None:
    if kind not in PENALTIES:
        raise UsageError(f"unknown penalty {kind!r}", suggest(kind, PENALTIES))
