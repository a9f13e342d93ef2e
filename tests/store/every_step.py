"""Break a process at the calls it makes of the operating system.

Each call that changes the file system is numbered; the process is killed, or the call fails, at
every number in turn.
"""

from __future__ import annotations

import builtins
import io
import os
import signal
from collections.abc import Callable
from typing import Any

_OS_CALLS = ("fsync", "rename", "replace", "link", "chmod", "unlink", "rmdir", "mkdir", "open")
_SITES = [(os, name) for name in _OS_CALLS] + [(builtins, "open"), (io, "open")]
ENOUGH = 300  # far more calls than publishing or copying one artefact makes


class Torn:
    """A file whose writes can be interrupted half way."""

    def __init__(self, file: Any, at_call: Callable[..., None]):
        self._file, self._at_call = file, at_call

    def write(self, data: Any) -> int:
        def half() -> None:
            self._file.write(data[: len(data) // 2])
            self._file.flush()

        self._at_call("write", (), half)
        return self._file.write(data)

    def __enter__(self) -> Torn:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def intercept(put: Callable[[Any, str, Any], None], at_call: Callable[..., None]) -> None:
    """Announce every call that can change the file system to ``at_call(name, args, half)``."""

    def wrapped(original: Callable, name: str) -> Callable:
        def call(*args: Any, **kwargs: Any) -> Any:
            at_call(name, args, lambda: None)
            result = original(*args, **kwargs)
            writable = isinstance(result, io.IOBase) and result.writable()
            return Torn(result, at_call) if writable else result

        return call

    for module, name in _SITES:
        put(module, name, wrapped(getattr(module, name), name))


def counter(limit: int, act: Callable[[Callable[[], None]], None], persist: bool = False):
    """An ``at_call`` that lets ``limit`` calls pass, then acts (once, or from then on)."""
    seen = 0

    def at_call(name: str, args: tuple, half: Callable[[], None]) -> None:
        nonlocal seen
        seen += 1
        if seen == limit + 1 or (persist and seen > limit):
            act(half)

    return at_call


def in_child(work: Callable[[], None]) -> int:
    """The wait status of a forked child that does ``work`` (99 if it raises)."""
    pid = os.fork()
    if pid == 0:
        code = 99
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return os.waitpid(pid, 0)[1]


def kill_self(half: Callable[[], None]) -> None:
    half()
    os.kill(os.getpid(), signal.SIGKILL)
