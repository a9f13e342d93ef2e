"""How lambda was chosen: by the students' true returns in the settings left out."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from irlcli.data.descriptions import PenaltyChoice
from irlcli.labels import weight_text
from irlcli.report.agents import title
from irlcli.report.parameters import Parameters
from irlcli.report.tables import Table
from irlcli.report.text import number

Choices = Mapping[tuple[str, str, int], PenaltyChoice]

_NOTE = (
    "For each lambda and each training setting, a reward was learned in the other settings. Its student's "
    "mean true return in the setting left out is the score; the lambda with the best mean is chosen, of "
    "equal ones the smallest. No held-out setting is used."
)


def choices(p: Parameters, found: Choices) -> pd.DataFrame:
    """A row per row, method, seed, lambda (``penalty_weight``) and setting left out.

    ``true_return`` is the student's there; ``chosen`` whether that lambda was chosen.
    """
    rows = [
        {
            "row": row.name,
            "agent": method,
            "seed": seed,
            "penalty_weight": weight,
            "left_out": setting,
            "true_return": scores[setting],
            "chosen": weight == choice.chosen,
        }
        for row in p.rows
        for method in p.methods
        for seed in p.seeds
        if (choice := found.get((row.name, method, seed))) is not None
        for weight, scores in zip(choice.weights, choice.scores, strict=True)
        for setting in row.trained
        if setting in scores
    ]
    names = ("row", "agent", "seed", "penalty_weight", "left_out", "true_return", "chosen")
    return pd.DataFrame(rows, columns=list(names))


def choice_table(found: pd.DataFrame) -> Table:
    """A line per row, method, seed and lambda."""
    lines = [
        [
            row,
            title(method),
            str(seed),
            weight_text(weight),
            number(scores["true_return"].mean()),
            ", ".join(f"{s.left_out}: {s.true_return:.1f}" for s in scores.itertuples()),
            "chosen" if scores["chosen"].any() else "",
        ]
        for (row, method, seed, weight), scores in found.groupby(
            ["row", "agent", "seed", "penalty_weight"], sort=False
        )
    ]
    columns = ["row", "method", "seed", "lambda", "mean", "in the setting left out", ""]
    return Table("Choice of lambda", _NOTE, columns, lines, heads=2)
