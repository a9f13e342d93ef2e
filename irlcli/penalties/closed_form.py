"""The penalty of MaxEnt IRL whose gradient the paper's App. A derives."""

from __future__ import annotations

import numpy as np


def occupancy(phi: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """||gap||^2 ||phi||^2 [R, E], and its gradient by phi, 2 ||gap||^2 phi [R, E, S].

    ``phi`` [R, S] is the reward, ``gap`` = rho_E - rho_pi [R, E, S], held fixed. By
    Cauchy-Schwarz this bounds :mod:`irlcli.penalties.irmv1` from above. It is a weight decay of the
    reward whose strength is how badly the setting's occupancy is matched.
    """
    squared_gap = (gap**2).sum(-1)
    value = squared_gap * (phi**2).sum(-1)[:, None]
    return value, 2.0 * squared_gap[..., None] * phi[:, None]
