"""A line for each stage in a notebook, with a bar while it runs.

No widgets: every front end of Jupyter shows it, and a saved notebook keeps the last state.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from irlcli.cli.console import Pace, TerminalConsole, printable
from irlcli.experiments.runner import Silent
from irlcli.requests.in_python import in_python
from irlcli.store import Artefact

_SECONDS_BETWEEN_UPDATES = 0.25


def console(quiet: bool) -> NotebookConsole | PlainConsole:
    """The console for a notebook, or else for a terminal or a file."""
    return NotebookConsole(quiet) if _in_notebook() else PlainConsole(quiet)


def _in_notebook() -> bool:
    # Whoever runs in a notebook has imported it.
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


class _Line:
    """A line of text, after a bar if ``share`` of the work is done."""

    def __init__(self, text: str, share: float | None = None):
        self._text = printable(text)
        self._share = share

    def __repr__(self) -> str:
        return self._text if self._share is None else f"{self._share:4.0%} {self._text}"

    def _repr_html_(self) -> str | None:
        if self._share is None:
            return None
        return f'<progress value="{self._share:.4f}"></progress> <code>{escape(self._text)}</code>'


class PlainConsole(TerminalConsole):
    """The command line's console; warnings call options as arguments."""

    def warn(self, message: str) -> None:
        """Print a warning, also if quiet."""
        super().warn(in_python(message))


class NotebookConsole(Silent):
    """Progress of stages below the cell, warnings on its stderr.

    Args:
        quiet: show warnings only.
    """

    def __init__(self, quiet: bool):
        self._quiet = quiet
        self._label = ""
        self._pace, self._updated = Pace(), 0.0
        self._handle: Any = None

    def start(self, label: str, resumed: bool, key: str = "") -> None:
        """A stage starts; ``resumed`` from a checkpoint or not. ``key`` is not shown."""
        self._label, self._pace, self._updated = label, Pace(), 0.0
        self._show(_Line(f"{'RESUME' if resumed else 'RUN'} {label}"))

    def progress(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> None:
        """Progress of the running stage."""
        words = self._pace.words(done, total, unit, facts)
        now = time.monotonic()
        if now - self._updated >= _SECONDS_BETWEEN_UPDATES or done >= total:
            self._updated = now
            self._show(_Line(f"{self._label}  {words}", done / total if total else 1.0))

    def finish(self, label: str, artefact: Artefact, hit: bool) -> None:
        """A stage ended, or its artefact existed (``hit``)."""
        self._end(f"{'HIT' if hit else 'DONE'} {label}: {artefact.directory}")

    def found(self, label: str, artefact: Artefact, where: Path | str) -> None:
        """An artefact was copied from the store ``where``."""
        self._end(f"FOUND {label}: {artefact.directory}, copied from {where}")

    def wait(self, label: str, holder: str) -> None:
        """Another process makes the same artefact, or runs gc."""
        self.say(f"WAIT {label}: {holder} is at work on it")

    def warn(self, message: str) -> None:
        """Print a warning, also if quiet."""
        print(printable(f"warning: {in_python(message)}"), file=sys.stderr, flush=True)

    def say(self, text: str) -> None:
        """Print a line."""
        if not self._quiet:
            print(printable(text), flush=True)

    def close(self) -> None:
        """No stage runs any more; one that did not finish was stopped."""
        if self._handle is not None:
            self._end(f"STOPPED {self._label}")

    def _end(self, text: str) -> None:
        self._show(_Line(text))
        self._handle = None

    def _show(self, line: _Line) -> None:
        if self._quiet:
            return
        if self._handle is not None:
            self._handle.update(line)
            return
        from IPython.display import display

        self._handle = display(line, display_id=True)
