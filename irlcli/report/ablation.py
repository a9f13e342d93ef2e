"""Variants of the config side by side: which part of reward learning makes a reward retrainable.

Points are those of :mod:`irlcli.report.compute`; the variants stand where methods stand elsewhere.
"""

from __future__ import annotations

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from irlcli.report.agents import title
from irlcli.report.compute import points_of, whole_seeds
from irlcli.report.drawing import offsets, panels
from irlcli.report.parameters import Parameters, Row
from irlcli.report.statistics import holm, paired_p, summarise
from irlcli.report.tables import Table
from irlcli.report.text import number, p_value, percent

# Shares of the expert's return that a retrained policy is asked to reach.
GATES = (0.8, 0.9)
_RETRAINED, _STUDENT = "transfer-id", "id"
_COLOUR = "#0072B2"
_NOTE = (
    "{method}. True return in the settings trained on, as a share of that setting's own expert: mean ± standard "
    "deviation over seeds of the reward learning, then each seed. Retrained: policies trained from "
    "scratch on the frozen reward; all settings: their mean, of seeds that have all of them. Reached: "
    "seeds whose policies reach this share in every setting. Student: the policy trained while the reward was learned. Progress: the retrained policies' share of the "
    "experts' progress. Difference: of the retrained policies' shares to those of {base}, in "
    "percentage points, over the seeds that both have (their number in brackets). p: paired t-test on "
    "these seeds, two-sided; Holm: adjusted over the variants that have a p-value."
)


def _passed(gate: float) -> str:
    """The column with the number of seeds that reach ``gate`` in every setting."""
    return f"passed_{100 * gate:.0f}"


def shares(p: Parameters, points: pd.DataFrame) -> pd.DataFrame:
    """What policies earn of their setting's expert, a row per row, variant, measure, setting, seed.

    Columns: ``row``, ``agent``, ``measure`` (``transfer-id`` or ``id``), ``setting``, ``seed``;
    ``share`` of the expert's true return and ``progress_share`` of its progress, each the mean of
    its retrainings, missing unless the expert's is positive. A seed that lacks a retraining in a
    setting has no row there.
    """
    own = points[(points["agent"] == "expert") & (points["measure"] == "id")]
    columns = ["true_return", "progress"]
    experts = own.set_index(["row", "setting"])[columns].astype(float)
    whole = whole_seeds(p, points)
    measured = whole[whole["agent"].isin(p.methods) & whole["measure"].isin((_RETRAINED, _STUDENT))]
    keys = ["row", "agent", "measure", "setting", "seed"]
    earned = measured.astype({"seed": int, "true_return": float, "progress": float})
    means = earned.groupby(keys, sort=False)[columns].mean().reset_index()
    positive = experts.where(experts > 0).add_suffix("_expert")
    both = means.join(positive, on=["row", "setting"])
    return both[keys].assign(
        share=both["true_return"] / both["true_return_expert"],
        progress_share=both["progress"] / both["progress_expert"],
    )


def summarise_variants(p: Parameters, found: pd.DataFrame) -> pd.DataFrame:
    """The variants' retrained policies and students, a row per row and variant.

    Columns: ``row``, ``agent``, ``overrides``; ``seeds`` retrained in all training settings,
    ``mean`` and ``deviation`` (n - 1) over them of the mean share over settings, ``progress``, that
    of the progress; ``passed_80`` and ``passed_90``, the seeds that reach a gate in every setting;
    ``student``, the mean share of the students; ``difference`` to the first variant over the ``pairs`` seeds that
    both have, its ``p_paired`` and ``p_paired_holm`` over the row's variants.

    Args:
        found: see :func:`shares`.
    """
    rows = []
    for row in p.rows:
        retrained = {v.name: over_settings(found, row, v.name, _RETRAINED) for v in p.variants}
        base = retrained[p.variants[0].name]
        lines = []
        for variant in p.variants:
            values = retrained[variant.name]
            least = _by_setting(found, row, variant.name, _RETRAINED, "share").min(axis=1)
            s = summarise(values.tolist())
            common = values.index.intersection(base.index)
            compared = variant != p.variants[0] and len(common) > 0
            student = over_settings(found, row, variant.name, _STUDENT)
            progress = over_settings(found, row, variant.name, _RETRAINED, "progress_share")
            lines.append(
                {
                    "row": row.name,
                    "agent": variant.name,
                    "overrides": " ".join(variant.overrides),
                    "seeds": s.n,
                    "mean": s.mean,
                    "deviation": s.deviation,
                    **{_passed(gate): int((least >= gate).sum()) for gate in GATES},
                    "progress": progress.mean(),
                    "student": student.mean(),
                    "difference": (values[common] - base[common]).mean() if compared else None,
                    "pairs": len(common) if compared else 0,
                    "p_paired": paired_p(values[common].tolist(), base[common].tolist())
                    if compared
                    else None,
                }
            )
        adjusted = holm([line["p_paired"] for line in lines])
        for line, value in zip(lines, adjusted, strict=True):
            rows.append({**line, "p_paired_holm": value})
    return pd.DataFrame(rows)


def over_settings(
    found: pd.DataFrame, row: Row, variant: str, measure: str, column: str = "share"
) -> pd.Series:
    """The mean share over ``row``'s training settings by seed, of seeds that have all of them."""
    return _by_setting(found, row, variant, measure, column).mean(axis=1)


def _by_setting(
    found: pd.DataFrame, row: Row, variant: str, measure: str, column: str
) -> pd.DataFrame:
    """The shares by seed and training setting, of seeds that have all settings."""
    chosen = points_of(found, row.name, variant, measure)
    by_seed = chosen.pivot(index="seed", columns="setting", values=column)
    return by_seed.reindex(columns=list(row.trained)).dropna()


def tables(p: Parameters, found: pd.DataFrame, summary: pd.DataFrame) -> list[Table]:
    """A table per row with a line per variant."""
    note = _NOTE.format(base=p.variants[0].name, method=title(p.learned_by))
    result = []
    for row in p.rows:
        lines = [
            [
                r.agent,
                r.overrides or "as in settings/",
                *(_setting(found, row, r.agent, setting) for setting in row.trained),
                _by_seed(over_settings(found, row, r.agent, _RETRAINED)),
                ", ".join(f"{getattr(r, _passed(gate))}/{r.seeds}" for gate in GATES)
                if r.seeds
                else "-",
                percent(r.progress),
                _by_seed(over_settings(found, row, r.agent, _STUDENT)),
                f"{100 * r.difference:+.1f} ({r.pairs})" if r.pairs else "-",
                p_value(r.p_paired),
                p_value(r.p_paired_holm),
            ]
            for r in summary[summary["row"] == row.name].itertuples()
        ]
        columns = ["variant", "changes", *row.trained, "all settings"]
        columns += [" and ".join(f"{100 * gate:.0f} %" for gate in GATES) + " reached"]
        columns += ["progress", "student", "difference", "p", "Holm"]
        result.append(Table(f"Retrained in distribution: {row.name}", note, columns, lines, 2))
        note = ""
    return result


def _setting(found: pd.DataFrame, row: Row, variant: str, setting: str) -> str:
    chosen = points_of(found, row.name, variant, _RETRAINED)
    chosen = chosen[chosen["setting"] == setting]
    return _by_seed(chosen.set_index("seed")["share"].sort_index().dropna())


def _by_seed(values: pd.Series) -> str:
    """``93 % ± 4 (89, 93, 97)``: mean, deviation, and each seed in order, in per cent."""
    s = summarise((100 * values).tolist())
    if s.mean is None:
        return "-"
    deviation = "" if s.deviation is None else f" ± {number(s.deviation, 0)}"
    seeds = ", ".join(f"{value:.0f}" for value in 100 * values)
    return f"{s.mean:.0f} %{deviation} ({seeds})"


def without_effect(p: Parameters) -> list[str]:
    """Variants whose evaluations are all those of another: their overrides change nothing here."""
    result = []
    for row in p.rows:
        runs: dict[frozenset[tuple[str, str, int | None]], list[str]] = {}
        for variant in p.variants:
            cells = p.cells_of(row.name, variant.name)
            if cells and all(c.run for c in cells):
                runs.setdefault(frozenset((c.run, c.setting, c.seed) for c in cells), []).append(
                    variant.name
                )
        result += [
            f"Same runs: {row.name}: {', '.join(names)} share every run: their overrides make no "
            "difference under these settings."
            for names in runs.values()
            if len(names) > 1
        ]
    return result


def figure(p: Parameters, found: pd.DataFrame) -> Figure:
    """A panel per row: each seed's retrained policies and student, by variant, and the gates."""
    size = (0.8 + max(4.0, 0.9 * len(p.variants)) * len(p.rows), 3.8)
    drawn, axes = panels(1, len(p.rows), size)
    for axis, row in zip(axes[0], p.rows, strict=True):
        _panel(axis, p, row, found)
    axes[0, 0].set_ylabel("true return, % of the setting's expert")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return drawn


def _panel(axis: Axes, p: Parameters, row: Row, found: pd.DataFrame) -> None:
    ink = matplotlib.rcParams["text.color"]
    for gate, line in zip(GATES, ("--", ":"), strict=True):
        axis.axhline(100 * gate, color=ink, lw=0.9, ls=line, alpha=0.7, label=f"{gate:.0%}")
    retrained = {"color": _COLOUR, "mew": 0}
    student = {"color": ink, "mfc": "none", "alpha": 0.6}
    for x, variant in enumerate(p.variants):
        for measure, shift, form, label in (
            (_RETRAINED, -0.12, retrained, "retrained, mean over settings"),
            (_STUDENT, 0.24, student, "student, mean over settings"),
        ):
            values = 100 * over_settings(found, row, variant.name, measure).to_numpy()
            n = len(values)
            axis.plot(
                x + shift + offsets(n, 0.1),
                values,
                "o",
                ms=4.5,
                label=label if x == 0 else None,
                **form,
            )
            if measure == _RETRAINED and n:
                axis.plot([x - 0.3, x + 0.06], [values.mean()] * 2, color=_COLOUR, lw=2)
    names = [v.name.replace(" ", "\n", 1) for v in p.variants]
    axis.set_xticks(range(len(names)), names, size=7.5)
    axis.set_xlim(-0.6, len(names) - 0.4)
    axis.set_title(row.name)
    axis.grid(axis="y", alpha=0.25)
