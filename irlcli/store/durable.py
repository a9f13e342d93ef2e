"""Writing files so that a crash leaves the old content or the new, never a part."""

import functools
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_DAY_SECONDS = 86400.0


def open_plainly(path: str, flags: int) -> int:
    """An opener that follows no link and does not wait for a pipe's other end."""
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK)


def fsync_file(path: Path) -> None:
    """Make a file's content durable."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())


def fsync_directory(path: Path | str) -> None:
    """Make the names in a directory durable."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_durably(path: Path, *data: bytes) -> None:
    """Replace the content of ``path`` with all ``data``, one after the other, atomically.

    Raises:
        OSError: the disk is full or the directory not writable; ``path`` is unchanged.
    """
    with temporary_file(path, *data) as temporary:
        os.replace(temporary, path)
    fsync_directory(path.parent)


@contextmanager
def temporary_file(path: Path, *data: bytes) -> Iterator[Path]:
    """A durable file beside ``path`` that contains all ``data`` and is removed afterwards."""
    temporary = path.with_name(unique_name(f".{path.name}"))
    try:
        with open(temporary, "wb") as file:
            for part in data:
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


@functools.cache
def machine() -> str:
    """Where process ids have the meaning that they have here.

    Containers and cloned machines may share a host name but neither boot nor process namespace.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{os.uname().nodename}-{boot[:8]}-{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return os.uname().nodename


def unique_name(stem: str) -> str:
    """A file name that no other process uses and that identifies this one."""
    return f"{stem}.{os.getpid()}.{os.urandom(16).hex()}.{machine()}"


def remove_leftovers(directory: Path) -> None:
    """Remove what dead processes left in ``directory``: those of other machines after a day.

    What another user's processes left is kept if only its owner can remove it.
    """
    for path in directory.iterdir():
        owner = re.fullmatch(r".+\.(\d{1,9})\.[0-9a-f]{32}\.(.+)", path.name)
        if owner is None:
            continue
        try:
            old = path.lstat().st_mtime < time.time() - _DAY_SECONDS
        except FileNotFoundError:
            continue
        if not alive(int(owner[1])) if owner[2] == machine() else old:
            # Another process may remove it at the same time.
            with suppress(PermissionError, FileNotFoundError):
                remove(path)


def remove(path: Path) -> None:
    """Remove a file, a symbolic link (not its target), or a directory with its content."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def alive(pid: int) -> bool:
    """Whether a process of this machine has the id ``pid``."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
