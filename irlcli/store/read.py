"""Finding and opening artefacts. Everything is checked before it is used.

A damaged artefact is moved to quarantine as soon as it is read, except by :func:`peek` and in a
read-only store.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import IntegrityError, IrlError, NewerFormat, NotFound
from irlcli.store.artefact import Artefact, output_problem, read_artefact
from irlcli.store.index import Index
from irlcli.store.layout import Layout, is_id, pointed_to
from irlcli.store.manifest import MANIFEST


class Peek(NamedTuple):
    """The artefact that holds a key, or the reason why it cannot be used.

    Both are None if no artefact holds the key.
    """

    artefact: Artefact | None = None
    problem: str | None = None


def find(layout: Layout, key: str) -> Artefact | None:
    """The artefact that holds ``key``; None if there is none.

    Checks the manifest and the sizes of the outputs; hashes no output.

    Raises:
        IntegrityError: the artefact is damaged, and now in quarantine.
        NewerFormat: the artefact has a newer schema.
    """
    id16 = held_by(layout, key)
    if id16 is None:
        return None
    try:
        artefact = get(layout, id16)
    except NotFound:
        return None
    if artefact.manifest.record.key != key:
        return None
    problem = _size_problem(artefact)
    if problem is not None:
        raise _damaged(layout, artefact.directory, problem)
    return artefact


def peek(layout: Layout, key: str) -> Peek:
    """What :func:`find` would find, without changing anything.

    Raises:
        NewerFormat: the artefact has a newer schema.
    """
    try:
        id16 = held_by(layout, key)
        if id16 is None:
            return Peek()
        artefact = read_artefact(layout.root / id16)
    except NewerFormat:
        raise
    except IntegrityError as error:
        return Peek(problem=error.message)
    except OSError as error:
        return Peek(problem=f"{error.filename} cannot be read ({error.strerror})")
    if artefact.manifest.record.key != key:
        return Peek()
    problem = _size_problem(artefact)
    return Peek(artefact) if problem is None else Peek(problem=problem)


def held_by(layout: Layout, key: str) -> str | None:
    """The id that ``key`` points to, if that artefact exists.

    A missing artefact or a malformed pointer is a miss: computing the result repairs both.
    """
    id16 = pointed_to(layout.keys / key)
    return id16 if id16 is not None and (layout.root / id16).is_dir() else None


def get(layout: Layout, id16: str) -> Artefact:
    """The artefact in the directory ``id16``, its manifest checked.

    Raises:
        IntegrityError: the manifest is damaged; the artefact is now in quarantine.
        NewerFormat: the artefact has a newer schema.
        NotFound: there is no such artefact.
    """
    try:
        return read_artefact(layout.root / id16)
    except NewerFormat:
        raise
    except IntegrityError as error:
        raise _damaged(layout, layout.root / id16, error.message) from None


def open_output(layout: Layout, artefact: Artefact, path: str) -> Path:
    """The file of an output, its bytes checked against the manifest.

    Raises:
        NotFound: the artefact has no such output.
        IntegrityError: the bytes differ; the artefact is now in quarantine.
    """
    problem = output_problem(artefact.directory, artefact.output(path))
    if problem is not None:
        raise _damaged(layout, artefact.directory, problem)
    return artefact.directory / path


def ids(layout: Layout) -> list[str]:
    """The ids of all artefacts, sorted."""
    try:
        return sorted(entry.name for entry in os.scandir(layout.root) if is_id(entry.name))
    except FileNotFoundError:
        return []


def index(
    layout: Layout,
    warn: Callable[[str], None],
    on_damage: Callable[[IntegrityError], None] | None = None,
) -> Index:
    """All artefacts, each manifest read once.

    Artefacts of a newer schema are left out, each with a warning; in a read-only store, so are
    damaged ones, which stay where they are. ``on_damage`` is given each error of a damaged one.

    Raises:
        IntegrityError: as :func:`get`, unless the store is read-only or ``on_damage`` is given.
    """
    artefacts, newer, damaged = {}, {}, []
    for id16 in ids(layout):
        try:
            artefacts[id16] = get(layout, id16)
        except NotFound:
            # Another process removed it since ids() listed it.
            continue
        except NewerFormat as error:
            newer[id16] = (layout.root / id16 / MANIFEST).read_bytes()
            warn(f"skipping artefact {id16}: {error.message}; {error.hint}")
        except IntegrityError as error:
            if layout.read_only:
                damaged.append(id16)
                warn(f"skipping an artefact of the store {layout.root}: {error.message}")
            elif on_damage is None:
                raise
            else:
                on_damage(error)
    return Index(artefacts, newer, damaged)


def _size_problem(artefact: Artefact) -> str | None:
    found = (output_problem(artefact.directory, o, quick=True) for o in artefact.manifest.outputs)
    return next(filter(None, found), None)


def _damaged(layout: Layout, directory: Path, problem: str) -> IrlError:
    # Imported here: a sound store does not need it, and every hit imports this module.
    from irlcli.store.integrity import damaged

    return damaged(layout, directory, problem)
