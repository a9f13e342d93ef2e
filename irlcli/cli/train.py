"""``irl train-airl`` and ``irl train-maxent``."""

from typing import Annotated, Any

import typer

from irlcli.cli import complete
from irlcli.cli import console as out
from irlcli.cli.options import Env, Name, Seed, stage_command
from irlcli.cli.session import StageSession
from irlcli.data.descriptions import Quality
from irlcli.experiments.references import output
from irlcli.requests import train as requested

_Grouping = Annotated[
    str | None,
    typer.Option(
        help="Demonstrations that share a risk: pooled, balanced, per-setting or shuffled.",
        autocompletion=complete.groupings,
    ),
]
_PenaltyWeight = Annotated[float | None, typer.Option(help="Weight of the penalty, lambda.")]


def _listed(learner: str) -> str:
    return f"Penalty: {', '.join(complete.penalties(learner))}."


@stage_command
def train_airl(
    session: StageSession,
    demos: Annotated[str, typer.Option(help="Artefact with demonstrations.")],
    method: Annotated[
        str | None,
        typer.Option(
            help=f"One of: {', '.join(name for name, _ in complete.methods())}. Default: erm.",
            autocompletion=complete.methods,
        ),
    ] = None,
    grouping: _Grouping = None,
    penalty: Annotated[
        str | None,
        typer.Option(help=_listed("airl"), autocompletion=lambda: complete.penalties("airl")),
    ] = None,
    penalty_weight: _PenaltyWeight = None,
    choose_penalty: Annotated[
        str | None,
        typer.Option(
            help="Choose lambda among these, e.g. 0.1,1,10, by leaving one setting out of training. "
            "own: the penalty's own candidates."
        ),
    ] = None,
    select: Annotated[
        str | None,
        typer.Option(
            help="Round to keep: last; episodes (the best on held-out episodes); or SETTING (the best "
            "in that setting, which is left out of training)."
        ),
    ] = None,
    state_only: Annotated[
        bool | None,
        typer.Option("--state-only/--no-state-only", help="Reward g(s) instead of g(s, a)."),
    ] = None,
    env: Env = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Learn a reward and a student policy from demonstrations."""
    request = requested.train_airl(
        session,
        demos=demos,
        method=method,
        grouping=grouping,
        penalty=penalty,
        penalty_weight=penalty_weight,
        choose_penalty=choose_penalty,
        select=select,
        state_only=state_only,
        env=env,
        seed=seed,
        name=name,
    )
    if request is not None:
        session.deliver([request], name)


@stage_command
def train_maxent(
    session: StageSession,
    demos: Annotated[str, typer.Option(help="Artefact with demonstrations in a gridworld.")],
    method: Annotated[
        str | None,
        typer.Option(
            help=f"One of: {', '.join(name for name, _ in complete.maxent_methods())}. Default: erm.",
            autocompletion=complete.maxent_methods,
        ),
    ] = None,
    grouping: _Grouping = None,
    penalty: Annotated[
        str | None,
        typer.Option(help=_listed("maxent"), autocompletion=lambda: complete.penalties("maxent")),
    ] = None,
    penalty_weight: _PenaltyWeight = None,
    l2: Annotated[float | None, typer.Option(help="Weight decay.")] = None,
    features: Annotated[str | None, typer.Option(help="learned or linear.")] = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Learn a reward from demonstrations in a gridworld, exactly."""
    request = requested.train_maxent(
        session,
        demos=demos,
        method=method,
        grouping=grouping,
        penalty=penalty,
        penalty_weight=penalty_weight,
        l2=l2,
        features=features,
        seed=seed,
    )
    artefacts = session.deliver([request], name)
    if artefacts and not session.as_json:
        _print_quality(session, artefacts[0])


def _print_quality(session: StageSession, artefact: Any) -> None:
    measures = ("goal_probability", "true_return", "value_difference", "rank_correlation")
    quality = output(session.store, artefact, "quality.json", Quality)
    rows = [
        [
            row.setting + ("" if row.seen else " (unseen)"),
            *(out.number(getattr(row, m), 2) for m in measures),
            f"{row.log_likelihood:.1f}",
        ]
        for row in quality.settings
    ]
    columns = ["setting", *(m.replace("_", " ") for m in measures), "log-likelihood"]
    out.print_table(columns, rows, stderr=True)
