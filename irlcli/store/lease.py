"""Leases: files with a heartbeat, which say across machines who works on what.

Some shared file systems lock for one machine only, or not at all. A lease is a file that its
holder touches every :data:`HEARTBEAT_SECONDS`. One that was not touched for
:data:`STALE_SECONDS` is taken over. A holder that was suspended for longer, and wakes up, does at
most the same work twice. A reader that was suspended for longer may find that gc has deleted an old
artefact without a name: its command fails, and can be run again.

Ages are differences between two times of the same file system, so that the clocks of the machines
need not agree.
"""

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import Busy
from irlcli.store.durable import alive, machine, open_plainly, remove, unique_name

HEARTBEAT_SECONDS = 20.0
# NFS clients may show times that are 60 s old, so a live lease can look 80 s old.
STALE_SECONDS = 120.0
_POLL_SECONDS = 2.0
_READER = ".reader"


class Holder(NamedTuple):
    """What the lease ``path`` says of its holder, and when it was touched [s].

    A lease that cannot be read says nothing.
    """

    path: Path
    touched: float
    host: str = ""
    machine: str = ""
    process: int = 0
    token: str = ""

    def __str__(self) -> str:
        return f"process {self.process} on {self.host}" if self.host else "another process"

    def lives(self, locks_work: bool) -> bool:
        """Whether it is at work. Where locks work, the caller holds the lock of this machine."""
        if self.machine == machine() and (locks_work or not alive(self.process)):
            return False
        return _now(self.path.parent) - self.touched < STALE_SECONDS


class Patience:
    """Whether to wait for whoever is working on ``what``.

    Args:
        what: for the error message.
        wait: wait instead of raising.
        on_wait: called once, with a description of the holder, before waiting.
    """

    def __init__(
        self,
        what: str = "the same artefact",
        wait: bool = False,
        on_wait: Callable[[str], None] | None = None,
    ):
        self._what, self._wait, self._on_wait = what, wait, on_wait

    def meet(self, holder: Holder | str) -> None:
        """Tell of ``holder`` and return, so that the caller waits.

        Raises:
            Busy: there is to be no waiting.
        """
        if not self._wait:
            raise Busy(f"{holder} is working on {self._what}", "try again later")
        if self._on_wait is not None:
            self._on_wait(str(holder))
            self._on_wait = None


@contextmanager
def leased(path: Path, locks_work: bool, patience: Patience) -> Iterator[None]:
    """Hold the lease ``path``. Call this while holding the lock of this machine, if it has locks.

    Without effect where the file cannot be written, for example on a full disk.

    Raises:
        Busy: a live process holds it, and ``patience`` is not to wait.
    """
    token = os.urandom(16).hex()
    while not _create(path, token):
        holder = read(path)
        if holder is None:
            continue
        if holder.lives(locks_work):
            patience.meet(holder)
            time.sleep(_POLL_SECONDS)
        else:
            _remove(path, holder.token)
    with _beating(path, token):
        yield


@contextmanager
def reading(directory: Path, gc: Path, locks_work: bool, patience: Patience) -> Iterator[None]:
    """Keep the holder of the lease ``gc`` from starting, by this process's own file in ``directory``.

    Raises:
        Busy: a live process holds ``gc``, and ``patience`` is not to wait.
    """
    token = os.urandom(16).hex()
    while True:
        own = directory / unique_name(_READER)
        _create(own, token)
        with _beating(own, token):
            # Each of the two writes its own file before it looks for the other's.
            holder = read(gc)
            if holder is None or not holder.lives(locks_work):
                yield
                return
        patience.meet(holder)
        time.sleep(_POLL_SECONDS)


def live_reader(directory: Path, locks_work: bool) -> Holder | None:
    """A live process that reads the store, if there is one. Files of dead ones are removed."""
    for path in directory.glob(f"{_READER}.*"):
        holder = read(path)
        if holder is not None and holder.lives(locks_work):
            return holder
        remove(path)
    return None


def is_leased(path: Path) -> bool:
    """Whether a live process holds the lease ``path``."""
    holder = read(path)
    return holder is not None and holder.lives(locks_work=False)


def read(path: Path) -> Holder | None:
    """The holder of a lease; None if nobody holds it."""
    try:
        # Opened and not only looked up, so that a file system of the network asks its server.
        with open(path, "rb", opener=open_plainly) as file:
            touched = os.fstat(file.fileno()).st_mtime
            text = file.read(1000)
    except FileNotFoundError:
        return None
    except OSError:
        # A link or a directory, for example: no lease, and to be removed.
        return Holder(path, 0.0)
    try:
        said = json.loads(text)
        host, where, token = (str(said[field]) for field in ("host", "machine", "token"))
        return Holder(path, touched, host, where, int(said["process"]), token)
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        # Cut short, or no lease.
        return Holder(path, touched)


def _token(path: Path) -> str | None:
    holder = read(path)
    return None if holder is None else holder.token


def _now(directory: Path) -> float:
    """The time of the file system; of this machine where nothing can be written."""
    path = directory / unique_name(".now")
    try:
        path.touch(exist_ok=False)
        return path.stat().st_mtime
    except OSError:
        return time.time()
    finally:
        with suppress(OSError):
            path.unlink()


def _create(path: Path, token: str) -> bool:
    """Create the lease; False if it exists. True also where it cannot be written at all."""
    said = {
        "host": os.uname().nodename,
        "machine": machine(),
        "process": os.getpid(),
        "token": token,
    }
    # Linked when it is whole: the holder of an empty lease is unknown, and lives until it is stale.
    whole = path.with_name(unique_name(f".{path.name}"))
    try:
        with open(whole, "x") as file:
            file.write(json.dumps(said))
        os.link(whole, path)
    except FileExistsError:
        return False
    except OSError:
        pass
    finally:
        with suppress(OSError):
            whole.unlink()
    return True


def _remove(path: Path, token: str) -> None:
    """Remove the lease if it still holds ``token``; of several processes, one does."""
    aside = path.with_name(unique_name(f".{path.name}"))
    try:
        os.rename(path, aside)
    except FileNotFoundError:
        return
    if _token(aside) not in (token, None):
        # Another process took it over first: give it back.
        with suppress(FileExistsError):
            os.link(aside, path)
    remove(aside)


@contextmanager
def _beating(path: Path, token: str) -> Iterator[None]:
    """Touch the lease of this process as long as it holds it. A forked child has no threads.

    It is created again if it is gone: the disk was full, or another process took this one for dead.
    """
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(HEARTBEAT_SECONDS):
            there = _token(path)
            if there is None:
                _create(path, token)
            elif there == token:
                with suppress(OSError):
                    os.utime(path, follow_symlinks=False)

    beating = threading.Thread(target=beat, daemon=True)
    beating.start()
    try:
        yield
    finally:
        ended.set()
        # Otherwise it might create the lease again.
        beating.join()
        if _token(path) == token:
            path.unlink(missing_ok=True)
