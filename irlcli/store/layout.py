"""Where a store keeps its files, and how they are named.

::

    runs/STORE                     format version
    runs/<id16>/                   manifest.json provenance.json reward.pt ...
    runs/.keys/<key>               id16 of the artefact that holds the key
    runs/.names/<name>             id16 of the artefact that has the name
    runs/.work/<key>/              checkpoint and unfinished outputs of a running stage
    runs/.locks/  .quarantine/
    runs/.jobs/                    what was submitted to a cluster, with the jobs' logs
"""

import errno
import os
import re
import shlex
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import IntegrityError, StageFailed, UsageError
from irlcli.store.digest import is_hexadecimal, is_sha256
from irlcli.store.durable import unique_name, write_durably
from irlcli.store.manifest import read_json

FORMAT = 1
DEFAULT_ROOT = "runs"
ID_DIGITS = 16
_KEY_DIGITS = 64
_LEAST_DIGITS = 3
_NAME = r"[A-Za-z][A-Za-z0-9._-]{0,99}"
_OWN = (".keys", ".names", ".work", ".locks", ".quarantine")
# Made by those who submit to a cluster.
_JOBS = ".jobs"
_NO_LINKS = (errno.EPERM, errno.ENOSYS, errno.EOPNOTSUPP)


class Layout(NamedTuple):
    """The paths of the store in the directory ``root``.

    A ``read_only`` store is never changed: nothing is created, moved or locked in it.
    """

    root: Path
    read_only: bool = False

    @property
    def option(self) -> list[str]:
        """The words that name this store on a command line; none if it is the default."""
        default = Path(os.environ.get("IRL_STORE") or DEFAULT_ROOT)
        return [] if self.root == default else ["--store", str(self.root)]

    @property
    def listing(self) -> str:
        """The command that lists the artefacts, as the end of a hint."""
        return f"`{shlex.join(['irl', 'ls', *self.option])}` lists the artefacts"

    @property
    def marker(self) -> Path:
        return self.root / "STORE"

    @property
    def keys(self) -> Path:
        return self.root / ".keys"

    @property
    def names(self) -> Path:
        return self.root / ".names"

    @property
    def work(self) -> Path:
        return self.root / ".work"

    @property
    def locks(self) -> Path:
        return self.root / ".locks"

    @property
    def quarantine(self) -> Path:
        return self.root / ".quarantine"

    @property
    def jobs(self) -> Path:
        return self.root / _JOBS

    @property
    def gc_lock(self) -> Path:
        return self.locks / "gc"


def store_around(path: Path) -> Path | None:
    """The store that holds ``path``, an artefact's directory or a file directly in one, if any does."""
    # Unlike Path.exists(), it does not raise for a name that no file system can hold.
    if not os.path.exists(path):
        return None
    around = path.absolute().parents[:2]
    return next((root for root in around if Layout(root).marker.is_file()), None)


def _marker_hint(layout: Layout) -> str:
    """How to mend the file by which a store is known."""
    return f"""if this is a store of irlcli, write {{"format": {FORMAT}}} to {layout.marker}"""


def check(layout: Layout) -> None:
    """Check that the root is a store of a known format, an empty directory, or absent.

    Raises:
        IntegrityError: the root is a newer store, or has links in place of directories.
        UsageError: the root is not a directory, or holds other files.
    """
    root, marker = layout.root, layout.marker
    hint = "name a directory: an artefact store, or one that is empty or not there yet"
    try:
        if not stat.S_ISDIR(root.stat().st_mode):
            raise UsageError(f"{root} is not a directory", hint)
    except FileNotFoundError:
        pass
    except OSError as error:
        raise UsageError(f"{root} cannot be a store ({error.strerror})", hint) from None
    if marker.exists():
        try:
            value = read_json(marker)
        except IntegrityError as error:
            raise IntegrityError(error.message, _marker_hint(layout)) from None
        version = value.get("format") if isinstance(value, dict) else None
        if type(version) is not int or version < 1:
            raise IntegrityError(
                f"{marker} does not contain a format version", _marker_hint(layout)
            )
        if version > FORMAT:
            raise IntegrityError(
                f"{root} is a store of format {version}, newer than the supported {FORMAT}",
                "a newer irlcli wrote it: upgrade irlcli, or name another store",
            )
    elif root.exists() and any(
        # An interrupted create() leaves these behind.
        path.name not in _OWN and not path.name.startswith(".STORE.")
        for path in root.iterdir()
    ):
        if marker.exists():
            # Another process created the store meanwhile.
            return check(layout)
        if any(path.is_dir() for path in (layout.locks, layout.names)):
            raise IntegrityError(f"the store {root} has no file STORE", _marker_hint(layout))
        raise UsageError(
            f"{root} contains files but is not a store",
            "name a store" if layout.read_only else "name a store, or an empty or new directory",
        )
    for name in (*_OWN, _JOBS):
        if (root / name).is_symlink():
            # A link would let the store write, move and remove files elsewhere.
            raise IntegrityError(
                f"{root / name} is a symbolic link", "replace the link with a directory"
            )


def create(layout: Layout) -> None:
    """Create the directories and the format marker if they are missing.

    Raises:
        StageFailed: the root cannot be written, or its file system has no hard links.
    """
    if layout.marker.exists():
        # Those that git did not keep; whoever may only read the store works without them.
        with suppress(OSError):
            make_directories(layout)
        return
    try:
        make_directories(layout)
        # Created now: a user who may only read the store later cannot create it, but can lock it.
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        os.close(os.open(layout.gc_lock, flags, 0o666))
        _check_links(layout)
        write_durably(layout.marker, b'{"format": %d}\n' % FORMAT)
    except OSError as error:
        raise StageFailed(
            f"{layout.root} cannot become a store ({error.strerror or error})",
            "name a directory that can be written, with --store (IRL_STORE) or --to",
        ) from None


def _check_links(layout: Layout) -> None:
    """Refuse a file system without hard links now: publishing would fail after the work."""
    own = layout.locks / unique_name(".link")
    try:
        os.link(layout.gc_lock, own)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        raise StageFailed(
            f"{layout.root} is on a file system without hard links",
            "name a directory on another file system, with --store (IRL_STORE) or --to",
        ) from None
    own.unlink()


def make_directories(layout: Layout) -> None:
    """Create the store's own directories; git, for one, does not keep empty ones."""
    for name in _OWN:
        (layout.root / name).mkdir(parents=True, exist_ok=True)


def is_id(text: str) -> bool:
    """Whether ``text`` is the name of an artefact's directory."""
    return len(text) == ID_DIGITS and is_hexadecimal(text)


def is_prefix(text: str) -> bool:
    """Whether ``text`` can be the beginning of an id: 3 to 64 hexadecimal digits."""
    return _LEAST_DIGITS <= len(text) <= _KEY_DIGITS and is_hexadecimal(text)


def is_name(text: str) -> bool:
    """Whether ``text`` has the form of a name: not that of an id's beginning."""
    return re.fullmatch(_NAME, text) is not None and not is_prefix(text)


def claims(layout: Layout) -> Iterator[tuple[Path, str]]:
    """Each key's file and the id it points to. Reads no manifest."""
    if not layout.keys.is_dir():
        return
    for path in layout.keys.iterdir():
        id16 = pointed_to(path)
        if is_sha256(path.name) and id16 is not None:
            yield path, id16


def pointer_to(id16: str) -> bytes:
    """What the file of a name or key contains."""
    return id16.encode() + b"\n"


def pointed_to(path: Path) -> str | None:
    """The id that the file of a name or key contains; None if absent or malformed."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return None
        with open(path, "rb") as file:
            text = file.read(2 * ID_DIGITS).decode("ascii").strip()
    except (FileNotFoundError, UnicodeDecodeError):
        return None
    return text if is_id(text) else None
