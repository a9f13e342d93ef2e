"""Verification, and quarantine of damaged artefacts. Nothing is deleted."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import Busy, IntegrityError, IrlError, NewerFormat, NotFound
from irlcli.store.artefact import (
    Artefact,
    entries,
    output_problem,
    read_artefact,
    recorded_command,
    repair_hint,
)
from irlcli.store.index import Index
from irlcli.store.layout import Layout, claims
from irlcli.store.lease import Patience
from irlcli.store.lock import exclusive
from irlcli.store.manifest import MANIFEST, PROVENANCE, read_provenance


class Damage(NamedTuple):
    """The problems of an artefact, and the command that made it (empty if unknown).

    ``place`` is its path in quarantine; None if it was not moved. An artefact of a ``newer``
    schema cannot be checked and is not moved.
    """

    problems: list[str]
    command: str
    place: Path | None = None
    newer: bool = False


class Verified(NamedTuple):
    """Damaged artefacts by id, and the index of the sound ones. Those of a newer schema are in both."""

    damaged: dict[str, Damage]
    sound: Index


def problems(layout: Layout, id16: str, quick: bool = False) -> list[str]:
    """The problems of the artefact ``id16``; empty if it is sound. Changes nothing.

    ``quick`` compares the outputs' sizes instead of hashing them.

    Raises:
        NewerFormat: the artefact has a newer schema and cannot be checked.
    """
    return _examine(layout, id16, quick)[1]


def _examine(layout: Layout, id16: str, quick: bool) -> tuple[Artefact | None, list[str]]:
    """The artefact, if its manifest is sound, and its :func:`problems`."""
    try:
        artefact = read_artefact(layout.root / id16)
    except NewerFormat:
        raise
    except IntegrityError as error:
        return None, [error.message]
    try:
        return artefact, _file_problems(artefact, quick)
    except OSError as error:
        # For example a file that another process removes at this moment.
        return artefact, [f"{error.filename} cannot be read ({error.strerror})"]


def _file_problems(artefact: Artefact, quick: bool) -> list[str]:
    directory, manifest = artefact
    found = [
        problem
        for output in manifest.outputs
        if (problem := output_problem(directory, output, quick))
    ]
    try:
        read_provenance(directory, manifest.id)
    except IntegrityError as error:
        found.append(error.message)
    listed = (MANIFEST, PROVENANCE, *(output.path for output in manifest.outputs))
    known = {f"{directory}/{path}" for path in listed}
    found += [f"{path} is not in the manifest" for path in entries(directory) if path not in known]
    return found


def verify(layout: Layout, ids: Iterable[str], quick: bool) -> Verified:
    """Check artefacts and move the damaged ones to quarantine, except those of a newer schema."""
    found: dict[str, Damage] = {}
    sound, unknown = {}, {}
    for id16 in ids:
        try:
            artefact, failed = _examine(layout, id16, quick)
        except NewerFormat as error:
            found[id16] = Damage([f"{error.message}: {error.hint}"], "", newer=True)
            unknown[id16] = (layout.root / id16 / MANIFEST).read_bytes()
            continue
        if artefact is not None and not failed:
            sound[id16] = artefact
            continue
        command, place = recorded_command(layout.root / id16, layout), None
        if not layout.read_only:
            try:
                place = set_aside(layout, layout.root / id16)
            except FileNotFoundError:
                # Another process collected it or moved it to quarantine meanwhile.
                continue
            except OSError as error:
                failed.append(f"it could not be moved to quarantine ({error.strerror})")
            else:
                if place is None:
                    continue
        found[id16] = Damage(failed, command, place)
    return Verified(found, Index(sound, unknown))


def damaged(layout: Layout, directory: Path, problem: str) -> IrlError:
    """The error to raise for a damaged artefact, after moving it to quarantine."""
    name = f"artefact {directory.name}"
    hint = repair_hint(directory, layout)
    try:
        directory.lstat()
        if layout.read_only:
            return IntegrityError(f"{name} is damaged: {problem}", hint)
        place = set_aside(layout, directory)
    except FileNotFoundError:
        return NotFound(
            f"{name} is missing: another process removed it or moved it to quarantine",
            "run the same command again: it recomputes what is missing",
        )
    except OSError as error:
        return IntegrityError(
            f"{name} is damaged: {problem}; it could not be moved to quarantine ({error.strerror})",
            hint,
        )
    if place is None:
        return Busy(
            f"{name} was repaired by another process while it was read",
            "run the same command again",
        )
    return IntegrityError(f"{name} was damaged and is now in {place}: {problem}", hint)


def set_aside(layout: Layout, directory: Path) -> Path | None:
    """Move a damaged artefact to quarantine; None if it turns out to be sound.

    Raises:
        FileNotFoundError: the artefact is missing.
        OSError: it cannot be moved.
    """
    layout.quarantine.mkdir(exist_ok=True)
    with repairing(layout):
        # Another process may have replaced it since the problem was seen.
        directory.lstat()
        if not problems(layout, directory.name):
            return None
        for pointer, id16 in claims(layout):
            if id16 == directory.name:
                pointer.unlink(missing_ok=True)
        place = layout.quarantine / f"{directory.name}-{os.urandom(4).hex()}"
        # Moving a directory to another parent rewrites its "..", which needs write permission.
        if not directory.is_symlink():
            directory.chmod(0o755)
        directory.rename(place)
        return place


def quarantined(layout: Layout, id16: str) -> Path | None:
    """A path of the artefact in quarantine; None if it is not there."""
    places = sorted(layout.quarantine.glob(f"{id16}-*"))
    return places[-1] if places else None


def repairing(layout: Layout):
    """A lock: one process at a time removes damaged artefacts and pointers."""
    layout.locks.mkdir(exist_ok=True)
    return exclusive(layout.locks / "repair", Patience(wait=True))
