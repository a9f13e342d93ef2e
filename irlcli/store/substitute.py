"""Copying an artefact and its ancestors from another store, every byte verified.

The other store is only read: nothing is locked, moved or repaired there. A damaged artefact there
is reported and treated as missing.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from irlcli.errors import IntegrityError
from irlcli.store.artefact import Artefact, Published, read_artefact
from irlcli.store.durable import unique_name
from irlcli.store.index import Index
from irlcli.store.integrity import problems
from irlcli.store.layout import Layout
from irlcli.store.manifest import Manifest, encode_provenance, read_provenance
from irlcli.store.publish import place_and_claim
from irlcli.store.read import held_by, ids
from irlcli.store.scratch import Scratch

Warn = Callable[[str], None]
_CHUNK = 1 << 20


def sound_manifests(layout: Layout, warn: Warn) -> Index:
    """The artefacts of another store; those with unreadable manifests are skipped with a warning."""
    artefacts = {}
    for id16 in ids(layout):
        try:
            artefacts[id16] = read_artefact(layout.root / id16)
        except IntegrityError as error:
            warn(f"skipping artefact {id16} of the store {layout.root}: {error.message}")
    return Index(artefacts, {})


def ancestors(artefact: Artefact, index: Index) -> list[Artefact]:
    """The artefacts of ``index`` that ``artefact`` was made from, each after its own ancestors."""
    found: dict[str, Artefact] = {}
    # Equal files are one content, so an artefact can seem to be made from its own descendants.
    visited = {artefact.id}

    def visit(child: Artefact) -> None:
        for holders in index.parents(child).values():
            for parent in holders:
                if parent.id not in visited:
                    visited.add(parent.id)
                    visit(parent)
                    found[parent.id] = parent

    visit(artefact)
    return list(found.values())


def adopt(
    layout: Layout, source: Layout, artefact: Artefact, before: Sequence[Artefact], warn: Warn
) -> Published | None:
    """Publish verified copies of the ancestors ``before`` an artefact, and of the artefact itself.

    A copy has the same files, manifest and provenance, byte for byte, and so the same id. What is
    damaged in ``source`` is skipped with a warning.

    Returns:
        The published copy; None if the artefact is damaged in ``source``.

    Raises:
        OSError: the disk is full or not writable.
    """
    for ancestor in before:
        # Without a holder of its key, it was placed by a process that was killed before its claim.
        present = (layout.root / ancestor.id).exists()
        if not present or held_by(layout, ancestor.manifest.record.key) is None:
            _adopt_one(layout, source, ancestor.id, warn)
    published = _adopt_one(layout, source, artefact.id, warn)
    if published is not None:
        Scratch(layout.work / artefact.manifest.record.key).clear()
    return published


def _adopt_one(layout: Layout, source: Layout, id16: str, warn: Warn) -> Published | None:
    # Not in the key's own working directory, where another process may be computing an ancestor.
    copy = layout.work / unique_name(f"copy-{id16}")
    copy.mkdir()
    try:
        manifest, provenance = _copy(source, id16, copy)
        return place_and_claim(layout, copy, manifest, provenance)
    except _Unusable as error:
        warn(f"not copying artefact {id16} from the store {source.root}: {error}")
        return None
    finally:
        shutil.rmtree(copy, ignore_errors=True)


class _Unusable(Exception):
    """The other store's artefact is damaged or unreadable."""


def _copy(source: Layout, id16: str, copy: Path) -> tuple[Manifest, bytes]:
    """Copy the outputs of an artefact; returns its manifest and its ``provenance.json``."""
    directory = source.root / id16
    try:
        # Finds damaged JSON, wrong sizes, symbolic links and unlisted files before any copying.
        found = problems(source, id16, quick=True)
        if found:
            raise _Unusable(found[0])
        manifest = read_artefact(directory).manifest
        provenance = read_provenance(directory, manifest.id)
    except IntegrityError as error:
        raise _Unusable(error.message) from None
    for output in manifest.outputs:
        target = copy / output.path
        target.parent.mkdir(parents=True, exist_ok=True)
        # The digest is of the bytes written, so a file that changes meanwhile is noticed.
        hasher = hashlib.sha256()
        with open(target, "xb") as file:
            for chunk in _chunks(directory / output.path):
                hasher.update(chunk)
                file.write(chunk)
        if hasher.hexdigest() != output.sha256:
            raise _Unusable(f"{directory / output.path} differs from the published bytes")
    return manifest, encode_provenance(manifest.id, provenance)


def _chunks(path: Path) -> Iterator[bytes]:
    try:
        with open(path, "rb") as file:
            while chunk := file.read(_CHUNK):
                yield chunk
    except OSError as error:
        raise _Unusable(f"{path} cannot be read ({error.strerror})") from None
