"""A table or figure of the paper from evaluations: numbers, statistics, plots, and one page.

Its inputs are evaluations and metrics, known by their content. What else it prints (which run took
how long, at which commit) are parameters, so that equal requests give equal bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from irlcli.report.lineage import demonstrations
from irlcli.report.parameters import (
    ASSESS,
    CUE,
    EXPERT_BY_REWARD,
    REWARD_LEARNING,
    TRANSFER_LEARNING,
    Cell,
    Parameters,
    curve_role,
)
from irlcli.stages.base import Job, Request, Source, Stage
from irlcli.store import read_json

if TYPE_CHECKING:
    import pandas as pd

    from irlcli.data.descriptions import AnyForm
    from irlcli.report import caveats, compute
    from irlcli.report.build import Report


def request(parameters: Parameters, sources: Mapping[str, Source]) -> Request:
    """The report on ``sources``: evaluations by :attr:`Cell.role`, and ``metrics.parquet`` files.

    The latter are ``ROW METHOD SEED reward-learning`` and ``... transfer-learning``. A chosen lambda
    has its ``choice.json``, by :func:`choice_role`. Outputs
    ``README.md``, ``KIND.csv`` (a row per cell), ``seeds.csv`` (a row per seed and setting),
    ``comparisons.csv``, with variants ``variants.csv`` and ``shares.csv``, ``KIND.json``, ``.tex``,
    ``.html``, ``.png`` and ``.pdf``; for each row with an assessed reward ``bank-ENV-KNOB.png``.
    """
    return Request(STAGE, parameters, dict(sources), f"report {parameters.kind}")


def choice_role(row: str, method: str, seed: int) -> str:
    """The role of the ``choice.json`` by which the lambda of a method and seed was chosen."""
    return f"{row} {method} {seed} penalty-choice"


def run(job: Job) -> None:
    """Read the evaluations, compute the statistics, lay them out."""
    import pandas as pd

    from irlcli.data import descriptions
    from irlcli.report import build

    p: Parameters = job.parameters
    learning = {
        role: _of_the_kept(pd.read_parquet(path))
        for role, path in job.inputs.items()
        if role.endswith((REWARD_LEARNING, TRANSFER_LEARNING))
    }
    rewards = {
        (row.name, method, seed): learning[role]
        for row in p.rows
        for method in p.methods
        for seed in p.seeds
        if (role := curve_role(row.name, method, seed, REWARD_LEARNING)) in learning
    }
    assessments = _of_rewards(job, ASSESS, "assessment.json", descriptions.Assessment)
    contrasts = _of_rewards(job, CUE, "cue.json", descriptions.CueContrast)
    choices = {
        (row.name, method, seed): descriptions.convert(
            read_json(job.inputs[role]), descriptions.PenaltyChoice, job.inputs[role]
        )
        for row in p.rows
        for method in p.methods
        for seed in p.seeds
        if (role := choice_role(row.name, method, seed)) in job.inputs
    }
    points = pd.DataFrame(_points(job))
    report = build.build(p, points, _episodes(job), rewards, assessments, contrasts, choices)
    _write(job, report, assessments, learning)


def _points(job: Job) -> list[dict[str, Any]]:
    """A row per evaluation and setting, see :mod:`irlcli.report.compute`."""
    from irlcli.data import descriptions

    points = []
    for cell in _filled(job.parameters):
        if cell.measure in (ASSESS, CUE):
            continue
        path = job.inputs[cell.role] / "summary.json"
        summary = descriptions.parse(read_json(path), descriptions.Evaluation, path)
        scored = cell.measure in ("transfer", EXPERT_BY_REWARD)
        of_expert = cell.agent in ("expert", "reused") or cell.measure == EXPERT_BY_REWARD
        errors = _errors(job, cell) if cell.measure == "transfer" else {}
        points += [
            {
                "row": cell.row,
                "agent": cell.agent,
                "measure": cell.measure,
                "seed": cell.seed,
                "retraining": cell.retraining,
                "expert_of": cell.setting if of_expert else "",
                "setting": measured.setting,
                "true_return": measured.mean_return,
                "progress": measured.mean_progress,
                "learned_return": measured.mean_learned_return if scored else None,
                "regret_error": errors.get((measured.setting, "true_return")),
                "gap_error": errors.get((measured.setting, "learned_return")),
                "episodes": measured.episodes,
                "stopped": measured.stopped,
                "evaluation": cell.run,
                "demonstrations": " ".join(demonstrations(job.parameters, [cell])),
            }
            for measured in summary.settings
            # In its own setting an expert is what the others are compared with, not a baseline.
            if cell.agent != "reused" or measured.setting != cell.setting
        ]
    return points


def _errors(job: Job, cell: Cell) -> dict[tuple[str, str], float]:
    """See :func:`irlcli.report.retrained.paired_errors`; none without the expert's evaluation."""
    import pandas as pd

    from irlcli.report.retrained import paired_errors

    experts = (
        other.role
        for other in _filled(job.parameters)
        if other.measure == EXPERT_BY_REWARD
        and (other.row, other.agent, other.seed) == (cell.row, cell.agent, cell.seed)
    )
    role = next(experts, None)
    if role is None:
        return {}
    policy, expert = (
        pd.read_parquet(job.inputs[r] / "episodes.parquet") for r in (cell.role, role)
    )
    return paired_errors(policy, expert)


def _episodes(job: Job) -> caveats.Episodes:
    """The true returns of what was learned, by (row, measure), then (agent, which)."""
    import pandas as pd

    p: Parameters = job.parameters
    shared: set[tuple[str, str]] = set()
    episodes: dict[tuple[str, str], dict[tuple[str, str], Any]] = {}
    for cell in _filled(p):
        if cell.seed is None or cell.measure not in p.measures:
            continue
        path = job.inputs[cell.role] / "episodes.parquet"
        returns = pd.read_parquet(path, columns=["true_return"])
        group = episodes.setdefault((cell.row, cell.measure), {})
        which = f"{cell.seed}"
        which += f" in {cell.setting}" if cell.setting else ""
        which += f" retraining {cell.retraining}" if cell.retraining else ""
        # Variants share whole runs by design; only different runs can be suspiciously equal.
        if not p.variants or (cell.row, cell.run) not in shared:
            group[cell.agent, which] = returns["true_return"].to_numpy()
        shared.add((cell.row, cell.run))
    return episodes


def _of_rewards(
    job: Job, measure: str, name: str, form: type[AnyForm]
) -> dict[tuple[str, str, int | None], AnyForm]:
    """What ``measure`` found of each reward, the file ``name``, by (row, method, seed)."""
    from irlcli.data import descriptions

    found = {}
    for cell in _filled(job.parameters):
        if cell.measure == measure:
            path = job.inputs[cell.role] / name
            found[cell.row, cell.agent, cell.seed] = descriptions.convert(
                read_json(path), form, path
            )
    return found


def _filled(p: Parameters) -> list[Cell]:
    return [cell for cell in p.cells if cell.run]


def _write(
    job: Job,
    report: Report,
    assessments: compute.Assessments,
    learning: Mapping[str, pd.DataFrame],
) -> None:
    from irlcli.data.outputs import write_csv, write_json
    from irlcli.report import build, page, plots, scatter

    p: Parameters = job.parameters
    write_csv(job.output / f"{p.kind}.csv", report.cells)
    # Baselines have no seed, and a float column would round the others.
    write_csv(job.output / "seeds.csv", report.points.astype({"seed": "Int64"}))
    write_csv(job.output / "comparisons.csv", report.comparisons)
    if p.variants:
        write_csv(job.output / "variants.csv", report.variants)
        write_csv(job.output / "shares.csv", report.shares)
    write_json(job.output / f"{p.kind}.json", build.as_json(report))
    (job.output / "README.md").write_text(page.markdown(p, report), encoding="utf-8")
    (job.output / f"{p.kind}.tex").write_text(page.latex(report), encoding="utf-8")
    points_svg = plots.draw_points(job.output, p, report)
    banks = scatter.draw_banks(job.output, p, assessments)
    curves = plots.learning_curves(p, learning)
    (job.output / f"{p.kind}.html").write_text(
        page.html(p, report, points_svg, banks, curves), encoding="utf-8"
    )


def _of_the_kept(metrics: pd.DataFrame) -> pd.DataFrame:
    """The rows of the restart that was kept."""
    return metrics[metrics["kept"]] if "kept" in metrics else metrics


STAGE = Stage("report", 47, run)
