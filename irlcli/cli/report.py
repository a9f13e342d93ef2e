"""``irl report``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from irlcli.cli import complete, returns
from irlcli.cli import console as out
from irlcli.cli.experiments import (
    ChoosePenalty,
    Methods,
    Rows,
    Seeds,
    TableFile,
)
from irlcli.cli.options import Name, Out, stage_command
from irlcli.cli.session import StageSession
from irlcli.cli.table_report import (
    check_out,
    copy_outputs,
    print_report,
    report_json,
    report_of,
)
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.errors import UsageError
from irlcli.requests.tables import TableChoice, open_plan, warn_of_lost_results
from irlcli.store import Artefact

# What every report takes.
_OF_ALL = ("kind", "refs", "store", "as_json", "debug", "quiet", "wait")
_FORMS = ("text", "markdown", "latex")


@stage_command
def report(
    session: StageSession,
    context: typer.Context,
    kind: Annotated[
        str,
        typer.Argument(
            metavar="REPORT",
            help="returns, table2, or a table: table1, ...",
            autocompletion=complete.reports,
        ),
    ],
    refs: Annotated[list[str] | None, typer.Argument(help="Evaluations, for returns.")] = None,
    seeds: Seeds = None,
    methods: Methods = None,
    rows: Rows = None,
    choose_penalty: ChoosePenalty = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Format of table2: text, markdown or latex.",
            autocompletion=lambda: list(_FORMS),
        ),
    ] = None,
    file: TableFile = None,
    directory: Out = None,
    name: Name = None,
) -> None:
    """Print or write a table or figure from stored results.

    Examples: irl report returns REF..., irl report table1.
    """
    if kind not in ("returns", "table2") and refs:
        from irlcli.experiments.tables import REPORTS, load_table

        load_table(kind, file, REPORTS)
    if kind != "returns" and refs:
        raise UsageError(
            f"{kind} takes no references", "its results are found by their configuration"
        )
    match kind:
        case "returns":
            if not refs:
                raise UsageError("name at least one evaluation", "irl report returns REF...")
            _refuse(context, kind)
            _returns(session, refs)
        case "table2":
            _refuse(context, kind, "form")
            _table2(session, form)
        case _:
            chosen = TableChoice(kind, seeds, methods, rows, choose_penalty, file=file)
            if form is not None:
                raise UsageError(f"{kind} takes no --format", "omit --format")
            _table(session, chosen, name, directory)


def _refuse(context: typer.Context, kind: str, *allowed: str) -> None:
    """Refuse options that the report would ignore, because it runs no stage."""
    for option in context.command.params:
        name = option.name or ""
        given = context.get_parameter_source(name)
        if name in (*_OF_ALL, *allowed) or given is None or given.name != "COMMANDLINE":
            continue
        if context.params.get(name) != option.get_default(context):
            raise UsageError(f"{kind} takes no {option.opts[0]}", f"omit {option.opts[0]}")


def _table(
    session: StageSession, chosen: TableChoice, name: str | None, directory: Path | None
) -> None:
    """The report on a table of ``settings/experiments.toml``, from what exists."""
    from irlcli.experiments.tables import REPORTS

    plan = open_plan(session, chosen, REPORTS)
    warn_of_lost_results(plan, session.console.warn)
    if directory is not None:
        check_out(directory, session.store.root, plan.table)
    request = report_of(session, chosen, plan)

    def details(artefact: Artefact) -> dict[str, Any]:
        text = report_json(session, artefact)
        return {} if text is None else {"report": text}

    for artefact in session.deliver([request], name, details):
        if directory is not None:
            copy_outputs(session, artefact, directory, plan.table)
        if not session.as_json:
            print_report(session, artefact)


def _table2(session: StageSession, form: str | None) -> None:
    """Paper Table 2, from the settings files."""
    from irlcli.report.tables import latex_table, markdown_table

    if form is not None and session.as_json:
        raise UsageError(
            "table2 takes no --format with --json", "the JSON document holds the values"
        )
    if form not in (None, *_FORMS):
        raise UsageError(f"unknown --format {form!r}", f"known: {', '.join(_FORMS)}")
    listed = [
        (env, knob, values)
        for env, environment in ENVIRONMENTS.items()
        if not environment.tabular
        for knob, values in session.config(env).interventions.items()
    ]
    if session.as_json:
        items = [
            {"env": env, "knob": knob, "id": list(values.id), "ood": list(values.ood)}
            for env, knob, values in listed
        ]
        out.print_json("table2", {"rows": items})
        return
    columns = ["environment", "intervention", "values (ID)", "values (OOD)"]
    rows = [[env, knob, ", ".join(v.id), ", ".join(v.ood)] for env, knob, v in listed]
    match form:
        case "markdown":
            out.print_data(markdown_table(columns, rows).rstrip())
        case "latex":
            out.print_data(latex_table(columns, rows, "Interventional settings").rstrip())
        case _:
            out.print_table(columns, rows)


def _returns(session: StageSession, refs: Sequence[str]) -> None:
    from irlcli.experiments.circumstances import by_own_reward, circumstances
    from irlcli.experiments.references import evaluation
    from irlcli.report.returns import as_json

    named = [evaluation(session.store, ref) for ref in refs]
    index = session.store.index()
    measured = [
        (summary, circumstances(artefact, index), by_own_reward(artefact, index))
        for artefact, summary in named
    ]
    if session.as_json:
        out.print_json("returns", {"rows": as_json(measured)})
    else:
        returns.print_rows(measured)
