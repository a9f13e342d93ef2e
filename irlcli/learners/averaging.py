"""The rounds whose rewards are averaged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def averaged_after(weights: Sequence[float], members: int) -> list[int]:
    """The rounds after which g joins the mean, in ascending order; the last round is among them.

    The plain mean of the ``members`` rewards approximates the mean of all rounds' rewards with
    ``weights``. Member k of K is the last round by which at most k/K of all weight is spent, or
    round 0 if there is none. So it stands for the rounds since member k - 1, of which it is the
    latest. With equal weights the rounds are equally spaced.

    In convex-concave games the averaged iterates have the step sizes as weights (Nemirovski et al.
    2009, Robust stochastic approximation approach to stochastic programming, Sec. 3). For networks
    this is a heuristic.

    Args:
        weights: one per round, not negative, at least one positive.
        members: at least 1. A round with more than 1/K of the weight may join several times.
    """
    spent = np.cumsum(weights) / np.sum(weights)
    # The tolerance keeps rounding from moving a member to the round before.
    shares = np.arange(1, members + 1) / members + 1e-9
    last = np.searchsorted(spent, shares, side="right") - 1
    return [max(0, int(index)) for index in last]
