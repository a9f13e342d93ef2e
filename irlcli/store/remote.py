"""A store behind a URL, laid out like one on disk, read and written through fsspec.

Manifests, names and keys are fetched when they are first needed, into a temporary directory, where
the code for stores on disk reads and checks them. Outputs are streamed. An artefact is written with
its manifest last, so that nobody sees what an interrupted push left.
"""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fsspec

from irlcli.errors import IntegrityError, IrlError, NewerFormat, StageFailed, UsageError
from irlcli.store import layout as layouts
from irlcli.store import references
from irlcli.store.artefact import Artefact, read_artefact, stored_inputs
from irlcli.store.digest import is_sha256
from irlcli.store.index import Index
from irlcli.store.layout import (
    FORMAT,
    Layout,
    is_id,
    is_name,
    is_prefix,
    pointed_to,
    pointer_to,
)
from irlcli.store.manifest import (
    MANIFEST,
    MAX_JSON_BYTES,
    PROVENANCE,
    Manifest,
    Output,
    encode_provenance,
    read_provenance,
)
from irlcli.store.read import Peek
from irlcli.store.read import index as read_index
from irlcli.store.remote_errors import explained
from irlcli.store.substitute import Advance, check, verified

if TYPE_CHECKING:
    from irlcli.store.sources import Place

_CHUNK = 8 << 20
# Small files fetched at a time: each is at most MAX_JSON_BYTES.
_BATCH = 32


class Remote:
    """The store at ``url``. What is fetched once is not fetched again.

    Args:
        url: any that fsspec knows: ``s3://bucket/path``, ``memory://name``, ...
        warn: receives warnings about artefacts that are skipped.

    Raises:
        UsageError: the protocol is unknown or its package missing, or access is denied.
        IntegrityError: it is a store of a newer format.
        StageFailed: it cannot be reached.
    """

    def __init__(self, url: str, warn: Callable[[str], None]):
        self.root = url.rstrip("/")
        self.warn = warn
        self._index: Index | None = None
        self._keys: set[str] | None = None
        with self._errors():
            # No other option: some protocols pass what they do not know on to their servers.
            self._fs, path = fsspec.core.url_to_fs(self.root, skip_instance_cache=True)
        self._path = path.rstrip("/")
        # The files that were fetched. It is removed with this object, or when the program ends.
        self._temporary = tempfile.TemporaryDirectory(prefix="irl-")
        self._layout = Layout(Path(self._temporary.name), read_only=True)
        self._fetch(["STORE"])
        with self._errors():
            layouts.check(self._layout)

    # Reading: as a Store

    def exists(self) -> bool:
        """Whether there is a store at the URL."""
        return self._layout.marker.exists()

    def in_use(
        self, wait: bool = False, on_wait: Callable[[str], None] | None = None
    ) -> AbstractContextManager[None]:
        """Nothing: no ``gc`` runs there."""
        return nullcontext()

    def ids(self) -> list[str]:
        """The ids of all artefacts, sorted, with those that are not whole yet."""
        return [name for name in self._list("") if is_id(name)]

    def index(self) -> Index:
        """All whole artefacts: see :func:`irlcli.store.read.index`."""
        self._fetch(f"{id16}/{MANIFEST}" for id16 in self.ids())
        self._index = read_index(self._layout, lambda text: self.warn(self._shown(text)))
        return self._index

    def manifests(self, id16: str) -> Index:
        """``id16`` and the ancestors that provenance names, so that few manifests are fetched.

        If an input is not found that way, all artefacts.
        """
        if self._index is not None and id16 in self._index.artefacts:
            return self._index
        found: dict[str, Artefact] = {}
        named = {id16}
        try:
            while pending := sorted(named - found.keys()):
                self._fetch(f"{i}/{name}" for i in pending for name in (MANIFEST, PROVENANCE))
                for i in pending:
                    found[i] = artefact = read_artefact(self._layout.root / i)
                    inputs = artefact.manifest.record.inputs
                    named.update(stored_inputs(artefact.provenance(), inputs))
        except IntegrityError:
            return self.index()
        index = Index(found, {})
        for artefact in found.values():
            if stored_inputs(artefact.provenance(), index.orphaned(artefact)):
                return self.index()
        return index

    def peek(self, key: str) -> Peek:
        """The artefact that holds ``key``, or why it cannot be used.

        Raises:
            NewerFormat: the artefact has a newer schema.
        """
        if self._keys is None:
            self._keys = {name for name in self._list(".keys") if is_sha256(name)}
        if key not in self._keys:
            return Peek()
        self._fetch([f".keys/{key}"])
        id16 = pointed_to(self._layout.keys / key)
        if id16 is None or not self._has_manifest(id16):
            return Peek()
        self._fetch([f"{id16}/{PROVENANCE}"])
        try:
            with self._errors():
                artefact = read_artefact(self._layout.root / id16)
        except NewerFormat:
            raise
        except IntegrityError as error:
            return Peek(problem=error.message)
        return Peek(artefact if artefact.manifest.record.key == key else None)

    def names(self) -> dict[str, str]:
        """Name to id, sorted by name."""
        self._fetch(f".names/{name}" for name in self._list(".names") if is_name(name))
        return references.names(self._layout)

    def resolve(self, ref: str) -> references.Resolved:
        """What ``ref`` names: see :func:`irlcli.store.references.resolve`."""
        head = ref.removeprefix(f"{layouts.DEFAULT_ROOT}/").partition("/")[0]
        found = [id16 for id16 in self.ids() if is_prefix(head) and id16.startswith(head[:16])]
        # All names, so that the nearest one can be suggested.
        found += [id16 for name, id16 in self.names().items() if name == head]
        self._fetch(f"{id16}/{MANIFEST}" for id16 in found)
        with self._errors():
            return references.resolve(self._layout, ref)

    def file(self, artefact: Artefact, path: str) -> Path:
        """A copy of an output, unchecked."""
        output = artefact.output(path)
        copy = artefact.directory / output.path
        copy.parent.mkdir(parents=True, exist_ok=True)
        with open(copy, "wb") as file:
            file.writelines(self.read(artefact.id, output))
        return copy

    def contents(self, id16: str) -> tuple[Manifest, dict[str, Any]]:
        """Manifest and provenance of a whole artefact: see :meth:`irlcli.store.Store.contents`."""
        self._fetch([f"{id16}/{MANIFEST}", f"{id16}/{PROVENANCE}"])
        directory = self._layout.root / id16
        with self._errors():
            manifest = read_artefact(directory).manifest
            sizes = self._sizes(id16)
            for output in manifest.outputs:
                where = f"{self.root}/{id16}/{output.path}"
                if output.path not in sizes:
                    raise IntegrityError(f"{where} is missing")
                if sizes[output.path] not in (output.size, None):
                    raise IntegrityError(
                        f"{where} has {sizes[output.path]} bytes instead of {output.size}"
                    )
            return manifest, read_provenance(directory, manifest.id)

    def read(self, id16: str, output: Output) -> Iterator[bytes]:
        """The bytes of an output as they are, in chunks."""
        # A request of its own for each chunk bounds the memory, whatever the protocol buffers.
        for start in range(0, output.size, _CHUNK):
            with self._errors():
                end = min(start + _CHUNK, output.size)
                data = self._fs.cat_file(self._at(f"{id16}/{output.path}"), start=start, end=end)
            if len(data) > end - start and output.size > _CHUNK:
                raise StageFailed(
                    f"{self.root} sends whole files when it is asked for a part",
                    "use a server that answers HTTP range requests",
                )
            yield data

    # Writing

    def create(self) -> None:
        """Write the format marker if it is missing.

        Raises:
            UsageError: a URL that can only be read, or other files at the URL.
        """
        if self.root.startswith(("http://", "https://")):
            raise UsageError(f"{self.root} can only be read", "push to a directory or a bucket")
        if self.exists():
            return
        if self._list(""):
            raise UsageError(
                f"{self.root} contains files but is not a store",
                "name a store, or an empty or new place",
            )
        self._write("STORE", b'{"format": %d}\n' % FORMAT)
        self._fetch(["STORE"])

    def holds(self, artefact: Artefact) -> bool:
        """Whether the artefact is there with all its files. Compares sizes; hashes nothing."""
        wanted = {output.path: output.size for output in artefact.manifest.outputs}
        wanted[MANIFEST] = len(artefact.manifest.encode())
        sizes = self._sizes(artefact.id)
        return PROVENANCE in sizes and all(sizes.get(p, -1) == size for p, size in wanted.items())

    def receive(self, source: Place, artefact: Artefact, advance: Advance) -> None:
        """Write a copy of an artefact of ``source``, its manifest last, and read it back.

        Raises:
            IntegrityError: it is damaged in ``source``, or on the way; it is not visible then.
        """
        manifest, provenance = source.contents(artefact.id)
        # First: where a file was lost, the others that lie here may be the only sound ones.
        check(source, artefact.id, manifest)
        for output in manifest.outputs:
            path = self._new(f"{artefact.id}/{output.path}")
            with self._errors(), self._fs.open(path, "wb", block_size=_CHUNK) as file:
                for chunk in verified(source, artefact.id, output):
                    file.write(chunk)
                    advance(len(chunk))
        check(self, artefact.id, manifest)
        self._write(f"{artefact.id}/{PROVENANCE}", encode_provenance(manifest.id, provenance))
        self._write(f"{artefact.id}/{MANIFEST}", manifest.encode())

    def claim(self, artefact: Artefact) -> str | None:
        """Let the artefact hold its key, unless another one does; returns that one's id."""
        key = artefact.manifest.record.key
        self._fetch([f".keys/{key}"])
        holder = pointed_to(self._layout.keys / key)
        if holder is None or not self._has_manifest(holder):
            self._write(f".keys/{key}", pointer_to(artefact.id))
            return None
        return None if holder == artefact.id else holder

    def claim_name(self, name: str, artefact: Artefact) -> str | None:
        """Name an artefact; the id of another artefact that has the name already, which keeps it."""
        (self._layout.names / name).unlink(missing_ok=True)
        self._fetch([f".names/{name}"])
        holder = pointed_to(self._layout.names / name)
        if holder is None:
            self._write(f".names/{name}", pointer_to(artefact.id))
        return None if holder in (None, artefact.id) else holder

    # The file system

    def _at(self, name: str) -> str:
        return f"{self._path}/{name}" if name else self._path

    def _list(self, directory: str) -> list[str]:
        """The names of what is in a directory, sorted; none if it does not exist."""
        own = self._at(directory)
        # Another process may write there at the same time.
        self._fs.invalidate_cache()
        with self._errors(), suppress(FileNotFoundError, NotADirectoryError):
            paths = {path.rstrip("/") for path in self._fs.ls(own, detail=False)}
            # A bucket's directory can hold an empty object of its own name.
            return sorted(path.rpartition("/")[2] for path in paths - {own})
        return []

    def _sizes(self, id16: str) -> dict[str, int | None]:
        """The size of each file of an artefact by its path inside it; None where unknown."""
        directory = self._at(id16)
        self._fs.invalidate_cache()
        with self._errors(), suppress(FileNotFoundError):
            found = self._fs.find(directory, detail=True)
            return {p[len(directory) + 1 :]: info.get("size") for p, info in found.items()}
        return {}

    def _has_manifest(self, id16: str) -> bool:
        self._fetch([f"{id16}/{MANIFEST}"])
        return (self._layout.root / id16 / MANIFEST).exists()

    def _fetch(self, names: Iterable[str]) -> None:
        """Fetch small files that were not fetched yet; absent ones are left out."""
        wanted = [name for name in names if not (self._layout.root / name).exists()]
        for start in range(0, len(wanted), _BATCH):
            batch = wanted[start : start + _BATCH]
            with self._errors():
                # One byte more than what read_json() takes, so that it notices.
                paths, end = [self._at(name) for name in batch], MAX_JSON_BYTES + 1
                found = self._fs.cat_ranges(paths, 0, end, on_error="return")
            for name, data in zip(batch, found, strict=True):
                if isinstance(data, FileNotFoundError):
                    continue
                if isinstance(data, OSError) and data.errno == errno.EINVAL:
                    # S3 refuses a range of an empty file.
                    data = b""
                with self._errors():
                    if isinstance(data, BaseException):
                        raise data
                copy = self._layout.root / name
                copy.parent.mkdir(exist_ok=True)
                copy.write_bytes(data)

    def _write(self, name: str, data: bytes) -> None:
        path = self._new(name)
        with self._errors():
            self._fs.pipe_file(path, data)

    def _new(self, name: str) -> str:
        """The path of a file to be written, after its directories were made."""
        path = self._at(name)
        # Object stores have no directories; their paths begin with a bucket, which must exist.
        if path.startswith("/"):
            with self._errors():
                self._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
        return path

    def _shown(self, text: str) -> str:
        """A message about a fetched file as one about the URL."""
        return text.replace(str(self._layout.root), self.root)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Turn what fsspec and its protocols raise into errors that name the URL."""
        try:
            yield
        except IrlError as error:
            error.message = self._shown(error.message)
            raise
        except Exception as error:
            raise explained(error, self.root) from error
