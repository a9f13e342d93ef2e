"""``irl report``."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from irlcli.cli import arguments, returns
from irlcli.cli import console as out
from irlcli.cli.options import Name, stage_command
from irlcli.cli.session import StageSession
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.errors import UsageError, suggest
from irlcli.interventions import check_tabular
from irlcli.store import Artefact, read_json

_KINDS = ("returns", "experts", "table1", "figure2", "figure3", "figure4", "table2")
_FORMS = ("text", "markdown", "latex")


def _kinds(incomplete: str) -> list[str]:
    return list(_KINDS)


def _forms(incomplete: str) -> list[str]:
    return list(_FORMS)


@stage_command
def report(
    session: StageSession,
    kind: Annotated[str, typer.Argument(help=", ".join(_KINDS) + ".", autocompletion=_kinds)],
    refs: Annotated[list[str] | None, typer.Argument(help="Evaluations, for returns.")] = None,
    seeds: Annotated[
        str | None, typer.Option(help="Seeds of the reward learning. Default: 0,1,2,3,4.")
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help="Methods to compare, e.g. erm,irm. Default: all.")
    ] = None,
    env: Annotated[str | None, typer.Option(help="Only this environment's rows.")] = None,
    choose_penalty: Annotated[
        str | None, typer.Option(help="Candidates for lambda, as given to train-airl.")
    ] = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--format", help="Format of table2: text, markdown or latex.", autocompletion=_forms
        ),
    ] = None,
    name: Name = None,
) -> None:
    """Print or write a table or figure from stored results.

    Examples: irl report returns REF..., irl report table1.
    """
    if kind not in _KINDS:
        raise UsageError(f"unknown report {kind!r}", suggest(kind, _KINDS))
    options = {
        "--seeds": seeds,
        "--methods": methods,
        "--env": env,
        "--choose-penalty": choose_penalty,
        "--format": form,
        "--name": name,
    }
    if kind != "returns" and refs:
        raise UsageError(
            f"{kind} takes no references", "its results are found by their configuration"
        )
    match kind:
        case "returns":
            _refuse(kind, options)
            if not refs:
                raise UsageError(
                    "refs are missing: no evaluation is named", "irl report returns REF..."
                )
            _returns(session, refs)
        case "figure2":
            _refuse(kind, options, "--name")
            _figure2(session, name)
        case "experts":
            _refuse(kind, options, "--name", "--env")
            _experts(session, env, name)
        case "table2":
            _refuse(kind, options, "--format")
            _table2(session, form)
        case _:
            _refuse(kind, options, "--name", "--env", "--seeds", "--methods", "--choose-penalty")
            _experiment(session, kind, methods, seeds, env, choose_penalty, name)


def _refuse(kind: str, options: Mapping[str, Any], *allowed: str) -> None:
    for option, value in options.items():
        if value is not None and option not in allowed:
            taken = f"{kind} takes {', '.join(allowed)}" if allowed else f"omit {option}"
            raise UsageError(f"{kind} takes no {option}", taken)


def _experiment(
    session: StageSession,
    kind: str,
    methods: str | None,
    seeds: str | None,
    env: str | None,
    choose_penalty: str | None,
    name: str | None,
) -> None:
    from irlcli.experiments import matrix as experiments
    from irlcli.methods import METHODS

    chosen = tuple(METHODS) if methods is None else tuple(methods.split(","))
    numbers = arguments.seeds("0,1,2,3,4" if seeds is None else seeds)
    words = ["irl", "report", kind, *session.config_words()]
    words += ["--seeds", ",".join(map(str, numbers)), "--methods", ",".join(chosen)]
    words += [] if env is None else ["--env", env]
    candidates: Sequence[float] = ()
    if choose_penalty is not None:
        words += ["--choose-penalty", choose_penalty]
        candidates = arguments.weights(choose_penalty)
    request = experiments.request(
        kind,
        session.runner(),
        session.config,
        chosen,
        numbers,
        shlex.join(words),
        env,
        candidates,
    )
    _deliver(session, request, name, f"{kind}.json")


def _experts(session: StageSession, env: str | None, name: str | None) -> None:
    from irlcli.experiments import matrix as experiments

    words = ["irl", "report", "experts", *session.config_words()]
    words += [] if env is None else ["--env", env]
    if env is not None:
        check_tabular(env, "report experts", wanted=False)
    envs = [spec.name for spec in ENVIRONMENTS.values() if env in (None, spec.name)]
    envs = [name for name in envs if not ENVIRONMENTS[name].tabular]
    request = experiments.experts(session.runner(), session.config, shlex.join(words), envs)
    _deliver(session, request, name, "experts.json")


def _deliver(session: StageSession, request: Any, name: str | None, table: str) -> None:
    def read(artefact: Artefact) -> Any:
        return read_json(session.store.open(artefact, table))

    for artefact in session.deliver([request], name, lambda made: {"report": read(made)}):
        if not session.as_json:
            _print_report(read(artefact))


def _print_report(report: dict[str, Any]) -> None:
    for table in report["tables"]:
        if table["title"] != "Every cell":
            out.print_table(table["columns"], table["rows"], table["title"], stderr=True)
            out.print_note(f"{table['note']}\n" if table["note"] else "")
    for caveat in report["caveats"]:
        out.print_note(f"- {note}")


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


def _figure2(session: StageSession, name: str | None) -> None:
    from irlcli.stages import figure2

    env = "gridworld"
    config = session.config(env)
    settings = arguments.named_settings(env, config, "path-group", "id")
    unseen = arguments.unseen_settings(env, config)
    artefacts = session.deliver([figure2.request(env, settings, unseen, config)], name)
    if artefacts and not session.as_json:
        out.print_note(session.store.open(artefacts[0], "figure2.md").read_text().rstrip())


def _returns(session: StageSession, refs: Sequence[str]) -> None:
    from irlcli.experiments.references import by_own_reward, circumstances, evaluation

    named = [evaluation(session.store, ref) for ref in refs]
    index = session.store.index()
    measured = [
        (summary, circumstances(artefact, index), by_own_reward(artefact, index))
        for artefact, summary in named
    ]
    if session.as_json:
        out.print_json("returns", {"rows": returns.as_json(measured)})
    else:
        returns.print_rows(measured)
