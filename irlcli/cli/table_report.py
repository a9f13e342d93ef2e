"""The report on a table of ``settings/experiments.toml``: its request, its text, its files."""

import itertools
import os
import re
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from irlcli.cli import console as out
from irlcli.cli.session import StageSession
from irlcli.configs import PROFILES
from irlcli.errors import NotFound, StageFailed, UsageError
from irlcli.report.tables import EVERY_CELL
from irlcli.requests.tables import TableChoice, needs_tag
from irlcli.store import Artefact, read_json

if TYPE_CHECKING:
    from irlcli.experiments.plan import Plan
    from irlcli.experiments.tables import Table
    from irlcli.stages.base import Request


def report_of(session: StageSession, choice: TableChoice, plan: "Plan") -> "Request":
    """The report on what the store holds of a whole table.

    Raises:
        NotFound: the store holds nothing of it, or of a figure not every step.
    """
    from irlcli.experiments import report

    # A figure's request is made from the steps themselves, so running it would compute them.
    if plan.figure is not None:
        missing = sum(not plan.exists(name) for name in plan.tasks)
        if missing:
            raise NotFound(
                f"{session.store.root} lacks {missing} of {len(plan.tasks)} steps of {choice.table}",
                f"`{_run_line(session, choice)}` makes them",
            )
    words = ["irl", "report", choice.table, *session.config_words(), *choice.words()]
    try:
        return report.request(plan, shlex.join(words))
    except NotFound as error:
        error.hint = (
            f"{_named(session, plan)}`{_run_line(session, choice)}` makes them. --profile, --set, --seeds "
            "and --methods must be those of the runs"
        )
        raise


def _named(session: StageSession, plan: "Plan") -> str:
    """Which results that the table reports have names in the store, for the hint."""
    tag = f"{plan.selection.tag}."
    reported = {name.removeprefix(tag) for name, t in plan.tasks.items() if t.cell is not None}
    there = set(session.store.ids())
    named = [name for name, id16 in session.store.names().items() if id16 in there]
    found = {first for first, _, rest in (n.partition(".") for n in named) if rest in reported}
    if plan.selection.tag in found:
        return "its results in the store have other keys: another config, or changed code. "
    if plan.table.settings is not None:
        # Its names are those of no profile.
        return ""
    profiles = [f"--profile {name}" for name in PROFILES if name in found]
    return f"there are results of {' and '.join(profiles)}. " if profiles else ""


def _run_line(session: StageSession, choice: TableChoice) -> str:
    """The command line that makes what a report on ``choice`` lacks, for a hint."""
    tag = ["--tag", "NAME"] if needs_tag(session, choice) else []
    return session.suggestion("run", choice.table, *choice.words(), *tag)


def check_out(directory: Path, store: Path, table: "Table") -> None:
    """Refuse a directory for the files of a report on ``table`` before any work is done.

    Raises:
        UsageError: it lies in the store, or holds something else than such a report.
    """
    if Path(os.path.realpath(directory)).is_relative_to(os.path.realpath(store)):
        raise UsageError(f"--out {directory} lies in the store", "name another directory")
    numbers = directory / _numbers(table)
    # Hidden files: of a copy that was killed, or of the system.
    others = directory.is_dir() and any(path.name[0] != "." for path in directory.iterdir())
    if others and not numbers.exists():
        raise UsageError(
            f"--out {directory} is not empty and holds no report on {table.name}: it has no "
            f"{numbers.name}",
            "name another directory",
        )


def _numbers(table: "Table") -> str:
    """The file with the numbers of every report on ``table``."""
    return f"{table.name if table.kind == 'comparison' else table.kind}.csv"


def copy_outputs(
    session: StageSession, artefact: Artefact, directory: Path, table: "Table"
) -> None:
    """Copy the verified outputs of ``artefact``, a report on ``table``, to ``directory``.

    Raises:
        StageFailed: the directory cannot be written.
    """
    try:
        # The numbers first: by them check_out knows the directory again.
        of = sorted(artefact.manifest.outputs, key=lambda one: one.path != _numbers(table))
        for output in of:
            target = directory / output.path
            target.parent.mkdir(parents=True, exist_ok=True)
            # Whole or absent, also if this process is killed.
            beside = target.with_name(f".{target.name}.{os.getpid()}")
            try:
                shutil.copyfile(session.store.open(artefact, output.path), beside)
                beside.replace(target)
            finally:
                beside.unlink(missing_ok=True)
    except OSError as error:
        raise StageFailed(
            f"--out {directory} cannot be written: {error.strerror or error}",
            f"the report is in {artefact.directory}",
        ) from None


def print_report(session: StageSession, artefact: Artefact) -> None:
    """A report's tables, caveats and result on stderr, with the note of the first table only."""
    _warn_of_versions(session, artefact)
    report = report_json(session, artefact)
    if report is None:
        _print_page(session.store.open(artefact, "README.md").read_text(encoding="utf-8"))
        return
    shown = [table for table in report["tables"] if table["title"] != EVERY_CELL]
    for table in shown:
        out.print_table(table["columns"], table["rows"], table["title"], stderr=True)
        out.print_note(f"{table['note']}\n" if table is shown[0] else "")
    if any(table["note"] for table in shown[1:]):
        out.print_note("The report's README.md explains the columns of the other tables.\n")
    for heading, lines in (("Caveats", report["caveats"]), ("In short", report.get("in_short"))):
        if lines:
            out.print_note("\n".join([f"{heading}:", *(f"- {line}" for line in lines), ""]))


def _print_page(page: str) -> None:
    """A page of Markdown on stderr, with its tables as tables and without its pictures."""
    for is_table, block in itertools.groupby(page.splitlines(), lambda line: line[:1] == "|"):
        if is_table:
            head, _, *rows = [line.strip("| ").split(" | ") for line in block]
            out.print_table(head, rows, stderr=True)
        else:
            kept = "\n".join(line for line in block if not line.startswith("!["))
            out.print_note(
                re.sub("\n{3,}", "\n\n", kept).strip("\n") + "\n" if kept.strip() else ""
            )


def _warn_of_versions(session: StageSession, artefact: Artefact) -> None:
    """Warn of artefacts in a report that were made with other library versions than those present."""
    from irlcli.experiments.provenance import other_versions

    parameters = artefact.manifest.record.parameters
    names = [made["libraries"] for made in parameters.get("runs", {}).values()]
    for name, versions in parameters.get("libraries", {}).items():
        others = other_versions({"libraries": versions})
        if others:
            session.console.warn(
                f"other library versions made {out.counted(names.count(name), 'artefact')} of this "
                f"report: {', '.join(others)}"
            )


def report_json(session: StageSession, artefact: Artefact) -> Any | None:
    """The tables of a report as JSON; None if it has none."""
    # A comparison's file has the name of its table, that of experts does not.
    names = [output.path for output in artefact.manifest.outputs if output.path.endswith(".json")]
    return read_json(session.store.open(artefact, names[0])) if names else None
