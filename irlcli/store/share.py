"""Copying artefacts, with all that they were made from and their names, from one store to another.

Either store is on disk or behind a URL. Ancestors are copied first, so that an interrupted copy
leaves whole artefacts whose inputs are there too; the next one skips them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, NamedTuple

from irlcli.errors import IntegrityError, NewerFormat
from irlcli.store.artefact import Artefact, stored_inputs
from irlcli.store.substitute import Advance, ancestors, check

if TYPE_CHECKING:
    from irlcli.store.sources import Place


class Shared(NamedTuple):
    """What a copy did.

    Attributes:
        copied: artefacts that were copied now, ancestors first.
        present: artefacts that were there already.
        names: name to id, of those that point to one of them there.
        taken: name to the id of another artefact that has it there, and keeps it.
        diverged: id to that of the different result that holds the same key there, and keeps it.
    """

    copied: list[Artefact]
    present: list[Artefact]
    names: dict[str, str]
    taken: dict[str, str]
    diverged: dict[str, str]

    @property
    def bytes(self) -> int:
        """Bytes of the outputs that were copied."""
        return sum(artefact.manifest.size for artefact in self.copied)


def share(
    source: Place,
    target: Place,
    artefacts: Sequence[Artefact],
    warn: Callable[[str], None],
    start: Callable[[int, int], Advance],
    partial: bool = False,
) -> Shared:
    """Copy ``artefacts`` of ``source``, their ancestors and their names to ``target``.

    Args:
        warn: receives what is missing of the lineage.
        start: called once with the number of artefacts and of bytes to copy. It returns a function
            that is called with the size of each chunk.
        partial: skip, with a warning, artefacts that are damaged in ``source``, and those that were
            made from one, instead of raising.

    Raises:
        IntegrityError: a file is damaged in ``source``. Its artefact does not appear in
            ``target``, and neither does any that was made from it.
        OSError: a disk is full or not writable.
    """
    wanted = _with_ancestors(source, artefacts, warn, partial)
    target.create()

    def wait_for(holder: str) -> None:
        warn(f"waiting for {holder}, which removes artefacts of {target.root}")

    with target.in_use(wait=True, on_wait=wait_for):
        # Asked once: in a bucket, each question is a request.
        there = set(target.ids())
        held = {a.id for a in wanted if a.id in there and target.holds(a)}
        present = [a for a in wanted if a.id in held]
        copied = [a for a in wanted if a.id not in held]
        advance = start(len(copied), sum(a.manifest.size for a in copied))
        diverged = {}
        damaged: set[str] = set()
        for artefact in wanted:
            if artefact.id not in held:
                why = _lost(artefact, source, damaged)
                if not why:
                    try:
                        target.receive(source, artefact, advance)
                    except IntegrityError as error:
                        if not (partial and _is_damaged(source, artefact.id)):
                            raise
                        why = error.message
                if why:
                    warn(f"skipping artefact {artefact.id}: {why}")
                    damaged.add(artefact.id)
                    continue
            # Also of what was there: a copy may have been killed before this.
            holder = target.claim(artefact)
            if holder is not None:
                diverged[artefact.id] = holder
        copied = [a for a in copied if a.id not in damaged]
        members = {a.id: a for a in wanted if a.id not in damaged}
        names = {name: id16 for name, id16 in source.names().items() if id16 in members}
        holders = {name: target.claim_name(name, members[id16]) for name, id16 in names.items()}
    taken = {name: other for name, other in holders.items() if other is not None}
    given = {name: id16 for name, id16 in names.items() if name not in taken}
    return Shared(copied, present, given, taken, diverged)


def _lost(artefact: Artefact, source: Place, damaged: Collection[str]) -> str:
    """Which artefact of ``damaged`` this one was made from, as a sentence; empty if none."""
    made_from = ancestors(artefact, source.manifests(artefact.id)) if damaged else ()
    lost = [a.id for a in made_from if a.id in damaged]
    return f"{source.root}/{lost[0]}, from which it was made, is damaged" if lost else ""


def _is_damaged(source: Place, id16: str) -> bool:
    """Whether ``source`` itself, not the way to the target, changed an artefact's bytes."""
    try:
        manifest, _ = source.contents(id16)
        check(source, id16, manifest)
    except IntegrityError:
        return True
    return False


def _with_ancestors(
    source: Place, artefacts: Sequence[Artefact], warn: Callable[[str], None], partial: bool
) -> list[Artefact]:
    """``artefacts``, each after all that it was made from.

    ``partial``: without those that were made from a damaged one.
    """
    found: dict[str, Artefact] = {}
    for artefact in artefacts:
        index = source.manifests(artefact.id)
        members = [m for m in (*ancestors(artefact, index), artefact) if m.id not in found]
        try:
            for member in members:
                if orphaned := index.orphaned(member):
                    _check_missing(source, member, orphaned, warn)
        except IntegrityError as error:
            if not partial or isinstance(error, NewerFormat):
                raise
            warn(f"skipping artefact {artefact.id}, made from a damaged one: {error.message}")
            continue
        found |= {member.id: member for member in members}
    return list(found.values())


def _check_missing(
    source: Place, artefact: Artefact, roles: Sequence[str], warn: Callable[[str], None]
) -> None:
    """Warn of inputs that were artefacts once and are gone; refuse what is there but damaged."""
    for id16 in stored_inputs(source.contents(artefact.id)[1], roles):
        if id16 in source.ids():
            source.contents(id16)
            raise IntegrityError(f"{source.root}/{id16} is not what {artefact.id} was made from")
        warn(f"{id16} is missing in {source.root}: {artefact.id} was made from it")
