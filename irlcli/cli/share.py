"""``irl push`` and ``irl pull``: artefacts from one store to another."""

import os
import shlex
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from irlcli.cli import console as out
from irlcli.cli.options import store_command
from irlcli.cli.session import Session
from irlcli.errors import (
    IntegrityError,
    NewerFormat,
    NotFound,
    StageFailed,
    UsageError,
    file_failure,
)
from irlcli.store import Artefact

if TYPE_CHECKING:
    from irlcli.store.share import Shared
    from irlcli.store.sources import Place
    from irlcli.store.substitute import Advance

_Refs = Annotated[
    list[str] | None, typer.Argument(metavar="REF...", help="Artefacts: names or id prefixes.")
]
_All = Annotated[bool, typer.Option("--all", help="All artefacts.")]
_Quiet = Annotated[bool, typer.Option("--quiet", help="No progress on stderr.")]


@store_command
def push(
    session: Session,
    refs: _Refs = None,
    *,
    to: Annotated[str, typer.Option("--to", help="Store: a directory or a URL.")],
    everything: _All = False,
    quiet: _Quiet = False,
) -> None:
    """Copy artefacts and all they were made from to a directory or URL.

    Artefacts that the destination already has are skipped. Names are copied, too.
    """
    from irlcli.store.sources import open_place

    place = open_place(to, session.console.warn)
    session.check_exists()
    source: Place = session.store
    if everything:
        # Otherwise the first damaged artefact would be moved to quarantine, and end the command.
        source = open_place(source.root, session.console.warn, read_only=True)
    artefacts, unread = _chosen(source, session.artefact, refs, everything)
    label = f"push to {place.root}"
    _share(session, source, place, artefacts, label, quiet, everything, unread)


@store_command
def pull(
    session: Session,
    refs: _Refs = None,
    *,
    source: Annotated[str, typer.Option("--from", help="Store: a directory or a URL.")],
    everything: _All = False,
    quiet: _Quiet = False,
) -> None:
    """Copy artefacts and all they were made from out of a directory or URL.

    Artefacts that this store already has are skipped. Names are copied, too; a name that already
    exists here keeps its artefact.
    """
    from irlcli.store.sources import open_sources

    (place,) = open_sources([source], session.console.warn)

    def there(ref: str) -> Artefact:
        artefact = place.resolve(ref).artefact
        if artefact is None:
            raise NotFound(f"{ref!r} is not an artefact")
        return artefact

    try:
        artefacts, unread = _chosen(place, there, refs, everything)
    except NotFound as error:
        listing = shlex.join(["irl", "ls", "--from", str(place.root)])
        raise NotFound(
            f"{place.root}: {error.message}", f"`{listing}` lists what is there"
        ) from None
    except NewerFormat:
        raise
    except IntegrityError as error:
        error.hint = _damaged_there(place)
        raise
    label = f"pull from {place.root}"
    _share(session, place, session.store, artefacts, label, quiet, everything, unread)


def _chosen(
    store: "Place", find: Callable[[str], Artefact], refs: list[str] | None, everything: bool
) -> tuple[list[Artefact], list[str]]:
    """The artefacts of ``store`` that a command line names, each once; ``find`` looks one up.

    With ``--all`` also the ids of those whose manifests are damaged.
    """
    if refs and everything:
        raise UsageError("REF and --all are both given", "give one of them")
    if everything:
        index = store.index()
        return list(index.artefacts.values()), list(index.damaged)
    if not refs:
        raise UsageError("name artefacts, or give --all", "either REF... or --all")
    return list({artefact.id: artefact for artefact in map(find, refs)}.values()), []


def _share(
    session: Session,
    source: "Place",
    target: "Place",
    artefacts: list[Artefact],
    label: str,
    quiet: bool,
    everything: bool,
    unread: list[str],
) -> None:
    """Copy ``artefacts`` and print what was copied; ``unread`` are ids of those that cannot be."""
    if os.path.realpath(source.root) == os.path.realpath(target.root):
        raise UsageError(f"{label}: that is this store itself", "name another one")
    console = out.TerminalConsole(quiet)
    try:
        shared = _copied(source, target, artefacts, label, console, everything)
    finally:
        console.close()
    for name, holder in shared.taken.items():
        console.warn(
            f"{target.root} already uses the name {name!r} for {holder}, so {name!r} was not copied"
        )
    for id16, holder in shared.diverged.items():
        console.warn(
            f"{id16} is kept beside {holder}: the same request gave {holder} in {target.root}, and "
            "commands find that one"
        )
    console.say(
        f"{out.counted(len(shared.copied), 'artefact')}, {shared.bytes:,} bytes copied to {target.root}; "
        f"{len(shared.present)} there already"
    )
    there = {artefact.id for artefact in (*shared.copied, *shared.present)}
    paths = {a.id: f"{target.root}/{a.id}" for a in artefacts if a.id in there}
    left_out = [*unread, *(artefact.id for artefact in artefacts if artefact.id not in there)]
    document: dict[str, Any] = {
        "artefacts": [{"id": id16, "path": path} for id16, path in paths.items()],
        "copied": [a.id for a in shared.copied],
        "present": [a.id for a in shared.present],
        "bytes": shared.bytes,
        "names": shared.names,
        "names_kept": shared.taken,
        "diverged": shared.diverged,
        "left_out": left_out,
    }
    if not session.as_json:
        for path in paths.values():
            out.print_data(path)
    if left_out:
        raise IntegrityError(
            f"{out.counted(len(left_out), 'artefact')} of {source.root} not copied, damaged or made from "
            f"damaged ones: {', '.join(left_out)}",
            _damaged_there(source),
            document,
        )
    if session.as_json:
        out.print_json("shared", document)


def _copied(
    source: "Place",
    target: "Place",
    artefacts: list[Artefact],
    label: str,
    console: out.TerminalConsole,
    everything: bool,
) -> "Shared":
    """Copy ``artefacts``, with progress.

    Raises:
        StageFailed: a file cannot be read or written.
        IntegrityError: an artefact is damaged.
    """
    from irlcli.store.share import share

    def start(count: int, total: int) -> "Advance":
        done = 0
        if count:
            console.start(label, resumed=False)

        def advance(number: int) -> None:
            nonlocal done
            done += number
            console.progress(done, total, "bytes", {})

        return advance

    try:
        return share(source, target, artefacts, console.warn, start, partial=everything)
    except OSError as error:
        raise StageFailed(
            f"{label}: {file_failure(error).message}",
            "whole artefacts that were copied are kept; run the same command again for the others",
        ) from None
    except IntegrityError as error:
        # The place to copy to can be at fault, too.
        if error.message.startswith(f"{source.root}/") and not isinstance(error, NewerFormat):
            error.hint = _damaged_there(source)
        raise


def _damaged_there(place: "Place") -> str:
    """What to do about damaged artefacts of ``place``."""
    if not isinstance(place.root, os.PathLike):
        return f"remove what is damaged in {place.root}, then push it again"
    line = shlex.join(["irl", "verify", "--store", str(place.root)])
    return (
        f"`{line}` moves what is damaged to quarantine and prints the commands that make it again"
    )
