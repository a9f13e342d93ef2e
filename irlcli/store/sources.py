"""Other stores, in which an artefact is looked for before it is computed (``--from``)."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import NewerFormat, NotFound
from irlcli.store.artefact import Artefact
from irlcli.store.store import Store


class Found(NamedTuple):
    """An artefact, and the other store that has it."""

    store: Store
    artefact: Artefact


def open_sources(directories: Iterable[Path | str], warn: Callable[[str], None]) -> list[Store]:
    """The stores in ``directories``, for reading only.

    Raises:
        NotFound: a directory is not a store.
        IntegrityError: a directory holds a newer store, or a damaged one.
        UsageError: a path is not a directory.
    """
    stores = []
    for directory in directories:
        store = Store(directory, warn, read_only=True)
        if not store.exists():
            raise NotFound(f"{directory} is not a store", "name a store with --from or IRL_FROM")
        stores.append(store)
    return stores


def find_in(stores: Sequence[Store], key: str) -> Found | None:
    """The artefact of ``key`` in the first of ``stores`` that has it; None if none has.

    Checks the manifest and the sizes; hashes nothing. An artefact that is damaged or of a newer
    schema is skipped with a warning.
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
