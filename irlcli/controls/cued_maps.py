"""A tabular MDP in which invariance must help: maps of cells that look better than they are.

The true reward is a cell's *quality*. The learner does not see it. It sees a *texture*, which agrees
with the quality equally often in every setting, and *colours*, which agree with it more often, but
differently often in each setting. Every setting has a map of its own; all maps have the same
dynamics: a torus on which an agent moves to a neighbour or stays, and nothing slips.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from irlcli.learners.occupancy import IndexedDemonstrations
from irlcli.learners.soft_values import solve
from irlcli.tabular import StackedMDPs, TabularMDP, backward, forward, stack


class Maps(NamedTuple):
    """The maps of E settings for each of R runs.

    Attributes:
        quality: [R, E, S] float64, 0 or 1.
        kinds: [R, E, S], what the learner sees of a cell: bit 0 is the texture, bit 1 + c is
            colour c. :func:`features` has a row for each kind.
    """

    quality: np.ndarray
    kinds: np.ndarray


def draw(
    seeds: Sequence[int], size: int, texture: float, strengths: np.ndarray, purpose: int
) -> Maps:
    """Maps of ``size`` x ``size`` cells, half of them good, for each seed.

    Args:
        texture: share of the cells in which the texture equals the quality, in [0, 1].
        strengths: the same share for each colour in each setting [R, E, C].
        purpose: maps of other purposes (to learn from, to be tested in) are drawn independently.

    The shares are exact among the good and among the bad cells, up to rounding. Which cells agree
    is drawn independently for the texture and for each colour.

    Raises:
        ValueError: a share outside [0, 1].
    """
    shares = np.concatenate([np.full((*strengths.shape[:2], 1), texture), strengths], axis=2)
    if not ((shares >= 0.0) & (shares <= 1.0)).all():
        raise ValueError(f"cue strengths must lie in [0, 1], not {np.unique(shares).tolist()}")
    cells = size * size
    quality = np.empty((*strengths.shape[:2], cells))
    kinds = np.zeros(quality.shape, dtype=np.int64)
    for r, seed in enumerate(seeds):
        rng = np.random.default_rng((seed, purpose))
        for e, row in enumerate(shares[r]):
            good = rng.permutation(cells) < cells // 2
            quality[r, e] = good
            for bit, share in enumerate(row):
                shown = good.copy()
                for group in (good, ~good):
                    members = rng.permutation(np.flatnonzero(group))
                    wrong = members[round(share * len(members)) :]
                    shown[wrong] = ~shown[wrong]
                kinds[r, e] |= shown.astype(np.int64) << bit
    return Maps(quality, kinds)


def features(colours: int) -> np.ndarray:
    """[T, F]: the texture and the colours of each kind of cell, -1 or 1."""
    kinds = np.arange(2 ** (1 + colours))
    return 2.0 * (kinds[:, None] >> np.arange(1 + colours) & 1) - 1.0


def hint_weights(reward: np.ndarray) -> np.ndarray:
    """The weights in ``reward`` [..., T] of the texture and of each colour [..., F].

    This is the mean over all kinds of cells of what turning this one from bad to good adds.
    """
    shown = features(reward.shape[-1].bit_length() - 2)
    return 2.0 * reward @ shown / len(shown)


def torus(size: int, settings: int) -> StackedMDPs:
    """``settings`` equal MDPs of ``size`` x ``size`` cells: stay, or move to one of four cells.

    The first state is uniform. Rewards are those of the maps; there is no goal, and cell 0, which
    the MDP must name as one, is a cell like any other.
    """
    cell = np.arange(size * size).reshape(size, size)
    moves = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)]
    mdp = TabularMDP(
        afterstate=np.stack([np.roll(cell, move, (0, 1)).ravel() for move in moves]),
        successor=cell.reshape(-1, 1),
        probability=np.ones((cell.size, 1)),
        start=np.full(cell.size, 1.0 / cell.size),
        reward=np.zeros(cell.size),
        goal=0,
    )
    return stack([mdp] * settings)


def demonstrate(
    settings: StackedMDPs, reward: np.ndarray, horizon: int, episodes: int, seeds: Sequence[int]
) -> list[IndexedDemonstrations]:
    """``episodes`` of experts that are soft-optimal for ``reward`` [R, E, S], for each run.

    The episodes of a run depend on its seed and on its own maps only.
    """
    policy = solve(settings, reward, horizon).policy
    _, actions, e, n, _ = policy.shape
    found = []
    for r, seed in enumerate(seeds):
        rng = np.random.default_rng((seed, 2))
        states = np.empty((e, episodes, horizon + 1), dtype=np.int64)
        chosen = np.empty((e, episodes, horizon), dtype=np.int64)
        states[..., 0] = rng.integers(n, size=(e, episodes))
        for t in range(horizon):
            probability = policy[t, :, np.arange(e)[:, None], states[..., t], r]
            draw = rng.random((e, episodes, 1))
            chosen[..., t] = (probability.cumsum(-1) < draw).sum(-1).clip(max=actions - 1)
            states[..., t + 1] = settings.mdps[0].afterstate[chosen[..., t], states[..., t]]
        found.append(IndexedDemonstrations(tuple(map(tuple, states)), tuple(map(tuple, chosen))))
    return found


class MapQuality(NamedTuple):
    """How R rewards do in M maps each, all [R].

    ``quality`` is the mean quality of the cells that the maximum-entropy policy of the reward
    visits, ``optimal_quality`` of those that its optimal policy visits; 0.5 is chance.
    ``value_difference`` is the true return of the expert minus that of the maximum-entropy policy.
    """

    quality: np.ndarray
    optimal_quality: np.ndarray
    value_difference: np.ndarray


def judge(
    settings: StackedMDPs, maps: Maps, reward: np.ndarray, value: float, horizon: int
) -> MapQuality:
    """Plan on ``reward`` [R, T] in ``maps`` [R, M, S] and visit.

    Args:
        value: of a good cell in the true reward, per step.
    """
    seen = np.take_along_axis(reward[:, None], maps.kinds, axis=2)
    own = solve(settings, seen, horizon).occupancy
    expert = solve(settings, value * maps.quality, horizon).occupancy
    policy, _ = backward(settings, seen, horizon)
    best, _ = forward(settings, policy)
    quality, best_quality, expert_quality = (
        (occupancy * maps.quality).sum(-1).mean(-1) / (horizon + 1)
        for occupancy in (own, best, expert)
    )
    difference = value * (horizon + 1) * (expert_quality - quality)
    return MapQuality(quality, best_quality, difference)
