"""Advisory file locks (flock). They only save work; correctness is the publish protocol's."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from irlcli.errors import Busy


@contextmanager
def locked(
    path: Path,
    *,
    shared: bool = False,
    wait: bool = False,
    on_wait: Callable[[str], None] | None = None,
    what: str = "this",
) -> Iterator[None]:
    """Hold ``path`` locked; the kernel releases it however the process ends.

    Args:
        path: lock file, created if absent and never removed while it could be held.
        shared: several holders may share it.
        wait: wait for the present holder instead of raising.
        on_wait: told once, with the holder's description, before waiting.
        what: what it stands for, in an error's words.

    Raises:
        Busy: held by another process and ``wait`` is false.
    """
    # A shared lock needs no write permission: a store that may only be read can be read safely.
    access = os.O_RDONLY if shared else os.O_RDWR
    descriptor = os.open(path, access | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        mode = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
        try:
            fcntl.flock(descriptor, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
            holder = holder or "another process"
            if not wait:
                raise Busy(f"{holder} is at work on {what} already", "try again later") from None
            if on_wait is not None:
                on_wait(holder)
            fcntl.flock(descriptor, mode)
        if not shared:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {os.uname().nodename}".encode(), 0)
        yield
    finally:
        os.close(descriptor)


def is_locked(path: Path) -> bool:
    """Whether some process holds ``path`` exclusively now."""
    if not path.exists():
        return False
    try:
        # Shared: a probe must neither look like a holder nor write itself down as one.
        with locked(path, shared=True):
            return False
    except Busy:
        return True
