"""Copying an artefact and its ancestors from another store, every byte verified.

The other store is on disk or behind a URL (:mod:`irlcli.store.remote`). It is only read: nothing is
locked, moved or repaired there. A damaged artefact there is reported and treated as missing.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from irlcli.errors import IntegrityError
from irlcli.store.artefact import Artefact, Published
from irlcli.store.durable import unique_name
from irlcli.store.index import Index
from irlcli.store.layout import Layout
from irlcli.store.manifest import Manifest, Output, encode_provenance
from irlcli.store.publish import place_and_claim
from irlcli.store.read import held_by
from irlcli.store.scratch import Scratch

if TYPE_CHECKING:
    from irlcli.store.sources import Place

Warn = Callable[[str], None]
# Receives the number of bytes that were copied.
Advance = Callable[[int], None]


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
    layout: Layout, source: Place, artefact: Artefact, before: Sequence[Artefact], warn: Warn
) -> Published | None:
    """Publish verified copies of the ancestors ``before`` an artefact, and of the artefact itself.

    A copy has the same files, manifest and provenance, byte for byte, and so the same id. What is
    damaged in ``source`` is skipped with a warning.

    Returns:
        The published copy; None if the artefact is damaged in ``source``.

    Raises:
        OSError: the disk is full or not writable.
    """

    def copied(id16: str) -> Published | None:
        try:
            return receive(layout, source, id16)
        except IntegrityError as error:
            warn(f"not copying artefact {id16} from the store {source.root}: {error.message}")
            return None

    for ancestor in before:
        # Without a holder of its key, it was placed by a process that was killed before its claim.
        present = (layout.root / ancestor.id).exists()
        if not present or held_by(layout, ancestor.manifest.record.key) is None:
            copied(ancestor.id)
    published = copied(artefact.id)
    if published is not None:
        Scratch(layout.work / artefact.manifest.record.key).clear()
    return published


def receive(
    layout: Layout, source: Place, id16: str, advance: Advance = lambda _: None
) -> Published:
    """Publish a verified copy of one artefact.

    Raises:
        IntegrityError: it is damaged in ``source``; nothing is published.
        OSError: the disk is full or not writable.
    """
    # Not in the key's own working directory, where another process may be computing it.
    copy = layout.work / unique_name(f"copy-{id16}")
    copy.mkdir()
    try:
        manifest, provenance = source.contents(id16)
        for output in manifest.outputs:
            target = copy / output.path
            target.parent.mkdir(parents=True, exist_ok=True)
            with open(target, "xb") as file:
                for chunk in verified(source, id16, output):
                    file.write(chunk)
                    advance(len(chunk))
        return place_and_claim(layout, copy, manifest, encode_provenance(manifest.id, provenance))
    finally:
        shutil.rmtree(copy, ignore_errors=True)


def verified(source: Place, id16: str, output: Output) -> Iterator[bytes]:
    """The bytes of an output, in chunks.

    The digest is of the bytes that were yielded, so a file that changes meanwhile is noticed.

    Raises:
        IntegrityError: after the last of them, if they are not the published ones.
    """
    hasher, left = hashlib.sha256(), output.size
    for chunk in source.read(id16, output):
        hasher.update(chunk)
        left -= len(chunk)
        # No more than was announced is written anywhere.
        if left < 0:
            break
        yield chunk
    if left != 0 or hasher.hexdigest() != output.sha256:
        raise IntegrityError(
            f"{source.root}/{id16}/{output.path} is not the file that was stored: its sha256 differs"
        )


def check(source: Place, id16: str, manifest: Manifest) -> None:
    """Hash every output of an artefact.

    Raises:
        IntegrityError: the bytes of one are not the published ones.
    """
    for output in manifest.outputs:
        for _ in verified(source, id16, output):
            pass
