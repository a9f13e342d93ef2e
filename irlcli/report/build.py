"""A report from its points: every number, table and caveat, before it is laid out."""

from __future__ import annotations

from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import pandas as pd

from irlcli.report import ablation, caveats, compute, cue, result_tables, retrained
from irlcli.report.choices import Choices, choice_table, choices
from irlcli.report.in_short import in_short
from irlcli.report.parameters import Parameters
from irlcli.report.tables import Table


@dataclass(frozen=True, eq=False)
class Report:
    """The content of a report.

    Attributes:
        points: a row per evaluation and setting, see :mod:`irlcli.report.compute`.
        cells: see :func:`irlcli.report.compute.summarise_cells`.
        comparisons: see :func:`irlcli.report.compute.compare_methods`.
        by_training_setting: see :func:`irlcli.report.retrained.by_training_setting`.
        against_zero_shot: see :func:`irlcli.report.retrained.against_zero_shot`.
        learned_returns: see :func:`irlcli.report.compute.learned_returns`.
        discriminators: see :func:`irlcli.report.compute.discriminator_ends`.
        shares, variants: see :func:`irlcli.report.ablation.shares` and
            :func:`irlcli.report.ablation.summarise_variants`; empty without variants.
        reward_quality: see :func:`irlcli.report.compute.reward_quality`.
        cue_contrasts: see :func:`irlcli.report.cue.cue_contrasts`.
        choices: see :func:`irlcli.report.choices.choices`.
        in_short: see :func:`irlcli.report.in_short.in_short`.
        tables: the same for people.
        caveats: what a reader must know before drawing conclusions.
    """

    points: pd.DataFrame
    cells: pd.DataFrame
    comparisons: pd.DataFrame
    by_training_setting: pd.DataFrame
    against_zero_shot: pd.DataFrame
    learned_returns: pd.DataFrame
    discriminators: pd.DataFrame
    reward_quality: pd.DataFrame
    cue_contrasts: pd.DataFrame
    choices: pd.DataFrame
    shares: pd.DataFrame
    variants: pd.DataFrame
    in_short: list[str]
    tables: list[Table]
    caveats: list[str]


def build(
    p: Parameters,
    points: pd.DataFrame,
    episodes: caveats.Episodes,
    learning: compute.Learning,
    assessments: compute.Assessments = MappingProxyType({}),
    contrasts: cue.CueContrasts = MappingProxyType({}),
    weights_chosen: Choices = MappingProxyType({}),
) -> Report:
    """The report on ``points``.

    Args:
        p: what the report is about.
        points: a row per evaluation and setting, see :mod:`irlcli.report.compute`.
        episodes: the true returns by (row, measure), then (method, seed).
        learning: the metrics of ``train-airl`` by (row, method, seed).
        assessments: of the rewards, by (row, method, seed).
        contrasts: how the rewards depend on a cue, by (row, method, seed).
        weights_chosen: how lambda was chosen, by (row, method, seed).
    """
    cells = compute.summarise_cells(p, points)
    comparisons = compute.compare_methods(p, points, cells)
    by_training_setting = retrained.by_training_setting(p, points)
    against_zero_shot = retrained.against_zero_shot(p, points)
    learned_returns = compute.learned_returns(p, points)
    discriminators = compute.discriminator_ends(p, learning)
    reward_quality = compute.reward_quality(p, assessments)
    cue_contrasts = cue.cue_contrasts(p, contrasts)
    chosen = choices(p, weights_chosen)
    shares = ablation.shares(p, points) if p.variants else pd.DataFrame()
    variants = ablation.summarise_variants(p, shares) if p.variants else pd.DataFrame()
    tables = [
        *(ablation.tables(p, shares, variants) if p.variants else ()),
        *result_tables.measures(p, cells, comparisons),
        cue.cue_table(cue_contrasts),
        result_tables.by_training_setting(by_training_setting),
        result_tables.against_zero_shot(against_zero_shot),
        result_tables.learned_returns(learned_returns),
        result_tables.reward_quality(reward_quality),
        result_tables.comparisons(p, comparisons),
        result_tables.discriminators(discriminators),
        choice_table(chosen),
        result_tables.cells(cells),
        result_tables.budgets(p),
        result_tables.costs(p),
    ]
    found = [
        *caveats.missing(p),
        *caveats.stopped(points, assessments),
        *caveats.weak_experts(p, points, cells, assessments),
        *caveats.below_bar(p, points),
        *caveats.not_imitated(cells),
        *caveats.short_of_expert(learned_returns),
        *caveats.criteria(cells, verdicts=not (learned_returns.empty and reward_quality.empty)),
        *caveats.saturated(discriminators),
        *caveats.identical(episodes),
        *ablation.without_effect(p),
        *caveats.without_p(comparisons),
        *caveats.shared_demonstrations(p),
        *caveats.left_out(p),
        *caveats.mixed(p),
    ]
    return Report(
        points=points,
        cells=cells,
        comparisons=comparisons,
        by_training_setting=by_training_setting,
        against_zero_shot=against_zero_shot,
        learned_returns=learned_returns,
        discriminators=discriminators,
        reward_quality=reward_quality,
        cue_contrasts=cue_contrasts,
        choices=chosen,
        shares=shares,
        variants=variants,
        in_short=in_short(p, cells, comparisons),
        tables=[table for table in tables if table.rows],
        caveats=found,
    )


def as_json(report: Report) -> dict[str, Any]:
    """The report as JSON values; missing numbers are None."""
    return {field.name: _plain(getattr(report, field.name)) for field in fields(report)}


def _plain(part: pd.DataFrame | list[Table] | list[str]) -> list[Any]:
    if isinstance(part, pd.DataFrame):
        return part.astype(object).where(part.notna(), None).to_dict("records")
    return [item._asdict() if isinstance(item, Table) else item for item in part]
