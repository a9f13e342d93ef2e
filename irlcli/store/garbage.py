"""Garbage collection: what is named, young or needed to resume is kept, with its ancestors."""

import os
import shlex
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import IntegrityError
from irlcli.store.artefact import Artefact, recorded_command, stored_inputs
from irlcli.store.durable import remove, remove_leftovers
from irlcli.store.index import Index
from irlcli.store.integrity import quarantined
from irlcli.store.layout import Layout, claims, make_directories
from irlcli.store.lease import Patience, live_reader
from irlcli.store.lock import exclusive, is_locked, lease_of
from irlcli.store.read import index as read_index
from irlcli.store.references import damaged_names, names
from irlcli.store.scratch import INPUTS


class Missing(NamedTuple):
    """A missing artefact and what refers to it.

    ``names`` point to it, and the artefacts ``made`` were made from it. ``place`` is its path in
    quarantine and ``command`` made it; None and empty if it is not there.
    """

    names: list[str]
    made: list[str]
    place: Path | None
    command: str

    def text(self, id16: str) -> str:
        """One line about the artefact ``id16``."""
        reasons = [f"the name {name!r} points to it" for name in self.names]
        if self.made:
            reasons += [
                f"{', '.join(self.made)} {'was' if len(self.made) == 1 else 'were'} made from it"
            ]
        where = f" (damaged, now in {self.place})" if self.place is not None else ""
        return f"{id16} is missing{where}: {'; '.join(reasons)}"


def garbage(
    layout: Layout, index: Index, grace_seconds: float, warn: Callable[[str], None]
) -> list[Artefact]:
    """All artefacts of ``index`` but those that are kept.

    Kept are named artefacts, those younger than the grace period [s], what a checkpoint younger than
    that needs, artefacts of a newer schema, whatever their manifests mention, and the ancestors of
    all these.
    """
    for name in damaged_names(layout):
        warn(f"{layout.names / name} is damaged: gc does not know what the name protects")
    for id16, lost in missing(layout, index).items():
        warn(f"{lost.text(id16)}; gc cannot protect the inputs of {id16}")
    limit = time.time() - grace_seconds
    young = [i for i, a in index.artefacts.items() if not _older(a.directory, limit)]
    resumed = [a.id for sha in _resumed_with(layout, limit) for a in index.holders(sha)]
    kept = index.reached_from([*names(layout).values(), *young, *resumed])
    return [artefact for id16, artefact in index.artefacts.items() if id16 not in kept]


def _resumed_with(layout: Layout, limit: float) -> Iterator[str]:
    """The sha256 of the inputs of runs that somebody may still resume."""
    for file in layout.work.glob(f"*/{INPUTS}"):
        # A link or a pipe is none of ours.
        if file.is_file() and not file.is_symlink() and not _older(file.parent, limit):
            with suppress(FileNotFoundError):
                yield from file.read_text(errors="replace").split()


def missing(layout: Layout, index: Index) -> dict[str, Missing]:
    """Artefacts that names or ancestors of named artefacts refer to but that do not exist, by id.

    Files from outside the store, and inputs whose provenance cannot be read, are not reported.
    ``index`` may be older than the store: artefacts published since are not missing.
    """
    pointers = names(layout)
    present = index.artefacts.keys() | index.newer.keys()
    found: dict[str, Missing] = {}

    def is_there(id16: str) -> bool:
        return id16 in present or (layout.root / id16).is_dir()

    def lost(id16: str) -> Missing:
        place = quarantined(layout, id16)
        command = "" if place is None else recorded_command(place, layout)
        return found.setdefault(id16, Missing([], [], place, command))

    for name, id16 in pointers.items():
        if not is_there(id16):
            lost(id16).names.append(name)
    for id16 in sorted(index.reached_from(pointers.values())):
        artefact = index.artefacts[id16]
        for source in _stored_inputs(artefact, index.orphaned(artefact)):
            if not is_there(source):
                lost(source).made.append(id16)
    return found


def stale_work(layout: Layout, grace_seconds: float) -> list[Path]:
    """Working directories that no process holds and that are older than the grace period [s]."""
    limit = time.time() - grace_seconds
    try:
        entries = sorted(layout.work.iterdir())
    except FileNotFoundError:
        return []
    return [
        path for path in entries if _older(path, limit) and not is_locked(layout.locks / path.name)
    ]


def collect(
    layout: Layout, grace_seconds: float, warn: Callable[[str], None]
) -> tuple[list[Artefact], list[Path]]:
    """Remove :func:`garbage` and :func:`stale_work`; returns what was removed.

    Temporary files of dead processes are removed too, those of other machines after a day.

    Raises:
        Busy: the store is in use.
        IntegrityError: the file of a name is damaged, so that what it protected is not known.
    """
    if not layout.marker.exists():
        return [], []
    make_directories(layout)
    no_patience = Patience(f"the store {layout.root}")
    with exclusive(layout.gc_lock, no_patience) as no_locks:
        if reader := live_reader(layout.locks, locks_work=no_locks is None):
            no_patience.meet(reader)
        if damaged := damaged_names(layout):
            raise IntegrityError(
                f"{layout.names / damaged[0]} is damaged, so gc does not know what the name protects",
                "name the artefact again: "
                f"`{shlex.join(['irl', 'name', 'REF', damaged[0], *layout.option])}`",
            )
        artefacts = garbage(layout, read_index(layout, warn), grace_seconds, warn)
        stale = stale_work(layout, grace_seconds)
        pointers: dict[str, list[Path]] = {}
        for pointer, id16 in claims(layout):
            pointers.setdefault(id16, []).append(pointer)
        removed, cleared = [], []
        for artefact in artefacts:
            try:
                if not artefact.directory.is_symlink():
                    artefact.directory.chmod(0o755)
            except PermissionError:
                warn(f"{artefact.directory} belongs to another user, who can remove it")
                continue
            for pointer in pointers.get(artefact.id, []):
                pointer.unlink(missing_ok=True)
                _remove_lock(layout.locks / pointer.name)
            # A unique name: an interrupted gc may have left an earlier, half-removed copy.
            grave = layout.work / f"removed-{artefact.id}-{os.urandom(4).hex()}"
            artefact.directory.rename(grave)
            remove(grave)
            removed.append(artefact)
        for work in stale:
            try:
                remove(work)
            except PermissionError:
                warn(f"{work} belongs to another user, who can remove it")
                continue
            _remove_lock(layout.locks / work.name)
            cleared.append(work)
        for directory in (layout.root, layout.keys, layout.names, layout.work, layout.locks):
            remove_leftovers(directory)
        return removed, cleared


def _remove_lock(path: Path) -> None:
    for file in (path, lease_of(path)):
        file.unlink(missing_ok=True)


def _stored_inputs(artefact: Artefact, roles: Iterable[str]) -> list[str]:
    """As :func:`irlcli.store.artefact.stored_inputs`; none if the provenance cannot be read."""
    try:
        return stored_inputs(artefact.provenance(), roles) if roles else []
    except IntegrityError:
        return []


def _older(path: Path, limit: float) -> bool:
    """Whether ``path`` exists and was last changed before ``limit`` [s since 1970]."""
    try:
        return path.stat().st_mtime < limit
    except FileNotFoundError:
        return False
