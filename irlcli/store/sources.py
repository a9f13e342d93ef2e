"""Other stores, in which an artefact is looked for before it is computed (``--from``)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from irlcli.errors import NewerFormat, NotFound, UsageError
from irlcli.store.artefact import Artefact
from irlcli.store.store import Store

# A place on disk loads no fsspec.
if TYPE_CHECKING:
    from irlcli.store.remote import Remote

    Place = Store | Remote


class Found(NamedTuple):
    """An artefact, and the other store that has it."""

    store: Place
    artefact: Artefact


def open_place(place: Path | str, warn: Callable[[str], None], read_only: bool = False) -> Place:
    """The store in a directory or behind a URL; it may not exist yet.

    Raises:
        IntegrityError: a newer store, or a damaged one.
        UsageError: an empty text, a path that is no directory, a directory of other files, or a URL
            that cannot be used.
        StageFailed: a URL cannot be reached.
    """
    text = str(place)
    if not text:
        raise UsageError(
            "the name of a store is empty", "name a directory or a URL: s3://BUCKET/PATH"
        )
    scheme, colon, rest = text.partition("://")
    if colon and not rest.strip("/"):
        path = "/PATH" if scheme == "file" else "BUCKET/PATH"
        raise UsageError(f"{text} names no bucket or path", f"write one, as in {scheme}://{path}")
    if text.startswith("file://"):
        text = text.removeprefix("file://")
    elif "://" in text:
        from irlcli.store.remote import Remote

        return Remote(text, warn)
    elif mistyped := re.match(r"([a-z][a-z0-9+]+):/", text):
        raise UsageError(
            f"{text} has one slash after {mistyped[1]}:",
            f"a URL has two: {mistyped[1]}://; a directory of this name is ./{text}",
        )
    return Store(text, warn, read_only)


def open_sources(places: Iterable[Path | str], warn: Callable[[str], None]) -> list[Place]:
    """The stores at ``places``, directories or URLs, for reading only.

    Raises:
        NotFound: there is no store.
        IntegrityError, UsageError, StageFailed: as :func:`open_place`.
    """
    stores: list[Place] = []
    for place in places:
        store = open_place(place, warn, read_only=True)
        if not store.exists():
            raise NotFound(
                f"{place} is not a store",
                "--from and IRL_FROM take the directory or URL of a store, such as zoo",
            )
        stores.append(store)
    return stores


def find_in(stores: Sequence[Place], key: str) -> Found | None:
    """The artefact of ``key`` in the first of ``stores`` that has it; None if none has.

    Checks the manifest, and in a directory the sizes; hashes nothing. An artefact that is damaged or
    of a newer schema is skipped with a warning.
    """
    for store in stores:
        try:
            artefact, problem = store.peek(key)
        except NewerFormat as error:
            artefact, problem = None, f"{error.message}; {error.hint}"
        if artefact is not None:
            return Found(store, artefact)
        if problem is not None:
            store.warn(f"not copying from the store {store.root}: {problem}")
    return None
