"""Writing files so that a crash leaves the old content or the new, never a part."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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


def write_durably(path: Path, data: bytes) -> None:
    """Replace the content of ``path`` with ``data``, atomically.

    Raises:
        OSError: the disk is full or the directory not writable; ``path`` is unchanged.
    """
    with temporary_file(path, data) as temporary:
        os.replace(temporary, path)
    fsync_directory(path.parent)


@contextmanager
def temporary_file(path: Path, data: bytes) -> Iterator[Path]:
    """A durable file beside ``path`` that contains ``data`` and is removed afterwards."""
    temporary = path.with_name(unique_name(f".{path.name}"))
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def unique_name(stem: str) -> str:
    """A file name that no other process uses and that identifies this one."""
    return f"{stem}.{os.getpid()}.{os.urandom(16).hex()}.{os.uname().nodename}"


def remove_leftovers(directory: Path) -> None:
    """Remove the files that dead processes of this machine left in ``directory``."""
    node = re.escape(os.uname().nodename)
    for path in directory.iterdir():
        owner = re.fullmatch(rf".+\.(\d{{1,9}})\.[0-9a-f]{{32}}\.{node}", path.name)
        if owner and not alive(int(owner[1])):
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
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
