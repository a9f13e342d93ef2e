"""What a user may write to refer to an artefact: a path, a name, or an id prefix."""

import fnmatch
import os
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import NotFound, UsageError, closest
from irlcli.store.artefact import Artefact, repair_hint
from irlcli.store.durable import fsync_directory, temporary_file, write_durably
from irlcli.store.layout import (
    DEFAULT_ROOT,
    ID_DIGITS,
    Layout,
    is_name,
    is_prefix,
    pointed_to,
    pointer_to,
)
from irlcli.store.read import get, ids


class Resolved(NamedTuple):
    """What a reference names: an artefact or one of its outputs, or a path outside the store."""

    artefact: Artefact | None
    path: Path

    @property
    def output(self) -> str | None:
        """The output's path inside the artefact; None if the reference names all of it."""
        if self.artefact is None or self.path == self.artefact.directory:
            return None
        return self.path.relative_to(self.artefact.directory).as_posix()


def resolve(layout: Layout, ref: str) -> Resolved:
    """What ``ref`` names.

    Either a name or a unique id prefix (at least 3 digits), alone, before ``/OUTPUT``, or in a
    path below the store's directory or below ``runs/``, which stands for any store; or an
    existing file or directory outside the store.

    Raises:
        NotFound: nothing matches, or more than one artefact.
        IntegrityError: the artefact is damaged.
    """
    below = _below(os.path.abspath(layout.root), os.path.abspath(ref))
    text = ref.rstrip("/") if below is None else below
    found = _inside(layout, text)
    if found is None and below is None:
        # The store, or a directory above it, may be known by several names: `runs` is a link, say.
        with suppress(ValueError):  # No path has such characters.
            below = _below(os.path.realpath(layout.root), os.path.realpath(ref))
        if below is not None:
            text = below
            found = _inside(layout, text)
    if found is None and below is None:
        if os.path.exists(ref):
            return Resolved(None, Path(ref))
        # A path printed by a run with the default store, used with a store elsewhere.
        default, _, rest = os.path.normpath(text).partition("/")
        if default == DEFAULT_ROOT and rest:
            text = rest
            found = _inside(layout, text)
    if found is None:
        raise _unknown(layout, ref, text)
    return found


def _below(root: str, path: str) -> str | None:
    """``path`` relative to ``root``; None if it is not below it."""
    return os.path.relpath(path, root) if path.startswith(root + os.sep) else None


def _unknown(layout: Layout, ref: str, text: str) -> NotFound:
    """Why ``ref`` names nothing; ``text`` is what it would be inside the store."""
    pull = shlex.join(["irl", "pull", "NAME", "--from", "STORE", *layout.option])
    if not layout.root.exists():
        return NotFound(
            f"{ref!r} names no file, and there is no store at {layout.root}",
            f"choose another store with --store or IRL_STORE; `{pull}` copies it into a new one",
        )
    from irlcli.store.integrity import quarantined

    head = text.partition("/")[0]
    if head in damaged_names(layout):
        naming = shlex.join(["irl", "name", "REF", head, *layout.option])
        return NotFound(
            f"the name {head!r} is damaged", f"name it again: `{naming}`; {layout.listing}"
        )
    if is_prefix(head) and quarantined(layout, head) is not None:
        return _missing(layout, f"artefact {head}", head)
    listing = f"{layout.listing}, `{pull}` copies one from another store"
    close = closest(head, names(layout))
    if close is not None:
        listing = f"did you mean {close!r}? {listing}"
    elif re.fullmatch("[0-9a-f]{1,2}", text):
        listing = f"write at least 3 digits of an id; {listing}"
    return NotFound(f"{ref!r} names no artefact and no file", listing)


def _inside(layout: Layout, text: str) -> Resolved | None:
    """An artefact, or ``artefact/output``, for a path relative to the store."""
    head, _, rest = text.partition("/")
    if os.path.isabs(text) or head in ("", ".", ".."):
        return None
    artefact = _by_name(layout, head) or _by_prefix(layout, head)
    if artefact is None:
        return None
    if not rest:
        return Resolved(artefact, artefact.directory)
    # Only what the manifest lists is an output, so no path leads out of the artefact.
    artefact.output(rest)
    return Resolved(artefact, artefact.directory / rest)


def _by_name(layout: Layout, name: str) -> Artefact | None:
    id16 = named(layout, name)
    if id16 is None:
        return None
    if not (layout.root / id16).is_dir():
        raise _missing(layout, f"the name {name!r} points to {id16}, which", id16)
    return get(layout, id16)


def _missing(layout: Layout, subject: str, id16: str) -> NotFound:
    from irlcli.store.integrity import quarantined

    place = quarantined(layout, id16)
    if place is None:
        return NotFound(
            f"{subject} is missing",
            "run the command that made it again, with --name; or copy it from another store (`irl pull "
            "REF --from STORE`); or name another artefact (`irl name`)",
        )
    return NotFound(f"{subject} was damaged and is now in {place}", repair_hint(place, layout))


def _by_prefix(layout: Layout, prefix: str) -> Artefact | None:
    if not is_prefix(prefix):
        return None
    short = prefix[:ID_DIGITS]
    if len(short) == ID_DIGITS:
        # A whole id is looked up directly, without listing the store.
        matches = [short] if os.path.lexists(layout.root / short) else []
    else:
        matches = [name for name in ids(layout) if name.startswith(short)]
    if len(matches) > 1:
        shown = ", ".join(matches[:5]) + (", ..." if len(matches) > 5 else "")
        raise NotFound(f"{prefix!r} is ambiguous: {shown}", "write more digits of the id")
    if not matches:
        return None
    artefact = get(layout, matches[0])
    return artefact if artefact.manifest.id.startswith(prefix) else None


def names(layout: Layout) -> dict[str, str]:
    """Name to id, sorted by name."""
    found = {name: named(layout, name) for name in _pointers(layout)}
    return {name: id16 for name, id16 in found.items() if id16 is not None}


def damaged_names(layout: Layout) -> list[str]:
    """The names whose file does not contain an id."""
    return [name for name in _pointers(layout) if named(layout, name) is None]


def _pointers(layout: Layout) -> list[str]:
    try:
        return sorted(path.name for path in layout.names.iterdir() if is_name(path.name))
    except FileNotFoundError:
        return []


def named(layout: Layout, name: str) -> str | None:
    """The id that ``name`` points to. Reads one file, however many names exist."""
    return pointed_to(layout.names / name) if is_name(name) else None


def check_name(name: str) -> None:
    """Refuse an invalid name.

    Raises:
        UsageError: the name has other characters than letters, digits and ``._-``, does not
            begin with a letter, reads as an id prefix, or stands for any store in a path.
    """
    if name == DEFAULT_ROOT:
        raise UsageError(
            f"{name!r} cannot be a name: {name}/ID names an artefact of any store",
            "choose another name",
        )
    if not is_name(name):
        raise UsageError(
            f"{name!r} cannot be a name",
            "use a letter, then up to 99 letters, digits, '.', '_' or '-'; hexadecimal digits alone "
            "would read as an id",
        )


def remove_names(layout: Layout, patterns: Sequence[str]) -> list[str]:
    """Remove the names that a pattern matches as in a shell; returns them, sorted.

    The artefacts stay until gc removes them. A name whose file is damaged is removed too.

    Raises:
        NotFound: a pattern matches no name. Then none is removed.
    """
    there = _pointers(layout)
    matched = {pattern: fnmatch.filter(there, pattern) for pattern in patterns}
    for pattern, found in matched.items():
        if not found:
            raise NotFound(f"no name matches {pattern!r}", layout.listing)
    removed = sorted({name for found in matched.values() for name in found})
    for name in removed:
        (layout.names / name).unlink(missing_ok=True)
    fsync_directory(layout.names)
    return removed


def set_name(layout: Layout, name: str, artefact: Artefact) -> str | None:
    """Point ``name`` to ``artefact``; returns the id of another artefact it pointed to.

    Raises:
        UsageError: as :func:`check_name`.
    """
    check_name(name)
    before = named(layout, name)
    if before == artefact.id:
        return None
    layout.names.mkdir(exist_ok=True)
    write_durably(layout.names / name, pointer_to(artefact.id))
    return before


def claim_name(layout: Layout, name: str, artefact: Artefact) -> str | None:
    """Point ``name`` to ``artefact`` unless it names another one; returns that one's id.

    Raises:
        UsageError: as :func:`check_name`.
    """
    check_name(name)
    layout.names.mkdir(exist_ok=True)
    pointer = layout.names / name
    with temporary_file(pointer, pointer_to(artefact.id)) as temporary:
        try:
            os.link(temporary, pointer)
        except FileExistsError:
            holder = named(layout, name)
            if holder is None:
                # A pointer that cannot be read names nothing.
                return set_name(layout, name, artefact)
            return None if holder == artefact.id else holder
    fsync_directory(layout.names)
    return None
