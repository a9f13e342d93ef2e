"""Where a stage at work keeps its checkpoint, so that a killed run goes on from there."""

from __future__ import annotations

import hashlib
import os
import shutil
import uuid
from contextlib import suppress
from pathlib import Path

CHECKPOINT = "checkpoint"


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
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    fsync_directory(path.parent)


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
        if not path.exists():
            return None
        stored = path.read_bytes()
        if hashlib.sha256(stored[32:]).digest() != stored[:32]:
            raise ValueError(f"{path} is damaged")
        return stored[32:]

    def discard_checkpoint(self) -> None:
        """Forget the checkpoint: the stage starts over."""
        (self.directory / CHECKPOINT).unlink(missing_ok=True)

    def new_output(self) -> Path:
        """An empty directory for one attempt's outputs; those of dead processes are removed."""
        self.directory.mkdir(exist_ok=True)
        node = os.uname().nodename
        for stale in self.directory.glob("out.*"):
            _, pid, _, *owner = stale.name.split(".", 3)
            if owner == [node] and not _alive(int(pid)):
                shutil.rmtree(stale)
        path = self.directory / f"out.{os.getpid()}.{uuid.uuid4().hex}.{node}"
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
