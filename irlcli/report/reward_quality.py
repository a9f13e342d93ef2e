"""How well a learned reward ranks policies, and why a policy retrained on it falls short.

The sample is a *bank*: policies of mixed quality, each with the true and the learned returns of the
same episodes. Every function is pure: arrays in, numbers out. A number that is not defined is None.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import rankdata

from irlcli.data.descriptions import (
    Agreement,
    Interval,
    Measured,
    RegretSplit,
    Verdict,
)

# A retrained policy succeeds if its regret is within this share of what the expert earns above
# the random agent.
ALLOWED_REGRET = 0.1
_RESAMPLES = 2000
# Episodes that are resampled at a time, which bounds the memory.
RESAMPLED_AT_ONCE = 1_000_000
# Policies below which a correlation has no interval.
FEWEST_RESAMPLED = 5


class Member(NamedTuple):
    """A policy of the bank in one setting.

    Attributes:
        policy: its name; one policy has the same name in every setting.
        kind: ``idle``, ``random``, ``clone`` (at several noise levels), ``student``, ``expert`` (the
            setting's own), ``reused`` (that of another setting), ``retrained`` or
            ``from-student`` (retrained from the student on).
        true, learned: returns [n] of the same n episodes.
        steps: [n], over which the learned return sums, absorbing ones included.
        progress: mean over the episodes; None if the environment reports none.
        ceiling: of the rewards that a retrained policy was trained on; None without.
        gap, discounted_gap: of a retrained policy, the expert's learned return minus its own [n],
            under its ceiling: of plain sums, and of the discounted ones that its training maximises.
    """

    policy: str
    kind: str
    setting: str
    true: np.ndarray
    learned: np.ndarray
    steps: np.ndarray
    progress: float | None = None
    ceiling: float | None = None
    gap: np.ndarray | None = None
    discounted_gap: np.ndarray | None = None


class Judgement(NamedTuple):
    """A verdict, or none, and whether the differences that decide it exceed two standard errors."""

    verdict: Verdict | None
    clear: bool


def measured(sample: np.ndarray) -> Measured:
    """Mean of ``sample`` [n] and its standard error; that of one episode is None."""
    error = float(sample.std(ddof=1)) / math.sqrt(len(sample)) if len(sample) > 1 else None
    return Measured(mean=float(sample.mean()), error=error)


# Correlations


def pearson(x: np.ndarray, y: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Pearson's r [...] of ``x`` and ``y`` [..., P] over the entries ``present`` [..., P].

    NaN below two entries, or where one of the two is constant.
    """
    count = np.maximum(present.sum(-1, keepdims=True), 1)
    # Subtracted first: a constant then has deviations of exactly zero.
    a, b = (np.where(present, v - _first(v, present), 0.0) for v in (x, y))
    a, b = (np.where(present, v - v.sum(-1, keepdims=True) / count, 0.0) for v in (a, b))
    varies = (_span(x, present) > 0) & (_span(y, present) > 0)
    scale = np.sqrt((a**2).sum(-1) * (b**2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(varies & (scale > 0), np.clip((a * b).sum(-1) / scale, -1, 1), np.nan)


def spearman(x: np.ndarray, y: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Spearman's rho, as :func:`pearson`: Pearson's r of the ranks, ties at their mean."""
    return pearson(_ranks(x, present), _ranks(y, present), present)


def lower_half(true: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Which entries [..., P] are present and at or below the median of ``true``.

    At least one is present.
    """
    middle = np.nanmedian(np.where(present, true, np.nan), axis=-1, keepdims=True)
    return present & (true <= middle)


def _first(values: np.ndarray, present: np.ndarray) -> np.ndarray:
    index = present.argmax(-1)[..., None]
    return np.take_along_axis(np.broadcast_to(values, present.shape), index, -1)


def _span(values: np.ndarray, present: np.ndarray) -> np.ndarray:
    high = np.where(present, values, -np.inf).max(-1)
    return high - np.where(present, values, np.inf).min(-1)


def _ranks(values: np.ndarray, present: np.ndarray) -> np.ndarray:
    # The absent ones rank last and so leave the others' ranks alone.
    return rankdata(np.where(present, values, np.inf), axis=-1)


def agreement(members: Sequence[Member], lower: bool = False) -> Agreement:
    """Correlations of the mean learned with the mean true return over the bank.

    The 95 % percentile intervals resample policies, with all their settings, and episodes within
    them. With ``lower``, only over the half of the entries with the lower true returns; each
    resample has its own lower half.

    Args:
        members: of one setting or of several; each has the same number of episodes.
        lower: whether to leave the better half out.
    """
    policies = list(dict.fromkeys(m.policy for m in members))
    settings = list(dict.fromkeys(m.setting for m in members))
    episodes = len(members[0].true)
    shape = len(policies), len(settings)
    present = np.zeros(shape, dtype=bool)
    true, learned = np.zeros((2, *shape, episodes))
    for m in members:
        at = policies.index(m.policy), settings.index(m.setting)
        present[at], true[at], learned[at] = True, m.true, m.learned
    rng = np.random.default_rng(0)
    drawn = rng.integers(shape[0], size=(_RESAMPLES, shape[0]))
    means = np.empty((2, _RESAMPLES, *shape))
    part = max(1, RESAMPLED_AT_ONCE // (present.size * episodes))
    for start in range(0, _RESAMPLES, part):
        end = min(start + part, _RESAMPLES)
        # The same episodes of every policy: episode k starts from the same state for all of them.
        at_random = rng.integers(episodes, size=(end - start, 1, 1, episodes))
        for of, values in zip(means, (true, learned), strict=True):
            of[start:end] = np.take_along_axis(values[None], at_random, -1).mean(-1)
    # A policy that is drawn twice has the same episodes both times. Two draws of them would differ
    # by noise alone, and spoil a perfect order.
    found = np.take_along_axis(means, drawn[None, ..., None], 2).reshape(2, _RESAMPLES, -1)
    draws = found[0], found[1]

    def chosen(values: np.ndarray, here: np.ndarray) -> np.ndarray:
        return lower_half(values, here) if lower else here

    point = true.mean(-1).reshape(1, -1), learned.mean(-1).reshape(1, -1)
    here = chosen(point[0], present.reshape(1, -1))
    there = chosen(draws[0], present[drawn].reshape(_RESAMPLES, -1))
    count = int(here.reshape(shape).any(1).sum())
    return Agreement(
        policies=int(here.sum()),
        spearman=_interval(spearman(*point, here), spearman(*draws, there), count),
        pearson=_interval(pearson(*point, here), pearson(*draws, there), count),
    )


def _interval(point: np.ndarray, draws: np.ndarray, count: int) -> Interval | None:
    """None if undefined. A resample that is constant says nothing and is left out.

    Of few policies, those that remain have nearly all the same order: they have no interval.
    """
    if math.isnan(point[0]):
        return None
    if count < FEWEST_RESAMPLED:
        return Interval(value=float(point[0]))
    low, high = np.nanpercentile(draws, [2.5, 97.5])
    return Interval(value=float(point[0]), low=float(low), high=float(high))


def return_distance(members: Sequence[Member]) -> float | None:
    """Episode-return correlation pseudometric sqrt((1 - r) / 2) (Gleave et al. 2021, Sec. 5).

    r is Pearson's over the episodes of the bank, each policy counting equally in each setting. 0: equal up to scale
    and offset; 1: opposite. Unlike EPIC it depends on the policies.
    """
    true = np.concatenate([m.true for m in members])
    learned = np.concatenate([m.learned for m in members])
    r = float(pearson(true, learned, np.ones(len(true), dtype=bool)))
    return None if math.isnan(r) else math.sqrt((1.0 - r) / 2.0)


# What a retrained policy fell short of


def judge(
    regret: Measured, margin: float, gap: Measured, discounted_gap: Measured | None = None
) -> Judgement:
    """Why a retrained policy does not earn what the expert earns, if it does not.

    None where the expert earns no more than the random agent. ``matches the expert``: its regret is within
    10 % of what the expert earns above the random agent. ``wrong reward``: its learned return is at
    least the expert's. ``optimisation fell short``: the expert's learned return is higher, so the
    reward still offers more.

    Args:
        regret: true return of the expert minus the policy's.
        margin: true return of the expert minus the random agent's.
        gap: learned return of the expert minus the policy's.
        discounted_gap: the same of discounted returns; with another sign, the verdict is not clear.
    """
    if margin <= 0.0:
        return Judgement(None, False)
    beyond = regret.mean - ALLOWED_REGRET * margin
    if beyond <= 0.0:
        return Judgement("matches the expert", _is_clear(beyond, regret))
    verdict: Verdict = "wrong reward" if gap.mean <= 0.0 else "optimisation fell short"
    agree = discounted_gap is None or (discounted_gap.mean > 0.0) == (gap.mean > 0.0)
    return Judgement(verdict, agree and _is_clear(beyond, regret) and _is_clear(gap.mean, gap))


def _is_clear(margin: float, of: Measured) -> bool:
    return of.error is not None and abs(margin) > 2.0 * of.error


def split_regret(policy: Member, expert: Member, random: Member) -> RegretSplit:
    """The true regret of a retrained policy beside the gap of its learned return to the expert.

    Learned returns are those that the policy was trained for: under its ceiling, if it has one.
    Standard errors are of paired differences, because episode k starts from the same state for all.
    """
    regret = measured(expert.true - policy.true)
    gap = measured(expert.learned - policy.learned if policy.gap is None else policy.gap)
    discounted = None if policy.discounted_gap is None else measured(policy.discounted_gap)
    margin = float(expert.true.mean() - random.true.mean())
    verdict, clear = judge(regret, margin, gap, discounted)
    return RegretSplit(
        policy=policy.policy,
        true_regret=regret,
        learned_gap=gap,
        discounted_gap=discounted,
        verdict=verdict,
        clear=clear,
        ceiling=policy.ceiling,
        from_student=policy.kind == "from-student",
    )
