"""Where a stage at work keeps its checkpoint, so that a killed run goes on from there."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

CHECKPOINT = "checkpoint"
# The largest that a stage writes are some tens of MB.
_MAX_BYTES = 1 << 30


def fsync_directory(path: Path) -> None:
    """Make the names in a directory durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_durably(path: Path, data: bytes) -> None:
    """Replace ``path`` with ``data``: after a crash it holds the old bytes or the new ones.

    Raises:
        OSError: the disk is full or the directory not writable; ``path`` is as it was.
    """
    with temporary_file(path, data) as temporary:
        os.replace(temporary, path)
    fsync_directory(path.parent)


@contextmanager
def temporary_file(path: Path, data: bytes) -> Iterator[Path]:
    """``data``, durable, in a file beside ``path`` that is gone afterwards."""
    temporary = path.with_name(_of_this_process(f".{path.name}"))
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _of_this_process(stem: str) -> str:
    """A file name nobody else uses, which says whose it is."""
    return f"{stem}.{os.getpid()}.{uuid.uuid4().hex}.{os.uname().nodename}"


def remove_leftovers(directory: Path) -> None:
    """Remove what dead processes of this machine left half-written in ``directory``."""
    node = re.escape(os.uname().nodename)
    for path in directory.iterdir():
        owner = re.fullmatch(rf".+\.(\d{{1,9}})\.[0-9a-f]{{32}}\.{node}", path.name)
        if owner and not _alive(int(owner[1])):
            remove(path)


def remove(path: Path) -> None:
    """Remove a file, a link (not what it points to) or a directory with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


class Scratch:
    """The working directory of one key, made on first use: a checkpoint, outputs per attempt."""

    def __init__(self, directory: Path):
        self.directory = directory

    def save(self, data: bytes) -> None:
        """Replace the checkpoint by ``data``."""
        self.directory.mkdir(exist_ok=True)
        write_durably(self.directory / CHECKPOINT, hashlib.sha256(data).digest() + data)

    def load(self) -> bytes | None:
        """The checkpoint's bytes; None where there is none.

        Raises:
            ValueError: the checkpoint's bytes are not those that were saved.
        """
        path = self.directory / CHECKPOINT
        try:
            information = path.lstat()
        except FileNotFoundError:
            return None
        if not stat.S_ISREG(information.st_mode) or information.st_size > _MAX_BYTES:
            raise ValueError(f"{path} is not one that was written here")
        stored = path.read_bytes()
        if hashlib.sha256(stored[32:]).digest() != stored[:32]:
            raise ValueError(f"{path} is damaged")
        return stored[32:]

    def discard_checkpoint(self) -> None:
        """Forget the checkpoint: the stage starts over."""
        remove(self.directory / CHECKPOINT)

    def new_output(self) -> Path:
        """An empty directory for one attempt's outputs; what dead processes left is removed."""
        self.directory.mkdir(exist_ok=True)
        remove_leftovers(self.directory)
        path = self.directory / _of_this_process("out")
        path.mkdir()
        return path

    def clear(self) -> None:
        """Forget the checkpoint; the directory goes too unless another process works in it."""
        self.discard_checkpoint()
        with suppress(OSError):
            self.directory.rmdir()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
