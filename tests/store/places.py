"""What tests of ``irl push`` and ``irl pull`` do with another place."""

from __future__ import annotations

from pathlib import Path

import fsspec
import pytest

from irlcli.store import Artefact, Store
from irlcli.store.share import Shared, share
from irlcli.store.sources import open_place


def copy(source, target, *artefacts: Artefact, warn=pytest.fail) -> Shared:
    return share(source, target, artefacts, warn, lambda count, total: lambda number: None)


def push(store: Store, url: str, *artefacts: Artefact) -> Shared:
    return copy(store, open_place(url, pytest.fail), *artefacts)


def pull(url: str, store: Store, ref: str, warn=pytest.fail) -> Shared:
    there = open_place(url, warn)
    return copy(there, store, there.resolve(ref).artefact, warn=warn)


def files_of(artefact: Artefact) -> dict[str, bytes]:
    paths = [path for path in artefact.directory.rglob("*") if path.is_file()]
    return {p.relative_to(artefact.directory).as_posix(): p.read_bytes() for p in paths}


def other(tmp_path: Path) -> Store:
    return Store(tmp_path / "other", pytest.fail)


def memory() -> fsspec.AbstractFileSystem:
    return fsspec.filesystem("memory")


def at(url: str, artefact: Artefact, name: str) -> str:
    return f"/{url.removeprefix('memory://')}/{artefact.id}/{name}"
