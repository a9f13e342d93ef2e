"""Statistics of a comparison between methods. The sample is the seed of the reward learning.

Every function is pure: arrays in, numbers out. A number that is not defined is None;
:attr:`Comparison.why` gives the reason.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy import optimize, stats

_RESAMPLES = 10_000
# The level of tests, and the power with which a detectable difference would be found.
LEVEL, POWER = 0.05, 0.8
Run = TypeVar("Run")


@dataclass(frozen=True)
class Sample:
    """Statistics of one method's seeds.

    Attributes:
        mean, iqm: mean and interquartile mean; None without a seed.
        deviation: standard deviation (n - 1); None below two seeds.
        interval: 95 % bootstrap interval of the mean; None below two seeds.
    """

    n: int
    mean: float | None
    deviation: float | None
    interval: tuple[float, float] | None
    iqm: float | None


@dataclass(frozen=True)
class Comparison:
    """``x`` against ``y``.

    Attributes:
        difference: mean of x minus mean of y; None if either is empty.
        interval: its 95 % interval by Welch's test; None without that test.
        detectable: see :func:`detectable_difference`.
        welch: two-sided p of Welch's test, the primary one.
        student: two-sided p of Student's test with equal variances, the paper's.
        rank: two-sided p of the Mann-Whitney test; None for a single seed.
        improvement: P(X > Y) + P(X = Y) / 2 over pairs of seeds; None for a single seed.
        why: the reason for missing p-values; else empty.
    """

    difference: float | None = None
    interval: tuple[float, float] | None = None
    detectable: float | None = None
    welch: float | None = None
    student: float | None = None
    rank: float | None = None
    improvement: float | None = None
    why: str = ""


def bootstrap_interval(sample: np.ndarray) -> tuple[float, float]:
    """95 % percentile interval of the mean of ``sample`` [n].

    Percentile rather than BCa, which is undefined for a constant sample. Both are too narrow with
    few seeds.
    """
    if _constant(sample):
        return float(sample[0]), float(sample[0])
    found = stats.bootstrap(
        (sample,),
        np.mean,
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def interquartile_mean(sample: np.ndarray) -> float:
    """Mean of the middle half of ``sample`` [n] (Agarwal et al. 2021).

    Exactly half for any n: values at the quartiles count in part, so of five seeds the middle three
    have weights 0.75, 1, 0.75. The authors' rliable calls ``trim_mean`` alone, which trims a whole
    number of values; the two agree if n is a multiple of four.
    """
    return float(stats.trim_mean(np.repeat(sample, 4), 0.25))


def rank_test(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """The Mann-Whitney test of ``x`` [n] against ``y`` [m]: its two-sided p, and P(better).

    P(better) is P(X > Y) + P(X = Y) / 2 over all pairs (Agarwal et al. 2021). Both depend on the order
    of the values alone, so one extreme value does not hide a difference. p is exact, but for ties
    among so many values that there are more than 9999 ways to split them: then a random sample of the
    splits is counted.
    """
    values = np.concatenate([x, y])
    ties = len(np.unique(values)) < len(values)
    counting = stats.PermutationMethod(rng=np.random.default_rng(0))
    found = stats.mannwhitneyu(x, y, method=counting if ties else "exact")
    return float(found.pvalue), float(found.statistic) / (len(x) * len(y))


def summarise(sample: Sequence[float]) -> Sample:
    """The statistics of one method's seeds [n]; n may be 0."""
    values = np.asarray(sample, np.float64)
    if len(values) == 0:
        return Sample(0, None, None, None, None)
    mean, iqm = float(values.mean()), interquartile_mean(values)
    if len(values) == 1:
        return Sample(1, mean, None, None, iqm)
    deviation = float(values.std(ddof=1)) if not _constant(values) else 0.0
    return Sample(len(values), mean, deviation, bootstrap_interval(values), iqm)


def compare(x: Sequence[float], y: Sequence[float]) -> Comparison:
    """``x`` [n] against ``y`` [m]."""
    a, b = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if not len(a) or not len(b):
        return Comparison(why="one of the two has no seed")
    found = Comparison(float(a.mean() - b.mean()))
    if min(len(a), len(b)) == 1:
        return replace(found, why="one seed has no variance, and a test needs two seeds of each")
    rank, improvement = rank_test(a, b)
    found = replace(found, rank=rank, improvement=improvement)
    if _constant(a) and _constant(b):
        return replace(found, why="the seeds of each are equal, so the variance is zero")
    # scipy warns if one sample is constant. The tests are defined all the same.
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        welch, student = (stats.ttest_ind(a, b, equal_var=v) for v in (False, True))
    low, high = map(float, welch.confidence_interval(0.95))
    return replace(
        found,
        interval=(low, high),
        detectable=detectable_difference(a, b),
        welch=float(welch.pvalue),
        student=float(student.pvalue),
    )


def detectable_difference(x: np.ndarray, y: np.ndarray) -> float:
    """The difference of means that Welch's two-sided test at 5 % would find with a power of 80 %.

    For normal samples of n and m values whose deviations are those of ``x`` [n] and ``y`` [m], which
    few seeds estimate roughly. n and m are 2 or more, and one of the samples varies.
    """
    true_x, true_y = x.var(ddof=1) / len(x), y.var(ddof=1) / len(y)
    # The test estimates both variances, and from them its degrees of freedom. Given the estimates,
    # the power is a normal tail; it is averaged over them by quadrature.
    (drawn_x, p), (drawn_y, q) = _variances(true_x, len(x) - 1), _variances(true_y, len(y) - 1)
    of_x, of_y = drawn_x[:, None], drawn_y[None, :]
    freedom = (of_x + of_y) ** 2 / (of_x**2 / (len(x) - 1) + of_y**2 / (len(y) - 1))
    needed = stats.t.isf(LEVEL / 2, freedom) * np.sqrt(of_x + of_y)
    error = float(np.sqrt(true_x + true_y))

    # The other tail, a significant difference of the wrong sign, is below 1e-5 there.
    def power(shift: float) -> float:
        return float(p @ stats.norm.sf(needed / error - shift) @ q)

    return error * optimize.brentq(lambda shift: power(shift) - POWER, 0.0, 100.0)


def _variances(true: float, freedom: int) -> tuple[np.ndarray, np.ndarray]:
    """Estimates [k] of the variance ``true`` and their probabilities [k]."""
    points, weights = np.polynomial.legendre.leggauss(64)
    return true * stats.chi2.ppf((points + 1.0) / 2.0, freedom) / freedom, weights / 2.0


def _constant(values: np.ndarray, scale: float | None = None) -> bool:
    """Whether ``values`` [n] are equal up to the rounding of numbers of size ``scale``, by default theirs."""
    size = np.abs(values).max() if scale is None else scale
    return bool(np.ptp(values) <= 1e-12 * size)


def paired_p(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Two-sided p of the paired t-test on ``x`` [n] and ``y`` [n], aligned by seed.

    None below two pairs, or if all differences are equal up to rounding.
    """
    differences = np.asarray(x, np.float64) - np.asarray(y, np.float64)
    if len(differences) < 2 or _constant(differences, np.abs([x, y]).max()):
        return None
    return float(stats.ttest_rel(x, y).pvalue)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm-adjusted p-values. None stays None and does not count as a test."""
    known = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    least = 0.0
    for rank, (p, i) in enumerate(known):
        least = max(least, min(1.0, (len(known) - rank) * p))
        adjusted[i] = least
    return adjusted


def identical_runs(episodes: Mapping[Run, Sequence[float] | np.ndarray]) -> list[tuple[Run, ...]]:
    """Groups of runs whose returns are bitwise equal in every episode.

    Such runs are one run, whatever their seeds or methods.
    """
    groups: dict[bytes, list[Run]] = {}
    for run, returns in episodes.items():
        groups.setdefault(np.asarray(returns, np.float64).tobytes(), []).append(run)
    return [tuple(runs) for runs in groups.values() if len(runs) > 1]
