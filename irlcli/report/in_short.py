"""What came out, one line per row of a table: the first thing to read in a report."""

from __future__ import annotations

from typing import Any

import pandas as pd

from irlcli.report.agents import BASELINES, MEASURES, own_measure, title
from irlcli.report.parameters import Parameters
from irlcli.report.statistics import LEVEL
from irlcli.report.text import incomplete, number, p_value


def in_short(p: Parameters, cells: pd.DataFrame, comparisons: pd.DataFrame) -> list[str]:
    """The first measure of each row: the true returns, and whether the first pair of methods differs.

    None for an ablation, whose first table compares its variants.
    """
    if p.variants:
        return []
    measure = p.measures[0]
    lines = []
    for row in p.rows:
        found = cells[cells["row"] == row.name]
        means = {
            r.agent: f"{title(r.agent)} {number(r.mean)}{incomplete(r)}"
            for r in found[found["mean"].notna()].itertuples()
            if r.measure == own_measure(r.agent, measure)
        }
        tested = comparisons[(comparisons["row"] == row.name) & (comparisons["measure"] == measure)]
        first = next(tested[tested["difference"].notna()].itertuples(), None)
        methods = p.methods if first is None else (first.y, first.x)
        shown = [means[agent] for agent in (*methods, *BASELINES) if agent in means]
        if not any(method in means for method in methods):
            continue
        verdict = "" if first is None else f" {_verdict(first)}"
        where = ", ".join(text.partition("=")[2] for text in row.settings_of(measure))
        what = MEASURES[measure].partition(":")[0].lower()
        lines.append(f"{row.name} = {where}, {what}, true return: {'; '.join(shown)}.{verdict}")
    return lines


def _verdict(test: Any) -> str:
    """Whether the pair of methods of ``test`` differs, and what difference would have been found."""
    x, y = title(test.x), title(test.y)
    if test.not_imitated:
        failed = " and ".join(map(title, test.not_imitated.split()))
        return f"{failed} did not imitate in distribution: do not interpret the gap."
    if pd.isna(test.p_welch):
        return f"Do not compare {x} with {y}: {test.why}."
    claim = f"{x} and {y} do not differ significantly"
    if test.p_welch_holm < LEVEL:
        more = "more" if test.difference > 0 else "less"
        claim = f"{x} earns significantly {more} than {y}"
    p, holm = p_value(test.p_welch), p_value(test.p_welch_holm)
    # Where other rows make it larger.
    adjusted = f", adjusted by Holm {holm}" if holm != p else ""
    return (
        f"{claim}: {test.difference:+z.1f} (95 % interval {test.low:z.1f} to {test.high:z.1f}, "
        f"p {p}{adjusted}). {'Without adjustment, a' if adjusted else 'A'} difference of "
        f"{test.detectable:.1f} would be found with a power of 80 %."
    )
