"""MaxEnt IRL on cued maps: rewards of many methods and maps side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from irlcli.configs.exact import CuedMapsConfig
from irlcli.controls.cued_maps import (
    MapQuality,
    Maps,
    demonstrate,
    draw,
    features,
    judge,
    torus,
)
from irlcli.controls.methods import MapMethod
from irlcli.learners.maxent import MaxEnt, Risks, group_risks
from irlcli.learners.occupancy import IndexedDemonstrations
from irlcli.learners.soft_values import solve


class Dataset(NamedTuple):
    """What S runs learn from: maps of E settings with C colours, and demonstrations in them."""

    maps: Maps
    demos: list[IndexedDemonstrations]
    colours: int


def dataset(config: CuedMapsConfig, strengths: np.ndarray, seeds: Sequence[int]) -> Dataset:
    """Maps whose colours have ``strengths`` [S, E, C], and episodes of soft-optimal experts."""
    maps = draw(seeds, config.size, config.texture, strengths, purpose=0)
    settings = torus(config.size, strengths.shape[1])
    reward = config.value * maps.quality
    demos = demonstrate(settings, reward, config.horizon, config.episodes, seeds)
    return Dataset(maps, demos, strengths.shape[2])


def without(data: Dataset, left_out: int) -> Dataset:
    """``data`` without one of its settings."""
    kept = [e for e in range(data.maps.kinds.shape[1]) if e != left_out]
    demos = [
        IndexedDemonstrations(tuple(d.states[e] for e in kept), tuple(d.actions[e] for e in kept))
        for d in data.demos
    ]
    maps = Maps(data.maps.quality[:, kept], data.maps.kinds[:, kept])
    return Dataset(maps, demos, data.colours)


class Fitted(NamedTuple):
    """The rewards [V, S, T] of V methods, and their records, [V, S] each.

    ``log_likelihood`` is the mean over the settings trained on [nats per episode].
    ``penalty_before`` is the penalty after ``warmup`` iterations, also of a method without a
    warm-up, and ``penalty`` the last one.
    """

    reward: np.ndarray
    log_likelihood: np.ndarray
    penalty_before: np.ndarray
    penalty: np.ndarray


def fit(
    config: CuedMapsConfig,
    data: Dataset,
    methods: Sequence[MapMethod],
    hidden: int,
    seeds: Sequence[int],
) -> Fitted:
    """Fit every method to every run's data; those that share a learner side by side.

    ``hidden`` is the width of the learned reward, in place of ``config.hidden``; 0 for a linear one.
    """
    settings = torus(config.size, data.maps.kinds.shape[1])
    risks: dict[tuple[str, int], Risks] = {}
    for grouping in {m.grouping for m in methods}:
        for r, (demos, seed) in enumerate(zip(data.demos, seeds, strict=True)):
            risks[grouping, r] = group_risks(settings, demos, grouping, config.horizon, seed)
    inputs = features(data.colours)
    results: dict[MapMethod, tuple[np.ndarray, ...]] = {}
    shared = dict.fromkeys((m.penalty, m.warm, m.sees) for m in methods)
    for penalty, warm, sees in shared:
        chosen = [m for m in methods if (m.penalty, m.warm, m.sees) == (penalty, warm, sees)]
        runs = [(m, r) for m in chosen for r in range(len(seeds))]
        learner = MaxEnt(
            settings,
            inputs * (np.arange(inputs.shape[1]) == 0) if sees == "texture" else inputs,
            [risks[m.grouping, r] for m, r in runs],
            np.array([m.penalty_weight for m, _ in runs]),
            np.array([m.l2 for m, _ in runs]),
            [seeds[r] for _, r in runs],
            penalty=penalty,
            horizon=config.horizon,
            hidden=hidden,
            learning_rate=config.learning_rate,
            kinds=np.stack([data.maps.kinds[r] for _, r in runs]),
            penalty_warmup=config.warmup if warm else 0,
        )
        reward = learner.fit(config.iterations, record_every=config.warmup)
        before, last = learner.records[1], learner.records[-1]
        found = (reward, last.log_likelihood.mean(-1), before.penalty, last.penalty)
        parts = zip(*(np.split(array, len(chosen)) for array in found), strict=True)
        results |= dict(zip(chosen, parts, strict=True))
    return Fitted(*map(np.stack, zip(*(results[m] for m in methods), strict=True)))


def unseen(
    config: CuedMapsConfig, fitted: Fitted, seeds: Sequence[int], colours: int
) -> MapQuality:
    """How the rewards do in maps of the unseen setting; each field [V, S]."""
    strengths = np.full((len(seeds), config.unseen_maps, colours), config.unseen)
    maps = draw(seeds, config.size, config.texture, strengths, purpose=1)
    settings = torus(config.size, config.unseen_maps)
    each = [judge(settings, maps, r, config.value, config.horizon) for r in fitted.reward]
    return MapQuality(*map(np.stack, zip(*each, strict=True)))


def held_out_risk(
    config: CuedMapsConfig, data: Dataset, setting: int, fitted: Fitted
) -> np.ndarray:
    """Negative log-likelihood of one setting's demonstrations [V, S], in nats per episode.

    As in the risk that is minimised, the first states are in expectation, not those of the
    demonstrations.
    """
    settings = torus(config.size, 1)
    kinds = data.maps.kinds[:, setting]
    visits = np.stack([d.states[setting] for d in data.demos])
    seen = np.take_along_axis(kinds, visits.reshape(len(kinds), -1), axis=1)
    found = []
    for reward in fitted.reward:
        partition = solve(settings, np.take_along_axis(reward, kinds, 1)[:, None], config.horizon)
        path = np.take_along_axis(reward, seen, 1).sum(1) / visits.shape[1]
        found.append(partition.log_partition[:, 0] - path)
    return np.stack(found)
