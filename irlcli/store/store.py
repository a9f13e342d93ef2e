"""The content-addressed artefact store: one object over the modules of this package.

An artefact is whole or absent at any moment: it is written under ``.work``, made durable, and
appears by one rename. Artefacts are checked before they are used; damaged ones are moved to
quarantine, never deleted. The layout is described in :mod:`irlcli.store.layout`.
"""

from __future__ import annotations

import os
import shlex
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from irlcli.errors import RETRY, IntegrityError, StageFailed, UsageError
from irlcli.store import layout as layouts
from irlcli.store import read, references
from irlcli.store.artefact import Artefact, Published, read_artefact
from irlcli.store.index import Index
from irlcli.store.layout import Layout
from irlcli.store.lease import Patience, reading
from irlcli.store.lock import exclusive, lease_of, locked
from irlcli.store.manifest import KeyRecord
from irlcli.store.scratch import CHECKPOINT, Scratch

# publish, integrity, collect and substitute are imported by the methods that need them: a hit,
# which most commands are, loads none of them.
if TYPE_CHECKING:
    from irlcli.store.garbage import Missing
    from irlcli.store.integrity import Verified
    from irlcli.store.manifest import Manifest, Output
    from irlcli.store.sources import Place
    from irlcli.store.substitute import Advance

# Stores of this process about which the user was told that their file system has no locks.
_WITHOUT_LOCKS: set[Path] = set()
_CHUNK = 1 << 20


class Store:
    """The store in the directory ``root``.

    Opening writes nothing; :meth:`create` creates the directory.

    Args:
        root: the store's directory, which may be absent.
        warn: receives warnings about artefacts that are skipped.
        read_only: change nothing: damage is reported, but nothing is moved, created or locked.

    Raises:
        IntegrityError: ``root`` holds other files, or a store of a newer format.
        UsageError: ``root`` is not a directory.
    """

    def __init__(
        self,
        root: Path | str,
        warn: Callable[[str], None] = warnings.warn,
        read_only: bool = False,
    ):
        self.warn = warn
        #: The references resolved so far, each with the id that it named, and the output.
        self.resolved: dict[str, str] = {}
        self._index: Index | None = None
        self._layout = Layout(Path(root), read_only)
        layouts.check(self._layout)

    @property
    def root(self) -> Path:
        """The store's directory."""
        return self._layout.root

    @property
    def _writable(self) -> Layout:
        if self._layout.read_only:
            raise UsageError(f"the store {self.root} is open for reading only")
        return self._layout

    @property
    def jobs(self) -> Path:
        """The directory for what was submitted to a cluster; it may be absent."""
        return self._layout.jobs

    def exists(self) -> bool:
        """Whether the store has been created."""
        return self._layout.marker.exists()

    def create(self) -> None:
        """Create the store if it does not exist.

        Raises:
            StageFailed: the directory is not writable, or its file system has no hard links.
        """
        layouts.create(self._writable)

    @property
    def option(self) -> list[str]:
        """The words that name this store on a command line; none if it is the default."""
        return self._layout.option

    @property
    def listing(self) -> str:
        """The command that lists the artefacts, as the end of a hint."""
        return self._layout.listing

    # Reading

    def find(self, key: str) -> Artefact | None:
        """The artefact that holds ``key``: see :func:`irlcli.store.read.find`."""
        return read.find(self._layout, key)

    def peek(self, key: str) -> read.Peek:
        """What :meth:`find` would find, changing nothing: see :func:`irlcli.store.read.peek`."""
        return read.peek(self._layout, key)

    def open(self, artefact: Artefact, path: str) -> Path:
        """The checked file of an output: see :func:`irlcli.store.read.open_output`."""
        return read.open_output(self._layout, artefact, path)

    def ids(self) -> list[str]:
        """The ids of all artefacts, sorted."""
        return read.ids(self._layout)

    def index(self, on_damage: Callable[[IntegrityError], None] | None = None) -> Index:
        """All artefacts: see :func:`irlcli.store.read.index`."""
        self._index = read.index(self._layout, self.warn, on_damage)
        return self._index

    def artefacts(self) -> Iterator[Artefact]:
        """The artefacts of :meth:`index`."""
        yield from self.index().artefacts.values()

    # References

    def resolve(self, ref: str) -> references.Resolved:
        """What ``ref`` names: see :func:`irlcli.store.references.resolve`."""
        found = references.resolve(self._layout, ref)
        if found.artefact is not None:
            self.resolved[ref] = "/".join(filter(None, (found.artefact.id, found.output)))
        return found

    def names(self) -> dict[str, str]:
        """Name to id, sorted by name."""
        return references.names(self._layout)

    def damaged_names(self) -> list[str]:
        """The names whose file does not contain an id."""
        return references.damaged_names(self._layout)

    def check_name(self, name: str) -> None:
        """Refuse an invalid name: see :func:`irlcli.store.references.check_name`."""
        references.check_name(name)

    def remove_names(self, patterns: Sequence[str]) -> list[str]:
        """Remove names: see :func:`irlcli.store.references.remove_names`.

        Raises:
            NotFound: as that.
            StageFailed: the store cannot be written.
        """
        with self._writing():
            return references.remove_names(self._writable, patterns)

    def set_name(self, name: str, artefact: Artefact) -> None:
        """Name an artefact, and warn if another one loses the name: gc may now delete that.

        Raises:
            UsageError: as :func:`irlcli.store.references.check_name`.
            StageFailed: the store cannot be written.
        """
        with self._writing():
            before = references.set_name(self._writable, name, artefact)
        if before is not None:
            undo = shlex.join(["irl", "name", before, name, *self.option])
            exists = (self.root / before).is_dir()
            self.warn(f"{name} no longer names {before}" + f"; `{undo}` undoes this" * exists)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StageFailed(
                f"the store {self.root} cannot be written: {error.strerror or error}", RETRY
            ) from None

    # Working

    @contextmanager
    def in_use(
        self, wait: bool = False, on_wait: Callable[[str], None] | None = None
    ) -> Iterator[None]:
        """Keep ``gc`` from running while artefacts are read or made.

        Without effect in a read-only store, and where the user cannot lock.

        Raises:
            Busy: gc is running and ``wait`` is false.
        """
        lock = self._layout.gc_lock
        lockable = lock.exists() or os.access(self._layout.locks, os.W_OK)
        if self._layout.read_only or not lockable:
            yield
            return
        patience = Patience(f"the store {self.root}", wait, on_wait)
        with locked(lock, patience, shared=True) as problem:
            if problem is not None and self.root not in _WITHOUT_LOCKS:
                _WITHOUT_LOCKS.add(self.root)
                self.warn(
                    f"{self.root} is on a file system without locks ({problem}): leases with a "
                    "heartbeat stand in for them (docs/store.md)"
                )
            with reading(self._layout.locks, lease_of(lock), problem is None, patience):
                yield

    @contextmanager
    def working_on(
        self,
        key: str,
        wait: bool,
        on_wait: Callable[[str], None] | None = None,
        what: str = "the same artefact",
    ) -> Iterator[Scratch]:
        """Hold the lock and the working directory of ``key``.

        Raises:
            Busy: another process holds them and ``wait`` is false.
            IntegrityError: the working directory is a file or a link.
        """
        layouts.make_directories(self._writable)
        directory = self._layout.work / key
        with exclusive(self._layout.locks / key, Patience(what, wait, on_wait)):
            if os.path.lexists(directory) and (directory.is_symlink() or not directory.is_dir()):
                raise IntegrityError(f"{directory} is not a directory", "remove it")
            yield Scratch(directory)

    def has_checkpoint(self, key: str) -> bool:
        """Whether an interrupted run of ``key`` can be resumed."""
        return (self._layout.work / key / CHECKPOINT).exists()

    def publish(self, record: KeyRecord, output: Path, provenance: dict[str, Any]) -> Published:
        """Publish an output directory: see :func:`irlcli.store.publish.publish`."""
        from irlcli.store.publish import publish

        return publish(self._writable, record, output, provenance)

    def adopt(self, other: Place, artefact: Artefact) -> Published | None:
        """Copy an artefact and its ancestors: see :func:`irlcli.store.substitute.adopt`.

        To be called as :meth:`publish` is, under :meth:`in_use` and :meth:`working_on`.
        """
        from irlcli.store.substitute import adopt, ancestors

        before = ancestors(artefact, other.manifests(artefact.id))
        return adopt(self._writable, other, artefact, before, self.warn)

    # Copying, as a Remote does

    def manifests(self, id16: str) -> Index:
        """The artefacts with sound manifests.

        They are read once, and again if ``id16`` is not among them.
        """
        if self._index is None or id16 not in self._index.artefacts:
            self._index = read.index(self._layout._replace(read_only=True), self.warn)
        return self._index

    def file(self, artefact: Artefact, path: str) -> Path:
        """The file of an output, unchecked."""
        return artefact.directory / artefact.output(path).path

    def contents(self, id16: str) -> tuple[Manifest, dict[str, Any]]:
        """Manifest and provenance of an artefact, all of whose files are there with their sizes.

        Raises:
            IntegrityError: it is damaged or not whole.
        """
        # Finds damaged JSON, wrong sizes, symbolic links and unlisted files before any copying.
        if found := self.problems(id16, quick=True):
            raise IntegrityError(found[0])
        artefact = read_artefact(self.root / id16)
        return artefact.manifest, artefact.provenance()

    def read(self, id16: str, output: Output) -> Iterator[bytes]:
        """The bytes of an output as they are, in chunks.

        Raises:
            IntegrityError: they cannot be read.
        """
        path = self.root / id16 / output.path
        try:
            with open(path, "rb") as file:
                while chunk := file.read(_CHUNK):
                    yield chunk
        except OSError as error:
            raise IntegrityError(f"{path} cannot be read ({error.strerror})") from None

    def holds(self, artefact: Artefact) -> bool:
        """Whether the artefact is here with all its files. Compares sizes; hashes nothing."""
        return not self.problems(artefact.id, quick=True)

    def receive(self, source: Place, artefact: Artefact, advance: Advance) -> None:
        """Copy one artefact: see :func:`irlcli.store.substitute.receive`."""
        from irlcli.store.durable import remove_leftovers
        from irlcli.store.substitute import receive

        layouts.make_directories(self._writable)
        # Killed copies leave large files.
        remove_leftovers(self._layout.work)
        receive(self._writable, source, artefact.id, advance)

    def claim(self, artefact: Artefact) -> str | None:
        """Let the artefact hold its key, unless another one does; returns that one's id."""
        from irlcli.store.publish import claim

        key = artefact.manifest.record.key
        holder = read.held_by(self._layout, key) or claim(self._writable, artefact).id
        return None if holder == artefact.id else holder

    def claim_name(self, name: str, artefact: Artefact) -> str | None:
        """Name an artefact unless another one has the name; returns that one's id."""
        return references.claim_name(self._writable, name, artefact)

    # Integrity

    def problems(self, id16: str, quick: bool = False) -> list[str]:
        """The problems of an artefact: see :func:`irlcli.store.integrity.problems`."""
        from irlcli.store.integrity import problems

        return problems(self._layout, id16, quick)

    def verify(self, ids: Iterable[str], quick: bool = False) -> Verified:
        """Check artefacts: see :func:`irlcli.store.integrity.verify`.

        A sound artefact whose key points to nothing holds it again, with a warning: otherwise it would
        be computed once more.
        """
        from irlcli.store.integrity import verify

        verified = verify(self._layout, ids, quick)
        if not self._layout.read_only:
            for artefact in verified.sound.artefacts.values():
                if read.held_by(self._layout, artefact.manifest.record.key) is None:
                    lost = f"artefact {artefact.id} had lost its key"
                    try:
                        layouts.make_directories(self._layout)
                        self.claim(artefact)
                    except OSError as error:
                        self.warn(f"{lost}, which cannot be restored ({error.strerror})")
                    else:
                        self.warn(f"{lost} and holds it again")
        return verified

    # Collection

    def garbage(self, grace_seconds: float, index: Index | None = None) -> list[Artefact]:
        """Artefacts that gc would remove: see :func:`irlcli.store.garbage.garbage`."""
        from irlcli.store.garbage import garbage

        return garbage(self._layout, index or self.index(), grace_seconds, self.warn)

    def missing(self, index: Index) -> dict[str, Missing]:
        """Missing artefacts: see :func:`irlcli.store.garbage.missing`."""
        from irlcli.store.garbage import missing

        return missing(self._layout, index)

    def stale_work(self, grace_seconds: float) -> list[Path]:
        """Working directories that gc would remove: see :func:`irlcli.store.garbage.stale_work`."""
        from irlcli.store.garbage import stale_work

        return stale_work(self._layout, grace_seconds)

    def collect(self, grace_seconds: float) -> tuple[list[Artefact], list[Path]]:
        """Remove garbage: see :func:`irlcli.store.garbage.collect`."""
        from irlcli.store.garbage import collect

        return collect(self._writable, grace_seconds, self.warn)
