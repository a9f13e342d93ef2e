"""IRM minus ERM in published reports, from their ``seeds.csv``: interval and detectable difference.

For reports that were written before these columns existed. Also the share of each training setting's
expert that the students earn in the mean over seeds, what the training experts earn in each other's
settings, and the mean over all methods, seed by seed, of what retraining earns above the student
(t-test). In the rows of the paper's Table 1, the paper's difference beside ours. Run with
``python -m benchmarks.intervals docs/results/table1-bounce docs/results/table1-engine-power``.
With ``--pool`` the reports are one: each has other seeds of the same rows, measured with the same
experts, and learned from the same demonstrations. Older reports do not hold the latter, so it is
checked only among the others.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from scipy import stats

from irlcli.methods import METHODS
from irlcli.report.paper import SEEDS, TABLE1
from irlcli.report.parameters import EXPERT_BY_REWARD
from irlcli.report.statistics import compare, paired_p


def main(reports: list[Path], pool: bool) -> None:
    """Print a line for each row and measure, and one for retraining."""
    tables = {report.name: pd.read_csv(report / "seeds.csv") for report in reports}
    if pool:
        tables = {" + ".join(tables): pooled([*tables.values()])}
    for name, seeds in tables.items():
        learned = seeds[seeds["agent"].isin([*METHODS]) & (seeds["measure"] != EXPERT_BY_REWARD)]
        for (row, measure), points in learned.groupby(["row", "measure"], sort=False):
            by_seed = points.groupby(["agent", "seed"])["true_return"].mean()
            if {"irm", "erm"} <= {*by_seed.index.get_level_values("agent")}:
                found = compare(by_seed["irm"].tolist(), by_seed["erm"].tolist())
                if found.interval is not None:
                    low, high = found.interval
                    means = ", ".join(
                        f"{method.upper()} {by_seed[method].mean():.1f} ± {by_seed[method].std():.1f} "
                        f"({len(by_seed[method])} seeds)"
                        for method in ("erm", "irm")
                    )
                    print(
                        f"{name}: {row}, {measure}: {means}, IRM - ERM {found.difference:.1f} "
                        f"[{low:.1f}, {high:.1f}], detectable {found.detectable:.1f}, p {found.welch:.3f}"
                    )
                    if measure == "transfer":
                        _print_paper(name, row, by_seed)
        _print_imitation(name, seeds)
        _print_reused(name, seeds)
        for row, points in learned.groupby("row", sort=False):
            means = points.pivot_table("true_return", ["agent", "seed"], "measure")
            if {"transfer", "zero-shot"} <= {*means}:
                both = means[["transfer", "zero-shot"]].dropna().groupby("seed").mean()
                p = paired_p(both["transfer"].tolist(), both["zero-shot"].tolist())
                gain = (both["transfer"] - both["zero-shot"]).mean()
                shown = "-" if p is None else f"{p:.3f}"
                print(f"{name}: {row}, all methods: transfer - zero-shot {gain:.1f}, p {shown}")


def pooled(tables: list[pd.DataFrame]) -> pd.DataFrame:
    """The tables of several reports as one, with the first report's agents that learn nothing.

    Raises:
        ValueError: two tables have the same seed of a method, other rows, other evaluations of an
            expert, or seeds that learned from other demonstrations.
    """
    rows = {tuple(table["row"].unique()) for table in tables}
    if len(rows) > 1:
        raise ValueError(f"the reports have different rows: {sorted(rows)}")
    everything = pd.concat(tables, ignore_index=True)
    of_methods = everything["agent"].isin([*METHODS])
    learned, others = everything[of_methods], everything[~of_methods]
    again = learned.duplicated(["row", "agent", "measure", "seed", "retraining", "setting"])
    if again.any():
        first = learned[again].iloc[0]
        raise ValueError(f"two reports have seed {first['seed']:g} of {first['agent']}")
    experts = others[others["agent"] == "expert"]
    if (experts.groupby(["row", "measure", "setting"])["evaluation"].nunique() > 1).any():
        raise ValueError("the reports have different experts, so their seeds do not compare")
    if "demonstrations" in learned:
        for (row, agent), sets in learned.groupby(["row", "agent"])["demonstrations"]:
            if sets.nunique() > 1:
                listed = ", ".join(sets.dropna().unique())
                raise ValueError(
                    f"{agent} of {row} learned from different demonstrations: {listed}"
                )
    place = ["row", "agent", "measure", "expert_of", "setting"]
    return pd.concat([others.drop_duplicates(place), learned], ignore_index=True)


def contrast(
    groups: Sequence[tuple[float, float, float, int]],
) -> tuple[float, float, float, float]:
    """A signed sum of independent means, its 95 % interval and its two-sided p (Welch-Satterthwaite).

    ``groups`` are sign, mean, standard deviation and n; n is 2 or more.
    """
    value = sum(sign * mean for sign, mean, _, _ in groups)
    variances = [(deviation**2 / n, n) for _, _, deviation, n in groups]
    total = sum(v for v, _ in variances)
    freedom = total**2 / sum(v**2 / (n - 1) for v, n in variances)
    half = float(stats.t.isf(0.025, freedom)) * total**0.5
    p = 2.0 * float(stats.t.sf(abs(value) / total**0.5, freedom))
    return value, value - half, value + half, p


def _print_paper(name: str, row: str, by_seed: pd.Series) -> None:
    env, knob = row.split()
    printed = TABLE1.get((env, knob))
    if printed is None:
        return
    theirs = [(1, *printed.irm, SEEDS), (-1, *printed.erm, SEEDS)]
    ours = [
        (sign, by_seed[method].mean(), by_seed[method].std(), len(by_seed[method]))
        for sign, method in ((-1, "irm"), (1, "erm"))
    ]
    gap, low, high, _ = contrast(theirs)
    more, least, most, p = contrast([*theirs, *ours])
    print(
        f"{name}: {row}, the paper's IRM - ERM {gap:.1f} [{low:.1f}, {high:.1f}], above ours by "
        f"{more:.1f} [{least:.1f}, {most:.1f}], p {p:.3f}"
    )


def _print_imitation(name: str, seeds: pd.DataFrame) -> None:
    means = (
        seeds[seeds["measure"] == "id"].groupby(["row", "agent", "setting"])["true_return"].mean()
    )
    for (row, agent), earned in means.groupby(level=["row", "agent"], sort=False):
        if agent not in METHODS or (row, "expert") not in means:
            continue
        shares = (earned.droplevel(["row", "agent"]) / means[row, "expert"]).items()
        shown = ", ".join(f"{setting} {share:.1%}" for setting, share in shares)
        print(f"{name}: {row}, {agent}: student's share of the expert: {shown}")


def _print_reused(name: str, seeds: pd.DataFrame) -> None:
    """The baseline as reports have it from stage 35 on; it used to hold each expert's own setting."""
    inside = seeds[seeds["measure"] == "id"]
    experts = inside[inside["agent"] == "expert"].set_index(["row", "setting"])["true_return"]
    # Version 0.1 called them carried over.
    reused = inside[inside["agent"].isin(["reused", "carried"])]
    others = reused[reused["expert_of"] != reused["setting"]]
    for row, of in others.groupby("row", sort=False):
        earned = of.groupby("setting")["true_return"].mean()
        share = (earned / experts[row]).mean()
        print(
            f"{name}: {row}, training experts in each other's settings: {earned.mean():.1f} "
            f"({share:.1%})"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", nargs="+", type=Path, help="directory with a seeds.csv")
    parser.add_argument("--pool", action="store_true", help="the reports have other seeds each")
    arguments = parser.parse_args()
    try:
        main(arguments.report, arguments.pool)
    except (ValueError, OSError) as error:
        parser.error(str(error))
