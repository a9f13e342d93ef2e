"""The penalty of MaxEnt IRL whose gradient the paper's App. A derives."""

from __future__ import annotations

import numpy as np

from irlcli.penalties import Occupancies


def occupancy(at: Occupancies) -> tuple[np.ndarray, np.ndarray]:
    """||gap||^2 ||phi||^2 [R, K], and its gradient with respect to phi, 2 ||gap||^2 phi [R, K, S].

    The gap is held fixed. By Cauchy-Schwarz this bounds :mod:`irlcli.penalties.irmv1` from above.
    It is a weight decay of the reward whose strength is how badly a risk's occupancy is matched.
    """
    squared_gap = (at.gap**2).sum(-1)
    value = squared_gap * (at.phi**2).sum(-1)[:, None]
    return value, 2.0 * squared_gap[..., None] * at.phi[:, None]
