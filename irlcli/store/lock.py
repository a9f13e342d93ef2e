"""Advisory file locks (flock).

Publishing is safe without them. They avoid duplicate work, and keep gc from deleting what a command
is using. They hold between the processes of one machine. Between machines, and on file systems without
locks, leases do this (:mod:`irlcli.store.lease`).
"""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from irlcli.errors import Busy
from irlcli.store.lease import Patience, is_leased, leased, read

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def locked(
    path: Path, patience: Patience | None = None, shared: bool = False
) -> Iterator[str | None]:
    """Hold a lock on ``path``. The kernel releases it however the process ends.

    The value is None, or why the file system has no locks; then nothing is held.

    Args:
        path: lock file, created if absent.
        patience: whether to wait for the present holder; by default, not.
        shared: allow several holders.

    Raises:
        Busy: another process holds it, and ``patience`` is not to wait.
    """
    # A shared lock needs no write permission, so readers of a read-only store can take it.
    access = os.O_RDONLY if shared else os.O_RDWR
    # Opening a named pipe would wait for a writer.
    flags = os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    descriptor = os.open(path, access | flags, 0o666)
    try:
        mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        problem = None
        try:
            fcntl.flock(descriptor, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            (patience or Patience()).meet(read(lease_of(path)) or "another process")
            fcntl.flock(descriptor, mode)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            problem = error.strerror
        yield problem
    finally:
        os.close(descriptor)


@contextmanager
def exclusive(path: Path, patience: Patience) -> Iterator[str | None]:
    """As :func:`locked`, also between machines: the lock, and a lease beside it."""
    with (
        locked(path, patience) as problem,
        leased(lease_of(path), problem is None, patience),
    ):
        yield problem


def lease_of(path: Path) -> Path:
    """The lease beside the lock ``path``."""
    # As earlier versions call it, which may use the same store.
    return path.with_name(f"{path.name}.claim")


def is_locked(path: Path) -> bool:
    """Whether a process holds ``path`` exclusively."""
    if is_leased(lease_of(path)):
        return True
    if not path.exists():
        return False
    try:
        # A shared lock: the probe must not be mistaken for a holder.
        with locked(path, shared=True):
            return False
    except Busy:
        return True
