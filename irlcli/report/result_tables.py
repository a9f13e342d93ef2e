"""The tables of a report as text: results, learned returns, comparisons, discriminators, costs."""

from __future__ import annotations

import re
from typing import Any, get_args

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind_from_stats

from irlcli.data.descriptions import Verdict
from irlcli.labels import duration, steps, steps_of_all_restarts, weight_text
from irlcli.methods import METHODS
from irlcli.report import paper
from irlcli.report.agents import IN_DISTRIBUTION, MEASURES, PROGRESS, beside, own_measure, title
from irlcli.report.compute import failed_to_imitate
from irlcli.report.lineage import commits, lineage
from irlcli.report.parameters import Parameters, Row, Run
from irlcli.report.tables import EVERY_CELL, REWARD_QUALITY, Table
from irlcli.report.text import incomplete, number, p_value, percent

_MAIN_NOTE = (
    "Mean true return ± standard deviation over seeds. Training experts, reused: the mean over the "
    "experts of the training settings, each evaluated in the other settings in which the students are "
    "evaluated. This is the return without learning a reward."
)
_TEST_NOTE = (
    f"p: Welch's test, {title('irm')} against {title('erm')}; Holm: adjusted over the rows that have a "
    "p-value."
)
# Patterns of cells, and what to say below a table that has such a cell.
_MARKS = {
    r"\(\d+/\d+\)": "(n/m): n of m seeds exist.",
    r"\(part\)": "(part): some evaluations are missing; differences and p-values leave their seeds out.",
    "†": "† in a training setting the student earns over a fifth less than the expert.",
    "‡": "‡ runs of more than one commit or set of libraries.",
    "^progress$": PROGRESS,
    "^ant ": "An idle ant earns 600 to 675.",
}
_RETRAININGS_NOTE = (
    "Each reward was retrained {} times: the return of a seed is their mean, and ± is over seeds. "
    "*Every cell* has the deviation between retrainings of one reward."
)
_SETTING_NOTE = (
    "A policy retrained from scratch in each training setting. Mean true return ± standard deviation "
    "over seeds, and its share of the return of that setting's own expert."
)
_ZERO_SHOT_NOTE = (
    "The student before and after retraining on its own reward in the held-out setting, over the "
    "seeds that have both. Better: seeds in which retraining earned more. p: paired t-test, two-sided."
)
_LEARNED_NOTE = (
    "Learned return: the sum of the frozen reward over an episode, undiscounted (training "
    "discounts), mean over seeds; of the policy retrained on that reward, and of the held-out "
    "setting's expert. Both are under the policy's transfer.ceiling, if it has one. Short: policies "
    "with a regret of more than 10 % of what the expert earns above the random agent; - if the expert "
    "is no better than the random agent. Scored higher: those of the short ones that the reward "
    "scores at least as high as the expert, so that it is wrong. In the others, optimisation fell "
    "short, which does not show that the reward is right. Uncertain: of all verdicts, also that a "
    "policy is not short, those on differences within two standard errors of the episodes. The unit "
    "is the standard deviation of g on the training data; zero has no meaning."
)
_QUALITY_NOTE = (
    "How well the frozen reward ranks a bank of policies (idle, random, a clone of the demonstrations "
    "at several noise levels, student, experts, retrained policy): Spearman's correlation of learned "
    "with true return, over the bank and over the half with the lower true returns, median over seeds "
    "(least to largest). Expert - idle: learned reward per step, in standard deviations of g, median "
    "over seeds. The next three count the policies retrained from scratch by verdict: matches the expert, if the "
    "regret is within 10 % of what the expert earns above the random agent; else wrong reward, if the "
    "policy's learned return is at least the expert's; else optimisation fell short. Uncertain: verdicts on "
    "differences within two standard errors, or whose plain and discounted gaps have opposite signs."
)
_COMPARISON_NOTE = (
    "Difference of the means, with its 95 % interval by Welch's test. Detectable: the difference that "
    "the test would find at 5 % with a power of 80 %, if the deviations are those of these seeds. "
    "Two-sided p-values. Welch's test is the primary one. Holm: adjusted over the rows, "
    "separately for each measure and pair of methods; in an ablation over all rows and variants "
    "of a measure. Paired: t-test over the seeds that both methods have (their number in "
    "brackets), which share initialisation and starts; - where the differences do not vary or "
    "fewer than two pairs exist. Student's test assumes equal variances; the paper used it (its "
    "value is recomputed from its means and deviations, n = 5). Rank: the Mann-Whitney test, on "
    "the order of the seeds alone; three against three seeds give at least 0.1, five against "
    "five 0.008. P(better): probability that a seed of the first method beats one of the second, "
    "ties count half."
)
_DISCRIMINATOR_NOTE = (
    "Over the last tenth of the rounds, means over settings and seeds. This round: after the update, on "
    "a new minibatch of the round's episodes and the demonstrations, which the update used; the penalty "
    "is IRMv1, also for methods that do not penalise it. Optimised: means over the update's minibatches, "
    "which hold replayed episodes; challengers and the gradient penalty are not included. With "
    "airl.symmetries the optimised samples are random images; those of *this round* are as recorded. "
    "Share: lambda times the optimised penalty over the optimised cross-entropy times its weight in "
    "the loss, which challengers reduce by airl.challenger.share. The unbiased estimate of the penalty "
    "may be negative. Where --select kept an earlier round, or rounds were averaged, these are still the "
    "last rounds. If the discriminator is always right, the penalty has nothing to change."
)
_CELL_NOTE = (
    "95 %: percentile bootstrap interval of the mean over seeds, too narrow with few seeds. IQM: "
    "mean of the middle half of the seeds. Retrainings: standard deviation between policies "
    "trained on one reward, pooled over rewards; the sd over seeds is that of each reward's mean. Random "
    "and idle are one policy each, and so is the held-out setting's expert; in distribution there is "
    "one expert per training setting, and the reused experts are these, each in the other settings."
)
_BUDGET_NOTE = (
    "Steps: the budget in whole rounds; the steps of challengers are not counted. "
    "Demonstrations: episodes per training setting. Lambda: the penalty's weight; by method "
    "where the table has its own, by method and seed where it was chosen by leaving a setting "
    "out. Kept: the round, or the number of rounds averaged. At most: training could end earlier by "
    "airl.plateau_rounds; `stopped_after` in reward.json is the round."
)
_COST_NOTE = (
    "Wall-clock time of one process on a machine shared with other runs. A resumed run counts each "
    "attempt up to its last checkpoint. + marks uncommitted changes."
)


def measures(p: Parameters, cells: pd.DataFrame, comparisons: pd.DataFrame) -> list[Table]:
    """A table per measure. The note below the first explains the marks in all of them."""
    tables = [_measure(p, measure, cells, comparisons) for measure in p.measures]
    seen = [cell for table in tables for line in table.rows for cell in line]
    notes = [_MAIN_NOTE, *([_TEST_NOTE] if "p" in tables[0].columns else [])]
    notes += [note for mark, note in _MARKS.items() if any(re.search(mark, cell) for cell in seen)]
    if p.retrainings > 1:
        notes.append(_RETRAININGS_NOTE.format(p.retrainings))
    return [table._replace(note=" ".join(notes)) for table in tables[:1]] + tables[1:]


def _measure(p: Parameters, measure: str, cells: pd.DataFrame, comparisons: pd.DataFrame) -> Table:
    """A line per row for its return, and more for progress and for the paper's numbers."""
    agents = [*p.methods, *beside(measure)]
    first = comparisons[(comparisons["x"] == "irm") & (comparisons["y"] == "erm")]
    tested = {r.row: r for r in first[first["measure"] == measure].itertuples()}
    compared = not first.empty
    lines = []
    for row in p.rows:
        own = {
            r.agent: r
            for r in cells[cells["row"] == row.name].itertuples()
            if r.measure == own_measure(r.agent, measure)
        }
        values = ", ".join(text.partition("=")[2] for text in row.settings_of(measure))
        where = f"{row.name} = {values}"
        test = tested.get(row.name)
        tests = ["-", "-"] if test is None else [p_value(test.p_welch), p_value(test.p_welch_holm)]
        own_lines = [["return", *(_cell(own[a]) for a in agents), *tests]]
        if any(not pd.isna(own[a].progress) for a in agents):
            own_lines.append(["progress", *(number(own[a].progress) for a in agents), "", ""])
        if measure in IN_DISTRIBUTION:
            ratios = {a: own[a].of_expert for a in agents if a != "expert"}
            shares = {a: "-" if r is pd.NA else f"{r:.0%}" for a, r in ratios.items()}
            own_lines.append(["of the expert", *(shares.get(a, "") for a in agents), "", ""])
        printed = paper_row(p, row, measure)
        if printed is not None:
            texts = {
                a: f"{v.mean} ± {v.deviation}"
                for a, v in (("erm", printed.erm), ("irm", printed.irm), ("expert", printed.expert))
            }
            welch = p_value(_paper_p(printed, equal_variances=False))
            own_lines.append(["paper", *(texts.get(a, "") for a in agents), welch, ""])
        lines += [[where, *line] if compared else [where, *line[:-2]] for line in own_lines]
    columns = ["setting", "", *(title(a) for a in agents), *(["p", "Holm"] if compared else [])]
    return Table(MEASURES[measure], "", columns, lines, heads=2)


def paper_row(p: Parameters, row: Row, measure: str) -> paper.PrintedRow | None:
    """The paper's numbers for ``row``, if it printed any for this report and measure."""
    if p.kind != "table1" or measure != "transfer":
        return None
    return paper.TABLE1.get((row.env, row.knob))


def _paper_p(row: paper.PrintedRow, equal_variances: bool) -> float:
    n = paper.SEEDS
    test = ttest_ind_from_stats(*row.irm, n, *row.erm, n, equal_var=equal_variances)
    return float(test.pvalue)


def _cell(cell: Any) -> str:
    if pd.isna(cell.mean):
        return "-"
    text = f"{cell.mean:z.1f}"
    if not pd.isna(cell.deviation):
        text += f" ± {cell.deviation:.1f}"
    text += incomplete(cell)
    if failed_to_imitate(cell):
        text += " †"
    return text + (" ‡" if cell.mixed else "")


def by_training_setting(found: pd.DataFrame) -> Table:
    """The policies retrained in distribution, each beside its setting's expert."""
    lines = [
        [
            r.row,
            r.setting,
            title(r.agent),
            str(r.seeds),
            f"{r.mean:z.1f}" + ("" if pd.isna(r.deviation) else f" ± {r.deviation:.1f}"),
            number(r.progress),
            number(r.expert),
            "-" if pd.isna(r.of_expert) else f"{r.of_expert:.0%}",
        ]
        for r in found.itertuples()
    ]
    columns = ["row", "setting", "method", "seeds", "retrained policy", "progress", "expert"]
    columns += ["of the expert"]
    return Table("Retrained in distribution, by setting", _SETTING_NOTE, columns, lines, heads=3)


def against_zero_shot(found: pd.DataFrame) -> Table:
    """The student before and after retraining."""
    lines = [
        [
            r.row,
            title(r.agent),
            str(r.pairs),
            number(r.zero_shot),
            number(r.from_student),
            number(r.difference),
            f"{r.better}/{r.pairs}",
            p_value(r.p_paired),
        ]
        for r in found.itertuples()
    ]
    columns = ["row", "method", "seeds", "zero-shot", "from the student", "difference", "better"]
    columns += ["p"]
    return Table("From the student, against zero-shot", _ZERO_SHOT_NOTE, columns, lines, heads=2)


def learned_returns(found: pd.DataFrame) -> Table:
    """The retrained policies and the expert, scored by the frozen rewards."""
    lines = [
        [
            r.row,
            title(r.agent),
            str(r.seeds),
            number(r.retrained),
            number(r.expert),
            f"{r.short}/{r.judged}" if r.judged else "-",
            f"{r.short_scored_higher}/{r.short}" if r.short else "",
            f"{r.uncertain}/{r.judged}" if r.judged else "",
        ]
        for r in found.itertuples()
    ]
    columns = ["row", "method", "seeds", "retrained policy", "expert", "short", "scored higher"]
    columns.append("uncertain")
    return Table("Learned returns", _LEARNED_NOTE, columns, lines, heads=2)


def reward_quality(found: pd.DataFrame) -> Table:
    """The rewards' assessments, a line per row, method and setting."""
    lines = []
    for (row, method, setting), seeds in found.groupby(["row", "agent", "setting"], sort=False):
        verdicts = [verdict for of_seed in seeds["verdicts"] for verdict in of_seed]
        lines.append(
            [
                row,
                setting.partition("=")[2],
                title(method),
                str(len(seeds)),
                _median_and_range(seeds["spearman"]),
                _median_and_range(seeds["spearman_low"]),
                number(seeds["expert_minus_idle"].astype(float).median(), 2),
                *(
                    f"{verdicts.count(v)}/{len(verdicts)}" if verdicts else ""
                    for v in get_args(Verdict)
                ),
                f"{seeds['uncertain'].sum()}/{len(verdicts)}" if verdicts else "",
            ]
        )
    columns = ["row", "setting", "method", "seeds", "Spearman", "lower half", "expert - idle"]
    columns += [*get_args(Verdict), "uncertain"]
    return Table(REWARD_QUALITY, _QUALITY_NOTE, columns, lines, heads=3)


def _median_and_range(values: pd.Series) -> str:
    """The median over seeds, and the range if it has one."""
    known = values.dropna().astype(float)
    if known.empty:
        return "-"
    middle = number(known.median(), 2)
    if len(known) == 1:
        return middle
    return f"{middle} ({number(known.min(), 2)} to {number(known.max(), 2)})"


def comparisons(p: Parameters, found: pd.DataFrame) -> Table:
    """The pairs of methods that both have a seed."""
    rows = {row.name: row for row in p.rows}
    lines = []
    for r in found[found["difference"].notna()].itertuples():
        printed = paper_row(p, rows[r.row], r.measure) if (r.x, r.y) == ("irm", "erm") else None
        remark = "not imitated: do not interpret the gap" if r.not_imitated else ""
        lines.append(
            [
                r.row,
                r.measure,
                f"{title(r.x)} - {title(r.y)}",
                number(r.difference),
                "-" if pd.isna(r.low) else f"[{r.low:z.1f}, {r.high:z.1f}]",
                number(r.detectable),
                p_value(r.p_welch),
                p_value(r.p_welch_holm),
                f"{p_value(r.p_paired)} ({r.pairs})",
                p_value(r.p_student),
                "" if printed is None else p_value(_paper_p(printed, equal_variances=True)),
                p_value(r.p_rank),
                number(r.improvement, 2),
                "; ".join(filter(None, (r.why, remark))),
            ]
        )
    columns = ["row", "measure", "difference of", "means", "95 %", "detectable"]
    columns += ["Welch", "Welch, Holm", "paired", "Student"]
    columns += ["Student, paper", "rank", "P(better)", "remark"]
    return Table("Comparisons", _COMPARISON_NOTE, columns, lines, heads=3)


def discriminators(found: pd.DataFrame) -> Table:
    """The discriminators at the end of training: diagnostics, and what was optimised."""
    lines = []
    for r in found.itertuples():
        penalised = r.penalty_weight > 0
        lines.append(
            [
                r.row,
                title(r.agent),
                str(r.seeds),
                f"{r.accuracy:.1%}",
                number(r.mean_abs_logit),
                f"{r.cross_entropy:.3f}",
                f"{r.penalty:z.4f}",
                f"{r.optimised_cross_entropy:.3f}",
                f"{r.optimised_penalty:z.4f}" if penalised else "",
                percent(r.share) if penalised else "",
            ]
        )
    columns = ["row", "method", "seeds", "accuracy, this round", "mean |logit|, this round"]
    columns += ["cross-entropy, this round", "IRMv1, this round", "cross-entropy, optimised"]
    columns += ["penalty, optimised", "share"]
    title_ = "The discriminator at the end of training"
    return Table(title_, _DISCRIMINATOR_NOTE, columns, lines, heads=2)


def cells(found: pd.DataFrame) -> Table:
    """Every cell with its statistics."""
    lines = [
        [
            r.row,
            title(r.agent),
            r.measure,
            f"{r.seeds}/{r.seeds_wanted}",
            number(r.mean),
            number(r.deviation),
            "-" if pd.isna(r.low) else f"[{r.low:z.1f}, {r.high:z.1f}]",
            number(r.iqm),
            number(r.between_retrainings),
            number(r.progress),
        ]
        for r in found.itertuples()
    ]
    columns = ["row", "agent", "measure", "seeds", "mean", "sd", "95 %", "IQM"]
    columns += ["retrainings", "progress"]
    return Table(EVERY_CELL, _CELL_NOTE, columns, lines, heads=3)


def budgets(p: Parameters) -> Table:
    """How long each stage trains, and on how much."""
    lines = []
    for row in p.rows:
        config = row.config
        transfer = config["transfer"]
        lines.append(
            [
                row.name,
                f"{steps(config['expert']):,}",
                ", ".join(map(str, row.demonstrations)),
                ("at most " if config["airl"].get("plateau_rounds") else "")
                + f"{steps(config['airl']):,}",
                _weights(p, row),
                f"mean of {config['airl']['averaged_rounds']}"
                if config["airl"].get("averaged_rounds")
                else config["airl"]["select"],
                f"{steps_of_all_restarts(transfer):,}"
                if {"transfer", "transfer-id"} & set(p.measures)
                else "-",
                f"{steps(transfer, transfer['from_student']['total_steps']):,}"
                if "from-student" in p.measures
                else "-",
                str(config["evaluation"]["episodes"]),
            ]
        )
    columns = ["row", "expert steps", "demonstrations", "AIRL steps", "lambda", "kept"]
    columns += ["transfer steps", "from the student", "evaluation episodes"]
    note = _BUDGET_NOTE
    if p.variants:
        note += f" Of the variant {p.variants[0].name}; the others may differ."
    return Table("Budgets", note, columns, lines)


def _weights(p: Parameters, row: Row) -> str:
    """Lambda of the config where a run has none of its own, and each run's own; ``-`` without penalty."""
    methods = (p.learned_by,) if p.variants else p.methods
    weighed = [m for m in methods if m not in METHODS or METHODS[m].penalty != "none"]
    own = [f"{run}: {weight_text(weight)}" for run, weight in row.chosen.items()]
    if any(not {m, f"{m} {seed}"} & row.chosen.keys() for m in weighed for seed in p.seeds):
        own.insert(0, weight_text(row.config["airl"]["penalty_weight"]))
    return ", ".join(own) or "-"


def costs(p: Parameters) -> Table:
    """How long the runs behind each row took, by stage."""
    lines = []
    for row in p.rows:
        stages: dict[str, list[Run]] = {}
        for id16 in lineage(p, p.cells_of(row.name)):
            stages.setdefault(p.runs[id16].stage, []).append(p.runs[id16])
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
    columns = ["row", "stage", "runs", "median time", "total time", "resumed", "commits"]
    return Table("Cost", _COST_NOTE, columns, lines, heads=2)
