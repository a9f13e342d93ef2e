"""No penalty: plain risk minimisation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from irlcli.penalties import PenaltyOptions

if TYPE_CHECKING:
    import torch


def discriminator(
    logits: torch.Tensor, f: torch.Tensor, risks: torch.Tensor, options: PenaltyOptions
) -> torch.Tensor:
    """Zero, for any input (see :mod:`irlcli.penalties`)."""
    return risks.new_zeros(())


def occupancy(phi: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Zero [R, E] and its gradient, zero [R, E, S], for ``phi`` [R, S] and ``gap`` [R, E, S]."""
    return np.zeros(gap.shape[:2]), np.zeros(gap.shape)
