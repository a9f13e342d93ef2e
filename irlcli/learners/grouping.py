"""Which demonstrations share a risk: one choice of a method, independent of its penalty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Part(NamedTuple):
    """A setting's demonstrations in a risk.

    Attributes:
        setting: its index.
        episodes: the indices of those of its episodes that belong to the risk.
        share: of the risk's samples.
    """

    setting: int
    episodes: np.ndarray
    share: float


class Group(NamedTuple):
    """The demonstrations of one risk, and the risk's weight; weights sum to one."""

    parts: tuple[Part, ...]
    weight: float


def group(grouping: str, counts: Sequence[int], rng: np.random.Generator) -> list[Group]:
    """The groups of E settings with ``counts`` [E] episodes.

    - ``pooled``: one group, settings weighted by their number of episodes (ERM), up to the rounding
      of :func:`apportion`; within a setting every step counts the same. Each setting has its own part,
      so that the policy's samples, which are paired with a part's settings, have the same shares.
      Otherwise a discriminator could learn how often a setting was demonstrated.
    - ``balanced`` and ``per-setting``: one group per setting, of equal weight. Balanced groups
      share one risk where a penalty looks at risks.
    - ``shuffled``: as many groups, over episodes dealt out by ``rng``, see :func:`deal`. Each setting keeps
      the share of the total weight that it has in ``per-setting``, whatever its count.
    """
    settings = range(len(counts))
    if grouping == "pooled":
        parts = (Part(e, np.arange(counts[e]), counts[e] / sum(counts)) for e in settings)
        return [Group(tuple(parts), 1.0)]
    if grouping in ("balanced", "per-setting"):
        return [Group((Part(e, np.arange(counts[e]), 1.0),), 1.0 / len(counts)) for e in settings]
    dealt = deal(counts, rng)
    # Group g holds shares[g, e] of setting e, so that the columns sum to one.
    shares = np.array([[np.mean(dealt[e] == g) for e in settings] for g in settings])
    return [
        Group(
            tuple(
                Part(e, np.flatnonzero(dealt[e] == g), shares[g, e] / shares[g].sum())
                for e in settings
                if shares[g, e] > 0.0
            ),
            shares[g].sum() / len(counts),
        )
        for g in settings
    ]


def deal(counts: Sequence[int], rng: np.random.Generator) -> list[np.ndarray]:
    """For each setting e the groups [counts[e]] of its episodes.

    Which episode goes to which of the E groups is random. The numbers of a setting's episodes in the
    groups differ by at most one. The larger groups are the same for every setting, so all groups mix
    the settings in nearly equal shares. No group stays empty.
    """
    size = len(counts)
    groups = []
    for setting, count in enumerate(counts):
        to = (setting + np.arange(count)) % size
        # If no setting reaches every group, this would leave the last groups empty.
        if max(counts) >= size:
            more = count % size
            to[count - more :] = np.arange(more)
        dealt = np.empty(count, dtype=np.int64)
        dealt[rng.permutation(count)] = to
        groups.append(dealt)
    return groups


def hides_settings(counts: Sequence[int]) -> bool:
    """Whether each of the E settings has an episode in every group that is dealt out."""
    return min(counts) >= len(counts)


def apportion(total: int, shares: Sequence[float]) -> list[int]:
    """``total`` samples, an even number, in even parts of at least 2 close to ``shares``."""
    pairs = total // 2
    exact = np.asarray(shares) * pairs
    parts = np.maximum(1, np.floor(exact).astype(int))
    while parts.sum() < pairs:
        parts[np.argmax(exact - parts)] += 1
    while parts.sum() > pairs:
        parts[np.argmax(parts)] -= 1
    return [int(2 * part) for part in parts]
