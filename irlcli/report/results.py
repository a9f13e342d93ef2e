"""What evaluations say: a number per cell, comparisons over seeds, and every reservation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import pandas as pd

from irlcli.report import paper
from irlcli.report.statistics import compare, holm, identical_runs, summarise

TITLES = {
    "erm": "AIRL-ERM",
    "irm": "AIRL-IRM",
    "erm-balanced": "ERM-balanced",
    "irm-shuffled": "IRM, labels shuffled",
    "expert": "expert",
    "carried": "experts, carried over",
    "random": "random",
    "idle": "idle",
}
MEASURES = {
    "transfer": "Transfer: a new policy on the frozen reward, in the unseen setting",
    "zero-shot": "Zero-shot: the student, in the unseen setting",
    "id": "In distribution: the student, mean over the settings trained in",
}
# What the unseen setting's expert earns of a learned reward, for each seed of a method.
EXPERT_PAID = "expert by reward"
BASELINES = ("expert", "carried", "random", "idle")
# The comparison the paper makes first, then those with the controls.
_PAIRS = (("irm", "erm"), ("irm", "erm-balanced"), ("irm", "irm-shuffled"))
IMITATED = 0.8
# Of a discriminator that is right this often, the gradient of the penalty is close to nothing.
SATURATED = 0.95


class Plan(Protocol):
    """What a report is about: ``stages.results.Parameters``."""

    kind: str
    title: str
    command: str
    measures: tuple[str, ...]
    rows: tuple[Any, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    cells: tuple[Any, ...]
    runs: dict[str, Any]
    libraries: dict[str, dict[str, str | None]]
    others: tuple[Any, ...]


class Table(NamedTuple):
    """Text in columns, the first ``heads`` of which name the row."""

    title: str
    note: str
    columns: list[str]
    rows: list[list[str]]
    heads: int = 1


@dataclass(frozen=True, eq=False)
class Report:
    """Everything that is said, before it is laid out.

    Attributes:
        points: a row per evaluation and setting: ``row``, ``agent``, ``measure``, ``seed``,
            ``expert_of`` (the setting that an expert was trained in), ``setting``, ``true_return``,
            ``progress``, ``learned_return``, ``episodes``, ``evaluation`` (its id).
        cells: a row per row, agent and measure.
        comparisons: a row per row, measure and pair of methods.
        paid: a row per row and method: what the frozen rewards pay the new policies (``policy``)
            and the setting's expert (``expert``), means over ``seeds``; ``short``: seeds in which
            the policy's true return is not within a fifth of the expert's, ``short_paid_more``:
            those of them in which it is nevertheless paid more.
        tables: the same for people.
        notes: what must be known before the numbers are believed.
    """

    points: pd.DataFrame
    cells: pd.DataFrame
    comparisons: pd.DataFrame
    paid: pd.DataFrame
    tables: list[Table]
    notes: list[str]


Episodes = Mapping[tuple[str, str], Mapping[tuple[str, int], np.ndarray]]
Learning = Mapping[tuple[str, str, int], pd.DataFrame]


def build(plan: Plan, points: pd.DataFrame, episodes: Episodes, learning: Learning) -> Report:
    """The report on ``points``: a row per evaluation and setting, as in :class:`Report`.

    Args:
        plan: what was wanted, and what is there.
        points: a row per evaluation and setting.
        episodes: the true returns by (row, measure), then (method, seed).
        learning: what ``train-airl`` recorded of each round and setting, by (row, method, seed).
    """
    ends = _ends(plan, learning)
    cells = _cells(plan, points)
    comparisons = _comparisons(plan, points, cells)
    paid = _paid(plan, points)
    notes = [
        *_missing(plan),
        *_not_imitated(cells),
        *_short(paid),
        *_saturated(ends),
        *_identical(episodes),
        *_without_p(comparisons),
        *_left_out(plan),
        *_mixed(plan),
    ]
    tables = [_main_table(plan, m, cells, comparisons) for m in plan.measures]
    tables += [
        _paid_table(paid),
        _comparison_table(comparisons),
        _discriminator_table(ends),
        _cell_table(cells),
    ]
    tables += [_budgets(plan), _costs(plan)]
    return Report(points, cells, comparisons, paid, [t for t in tables if t.rows], notes)


def sample(points: pd.DataFrame, row: str, agent: str, measure: str) -> pd.DataFrame:
    """``true_return`` and ``progress`` of each seed, means over settings."""
    chosen = points[
        (points["row"] == row) & (points["agent"] == agent) & (points["measure"] == measure)
    ]
    by_seed = chosen.groupby("seed", dropna=False, sort=True)
    return by_seed[["true_return", "progress"]].mean()


def imitates(student: float | None, expert: float | None) -> bool | None:
    """Whether a student comes within a fifth of its expert's true return; None if unknown.

    For a positive return that is the 80 % rule; a ratio of negative returns would say the reverse.
    """
    if student is None or expert is None:
        return None
    return student >= expert - (1 - IMITATED) * abs(expert)


def _failed(cell: Any) -> bool:
    return cell.imitated is not pd.NA and not cell.imitated


def _cells(plan: Plan, points: pd.DataFrame) -> pd.DataFrame:
    found = []
    for row in plan.rows:
        wanted = [(agent, "ood") for agent in BASELINES]
        if "id" in plan.measures:
            wanted += [("expert", "id"), ("carried", "id")]
        wanted += [(method, m) for m in plan.measures for method in plan.methods]
        for agent, measure in wanted:
            values = sample(points, row.name, agent, measure)
            s = summarise(values["true_return"].tolist())
            low, high = s.interval or (None, None)
            progress = values["progress"].mean() if len(values) else math.nan
            planned = [
                c for c in plan.cells if (c.row, c.agent, c.measure) == (row.name, agent, measure)
            ]
            found.append(
                {
                    "row": row.name,
                    "agent": agent,
                    "measure": measure,
                    "setting": ", ".join(row.trained) if measure == "id" else row.unseen,
                    "seeds": s.n,
                    "seeds_wanted": len(plan.seeds) if agent in plan.methods else 1,
                    "mean": s.mean,
                    "deviation": s.deviation,
                    "low": low,
                    "high": high,
                    "iqm": s.iqm,
                    "progress": None if math.isnan(progress) else float(progress),
                    "complete": all(c.run for c in planned),
                    "mixed": _is_mixed(_origins(plan, (c.run for c in planned if c.run))),
                }
            )
    table = pd.DataFrame(found)
    experts = table[(table["agent"] == "expert") & (table["measure"] == "id") & table["complete"]]
    experts = experts.set_index("row")["mean"].to_dict()
    of_expert, imitated = [], []
    for r in table.itertuples():
        expert, mean = experts.get(r.row), None if pd.isna(r.mean) else r.mean
        is_student = r.agent in plan.methods
        known = r.measure == "id" and expert is not None and mean is not None
        compared = known and (is_student or (r.agent == "carried" and r.complete))
        of_expert.append(mean / expert if compared and expert > 0 else None)
        imitated.append(imitates(mean, expert) if known and is_student else None)
    return table.assign(
        of_expert=pd.array(of_expert, "Float64"), imitated=pd.array(imitated, "boolean")
    )


def _comparisons(plan: Plan, points: pd.DataFrame, cells: pd.DataFrame) -> pd.DataFrame:
    students = cells[(cells["measure"] == "id") & cells["agent"].isin(plan.methods)]
    failed = {(r.row, r.agent) for r in students.itertuples() if _failed(r)}
    found = []
    for measure in plan.measures:
        for x, y in _PAIRS:
            if x not in plan.methods or y not in plan.methods:
                continue
            tested = [
                compare(
                    sample(points, row.name, x, measure)["true_return"].tolist(),
                    sample(points, row.name, y, measure)["true_return"].tolist(),
                )
                for row in plan.rows
            ]
            adjusted = holm([c.welch for c in tested])
            for row, c, p in zip(plan.rows, tested, adjusted, strict=True):
                found.append(
                    {
                        "row": row.name,
                        "measure": measure,
                        "x": x,
                        "y": y,
                        "difference": c.difference,
                        "p_welch": c.welch,
                        "p_welch_holm": p,
                        "p_student": c.student,
                        "improvement": c.improvement,
                        "not_imitated": " ".join(a for a in (x, y) if (row.name, a) in failed),
                        "why": c.why,
                    }
                )
    columns = ["row", "measure", "x", "y", "difference", "p_welch", "p_welch_holm", "p_student"]
    return pd.DataFrame(found, columns=[*columns, "improvement", "not_imitated", "why"])


def _ends(plan: Plan, learning: Learning) -> pd.DataFrame:
    """A row per row and method: the discriminator over the last tenth of the rounds.

    Means over settings and seeds; ``share`` is that of lambda times the penalty over that of the
    cross-entropy, None if that is zero.
    """
    names = ["accuracy", "cross_entropy", "penalty", "penalty_weight", "weighted", "mean_abs_logit"]
    found = []
    for row in plan.rows:
        for method in plan.methods:
            runs = [m for (r, a, _), m in learning.items() if (r, a) == (row.name, method)]
            if not runs:
                continue
            runs = [m.assign(weighted=m["penalty_weight"] * m["penalty"]) for m in runs]
            last = [m[m["round"] >= 0.9 * m["round"].max()][names].mean() for m in runs]
            means = pd.concat(last, axis=1).mean(axis=1)
            entropy = means["cross_entropy"]
            share = means["weighted"] / entropy if entropy > 0 else None
            values = {"row": row.name, "agent": method, "seeds": len(runs), "share": share}
            found.append(values | means.to_dict())
    return pd.DataFrame(found, columns=["row", "agent", "seeds", "share", *names])


def _paid(plan: Plan, points: pd.DataFrame) -> pd.DataFrame:
    columns = ["row", "agent", "seeds", "policy", "expert", "short", "short_paid_more"]
    found = []
    for row in plan.rows if "transfer" in plan.measures else ():
        for method in plan.methods:
            of = points[(points["row"] == row.name) & (points["agent"] == method)]
            of = of[of["learned_return"].notna()]
            policies, experts = (of[of["measure"] == m] for m in ("transfer", EXPERT_PAID))
            both = policies.merge(experts, on="seed", suffixes=("", "_expert"))
            if both.empty:
                continue
            returns = zip(both["true_return"], both["true_return_expert"], strict=True)
            short = np.array([not imitates(policy, expert) for policy, expert in returns])
            paid, offered = both["learned_return"], both["learned_return_expert"]
            means = float(paid.mean()), float(offered.mean())
            counts = int(short.sum()), int((short & (paid > offered)).sum())
            found.append((row.name, method, len(both), *means, *counts))
    return pd.DataFrame(found, columns=columns)


# Reservations


def _missing(plan: Plan) -> list[str]:
    """A note per row: what it waits for, and for whom."""
    notes = []
    for row in plan.rows:
        cells = [c for c in plan.cells if c.row == row.name]
        reasons: dict[str, dict[str, dict[str, None]]] = {}
        for c in cells:
            if not c.run:
                which = c.place if c.seed is None else f"{c.seed}"
                agent = TITLES[c.agent]
                if c.seed is not None and c.why.startswith("evaluate"):
                    # A run has several evaluations; any other stage stands for all of them.
                    agent += f" {c.measure}"
                reasons.setdefault(c.why, {}).setdefault(agent, {})[which] = None
        parts = [
            f"{why}: "
            + "; ".join(f"{agent} {', '.join(which)}".strip() for agent, which in agents.items())
            for why, agents in reasons.items()
        ]
        if parts:
            there = sum(1 for c in cells if c.run)
            notes.append(
                f"Missing: {row.name}: {there} of {len(cells)} evaluations are there. "
                f"{'. '.join(parts)}."
            )
    return notes


def _not_imitated(cells: pd.DataFrame) -> list[str]:
    notes = []
    for r in cells.itertuples():
        if _failed(r):
            share = "" if r.of_expert is pd.NA else f" ({r.of_expert:.1%} of the expert's return)"
            notes.append(
                f"Not imitated: {r.row}, {TITLES[r.agent]}: in distribution the student stays below "
                f"{IMITATED:.0%} of the expert{share}; a gap to another method is noise."
            )
    return notes


def _short(paid: pd.DataFrame) -> list[str]:
    """New policies that fall short of the expert, and whether their reward ranks them so too."""
    return [
        f"Short of the expert: {r.row}, {TITLES[r.agent]}: {r.short} of {r.seeds} new policies. The "
        f"learned reward pays {r.short_paid_more} of them more than it would pay the setting's expert, "
        f"{r.short - r.short_paid_more} less."
        for r in paid.itertuples()
        if r.short
    ]


def _saturated(ends: pd.DataFrame) -> list[str]:
    return [
        f"Saturated: {r.row}, {TITLES[r.agent]}: at the end of training the discriminator is right "
        f"about {r.accuracy:.1%} of the samples and lambda times the penalty is {_percent(r.share)} of "
        "the cross-entropy: there is little left for the penalty to change."
        for r in ends.itertuples()
        if r.penalty_weight > 0 and r.accuracy >= SATURATED
    ]


def _identical(episodes: Episodes) -> list[str]:
    """Runs that cannot be told apart: seeds that are no sample, or a method without effect."""
    groups: dict[tuple[str, tuple], list[str]] = {}
    for (row, measure), found in episodes.items():
        for runs in identical_runs(found):
            groups.setdefault((row, runs), []).append(measure)
    return [
        f"Identical: {row}, {', '.join(measures)}: {', '.join(f'{TITLES[a]} seed {s}' for a, s in runs)} "
        "have the same returns to the bit: between them neither seed nor method made a difference."
        for (row, runs), measures in groups.items()
    ]


def _without_p(comparisons: pd.DataFrame) -> list[str]:
    """A note per row and reason; the table of comparisons says which."""
    counts = comparisons[comparisons["why"] != ""].groupby(["row", "why"], sort=False).size()
    total = comparisons.groupby("row", sort=False).size()
    return [
        f"No p-value: {row}: {n} of {total[row]} comparisons: {why}."
        for (row, why), n in counts.items()
    ]


def _runs(count: int) -> str:
    return f"{count} run" if count == 1 else f"{count} runs"


def _left_out(plan: Plan) -> list[str]:
    return [
        f"Left out: {_runs(len(o.ids))} of {o.stage}, {o.about} ({', '.join(o.ids)}): {o.why}."
        for o in plan.others
    ]


def _mixed(plan: Plan) -> list[str]:
    notes = []
    for row in plan.rows:
        origins = _origins(plan, (c.run for c in plan.cells if c.row == row.name and c.run))
        if _is_mixed(origins):
            parts = [
                f"commit {_states(code)}, libraries {libraries}: {_runs(len(ids))}"
                for (code, libraries), ids in origins.items()
            ]
            notes.append(
                f"Mixed: {row.name}: its runs differ in the code or the libraries they were made "
                f"with: {'; '.join(parts)}."
            )
    return notes


def lineage(plan: Plan, ids: Iterable[str]) -> list[str]:
    """``ids`` and everything that they were made from, each once, depth first."""
    found: dict[str, None] = {}
    pending = list(ids)[::-1]
    while pending:
        id16 = pending.pop()
        if id16 in plan.runs and id16 not in found:
            found[id16] = None
            pending += reversed(plan.runs[id16].inputs)
    return list(found)


def _origins(plan: Plan, ids: Iterable[str]) -> dict[tuple, list[str]]:
    """Runs behind ``ids`` by (states of the code, libraries), the largest group first."""
    groups: dict[tuple, list[str]] = {}
    for id16 in lineage(plan, ids):
        run = plan.runs[id16]
        groups.setdefault((run.code, run.libraries), []).append(id16)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


def _is_mixed(origins: Mapping[tuple, Any]) -> bool:
    return len(origins) > 1 or any(len(code) > 1 for code, _ in origins)


# Tables for people


def _percent(share: Any) -> str:
    return "-" if share is None or pd.isna(share) else f"{share:.1%}"


def _number(value: Any, digits: int = 1) -> str:
    return "-" if value is None or pd.isna(value) else f"{value:.{digits}f}"


def p_text(value: Any) -> str:
    """A p-value to three digits, or ``-``."""
    return "-" if value is None or pd.isna(value) else "< .001" if value < 1e-3 else f"{value:.3f}"


def _cell_text(cell: Any) -> str:
    if pd.isna(cell.mean):
        return "-"
    text = f"{cell.mean:.1f}"
    if not pd.isna(cell.deviation):
        text += f" ± {cell.deviation:.1f}"
    if cell.seeds < cell.seeds_wanted:
        text += f" ({cell.seeds}/{cell.seeds_wanted})"
    elif not cell.complete:
        text += " (part)"
    if _failed(cell):
        text += " †"
    return text + (" ‡" if cell.mixed else "")


def _main_table(plan: Plan, measure: str, cells: pd.DataFrame, comparisons: pd.DataFrame) -> Table:
    """A line per row, one more for its progress, and one for the paper's numbers."""
    baseline = "id" if measure == "id" else "ood"
    agents = [*plan.methods, "expert", "carried"]
    agents += [] if measure == "id" else ["random", "idle"]
    first = comparisons[(comparisons["x"] == "irm") & (comparisons["y"] == "erm")]
    tested = {r.row: r for r in first[first["measure"] == measure].itertuples()}
    lines = []
    for row in plan.rows:
        own = {
            r.agent: r
            for r in cells[cells["row"] == row.name].itertuples()
            if r.measure == (baseline if r.agent in BASELINES else measure)
        }
        where = f"{row.name} = {', '.join(t.partition('=')[2] for t in row.trained)}"
        if measure != "id":
            where = f"{row.name} = {row.unseen.partition('=')[2]}"
        test = tested.get(row.name)
        p_values = ["-", "-"] if test is None else [p_text(test.p_welch), p_text(test.p_welch_holm)]
        lines.append([where, "return", *(_cell_text(own[a]) for a in agents), *p_values])
        if any(not pd.isna(own[a].progress) for a in agents):
            lines.append([where, "progress", *(_number(own[a].progress) for a in agents), "", ""])
        if measure == "id":
            ratios = {a: own[a].of_expert for a in agents if a != "expert"}
            shares = {a: "-" if r is pd.NA else f"{r:.0%}" for a, r in ratios.items()}
            texts = (shares.get(a, "") for a in agents)
            lines.append([where, "of the expert", *texts, "", ""])
        printed = paper.TABLE1.get((row.env, row.knob))
        if plan.kind == "table1" and measure == "transfer" and printed is not None:
            texts = {
                a: f"{v.mean} ± {v.deviation}"
                for a, v in (("erm", printed.erm), ("irm", printed.irm), ("expert", printed.expert))
            }
            welch = p_text(_printed_p(printed, welch=True))
            lines.append([where, "paper", *(texts.get(a, "") for a in agents), welch, ""])
    note = (
        "Mean true return ± standard deviation over seeds. p: Welch, AIRL-IRM against AIRL-ERM; "
        "Holm: over the rows that have a p-value. (3/5): seeds there are of those wanted. "
        "† not imitated in distribution. ‡ made on more than one commit or set of libraries. "
        "Experts, carried over: the policies of the experts trained in, each measured in every "
        "setting that the students are, their mean: what it earns to learn no reward. "
        "Progress: the part of the return that walking or reaching earned (an idle ant earns about "
        "600 for being alive)."
    )
    columns = ["setting", "", *(TITLES[a] for a in agents), "p", "Holm"]
    note = note if measure == plan.measures[0] else ""
    return Table(MEASURES[measure], note, columns, lines, heads=2)


def _printed_p(row: paper.Row, welch: bool) -> float:
    from scipy.stats import ttest_ind_from_stats

    n = paper.SEEDS
    test = ttest_ind_from_stats(*row.irm, n, *row.erm, n, equal_var=not welch)
    return float(test.pvalue)


def _paid_table(paid: pd.DataFrame) -> Table:
    lines = [
        [
            r.row,
            TITLES[r.agent],
            str(r.seeds),
            _number(r.policy),
            _number(r.expert),
            f"{r.short}/{r.seeds}",
            f"{r.short_paid_more}/{r.short}" if r.short else "",
        ]
        for r in paid.itertuples()
    ]
    note = (
        "The frozen reward of an episode, of the new policy trained on it and of the expert of the "
        "unseen setting; means over seeds, undiscounted, where the training discounts. Short: seeds "
        "in which the new policy's true return stays more than a fifth below the expert's. Paid "
        "more: those in which it is paid more nevertheless: the reward ranks a worse policy first. "
        "Where it is paid less, the training did not find what the reward offers; that does not show "
        "that the reward is right. One unit is the standard deviation of g on the training data; "
        "zero means nothing."
    )
    columns = ["row", "agent", "seeds", "new policy", "expert", "short", "paid more"]
    return Table("What the learned reward pays", note, columns, lines, heads=2)


def _comparison_table(comparisons: pd.DataFrame) -> Table:
    lines = []
    for r in comparisons[comparisons["difference"].notna()].itertuples():
        printed = paper.TABLE1.get(tuple(r.row.split(" ", 1)))
        shown = r.measure == "transfer" and (r.x, r.y) == ("irm", "erm") and printed is not None
        lines.append(
            [
                r.row,
                r.measure,
                f"{TITLES[r.x]} - {TITLES[r.y]}",
                _number(r.difference),
                p_text(r.p_welch),
                p_text(r.p_welch_holm),
                p_text(r.p_student),
                p_text(_printed_p(printed, welch=False)) if shown else "",
                _number(r.improvement, 2),
                r.why or ("not imitated: the gap is noise" if r.not_imitated else ""),
            ]
        )
    note = (
        "Two-sided. Welch's test is the primary one; Student's, with equal variances, is what the "
        "paper used (its value recomputed from its means and deviations, n = 5). P(better): "
        "probability that a seed of the first beats one of the second, ties by half."
    )
    columns = ["row", "measure", "difference of", "means", "Welch", "Welch, Holm", "Student"]
    return Table(
        "Comparisons", note, [*columns, "Student, paper", "P(better)", "remark"], lines, heads=3
    )


def _discriminator_table(ends: pd.DataFrame) -> Table:
    lines = [
        [
            r.row,
            TITLES[r.agent],
            str(r.seeds),
            f"{r.accuracy:.1%}",
            f"{r.cross_entropy:.3f}",
            f"{r.penalty:.4f}",
            _percent(r.share) if r.penalty_weight > 0 else "",
            _number(r.mean_abs_logit),
        ]
        for r in ends.itertuples()
    ]
    note = (
        "Over the last tenth of the rounds, means over settings and seeds. Share: lambda times the "
        "penalty, of the cross-entropy; the estimate of the penalty is unbiased and may be negative. "
        "Where --select kept an earlier round, these are still the last. Without a weight the "
        "penalty is only measured. A discriminator that is always right leaves it nothing to change."
    )
    columns = [
        "row",
        "agent",
        "seeds",
        "accuracy",
        "cross-entropy",
        "penalty",
        "share",
        "mean |logit|",
    ]
    return Table("The discriminator at the end", note, columns, lines, heads=2)


def _cell_table(cells: pd.DataFrame) -> Table:
    lines = [
        [
            r.row,
            TITLES[r.agent],
            r.measure,
            f"{r.seeds}/{r.seeds_wanted}",
            _number(r.mean),
            _number(r.deviation),
            "-" if pd.isna(r.low) else f"[{r.low:.1f}, {r.high:.1f}]",
            _number(r.iqm),
            _number(r.progress),
        ]
        for r in cells.itertuples()
    ]
    note = (
        "Interval: 95 % of the mean by the percentile bootstrap over seeds, too narrow with few. "
        "IQM: mean of the middle half of the seeds. The expert, the random and the idle agent are "
        "one policy each, the experts carried over one for each setting trained in."
    )
    columns = ["row", "agent", "measure", "seeds", "mean", "sd", "95 %", "IQM", "progress"]
    return Table("Every cell", note, columns, lines, heads=3)


def _budgets(plan: Plan) -> Table:
    lines = []
    for row in plan.rows:
        s = row.settings
        lines.append(
            [
                row.name,
                f"{s['expert']['total_steps']:,}",
                ", ".join(map(str, row.demonstrations)),
                f"{s['airl']['total_steps']:,}",
                ", ".join(f"{run}: {weight:g}" for run, weight in row.chosen.items())
                or f"{s['airl']['penalty_weight']:g}",
                s["airl"].get("select", "last"),
                f"{s['transfer']['total_steps']:,}" if "transfer" in plan.measures else "-",
                str(s["evaluation"]["episodes"]),
            ]
        )
    columns = ["row", "expert steps", "demonstrations", "AIRL steps", "lambda", "round"]
    note = (
        "Demonstrations: episodes of each setting trained in. Lambda: the weight of IRM's penalty, by "
        "method and seed where it was chosen by leaving a setting out. Round: the one kept."
    )
    return Table("Budgets", note, [*columns, "transfer steps", "evaluation episodes"], lines)


def _costs(plan: Plan) -> Table:
    lines = []
    for row in plan.rows:
        ids = lineage(plan, (c.run for c in plan.cells if c.row == row.name and c.run))
        stages: dict[str, list[Any]] = {}
        for id16 in ids:
            stages.setdefault(plan.runs[id16].stage, []).append(plan.runs[id16])
        for stage, runs in sorted(stages.items()):
            seconds = [r.seconds for r in runs if r.seconds is not None]
            lines.append(
                [
                    row.name,
                    stage,
                    str(len(runs)),
                    duration(float(np.median(seconds))) if seconds else "-",
                    duration(sum(seconds)) if seconds else "-",
                    str(sum(1 for r in runs if r.resumed)),
                    ", ".join(commits(runs)),
                ]
            )
    note = (
        "Time of one process on a machine that other runs shared; a resumed run counts each attempt "
        "up to its last checkpoint. + marks uncommitted changes."
    )
    columns = ["row", "stage", "runs", "median time", "in all", "resumed", "commits"]
    return Table("What ran", note, columns, lines, heads=2)


def commits(runs: Sequence[Any]) -> list[str]:
    """The commits that ``runs`` ran on, shortened; ``+`` marks uncommitted changes."""
    states = {state for run in runs for state in run.code}
    return sorted(f"{(s.commit or 'unknown')[:10]}{'+' if s.dirty else ''}" for s in states)


def _states(code: Sequence[Any]) -> str:
    return " then ".join(
        f"{(s.commit or 'unknown')[:10]}{' with changes ' + s.dirty if s.dirty else ''}"
        for s in code
    )


def duration(seconds: float) -> str:
    """``1:02:03`` (hours) or ``2:03`` (minutes)."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def as_json(report: Report) -> dict[str, Any]:
    """Cells, comparisons, tables and notes as JSON values."""

    def records(table: pd.DataFrame) -> list[dict[str, Any]]:
        plain = table.astype(object).where(table.notna(), None)
        return plain.to_dict("records")

    return {
        "cells": records(report.cells),
        "comparisons": records(report.comparisons),
        "paid": records(report.paid),
        "points": records(report.points),
        "tables": [t._asdict() for t in report.tables],
        "notes": report.notes,
    }
