"""Errors that a user can act on: each carries an exit code and a hint.

Every module raises these for input it cannot use; only the command line turns them into
text and an exit status. Anything else that escapes is a defect of the program.
"""

from __future__ import annotations

from collections.abc import Iterable


class IrlError(Exception):
    """An error with a one-line message, a hint and the exit code it maps to.

    ``details`` are for programs: ``--json`` shows them beside the message.
    """

    exit_code = 1

    def __init__(self, message: str, hint: str = ""):
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.details: dict[str, object] = {}


class StageFailed(IrlError):
    """A stage could not finish its work (exit 1)."""

    exit_code = 1


class UsageError(IrlError):
    """The request itself is wrong: an unknown name, value, setting or flag (exit 2)."""

    exit_code = 2


class NotFound(IrlError):
    """A reference names no artefact or file, or more than one (exit 3)."""

    exit_code = 3


class IntegrityError(IrlError):
    """Stored bytes are not what they were when published, or are not ours to read (exit 4)."""

    exit_code = 4

    def __init__(self, message: str, hint: str = "make it again, or name another"):
        super().__init__(message, hint)


class NewerFormat(IntegrityError):
    """Sound bytes in a form that only a newer version of this program knows (exit 4)."""

    def __init__(self, what: str, found: object, known: int):
        super().__init__(
            f"{what} has schema {found}, newer than the {known} known here",
            "it was written by a newer irlcli: upgrade this one",
        )


class Busy(IrlError):
    """Another process holds what this one needs; trying again later will work (exit 75)."""

    exit_code = 75


class Interrupted(IrlError):
    """Stopped by a signal after a checkpoint was written (exit 130)."""

    exit_code = 130


def closest(name: str, known: Iterable[str]) -> str | None:
    """The known name that a mistyped ``name`` most likely means, if one is near."""
    # Imported here: only mistakes need it, and every command imports this module.
    import difflib

    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return close[0] if close else None


def suggest(name: str, known: Iterable[str]) -> str:
    """A hint for a mistyped ``name``: the closest known one, and all of them."""
    known = sorted(known)
    close = closest(name, known)
    listed = f"known: {', '.join(known)}"
    return f"did you mean {close!r}? {listed}" if close else listed
