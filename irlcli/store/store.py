"""The content-addressed artefact store.

::

    runs/STORE                     format version
    runs/<id16>/                   manifest.json provenance.json reward.pt ...
    runs/.keys/<key>               the id16 that key led to
    runs/.names/<name>             an id16
    runs/.work/<key>/              scratch of a stage at work
    runs/.locks/  .quarantine/

An artefact is whole or absent at any moment: it is written under ``.work``, made durable, and
appears by one rename. The first result of a key wins; a second, different one is kept beside it.
Reading checks before it trusts: what does not match is moved to quarantine, never deleted.
"""

import errno
import os
import re
import shutil
import stat
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from irlcli.errors import (
    Busy,
    IntegrityError,
    IrlError,
    NewerFormat,
    NotFound,
    UsageError,
    closest,
    suggest,
)
from irlcli.store.digest import file_digest
from irlcli.store.index import Index
from irlcli.store.lock import is_locked, locked
from irlcli.store.manifest import (
    MANIFEST,
    PROVENANCE,
    KeyRecord,
    Manifest,
    Output,
    directory_outputs,
    encode_provenance,
    read_json,
    read_manifest,
    read_provenance,
)
from irlcli.store.scratch import (
    Scratch,
    fsync_directory,
    remove,
    remove_leftovers,
    temporary_file,
    write_durably,
)

FORMAT = 1
_OWN = (".keys", ".names", ".work", ".locks", ".quarantine")
_ID_DIGITS = 16
_ID = rf"[0-9a-f]{{{_ID_DIGITS}}}"
_KEY = r"[0-9a-f]{64}"
_PREFIX = r"[0-9a-f]{3,64}"
_NAME = r"[A-Za-z][A-Za-z0-9._-]{0,99}"


class Artefact(NamedTuple):
    """A published artefact: its directory and its manifest."""

    directory: Path
    manifest: Manifest

    @property
    def id(self) -> str:
        """The first 16 hexadecimal digits of the id, its directory's name."""
        return self.directory.name

    def output(self, path: str) -> Output:
        """The output called ``path``.

        Raises:
            NotFound: the artefact has no such output.
        """
        for output in self.manifest.outputs:
            if output.path == path:
                return output
        names = [o.path for o in self.manifest.outputs]
        raise NotFound(f"artefact {self.id} holds no {path!r}", suggest(path, names))

    def provenance(self) -> dict[str, Any]:
        """Where it came from: command line, versions, timings.

        Raises:
            IntegrityError: altered or unreadable.
        """
        return read_provenance(self.directory, self.manifest.id)


class Published(NamedTuple):
    """What publishing led to; ``diverged`` is the artefact that holds the key if not this one."""

    artefact: Artefact
    diverged: Artefact | None = None


class Damage(NamedTuple):
    """What is wrong with an artefact, and the command that made it if it still says so.

    ``place`` is where it lies in quarantine; None if it could not be moved. Of a ``newer`` schema
    nothing is known: such an artefact is no damaged one, and stays where it is.
    """

    problems: list[str]
    command: str
    place: Path | None = None
    newer: bool = False


class Missing(NamedTuple):
    """Who needs an artefact that is gone, and what is known of it: nothing, if not quarantined.

    ``names`` point to it, the artefacts ``made`` were made from it.
    """

    names: list[str]
    made: list[str]
    place: Path | None
    command: str

    def text(self, id16: str) -> str:
        """One line on the artefact ``id16``."""
        needed = [f"the name {name!r} points to it" for name in self.names]
        needed += [f"{', '.join(self.made)} came from it"] if self.made else []
        where = f" (it was damaged and is in {self.place})" if self.place is not None else ""
        return f"{id16} is gone{where}: {'; '.join(needed)}"


class Resolved(NamedTuple):
    """What a reference names: an artefact and perhaps one of its outputs, or a foreign path."""

    artefact: Artefact | None
    path: Path

    @property
    def output(self) -> str | None:
        """Path of the output inside the artefact; None if the reference names all of it."""
        if self.artefact is None or self.path == self.artefact.directory:
            return None
        return self.path.relative_to(self.artefact.directory).as_posix()


class Store:
    """A store in the directory ``root``, created on first use.

    ``warn`` is told of artefacts that are left out because a newer version made them.

    Raises:
        IntegrityError: ``root`` holds something else, or a store of a newer format.
        UsageError: ``root`` is not a directory.
    """

    def __init__(self, root: Path | str, warn: Callable[[str], None] = warnings.warn):
        self.root = Path(root)
        self._warn = warn
        try:
            present = stat.S_ISDIR(self.root.stat().st_mode)
        except FileNotFoundError:
            present = True
        except OSError as error:
            raise UsageError(
                f"{self.root} cannot be a store ({error.strerror})", "name a directory with --store"
            ) from None
        if not present:
            raise UsageError(f"{self.root} is not a directory", "name a directory with --store")
        marker = self.root / "STORE"
        if marker.exists():
            value = read_json(marker)
            version = value.get("format") if isinstance(value, dict) else None
            if type(version) is not int or version < 1:
                raise IntegrityError(f"{marker} names no format", "is this an irlcli store?")
            if version > FORMAT:
                raise IntegrityError(
                    f"{self.root} is a store of format {version}, newer than the {FORMAT} known here",
                    "it was made by a newer irlcli: upgrade this one, or name another --store",
                )
        elif self.root.exists() and any(
            p.name not in _OWN and not p.name.startswith(".STORE.") for p in self.root.iterdir()
        ):
            # Our own directories alone are a store whose creation was cut short.
            raise IntegrityError(
                f"{self.root} has files in it but is no store",
                "name a store, or an empty or a new directory, with --store",
            )
        for name in _OWN:
            if (self.root / name).is_symlink():
                # What is written, moved and removed there stays inside the store.
                raise IntegrityError(
                    f"{self.root / name} is a symbolic link", "replace it by a directory"
                )

    # Layout

    def _keys(self) -> Path:
        return self.root / ".keys"

    def _names(self) -> Path:
        return self.root / ".names"

    def _work(self) -> Path:
        return self.root / ".work"

    def _locks(self) -> Path:
        return self.root / ".locks"

    def _quarantine(self) -> Path:
        return self.root / ".quarantine"

    def create(self) -> None:
        """Make the directories and the format marker, if they are not there.

        Raises:
            OSError: the place cannot be written.
        """
        if (self.root / "STORE").exists():
            return
        for directory in (self._keys(), self._names(), self._work(), self._locks()):
            directory.mkdir(parents=True, exist_ok=True)
        self._quarantine().mkdir(exist_ok=True)
        # It is there for whoever may only read the store later.
        (self._locks() / "gc").touch()
        write_durably(self.root / "STORE", b'{"format": %d}\n' % FORMAT)

    # Reading

    def find(self, key: str) -> Artefact | None:
        """The artefact that ``key`` led to, or None. Checks the manifest, not the outputs.

        Raises:
            IntegrityError: the artefact is damaged; it has been moved to quarantine.
        """
        name = self._pointee(key)
        if name is None:
            return None
        try:
            artefact = self.get(name)
        except NotFound:
            return None
        if artefact.manifest.record.key != key:
            return None
        for output in artefact.manifest.outputs:
            if not _has_size(artefact.directory / output.path, output.size):
                raise self._damaged(artefact.directory, f"{output.path} is missing or truncated")
        return artefact

    def _pointee(self, key: str) -> str | None:
        """The id that ``key`` points to, if there is such an artefact.

        Where it was removed, or the pointer damaged, computing again repairs both.
        """
        name = _pointed_to(self._keys() / key)
        return name if name is not None and (self.root / name).is_dir() else None

    def get(self, id16: str) -> Artefact:
        """The artefact in directory ``id16``, its manifest checked against that address.

        Raises:
            IntegrityError: the manifest is damaged; the artefact has been moved to quarantine.
            NotFound: there is no such artefact (any more).
        """
        try:
            return self._read(id16)
        except NewerFormat:
            raise
        except IntegrityError as error:
            raise self._damaged(self.root / id16, error.message) from None

    def _read(self, id16: str) -> Artefact:
        directory = self.root / id16
        manifest = read_manifest(directory)
        if manifest.id[:_ID_DIGITS] != id16:
            raise IntegrityError(f"{directory / MANIFEST} does not match its address")
        return Artefact(directory, manifest)

    def open(self, artefact: Artefact, path: str) -> Path:
        """The file of an output, its bytes checked against the manifest.

        Raises:
            NotFound: no such output.
            IntegrityError: other bytes; the artefact has been moved to quarantine.
        """
        output = artefact.output(path)
        problem = _output_problem(artefact.directory, output)
        if problem:
            raise self._damaged(artefact.directory, problem)
        return artefact.directory / path

    def ids(self) -> list[str]:
        """The ids of all artefacts, sorted."""
        try:
            return sorted(
                entry.name for entry in os.scandir(self.root) if re.fullmatch(_ID, entry.name)
            )
        except FileNotFoundError:
            return []

    def artefacts(self) -> Iterator[Artefact]:
        """The artefacts of :meth:`index`."""
        yield from self.index().artefacts.values()

    def index(self, name_newer: bool = True) -> Index:
        """All artefacts as they are now, each manifest read once.

        With ``name_newer`` those of a newer schema are named in a warning; those removed
        meanwhile are left out.

        Raises:
            IntegrityError: as :meth:`get`.
        """
        artefacts, newer = {}, {}
        for name in self.ids():
            try:
                artefacts[name] = self.get(name)
            except NotFound:
                continue
            except NewerFormat as error:
                newer[name] = (self.root / name / MANIFEST).read_bytes()
                if name_newer:
                    self._warn(f"{error.message}: left out; {error.hint}")
        return Index(artefacts, newer)

    def names(self) -> dict[str, str]:
        """Name to id, sorted by name."""
        try:
            entries = sorted(path.name for path in self._names().iterdir())
        except FileNotFoundError:
            return {}
        found = {name: self._named(name) for name in entries}
        return {name: id16 for name, id16 in found.items() if id16 is not None}

    def _named(self, name: str) -> str | None:
        """The id that ``name`` stands for; one file is read, however many names there are."""
        return _pointed_to(self._names() / name) if re.fullmatch(_NAME, name) else None

    # References

    def resolve(self, ref: str) -> Resolved:
        """What ``ref`` names: a path into an artefact, a name, a unique id prefix of at least 3
        digits (alone or inside a path), or an existing file or directory outside the store.

        Raises:
            NotFound: nothing, or more than one thing, is called that.
            IntegrityError: the artefact is damaged.
        """
        root, absolute = os.path.abspath(self.root), os.path.abspath(ref)
        inside = absolute.startswith(root + os.sep)
        text = os.path.relpath(absolute, root) if inside else ref.rstrip("/")
        head, _, rest = text.partition("/")
        artefact = None
        if not os.path.isabs(text) and head not in ("", ".", ".."):
            artefact = self._by_name(head) or self._by_prefix(head)
        if artefact is None:
            if not inside and os.path.exists(ref):
                return Resolved(None, Path(ref))
            hint = "`irl ls` lists the artefacts"
            close = closest(head, self.names())
            if close is not None:
                hint = f"did you mean {close!r}? {hint}"
            raise NotFound(f"{ref!r} names no artefact and no file", hint)
        if not rest:
            return Resolved(artefact, artefact.directory)
        artefact.output(rest)
        return Resolved(artefact, artefact.directory / rest)

    def _by_name(self, name: str) -> Artefact | None:
        id16 = self._named(name)
        if id16 is None:
            return None
        if not (self.root / id16).is_dir():
            raise self._gone(name, id16)
        return self.get(id16)

    def _gone(self, name: str, id16: str) -> NotFound:
        place = self._quarantined(id16)
        if place is None:
            hint = "name another with `irl name`"
            return NotFound(f"the name {name!r} points to {id16}, which is gone", hint)
        command = _recorded_command(place)
        return NotFound(
            f"the name {name!r} points to {id16}, which was damaged and is now in {place}",
            f"compute it again: {command}" if command else "compute it again",
        )

    def _quarantined(self, id16: str) -> Path | None:
        """Where the artefact was set aside last, if it was."""
        places = sorted(self._quarantine().glob(f"{id16}-*"))
        return places[-1] if places else None

    def _by_prefix(self, prefix: str) -> Artefact | None:
        if not re.fullmatch(_PREFIX, prefix):
            return None
        short = prefix[:_ID_DIGITS]
        if len(short) == _ID_DIGITS:
            # A whole id needs no look at the others.
            matches = [short] if os.path.lexists(self.root / short) else []
        else:
            matches = [name for name in self.ids() if name.startswith(short)]
        if len(matches) > 1:
            shown = ", ".join(matches[:5]) + (", ..." if len(matches) > 5 else "")
            raise NotFound(
                f"{prefix!r} is ambiguous: {shown}", "write more digits of the one you mean"
            )
        if not matches:
            return None
        artefact = self.get(matches[0])
        return artefact if artefact.manifest.id.startswith(prefix) else None

    def check_name(self, name: str) -> None:
        """Refuse what cannot be a name.

        Raises:
            UsageError: not a name (letters, digits, ``._-``; an id prefix is none).
        """
        if not re.fullmatch(_NAME, name) or re.fullmatch(_PREFIX, name):
            raise UsageError(
                f"{name!r} cannot be a name",
                "a letter, then letters, digits, '.', '_', '-'; not hexadecimal digits alone, "
                "which would read as an id",
            )

    def set_name(self, name: str, artefact: Artefact) -> str | None:
        """Let ``name`` stand for ``artefact``; returns the id of another that it stood for.

        Raises:
            UsageError: as :meth:`check_name`.
        """
        self.check_name(name)
        before = self._named(name)
        if before == artefact.id:
            return None
        write_durably(self._names() / name, artefact.id.encode() + b"\n")
        return before

    # Writing

    @contextmanager
    def in_use(
        self, wait: bool = False, on_wait: Callable[[str], None] | None = None
    ) -> Iterator[None]:
        """Keep ``gc`` away while artefacts are read or made.

        Where there is no store yet, or none that gc could have run in, nothing keeps it away.

        Raises:
            Busy: gc is running and ``wait`` is false.
        """
        lock = self._locks() / "gc"
        if not lock.exists() and not os.access(self._locks(), os.W_OK):
            yield
            return
        with locked(lock, shared=True, wait=wait, on_wait=on_wait):
            yield

    @contextmanager
    def working_on(self, key: str, wait: bool, on_wait=None) -> Iterator[Scratch]:
        """Hold the lock of ``key`` and its scratch directory.

        Raises:
            Busy: another process holds it and ``wait`` is false.
            IntegrityError: something else lies where the directory would be.
        """
        with locked(self._locks() / key, wait=wait, on_wait=on_wait):
            directory = self._work() / key
            if os.path.lexists(directory) and (directory.is_symlink() or not directory.is_dir()):
                raise IntegrityError(f"{directory} is not a directory", "remove it")
            yield Scratch(directory)

    def has_checkpoint(self, key: str) -> bool:
        """Whether an interrupted run of ``key`` left something to go on from."""
        return (self._work() / key / "checkpoint").exists()

    def publish(self, record: KeyRecord, output: Path, provenance: dict[str, Any]) -> Published:
        """Turn the directory ``output`` (under ``.work``) into the artefact of ``record``.

        The files are made durable and read-only, the manifest is written last, the directory
        appears under its id by one rename, and the key is claimed by an atomic link (design:
        Store, 5). ``output`` is gone afterwards.

        Raises:
            OSError: disk full or not writable; nothing was published.
            ValueError: the outputs hold something that is no plain file.
        """
        manifest = Manifest(record, directory_outputs(output))
        for item in manifest.outputs:
            _fsync_file(output / item.path)
            (output / item.path).chmod(0o444)
        write_durably(output / PROVENANCE, encode_provenance(manifest.id, provenance))
        (output / PROVENANCE).chmod(0o444)
        write_durably(output / MANIFEST, manifest.encode())
        (output / MANIFEST).chmod(0o444)
        for directory in {path.parent for path in _entries(output)}:
            fsync_directory(directory)
        artefact = self._place(output, manifest)
        holder = self._claim(record.key, artefact)
        Scratch(self._work() / record.key).clear()
        return Published(artefact, None if holder.id == artefact.id else holder)

    def _place(self, output: Path, manifest: Manifest) -> Artefact:
        target = self.root / manifest.id[:_ID_DIGITS]
        while True:
            try:
                output.rename(target)
                break
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
            # Equal bytes were published before, perhaps by a process that died before its claim.
            if not self.problems(target.name):
                shutil.rmtree(output)
                break
            with suppress(FileNotFoundError):
                self._set_aside(target)
        target.chmod(0o555)
        fsync_directory(self.root)
        return Artefact(target, manifest)

    def _claim(self, key: str, artefact: Artefact) -> Artefact:
        pointer = self._keys() / key
        with temporary_file(pointer, artefact.id.encode() + b"\n") as temporary:
            while True:
                try:
                    os.link(temporary, pointer)
                    fsync_directory(self._keys())
                    return artefact
                except FileExistsError:
                    holder = self._holder(key)
                    if holder is not None:
                        return holder

    def _holder(self, key: str) -> Artefact | None:
        """The artefact that holds ``key``; None once a claim that leads nowhere is out of the way.

        Raises:
            IntegrityError: the holder is damaged and cannot be set aside.
        """
        pointer = self._keys() / key
        try:
            holder = self.find(key)
        except NewerFormat:
            raise
        except IntegrityError:
            # A damaged holder is in quarantine now, and its claim is gone.
            if os.path.lexists(pointer):
                raise
            return None
        if holder is not None:
            return holder
        with self._repairing():
            # Looked at again: another process may have put a claim of its own in its place.
            name = self._pointee(key)
            if name is None or self._read(name).manifest.record.key != key:
                pointer.unlink(missing_ok=True)
        return None

    # Integrity

    def problems(self, id16: str, quick: bool = False) -> list[str]:
        """What is wrong with the artefact ``id16``; empty if nothing. Moves nothing.

        ``quick`` compares sizes instead of hashing the outputs.

        Raises:
            NewerFormat: a newer version made it; nothing can be said of it.
        """
        try:
            return self._problems(id16, quick)
        except NewerFormat:
            raise
        except IntegrityError as error:
            return [error.message]
        except OSError as error:
            # Also of what another process removes while it is looked at.
            return [f"{error.filename} cannot be read ({error.strerror})"]

    def _problems(self, id16: str, quick: bool) -> list[str]:
        directory, manifest = self._read(id16)
        found = [
            problem
            for output in manifest.outputs
            if (problem := _output_problem(directory, output, quick))
        ]
        try:
            read_provenance(directory, manifest.id)
        except IntegrityError as error:
            found.append(error.message)
        known = {o.path for o in manifest.outputs} | {MANIFEST, PROVENANCE}
        found += [
            f"{path} is not in the manifest"
            for path in _entries(directory)
            if path.relative_to(directory).as_posix() not in known
        ]
        return found

    def verify(self, ids: Iterable[str], quick: bool = False) -> dict[str, Damage]:
        """Check artefacts; the damaged ones are moved to quarantine. Returns these.

        Those of a newer schema are among them (``newer``) and stay: they cannot be judged here.
        """
        damaged: dict[str, Damage] = {}
        for id16 in ids:
            try:
                problems = self.problems(id16, quick)
            except NewerFormat as error:
                damaged[id16] = Damage([f"{error.message}: {error.hint}"], "", newer=True)
                continue
            if problems:
                command, place = _recorded_command(self.root / id16), None
                try:
                    place = self._set_aside(self.root / id16)
                    if place is None:
                        continue
                except FileNotFoundError:
                    # Another process collected it, or moved it to quarantine, meanwhile.
                    continue
                except OSError as error:
                    problems.append(f"it could not be moved to quarantine ({error.strerror})")
                damaged[id16] = Damage(problems, command, place)
        return damaged

    def _damaged(self, directory: Path, problem: str) -> IrlError:
        command = _recorded_command(directory)
        hint = f"compute it again: {command}" if command else "compute it again"
        try:
            place = self._set_aside(directory)
        except FileNotFoundError:
            return NotFound(
                f"artefact {directory.name} is gone: another process removed it or set it aside",
                "run the same command again: what is missing is recomputed",
            )
        except OSError as error:
            return IntegrityError(
                f"artefact {directory.name} is damaged: {problem}; it could not be moved to "
                f"quarantine ({error.strerror})",
                hint,
            )
        if place is None:
            return Busy(
                f"artefact {directory.name} was repaired by another process while it was read",
                "run the same command again",
            )
        return IntegrityError(
            f"artefact {directory.name} was damaged and is now in {place}: {problem}", hint
        )

    def _repairing(self):
        """One process at a time takes damaged things out of the way."""
        self._locks().mkdir(exist_ok=True)
        return locked(self._locks() / "repair", wait=True)

    def _set_aside(self, directory: Path) -> Path | None:
        """Move a damaged artefact to quarantine; None if a sound one is in its place by now.

        Raises:
            FileNotFoundError: it is gone.
            OSError: it cannot be moved.
        """
        directory.lstat()
        self._quarantine().mkdir(exist_ok=True)
        with self._repairing():
            directory.lstat()
            if not self.problems(directory.name):
                return None
            for pointer, id16 in _pointers(self._keys()):
                if id16 == directory.name:
                    pointer.unlink(missing_ok=True)
            place = self._quarantine() / f"{directory.name}-{uuid.uuid4().hex[:8]}"
            # Moving a directory to another parent rewrites its "..", which needs write permission.
            if not directory.is_symlink():
                directory.chmod(0o755)
            directory.rename(place)
            return place

    # Ancestry and collection

    def garbage(self, grace_seconds: float) -> list[Artefact]:
        """Artefacts that no name leads to and that are older than the grace period.

        What a newer version made is never among them, nor what its manifest mentions.
        """
        index = self.index()
        for id16, lost in self.missing(index).items():
            self._warn(f"{lost.text(id16)}: nothing that {id16} was made from is kept for it")
        kept = index.reached_from(self.names().values())
        limit = time.time() - grace_seconds
        return [
            artefact
            for id16, artefact in index.artefacts.items()
            if id16 not in kept and _older(artefact.directory, limit)
        ]

    def missing(self, index: Index) -> dict[str, Missing]:
        """What a name points to, or something named was made from, and that is not there, by id.

        ``gc`` takes no such artefact away. A file from outside the store is not looked for, nor
        what a provenance names that cannot be read. ``index`` is of now or of some time ago: what
        was published since is not missed.
        """
        names = self.names()
        there = index.artefacts.keys() | index.newer.keys()
        found: dict[str, Missing] = {}

        def gone(id16: str) -> Missing:
            place = self._quarantined(id16)
            command = "" if place is None else _recorded_command(place)
            return found.setdefault(id16, Missing([], [], place, command))

        for name, id16 in names.items():
            if id16 not in there and not (self.root / id16).is_dir():
                gone(id16).names.append(name)
        for id16 in sorted(index.reached_from(names.values())):
            artefact = index.artefacts[id16]
            lost = [role for role, held in index.parents(artefact).items() if not held]
            for source in _stored_inputs(artefact, lost):
                if source not in there:
                    gone(source).made.append(id16)
        return found

    def stale_work(self, grace_seconds: float) -> list[Path]:
        """Scratch directories that nobody holds and nobody touched within the grace period."""
        limit = time.time() - grace_seconds
        try:
            entries = sorted(self._work().iterdir())
        except FileNotFoundError:
            return []
        return [
            path
            for path in entries
            if _older(path, limit) and not is_locked(self._locks() / path.name)
        ]

    def collect(self, grace_seconds: float) -> tuple[list[Artefact], list[Path]]:
        """Remove ``garbage`` and ``stale_work``; returns what was removed.

        Temporary files of dead processes go too, whatever their age.

        Raises:
            Busy: the store is in use.
        """
        if not self._locks().is_dir():
            return [], []
        with locked(self._locks() / "gc", what=f"the store {self.root}"):
            artefacts, work = self.garbage(grace_seconds), self.stale_work(grace_seconds)
            pointers: dict[str, list[Path]] = {}
            for pointer, id16 in _pointers(self._keys()):
                pointers.setdefault(id16, []).append(pointer)
            for artefact in artefacts:
                for pointer in pointers.get(artefact.id, []):
                    pointer.unlink(missing_ok=True)
                    (self._locks() / pointer.name).unlink(missing_ok=True)
                # A name of its own: a crash may have left an earlier one half removed.
                grave = self._work() / f"removed-{artefact.id}-{uuid.uuid4().hex[:8]}"
                artefact.directory.chmod(0o755)
                artefact.directory.rename(grave)
                shutil.rmtree(grave)
            for path in work:
                remove(path)
                (self._locks() / path.name).unlink(missing_ok=True)
            for directory in (self.root, self._keys(), self._names()):
                remove_leftovers(directory)
            return artefacts, work


def _stored_inputs(artefact: Artefact, roles: Iterable[str]) -> list[str]:
    """The ids that the inputs ``roles`` were read from, those of files outside the store left out."""
    try:
        places = artefact.provenance().get("inputs") if roles else None
    except IntegrityError:
        return []
    if not isinstance(places, dict):
        return []
    texts = [str(places.get(role, "")).partition("/") for role in roles]
    return [id16 for id16, slash, _ in texts if slash and re.fullmatch(_ID, id16)]


def _recorded_command(directory: Path) -> str:
    """The command line in a provenance that need not be sound; empty if it cannot be told."""
    import shlex

    try:
        return shlex.join(read_json(directory / PROVENANCE)["record"]["command"])
    except (IntegrityError, KeyError, TypeError):
        return ""


def _pointers(keys: Path) -> Iterator[tuple[Path, str]]:
    """The claims that lead to an id, and that id, without trusting any manifest."""
    for path in keys.iterdir():
        id16 = _pointed_to(path)
        if re.fullmatch(_KEY, path.name) and id16 is not None:
            yield path, id16


def _pointed_to(path: Path) -> str | None:
    """The id that a name or a claim holds; None for anything else, however large."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return None
        with open(path, "rb") as file:
            text = file.read(2 * _ID_DIGITS).decode("ascii").strip()
    except (FileNotFoundError, UnicodeDecodeError):
        return None
    return text if re.fullmatch(_ID, text) else None


def _has_size(path: Path, size: int) -> bool:
    try:
        information = path.stat()
    except OSError:
        return False
    return stat.S_ISREG(information.st_mode) and information.st_size == size


def _older(path: Path, limit: float) -> bool:
    """Whether ``path`` was last changed before ``limit`` [s since 1970]; what is gone was not."""
    try:
        return path.stat().st_mtime < limit
    except FileNotFoundError:
        return False


def _entries(directory: Path) -> list[Path]:
    """Everything below ``directory`` but plain directories."""
    return [p for p in directory.rglob("*") if p.is_symlink() or not p.is_dir()]


def _fsync_file(path: Path) -> None:
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def _output_problem(directory: Path, output: Output, quick: bool = False) -> str | None:
    path = directory / output.path
    try:
        information = path.lstat()
    except OSError as error:
        return f"{path} cannot be read ({error.strerror})"
    if not stat.S_ISREG(information.st_mode):
        return f"{path} is not a plain file"
    if any((directory / part).is_symlink() for part in Path(output.path).parents):
        return f"{path} is reached through a symbolic link"
    if information.st_size != output.size:
        return f"{path} has {information.st_size} bytes instead of {output.size}"
    try:
        altered = not quick and file_digest(path) != output.sha256
    except OSError as error:
        return f"{path} cannot be read ({error.strerror})"
    if altered:
        return f"{path} has other bytes than were published"
    return None
