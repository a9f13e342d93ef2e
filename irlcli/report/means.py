"""Means with bootstrap intervals, in groups of a frame and as text."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from irlcli.report.statistics import bootstrap_interval


def means(frame: pd.DataFrame, by: Sequence[str], measures: Sequence[str]) -> pd.DataFrame:
    """Mean and bootstrap interval of each of ``measures``, in each group of ``frame``.

    Returns a row per group and measure: ``by``, ``measure``, ``mean``, ``low``, ``high``, ``n``.
    """
    rows = []
    for group, members in frame.groupby(list(by), sort=False):
        for measure in measures:
            sample = members[measure].to_numpy()
            low, high = bootstrap_interval(sample)
            values = (*group, measure, float(sample.mean()), low, high, len(sample))
            rows.append(values)
    return pd.DataFrame(rows, columns=[*by, "measure", "mean", "low", "high", "n"])


def interval_text(mean: float, low: float, high: float, digits: int) -> str:
    """``mean [low, high]``, without a minus sign before zero."""
    rounded = (round(x, digits) + 0.0 for x in (mean, low, high))
    return "{:.{d}f} [{:.{d}f}, {:.{d}f}]".format(*rounded, d=digits)
