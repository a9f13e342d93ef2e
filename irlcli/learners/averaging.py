"""The rounds whose rewards are averaged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def averaged_after(weights: Sequence[float], members: int) -> list[int]:
    """The rounds after which g joins the mean, in ascending order; the last one is among them.

    The plain mean of the ``members`` rewards approximates the mean of all rounds' rewards with
    ``weights``: member k of K is the last round by which at most k/K of all weight is spent. With
    equal weights the rounds are equally spaced. The average iterate of a zero-sum game has the
    learning rates as weights (Nemirovski et al. 2009, Sec. 3: robust stochastic approximation).

    Args:
        weights: one of each round, not negative, at least one positive.
        members: at least 1. Where there are more members than rounds with enough weight, a round
            joins several times.
    """
    spent = np.cumsum(weights) / np.sum(weights)
    # The tolerance keeps rounding from moving a member to the round before.
    shares = np.arange(1, members + 1) / members + 1e-9
    last = np.searchsorted(spent, shares, side="right") - 1
    return [max(0, int(index)) for index in last]
