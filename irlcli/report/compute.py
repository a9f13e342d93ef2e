"""The numbers of a report: cells, comparisons, learned returns, and the discriminators' ends.

Most functions take *points*: a row per evaluation and setting with the columns

    row           ENV KNOB
    agent         method or baseline
    measure       see :class:`irlcli.report.parameters.Cell`
    seed          of the reward learning; missing for baselines
    retraining    number of the policy trained on that seed's reward, from 0
    expert_of     the setting in which an expert was trained; of ``reused``, never ``setting``
    setting       the setting of the evaluation
    true_return, progress, learned_return
                  means over episodes. Progress may be missing. The learned return is known only
                  of retrained policies, and of the expert scored by their reward; both are under
                  the policy's ceiling
    regret_error, gap_error
                  standard errors of the differences to the expert, of the true and of the learned
                  returns, over episodes from the same start states; known of retrained policies,
                  unless an error stopped an episode
    episodes      their number
    stopped       how many of them an error stopped; the means leave them out, unless they are all
    evaluation    id of the artefact
    demonstrations
                  ids of the datasets behind it; empty for experts and baselines
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from irlcli.data.descriptions import Assessment, Interval, Measured
from irlcli.report.agents import BASELINES, IN_DISTRIBUTION, comparisons
from irlcli.report.lineage import is_mixed, origins
from irlcli.report.parameters import EXPERT_BY_REWARD, Parameters, has_held_out
from irlcli.report.reward_quality import Judgement, judge
from irlcli.report.statistics import compare, holm, paired_p, summarise

# A student imitates if its return is within a fifth of its expert's, in every training setting.
IMITATED = 0.8
_DIAGNOSTICS = (
    "accuracy",
    "mean_abs_logit",
    "cross_entropy",
    "penalty",
    "optimised_cross_entropy",
    "optimised_penalty",
    "penalty_weight",
)

_SCORED = ["true_return", "learned_return", "regret_error", "gap_error"]

Learning = Mapping[tuple[str, str, int], pd.DataFrame]
Assessments = Mapping[tuple[str, str, int | None], Assessment]


def sample(points: pd.DataFrame, row: str, agent: str, measure: str) -> pd.DataFrame:
    """``true_return`` and ``progress`` by seed, means over settings and retrainings."""
    by_seed = points_of(points, row, agent, measure).groupby("seed", dropna=False, sort=True)
    return by_seed[["true_return", "progress"]].mean()


def whole_sample(
    p: Parameters, points: pd.DataFrame, row: str, agent: str, measure: str
) -> pd.DataFrame:
    """:func:`sample` without the seeds that lack an evaluation.

    A mean over some of the settings cannot be compared with one over all of them.
    """
    lacking = [c.seed for c in p.cells_of(row, agent, measure) if not c.run]
    return sample(points, row, agent, measure).drop(lacking, errors="ignore")


def whole_seeds(p: Parameters, points: pd.DataFrame) -> pd.DataFrame:
    """``points`` without those of a seed that lacks a retraining in the same setting.

    Points of agents without seeds stay.
    """
    unseen = {row.name: row.unseen for row in p.rows}
    lacking = {
        (c.row, c.agent, c.measure, c.setting or unseen[c.row], c.seed)
        for c in p.cells
        if not c.run
    }
    columns = ["row", "agent", "measure", "setting", "seed"]
    kept = [key not in lacking for key in points[columns].itertuples(index=False, name=None)]
    return points[kept]


def points_of(points: pd.DataFrame, row: str, agent: str, measure: str) -> pd.DataFrame:
    """The points of one row, agent and measure."""
    of = (points["row"] == row) & (points["agent"] == agent) & (points["measure"] == measure)
    return points[of]


def between_retrainings(points: pd.DataFrame, row: str, agent: str, measure: str) -> float | None:
    """Deviation (n - 1) of the true return between policies trained on one reward, pooled.

    The root of the mean variance over rewards and the settings that policies are trained in; None if
    no reward was retrained twice in one setting.
    """
    chosen = points_of(points, row, agent, measure)
    if not chosen["retraining"].any():
        return None
    means = chosen.groupby(["seed", "setting", "retraining"])["true_return"].mean()
    variances = means.groupby(["seed", "setting"]).var().dropna()
    return float(np.sqrt(variances.mean())) if len(variances) else None


def imitates(student: float | None, expert: float | None) -> bool | None:
    """Whether a true return is within a fifth of an expert's; None if either is unknown.

    For a positive return this is the 80 % rule. For a negative one the ratio would have the
    opposite meaning.
    """
    if student is None or expert is None:
        return None
    return student >= expert - (1 - IMITATED) * abs(expert)


def failed_to_imitate(cell: Any) -> bool:
    """Whether a row of :func:`summarise_cells` is a student's that did not reach its expert."""
    return cell.imitated is not pd.NA and not cell.imitated


def summarise_cells(p: Parameters, points: pd.DataFrame) -> pd.DataFrame:
    """A row per row, agent and measure.

    Columns: ``row``, ``agent``, ``measure``, ``setting``; ``seeds`` and ``seeds_wanted``; ``mean``,
    ``deviation`` (n - 1), ``low`` and ``high`` (95 % bootstrap interval) and ``iqm`` of the true
    return over seeds; ``progress``, its mean; ``complete``, whether all evaluations exist;
    ``partial``, whether a seed in the mean lacks some; ``mixed``, whether the runs behind them
    differ in code or libraries; ``of_expert``, in distribution the mean over settings of the share
    of the setting's expert's return, and ``least_of_expert``, the smallest of these shares;
    ``imitated``, whether a student imitates (:func:`imitates`) in every training setting, in the
    mean over seeds; ``between_retrainings``, see :func:`between_retrainings`.
    """
    found = []
    for row in p.rows:
        wanted = [(agent, "ood") for agent in BASELINES if has_held_out(p.measures)]
        if not set(IN_DISTRIBUTION).isdisjoint(p.measures):
            wanted += [("expert", "id"), ("reused", "id")]
        wanted += [(method, m) for m in p.measures for method in p.methods]
        for agent, measure in wanted:
            values = sample(points, row.name, agent, measure)
            s = summarise(values["true_return"].tolist())
            low, high = s.interval or (None, None)
            progress = values["progress"].mean() if len(values) else math.nan
            # Baselines have one sample and no seed.
            sampled = {None, *values.index} if len(values) else set()
            planned = p.cells_of(row.name, agent, measure)
            found.append(
                {
                    "row": row.name,
                    "agent": agent,
                    "measure": measure,
                    "setting": ", ".join(row.settings_of(measure)),
                    "seeds": s.n,
                    "seeds_wanted": len(p.seeds) if agent in p.methods else min(1, len(planned)),
                    "mean": s.mean,
                    "deviation": s.deviation,
                    "low": low,
                    "high": high,
                    "iqm": s.iqm,
                    "between_retrainings": between_retrainings(points, row.name, agent, measure),
                    "progress": None if math.isnan(progress) else float(progress),
                    "complete": all(c.run for c in planned),
                    "partial": any(not c.run and c.seed in sampled for c in planned),
                    "mixed": is_mixed(origins(p, planned)),
                }
            )
    return _with_imitation(p, points, pd.DataFrame(found))


def _with_imitation(p: Parameters, points: pd.DataFrame, table: pd.DataFrame) -> pd.DataFrame:
    """``table`` with the columns ``of_expert``, ``least_of_expert`` and ``imitated``."""
    whole = table[(table["agent"] == "expert") & (table["measure"] == "id") & table["complete"]]
    rows = set(whole["row"])
    experts_of = {row: _by_setting(points, row, "expert", "id") for row in rows}
    shares_of: list[tuple[float | None, float | None, bool | None]] = []
    for r in table.itertuples():
        is_student = r.agent in p.methods and r.measure == "id"
        # A student's evaluation covers all training settings, the others have one for each.
        compared = (
            r.measure in IN_DISTRIBUTION and r.agent != "expert" and (r.complete or is_student)
        )
        if not compared or r.row not in rows or not r.seeds:
            shares_of.append((None, None, None))
            continue
        earned, experts = _by_setting(points, r.row, r.agent, r.measure), experts_of[r.row]
        shares = (earned / experts).where(experts > 0)
        known = shares.notna().all()
        mean, least = (shares.mean(), shares.min()) if known else (None, None)
        reached = [imitates(earned.get(setting), experts[setting]) for setting in experts.index]
        imitated = all(reached) if is_student and None not in reached else None
        shares_of.append((mean, least, imitated))
    means, least_shares, imitations = zip(*shares_of, strict=True)
    return table.assign(
        of_expert=pd.array(means, "Float64"),
        least_of_expert=pd.array(least_shares, "Float64"),
        imitated=pd.array(imitations, "boolean"),
    )


def _by_setting(points: pd.DataFrame, row: str, agent: str, measure: str) -> pd.Series:
    """The mean true return over seeds of each setting; a seed's is the mean of its retrainings."""
    of = points_of(points, row, agent, measure).astype({"true_return": float})
    means = of.groupby(["setting", "seed"], dropna=False)["true_return"].mean()
    return means.groupby("setting").mean()


def compare_methods(p: Parameters, points: pd.DataFrame, cells: pd.DataFrame) -> pd.DataFrame:
    """A row per row, measure and pair of methods (x, y), over seeds with every evaluation.

    Pairs that share all runs of a measure are left out. Columns: ``row``, ``measure``, ``x``, ``y``;
    ``difference`` of the means, ``low`` and ``high``, its 95 % interval by Welch's test, and the
    ``detectable`` difference; two-sided p-values ``p_welch`` (primary), ``p_welch_holm`` (over the rows, in an ablation over the rows and
    variants), ``p_paired`` (over the ``pairs`` seeds that both methods have), ``p_student`` and
    ``p_rank`` (Mann-Whitney); ``improvement``, the probability that a seed of x beats one of y;
    ``not_imitated``, which of the two failed in distribution; ``why``, the reason for a missing
    Welch test.
    """
    pairs = [(v.name, p.variants[0].name) for v in p.variants[1:]] or comparisons(p.methods)
    students = cells[(cells["measure"] == "id") & cells["agent"].isin(p.methods)]
    failed = {(r.row, r.agent) for r in students.itertuples() if failed_to_imitate(r)}
    families = [pairs] if p.variants else [[pair] for pair in pairs]
    found = []
    for measure in p.measures:
        for family in families:
            # A variant may share the runs of its base.
            tests = [
                (x, y, row)
                for x, y in family
                for row in p.rows
                if not _same_runs(p, row.name, x, y, measure)
            ]
            samples = [
                [
                    whole_sample(p, points, row.name, agent, measure)["true_return"]
                    for agent in (x, y)
                ]
                for x, y, row in tests
            ]
            tested = [compare(a.tolist(), b.tolist()) for a, b in samples]
            adjusted = holm([c.welch for c in tested])
            for (x, y, row), (a, b), c, p_holm in zip(
                tests, samples, tested, adjusted, strict=True
            ):
                common = a.index.intersection(b.index)
                low, high = c.interval or (None, None)
                found.append(
                    {
                        "row": row.name,
                        "measure": measure,
                        "x": x,
                        "y": y,
                        "difference": c.difference,
                        "low": low,
                        "high": high,
                        "detectable": c.detectable,
                        "p_welch": c.welch,
                        "p_welch_holm": p_holm,
                        "p_paired": paired_p(a[common].tolist(), b[common].tolist()),
                        "pairs": len(common),
                        "p_student": c.student,
                        "p_rank": c.rank,
                        "improvement": c.improvement,
                        "not_imitated": " ".join(m for m in (x, y) if (row.name, m) in failed),
                        "why": c.why,
                    }
                )
    columns = ["row", "measure", "x", "y", "difference", "low", "high", "detectable", "p_welch"]
    columns += ["p_welch_holm", "p_paired", "pairs", "p_student", "p_rank", "improvement"]
    columns += ["not_imitated", "why"]
    return pd.DataFrame(found, columns=columns)


def _same_runs(p: Parameters, row: str, x: str, y: str, measure: str) -> bool:
    """Whether ``x`` and ``y`` have the same evaluations, or none, so that there is nothing to compare."""
    of_x, of_y = ({cell.run for cell in p.cells_of(row, agent, measure)} for agent in (x, y))
    return bool(of_x) and of_x == of_y


def learned_returns(p: Parameters, points: pd.DataFrame) -> pd.DataFrame:
    """What the frozen rewards score, a row per row and method.

    Columns: ``row``, ``agent``; ``seeds`` that have both evaluations, and the retrained policies of them
    that were ``judged``: none beside an expert that is no better than the random agent;
    ``retrained`` and ``expert``, mean learned returns of the retrained policies and of the held-out
    setting's expert; ``short``, the policies that fall short of the expert, and
    ``short_scored_higher``, those of them because of a wrong reward: see
    :func:`irlcli.report.reward_quality.judge`, which also needs the random agent's return;
    ``uncertain``, the verdicts that rest on differences within two standard errors, and
    ``short_uncertain``, those of them on policies that fall short.
    """
    columns = ["row", "agent", "seeds", "judged", "retrained", "expert"]
    columns += ["short", "short_scored_higher", "uncertain", "short_uncertain"]
    found = []
    for row in p.rows if "transfer" in p.measures else ():
        random = sample(points, row.name, "random", "ood")["true_return"].mean()
        for method in p.methods:
            policies, experts = (
                points_of(points, row.name, method, m).dropna(subset="learned_return")
                for m in ("transfer", EXPERT_BY_REWARD)
            )
            experts = experts[["seed", "true_return", "learned_return"]]
            both = policies[["seed", *_SCORED]].merge(experts, on="seed", suffixes=("", "_expert"))
            if both.empty or math.isnan(random):
                continue
            every = (_judged(pair, random) for pair in both.itertuples())
            judged = [judgement for judgement in every if judgement.verdict is not None]
            verdicts = [judgement.verdict for judgement in judged]
            scores = both[["learned_return", "learned_return_expert"]]
            means = map(float, scores.groupby(both["seed"]).mean().mean())
            counts = (
                len(verdicts) - verdicts.count("matches the expert"),
                verdicts.count("wrong reward"),
                sum(not judgement.clear for judgement in judged),
                sum(not j.clear for j in judged if j.verdict != "matches the expert"),
            )
            seeds = both["seed"].nunique()
            found.append((row.name, method, seeds, len(verdicts), *means, *counts))
    return pd.DataFrame(found, columns=columns)


def reward_quality(p: Parameters, assessments: Assessments) -> pd.DataFrame:
    """How well each reward ranks a bank of policies, a row per row, method, setting and seed.

    Columns: ``row``, ``agent``, ``setting``, ``seed``; ``spearman`` and ``spearman_low`` over the
    bank and over its lower half; ``expert_minus_idle`` per step; ``return_distance``; ``verdicts``
    on the policies retrained there from scratch, one for each retraining, none where the expert is
    no better than the random agent; ``uncertain``, how many of them rest on differences within
    two standard errors.
    """

    def value(found: Interval | None) -> float | None:
        return None if found is None else found.value

    found = []
    for row, method, seed in product(p.rows, p.methods, p.seeds):
        of = assessments.get((row.name, method, seed))
        if of is None:
            continue
        for s in of.settings:
            judged = [r for r in s.retrained if r.verdict is not None and not r.from_student]
            found.append(
                {
                    "row": row.name,
                    "agent": method,
                    "setting": s.setting,
                    "seed": seed,
                    "spearman": value(s.overall.spearman),
                    "spearman_low": value(s.lower_half.spearman),
                    "expert_minus_idle": s.expert_minus_idle and s.expert_minus_idle.mean,
                    "return_distance": s.return_distance,
                    "verdicts": [r.verdict for r in judged],
                    "uncertain": sum(not r.clear for r in judged),
                }
            )
    columns = ["row", "agent", "setting", "seed", "spearman", "spearman_low", "expert_minus_idle"]
    return pd.DataFrame(found, columns=[*columns, "return_distance", "verdicts", "uncertain"])


def _judged(pair: Any, random: float) -> Judgement:
    """The verdict on a retrained policy, beside the expert under the same reward."""

    def known(mean: float, error: float) -> Measured:
        return Measured(mean=float(mean), error=None if pd.isna(error) else float(error))

    return judge(
        known(pair.true_return_expert - pair.true_return, pair.regret_error),
        pair.true_return_expert - random,
        known(pair.learned_return_expert - pair.learned_return, pair.gap_error),
    )


def discriminator_ends(p: Parameters, learning: Learning) -> pd.DataFrame:
    """The discriminator over the last tenth of the rounds, a row per row and method.

    Columns: ``row``, ``agent``, ``seeds``; means over settings and seeds of the metrics of
    ``train-airl``; ``share``, lambda times the optimised penalty over the optimised cross-entropy
    times its weight in the loss (:attr:`irlcli.report.parameters.Row.student_share`), None if that is
    zero. ``cross_entropy`` and ``penalty`` are of the round's samples, the optimised ones
    of the minibatches that were minimised.
    """
    found = []
    for row in p.rows:
        for method in p.methods:
            runs = [m for (r, a, _), m in learning.items() if (r, a) == (row.name, method)]
            if not runs:
                continue
            ends = []
            for metrics in runs:
                end = metrics[metrics["round"] >= 0.9 * metrics["round"].max()]
                weighted = end["penalty_weight"] * end["optimised_penalty"]
                ends.append(end[list(_DIAGNOSTICS)].assign(weighted=weighted).mean())
            means = pd.concat(ends, axis=1).mean(axis=1)
            weighted, entropy = means.pop("weighted"), means["optimised_cross_entropy"]
            entropy *= row.student_share.get(method, 1.0)
            share = weighted / entropy if entropy > 0 else None
            values = {"row": row.name, "agent": method, "seeds": len(runs), "share": share}
            found.append(values | means.to_dict())
    return pd.DataFrame(found, columns=["row", "agent", "seeds", "share", *_DIAGNOSTICS])
