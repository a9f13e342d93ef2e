"""Errors that a user can act on. Each has an exit code and a hint.

Any module raises them for input that it cannot use. Only the command line turns them into text and
an exit status. Every other exception that reaches the command line is a bug.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

RETRY = "No partial output was written. Fix the problem and run the same command again."


class IrlError(Exception):
    """An error with a one-line message, a hint and an exit code.

    ``details`` are for programs: ``--json`` prints them next to the message.
    """

    exit_code = 1

    def __init__(self, message: str, hint: str = "", details: Mapping[str, object] | None = None):
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.details = details or {}

    def __str__(self) -> str:
        return f"{self.message}\nhint: {self.hint}" if self.hint else self.message


class StageFailed(IrlError):
    """A stage could not finish its work (exit 1)."""


class UsageError(IrlError):
    """The request is wrong: an unknown name, value, setting or flag (exit 2)."""

    exit_code = 2


class NotFound(IrlError):
    """A reference matches no artefact or file, or more than one (exit 3)."""

    exit_code = 3


class IntegrityError(IrlError):
    """Stored bytes differ from what was published, or have an unsupported format (exit 4)."""

    exit_code = 4

    def __init__(
        self,
        message: str,
        hint: str = "recompute it, or choose another one",
        details: Mapping[str, object] | None = None,
    ):
        super().__init__(message, hint, details)


class NewerFormat(IntegrityError):
    """Intact bytes in a format that only a newer version of this program reads (exit 4)."""

    def __init__(self, what: str, found: object, known: int):
        super().__init__(
            f"{what} has schema {found}, newer than {known}, the newest that this version reads",
            "a newer irlcli wrote it: upgrade irlcli to read it",
        )


class Busy(IrlError):
    """Another process holds a lock that this one needs; retry later (exit 75)."""

    exit_code = 75


class Interrupted(IrlError):
    """A signal stopped the run after a checkpoint was written (exit 130)."""

    exit_code = 130


def imported(what: str, place: str) -> Any:
    """The object at ``place`` (``module`` or ``module:name``), which ``what`` is registered with.

    Raises:
        StageFailed: it or what it imports is not installed, it has no such name, or it is not Python.
    """
    from pkgutil import resolve_name

    try:
        return resolve_name(place if ":" in place else f"{place}:")
    except (ImportError, AttributeError, SyntaxError) as error:
        hint = (
            "install its package, or name its folder in PYTHONPATH; or correct the registered name"
        )
        message = str(error)
        if isinstance(error, SyntaxError):
            message, hint = error.msg, f"correct {error.filename}, line {error.lineno}"
        elif (
            isinstance(error, ImportError)
            and error.name
            and not f"{place}:".startswith((f"{error.name}.", f"{error.name}:"))
        ):
            hint = f"the module imports {error.name}: install that, or correct the import"
        elif line := own_line(error):
            # The module itself raised it, while it was imported.
            hint = f"correct {line}"
        raise StageFailed(f"{what}: {place} cannot be imported ({message})", hint) from error


def file_failure(error: OSError) -> StageFailed:
    """A file that cannot be read or written, as an error with a hint."""
    where = f": {error.filename}" if error.filename else ""
    return StageFailed(f"{error.strerror or error}{where}", RETRY)


def first_line(error: BaseException) -> str:
    """The first line with text of any exception's message, or its class if it has none."""
    return next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)


def described(error: BaseException) -> str:
    """The class of any exception, and the first line of its message if it has one."""
    name = type(error).__name__
    return f"{name}: {first_line(error)}" if str(error).strip() else name


def own_line(error: BaseException) -> str:
    """``FILE, line N``: the last line outside this package and Python's libraries that led to ``error``.

    Empty if there is none.
    """
    import os
    import sysconfig
    import traceback
    from pathlib import Path

    installed = (
        sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")
    )
    paths = [os.path.dirname(__file__), *installed]
    libraries = tuple(os.path.realpath(path) + os.sep for path in paths)
    places = [
        f"{frame.filename}, line {frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if os.path.isfile(frame.filename)
        and not os.path.realpath(frame.filename).startswith(libraries)
        and {"site-packages", "dist-packages"}.isdisjoint(Path(frame.filename).parts)
    ]
    return places[-1] if places else ""


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name that is most similar to ``name``, or ``None`` if none is similar."""
    # Imported here because only mistakes need it, and every command imports this module.
    import difflib

    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return close[0] if close else None


def suggest(name: str, known: Iterable[str]) -> str:
    """A hint for a mistyped ``name``: the most similar known name, and all known names."""
    known = sorted(known)
    close = closest(name, known)
    listed = f"known: {', '.join(known) or 'none'}"
    return f"did you mean {close!r}? {listed}" if close else listed
