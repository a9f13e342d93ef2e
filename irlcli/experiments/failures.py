"""Why a step failed, read from what its process left."""

import signal
from collections.abc import Sequence
from typing import NamedTuple

# A process's error and hint are among its last lines.
LAST_LINES = 20


class Failure(NamedTuple):
    """Why a step failed: the exit code of its process, its error line and its hint."""

    code: int
    message: str
    hint: str


def failure(code: int, lines: Sequence[str]) -> Failure:
    """Why a process failed that ended with ``code``, after it wrote ``lines`` to stderr."""

    def after(prefix: str) -> str:
        found = [line for line in lines if line.startswith(prefix)]
        return found[-1].removeprefix(prefix) if found else ""

    if code < 0:
        reason = f"its process was killed by signal {-code}"
        hint = "run the same command again: it resumes"
        if code == -signal.SIGKILL:
            hint += ". If memory ran out, use fewer --jobs or --workers"
        return Failure(1, reason, hint)
    message = after("error: ") or (lines[-1] if lines else f"exit code {code}")
    return Failure(code, message, after("hint: "))
