"""``irl verify`` and ``irl gc``: damaged and unused artefacts."""

import shlex
from collections.abc import Iterable
from typing import Annotated, Any

import typer

from irlcli import labels
from irlcli.cli import console as out
from irlcli.cli.cluster import ended_submissions
from irlcli.cli.options import gc_command, store_command
from irlcli.cli.session import Session
from irlcli.errors import IntegrityError, UsageError
from irlcli.store import Artefact, Index

_DAY = 86400.0


@store_command
def verify(
    session: Session,
    ref: Annotated[str | None, typer.Argument(help="One artefact. Default: all.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Compare sizes only, without hashing.")
    ] = False,
) -> None:
    """Check stored bytes against their digests.

    Damaged artefacts are moved to quarantine.
    """
    if ref is None:
        session.check_exists()
        ids = session.store.ids()
    else:
        ids = [session.artefact(ref).id]
    found, index = session.store.verify(ids, quick)
    newer = [id16 for id16, damage in found.items() if damage.newer]
    damaged = {id16: damage for id16, damage in found.items() if not damage.newer}
    for id16 in newer:
        session.console.warn(f"not checked: {found[id16].problems[0]}")
    checked = len(ids) - len(newer)
    result: dict[str, Any] = {
        "checked": checked,
        "newer": newer,
        "damaged": {
            id16: {
                "problems": damage.problems,
                "command": damage.command,
                "quarantine": str(damage.place) if damage.place is not None else None,
            }
            for id16, damage in damaged.items()
        },
    }
    if damaged:
        for id16, damage in damaged.items():
            for problem in damage.problems:
                out.print_note(f"{id16}: {problem}")
            _print_command(id16, damage.command)
        if ref is None:
            _warn_of_names(session, index)
        moved = all(damage.place is not None for damage in damaged.values())
        was, are = ("was", "is") if len(damaged) == 1 else ("were", "are")
        state = f"{was} damaged and {are} now in quarantine" if moved else f"{are} damaged"
        raise IntegrityError(
            f"{len(damaged)} of {checked} artefacts {state}: {', '.join(damaged)}",
            "run the commands above again to recompute them; with `--from STORE` they copy what "
            "another store holds",
            result,
        )
    if ref is None:
        _check_missing(session, index, result)
    if session.as_json:
        out.print_json("verify", result)
    else:
        done = "have the right sizes (contents were not read)" if quick else "verified"
        out.print_data(f"{out.counted(checked, 'artefact')} {done}")


def _warn_of_names(session: Session, index: Index) -> None:
    """Warn of what :func:`_check_missing` refuses, beside an error that is worse."""
    lost = [*session.store.damaged_names()]
    lost += [name for made in session.store.missing(index).values() for name in made.names]
    if lost:
        session.console.warn(f"these names point to nothing now: {', '.join(sorted(lost))}")


def _check_missing(session: Session, index: Index, result: dict[str, Any]) -> None:
    """Fail if a name points to nothing; warn if only an ancestor of a named artefact is missing."""
    result["damaged_names"] = session.store.damaged_names()
    if result["damaged_names"]:
        raise IntegrityError(
            f"damaged names: {', '.join(result['damaged_names'])}",
            f"name the artefacts again: `{_naming(session)}`",
            result,
        )
    missing = session.store.missing(index)
    result["missing"] = {
        id16: {"names": lost.names, "made": lost.made, "command": lost.command or None}
        for id16, lost in missing.items()
    }
    for id16, lost in missing.items():
        if lost.names:
            out.print_note(lost.text(id16))
            _print_command(id16, lost.command)
        else:
            session.console.warn(lost.text(id16))
    names = sorted(name for lost in missing.values() for name in lost.names)
    if names:
        raise IntegrityError(
            f"{len(names)} of {len(session.store.names())} names point to nothing: "
            f"{', '.join(names)}",
            "run the command that made the artefact again, with its --name if it had one; or give "
            f"the name to another artefact (`{_naming(session)}`)",
            result,
        )


def _naming(session: Session) -> str:
    return shlex.join(["irl", "name", "REF", "NAME", *session.store.option])


def _print_command(id16: str, command: str) -> None:
    out.print_note(f"{id16}: made by: {command or 'a command whose record is lost'}")


@gc_command
def gc(
    session: Session,
    delete: Annotated[
        bool, typer.Option("--delete", help="Delete them. Default: only list them.")
    ] = False,
    grace_days: Annotated[
        float, typer.Option(min=0, help="Keep what is younger than this [days].")
    ] = 7.0,
) -> None:
    """List or delete artefacts that no name depends on, and old job logs."""
    if not grace_days >= 0:
        raise UsageError(f"--grace-days {grace_days} is not a number of days", "write 0 or more")
    from irlcli.experiments.cluster.records import LOCK, remove

    session.check_exists()
    grace = grace_days * _DAY
    if delete:
        # First of all: whoever submits jobs may hold it for long, and then nothing is deleted.
        with session.store.working_on(LOCK, wait=False, what="a submission of jobs"):
            artefacts, work = session.store.collect(grace)
            submissions = ended_submissions(session, grace)
            remove(submissions)
        known: Iterable[Artefact] = artefacts
    else:
        submissions = ended_submissions(session, grace)
        with session.reading():
            index = session.store.index()
            artefacts = session.store.garbage(grace, index)
            work = session.store.stale_work(grace)
        known = index.artefacts.values()
    size = sum(artefact.manifest.size for artefact in artefacts)
    if session.as_json:
        value = {"deleted": delete, "artefacts": [a.id for a in artefacts], "bytes": size}
        value |= {"work": [path.name for path in work]}
        value |= {"submissions": [path.name for path in submissions]}
        out.print_json("gc", value)
        return
    makers = labels.makers(artefact.manifest for artefact in known)
    for artefact in artefacts:
        record = artefact.manifest.record
        about = labels.describe(record) + labels.origin(record, makers)
        out.print_data(f"{artefact.id}  {record.stage}  {about}")
    for path in work:
        out.print_data(f"{path.name[:16]}  scratch of an interrupted run")
    for path in submissions:
        out.print_data(f"{path.name}  logs of jobs that have ended")
    verb = "removed" if delete else "would be removed (add --delete)"
    logs = f", {out.counted(len(submissions), 'submission')}" if submissions else ""
    scratch = f" and scratch of {out.counted(len(work), 'run')}" if work else ""
    young = f"; what is younger than {grace_days:g} days is kept (--grace-days)" if grace else ""
    out.print_note(
        f"{out.counted(len(artefacts), 'artefact')}, {size:,} bytes{logs}{scratch} {verb}{young}"
    )
