"""What a reader must know before drawing conclusions from a report, one sentence or two each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from irlcli.report.agents import IN_DISTRIBUTION, MEASURES, title
from irlcli.report.compute import Assessments, failed_to_imitate
from irlcli.report.lineage import demonstrations, is_mixed, origins, short
from irlcli.report.parameters import EXPERT_BY_REWARD, Cell, Code, Parameters, has_held_out
from irlcli.report.statistics import identical_runs
from irlcli.report.text import percent

# At this accuracy, the gradient of the penalty is close to zero.
SATURATED = 0.95

Episodes = Mapping[tuple[str, str], Mapping[tuple[str, str], np.ndarray]]


def missing(p: Parameters) -> list[str]:
    """A caveat per row: which evaluations are missing, and what they wait for."""
    found = []
    for row in p.rows:
        cells = p.cells_of(row.name)
        reasons: dict[str, dict[str, dict[str, None]]] = {}
        for c in cells:
            if not c.run:
                reasons.setdefault(c.why, {}).setdefault(_waiting(c), {})[_which(c)] = None
        parts = [
            f"{why}: "
            + "; ".join(f"{agent} {', '.join(which)}".strip() for agent, which in agents.items())
            for why, agents in reasons.items()
        ]
        if parts:
            exist = sum(bool(c.run) for c in cells)
            found.append(
                f"Missing: {row.name}: {exist} of {len(cells)} evaluations exist. "
                f"{'. '.join(parts)}."
            )
    return found


def _waiting(cell: Cell) -> str:
    # A run has several evaluations; any other stage stands for all of them.
    several = cell.seed is not None and cell.why.startswith("evaluate")
    return f"{title(cell.agent)} {cell.measure}" if several else title(cell.agent)


def _which(cell: Cell) -> str:
    return cell.setting if cell.seed is None else str(cell.seed)


def not_imitated(cells: pd.DataFrame) -> list[str]:
    """Students that stay below their experts in distribution."""
    found = []
    for r in cells.itertuples():
        if failed_to_imitate(r):
            least = r.least_of_expert
            share = "" if least is pd.NA else f" ({least:.1%} of its return)"
            found.append(
                f"Not imitated: {r.row}, {title(r.agent)}: in a training setting the student earns over a "
                f"fifth less than the expert{share}, in the mean over seeds. Do not interpret gaps to "
                "others."
            )
    return found


def stopped(points: pd.DataFrame, assessments: Assessments) -> list[str]:
    """A caveat per row: evaluations and assessments in which an error stopped episodes."""
    found: dict[str, list[str]] = {}
    acted = points[points["measure"] != EXPERT_BY_REWARD]
    for (row, agent, measure, setting), group in acted.groupby(
        ["row", "agent", "measure", "setting"], sort=False
    ):
        if not (group["stopped"] > 0).any():
            continue
        what = f" {measure}" if measure in MEASURES else ""
        counts = f"{group['stopped'].sum()} of {group['episodes'].sum()}"
        found.setdefault(row, []).append(f"{title(agent)}{what} in {setting} {counts}")
    for (row, method, seed), of in assessments.items():
        if of.left_out:
            found.setdefault(row, []).append(
                f"assessment of {title(method)}'s reward, seed {seed}: {of.left_out} of each policy's"
            )
    return [
        f"Episodes stopped by an error: {row}: {'; '.join(parts)}. Means leave them out. Where all of a "
        "policy's were stopped its mean is of what came before: do not compare it."
        for row, parts in found.items()
    ]


def weak_experts(
    p: Parameters, points: pd.DataFrame, cells: pd.DataFrame, assessments: Assessments
) -> list[str]:
    """Experts that earn no more than the random or the idle agent, or less than another policy.

    A table without a measure in the held-out setting says nothing about its expert.
    """
    weak: dict[tuple[str, str, str], None] = {}
    for (assessed, _, _), assessment in assessments.items():
        weak |= dict.fromkeys((assessed, *found) for found in assessment.weak_experts)
    means = cells[cells["measure"] == "ood"].set_index(["row", "agent"])["mean"]
    for row in p.rows if has_held_out(p.measures) else ():
        expert = means.get((row.name, "expert"))
        for agent in ("random", "idle"):
            other = means.get((row.name, agent))
            if expert is not None and other is not None and expert <= other:
                weak[row.name, row.unseen, agent] = None
    found = [
        f"Weak expert: {name}: in {setting} the expert earns no more than the {agent} agent. Shares of "
        f"the expert {'and verdicts mean nothing' if agent == 'random' else 'mean little'} there."
        for name, setting, agent in weak
    ]
    for row in p.rows if has_held_out(p.measures) else ():
        expert = means.get((row.name, "expert"))
        others = _earned_in(row.unseen, points[points["row"] == row.name], p.methods)
        better = {} if expert is None else others[others > expert].to_dict()
        if better:
            listed = " and ".join(f"{agents} ({earned:.1f})" for agents, earned in better.items())
            found.append(
                f"Expert not the best: {row.name}: in {row.unseen} it earns {expert:.1f}, less than "
                f"{listed}."
            )
    return found


def _earned_in(setting: str, points: pd.DataFrame, methods: Sequence[str]) -> pd.Series:
    """The mean true returns in ``setting`` of each method's policies, and of the best training expert."""
    of = points[(points["setting"] == setting) & points["true_return"].notna()]
    of = of[~of["measure"].isin([EXPERT_BY_REWARD, *IN_DISTRIBUTION])]
    reused, learned = of[of["agent"] == "reused"], of[of["agent"].isin(methods)]
    earned = {
        f"{title(agent)}'s {measure} policies": group["true_return"].mean()
        for (agent, measure), group in learned.groupby(["agent", "measure"], sort=False)
    }
    if len(reused):
        earned["the best training expert there"] = reused["true_return"].max()
    return pd.Series(earned, dtype=float)


def below_bar(p: Parameters, points: pd.DataFrame) -> list[str]:
    """Experts below the least return that the settings file asks of an expert."""
    found = []
    for row in p.rows:
        bar = row.config["expert"].get("bar")
        experts = points[(points["row"] == row.name) & (points["agent"] == "expert")]
        low = experts[experts["true_return"] < (-math.inf if bar is None else bar)]
        if len(low):
            earned = zip(low["setting"], low["true_return"], strict=True)
            listed = ", ".join(f"{setting} ({earns:.1f})" for setting, earns in earned)
            found.append(
                f"Expert below its bar of {bar:g}: {row.name}: {listed}. Compared with it, policies look "
                "better than they are."
            )
    return found


def short_of_expert(learned_returns: pd.DataFrame) -> list[str]:
    """Retrained policies that fall short of the expert: a wrong reward, or failed optimisation."""
    found = []
    for r in learned_returns.itertuples():
        if r.short:
            higher, lower = r.short_scored_higher, r.short - r.short_scored_higher
            parts = [
                f"Wrong reward: it scores {higher} of them at least as high as the expert."
            ] * (higher > 0)
            parts += [
                f"Optimisation fell short: the reward scores the expert above {lower} of them."
            ] * (lower > 0)
            if r.short_uncertain:
                parts.append(
                    f"Uncertain (within two standard errors): {r.short_uncertain} of the {r.short}."
                )
            found.append(
                f"Short of the expert: {r.row}, {title(r.agent)}: {r.short} of {r.judged} retrained "
                f"policies. {' '.join(parts)}"
            )
    return found


def criteria(cells: pd.DataFrame, verdicts: bool) -> list[str]:
    """Shares and verdicts are measured differently; a page with both must say so."""
    if not verdicts or cells["of_expert"].isna().all():
        return []
    return [
        "Two criteria: shares of the expert and the gates divide by the expert's whole return; the "
        "verdicts (matches the expert, short) by what it earns above the random agent. One policy can pass one "
        "and fail the other."
    ]


def saturated(ends: pd.DataFrame) -> list[str]:
    """Discriminators that are nearly always right, which makes the penalty vacuous."""
    return [
        f"Saturated: {r.row}, {title(r.agent)}: at the end of training the discriminator classifies "
        f"{r.accuracy:.1%} of the round's samples correctly, and lambda times the optimised penalty is "
        f"{percent(r.share)} of the optimised cross-entropy, as weighted in the loss. The penalty has little left to change."
        for r in ends.itertuples()
        if r.penalty_weight > 0 and r.accuracy >= SATURATED
    ]


def identical(episodes: Episodes) -> list[str]:
    """Runs whose returns are bitwise equal: seeds that are no sample, or a method without effect.

    Args:
        episodes: the true returns by (row, measure), then (method, seed); the seed's text also
            names the setting and the retraining if there are several.
    """
    groups: dict[tuple[str, tuple], list[str]] = {}
    for (row, measure), found in episodes.items():
        for runs in identical_runs(found):
            groups.setdefault((row, runs), []).append(measure)
    return [
        f"Identical: {row}, {', '.join(measures)}: "
        f"{', '.join(f'{title(a)} seed {s}' for a, s in runs)} have bitwise equal returns: what "
        "they differ in did not change these returns."
        for (row, runs), measures in groups.items()
    ]


def without_p(comparisons: pd.DataFrame) -> list[str]:
    """A caveat per row and reason; comparisons.csv tells which."""
    counts = comparisons[comparisons["why"] != ""].groupby(["row", "why"], sort=False).size()
    total = comparisons.groupby("row", sort=False).size()
    return [
        f"No p-value: {row}: {n} of {total[row]} comparisons: {why}."
        for (row, why), n in counts.items()
    ]


def shared_demonstrations(p: Parameters) -> list[str]:
    """Rows in which several seeds learn from one set of demonstrations."""
    rows = []
    for row in p.rows:
        cells = [c for c in p.cells_of(row.name) if c.seed is not None and c.run]
        seeds = {c.seed for c in cells}
        if len(demonstrations(p, cells)) == 1 and len(seeds) > 1:
            rows.append(row.name)
    if not rows:
        return []
    return [
        f"Shared demonstrations: {', '.join(rows)}: all seeds and methods of a row learn from one set "
        "of demonstrations, by one expert per setting. Seeds vary the reward learning and what "
        "follows from it; deviations, intervals and p-values do not cover other experts or "
        "demonstrations."
    ]


def left_out(p: Parameters) -> list[str]:
    """Runs for a cell of the report that were made with other parameters."""
    return [
        f"Left out: {_runs(len(o.ids))} of {o.stage}, {o.about} ({', '.join(o.ids)}): {o.why}."
        for o in p.others
    ]


def mixed(p: Parameters) -> list[str]:
    """Rows whose runs differ in code or library versions."""
    found = []
    for row in p.rows:
        made = origins(p, p.cells_of(row.name))
        if is_mixed(made):
            parts = [
                f"commit {_attempts(origin.code)}, libraries {origin.libraries}: {_runs(len(ids))}"
                for origin, ids in made.items()
            ]
            found.append(
                f"Mixed: {row.name}: its runs differ in code or library versions: {'; '.join(parts)}."
            )
    return found


def _attempts(code: tuple[Code, ...]) -> str:
    return " then ".join(
        f"{short(state)}{' with changes ' + state.dirty if state.dirty else ''}" for state in code
    )


def _runs(count: int) -> str:
    return f"{count} run" if count == 1 else f"{count} runs"
