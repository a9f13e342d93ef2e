"""How learned rewards depend on a cue, and on the texture that is equally good everywhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from irlcli.data.descriptions import CueContrast
from irlcli.envs.cue import HINTS, TEXTURE
from irlcli.report.agents import title
from irlcli.report.parameters import Parameters
from irlcli.report.statistics import summarise
from irlcli.report.tables import Table
from irlcli.report.text import number
from irlcli.trajectories import Transitions

CueContrasts = Mapping[tuple[str, str, int | None], CueContrast]

_NOTE = (
    "How the frozen reward depends on each hint alone: the difference between g with the hint at 1 and "
    "g with the hint at -1, everything else as recorded, mean over the demonstrated steps, in standard deviations of g on the "
    "training data; mean over the settings trained in, then over seeds with its 95 % bootstrap interval. "
    f"The texture is right in {TEXTURE:.0%} of the steps of every setting, the cue in a share that differs. "
    "sd of g: that deviation, mean over seeds (least to largest). If it is near zero, g hardly distinguishes the "
    "policy from the expert, and the other columns are noise."
)


def hint_contrasts(
    score: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray], steps: Transitions
) -> dict[str, float]:
    """How ``score`` depends on each hint: its mean difference over ``steps``, hint at 1 and at -1.

    ``score`` gives rewards [B] of observations [B, D], actions and next observations [B, D].
    """
    found = {}
    for name, column in zip(HINTS, range(-len(HINTS), 0), strict=True):
        scores = []
        for sign in (1.0, -1.0):
            observations = steps.observations.copy()
            observations[:, column] = sign
            scores.append(score(observations, steps.actions, steps.next_observations))
        found[name] = float(np.mean(scores[0] - scores[1]))
    return found


def cue_contrasts(p: Parameters, contrasts: CueContrasts) -> pd.DataFrame:
    """A row per row, method and seed: how its reward depends on ``cue`` and ``texture``, its ``scale``.

    Means over the settings trained in. The scale is the standard deviation of g.
    """
    found = [
        {
            "row": row.name,
            "agent": method,
            "seed": seed,
            **{name: np.mean([getattr(s, name) for s in contrast.settings]) for name in HINTS},
            "scale": contrast.scale,
        }
        for row in p.rows
        for method in p.methods
        for seed in p.seeds
        if (contrast := contrasts.get((row.name, method, seed))) is not None
    ]
    return pd.DataFrame(found, columns=["row", "agent", "seed", *HINTS, "scale"])


def cue_table(found: pd.DataFrame) -> Table:
    """A line per row and method."""
    lines = [
        [
            row,
            title(method),
            str(len(seeds)),
            *(_interval(seeds[name]) for name in reversed(HINTS)),
            _range(seeds["scale"]),
        ]
        for (row, method), seeds in found.groupby(["row", "agent"], sort=False)
    ]
    columns = ["row", "method", "seeds", *reversed(HINTS), "sd of g"]
    return Table("How the reward depends on the cue", _NOTE, columns, lines, heads=2)


def _interval(values: pd.Series) -> str:
    """The mean, and its interval if there are several seeds."""
    s = summarise(values.tolist())
    text = number(s.mean, 2)
    return text if s.interval is None else f"{text} [{s.interval[0]:.2f}, {s.interval[1]:.2f}]"


def _range(values: pd.Series) -> str:
    """The mean, and the least and the largest if there are several seeds."""
    text = number(values.mean(), 2)
    return text if len(values) == 1 else f"{text} ({values.min():.2f} to {values.max():.2f})"
