"""What ``irl run`` shows while it works: an overall bar and a line per running job."""

import re
import time
from typing import Any

from irlcli.cli.console import TerminalConsole, live_display
from irlcli.experiments.failures import Failure
from irlcli.labels import duration

_PLAIN_SECONDS = 60.0
_LONGEST_NAME = 32


class PlainJobs:
    """One line on stderr per event, and each job's progress once a minute."""

    def __init__(self, console: TerminalConsole):
        self._console = console
        self._done = self._total = 0
        self._printed: dict[str, float] = {}

    def begin(self, total: int, done: int) -> None:
        self._total, self._done = total, done
        self._console.say(f"{done} of {total} steps exist")

    def start(self, name: str) -> None:
        self._printed[name] = time.monotonic()
        self._console.say(f"RUN {name}")

    def line(self, name: str, text: str) -> None:
        if text.startswith("warning: "):
            self._console.warn(f"{name}: {text.removeprefix('warning: ')}")
        elif text.startswith("WAIT "):
            self._console.say(f"WAIT {name}: {text.rpartition(': ')[2]}")
        elif text.startswith("RESUME "):
            self._console.say(f"RESUME {name} from its checkpoint")
        elif text.startswith("  ") and self._is_due(name):
            self._console.say(f"  {name}: {text.rpartition(': ')[2]}")

    def _is_due(self, name: str) -> bool:
        now = time.monotonic()
        if now - self._printed.get(name, now) < _PLAIN_SECONDS:
            return False
        self._printed[name] = now
        return True

    def copied(self, name: str, why: str) -> None:
        self._done += 1
        self._console.say(f"FOUND {name}: copied from {why.removeprefix('in ')}")

    def done(self, name: str, seconds: float) -> None:
        self._done += 1
        self._console.say(f"DONE {name} in {duration(seconds)} ({self._done} of {self._total})")

    def failed(self, name: str, failure: Failure) -> None:
        self._console.warn(f"{name} failed: {failure.message}")
        if failure.hint:
            self._console.hint(failure.hint)

    def stopping(self, again: str = "to stop at once") -> None:
        self._console.warn(
            f"stopping: running steps write a checkpoint (repeat the signal {again})"
        )

    def close(self) -> None:
        """End the display."""


class LiveJobs(PlainJobs):
    """A live display on a terminal: what ended scrolls by above the bars."""

    def __init__(self, console: TerminalConsole):
        from rich.progress import BarColumn, TextColumn
        from rich.table import Column

        super().__init__(console)
        name = TextColumn("{task.fields[name]}", markup=False, table_column=Column(no_wrap=True))
        self._progress = live_display(name, BarColumn(bar_width=12))
        self._bars: dict[str, Any] = {}

    def begin(self, total: int, done: int) -> None:
        super().begin(total, done)
        self._overall = self._progress.add_task(
            "", total=total, completed=done, name="all steps", detail=f"{done} of {total}"
        )
        if done < total:
            self._console.share(self._progress)
            self._progress.start()

    def start(self, name: str) -> None:
        # Steps that run together differ at the end of their names.
        shown = name if len(name) <= _LONGEST_NAME else f"…{name[1 - _LONGEST_NAME :]}"
        self._bars[name] = self._progress.add_task("", total=None, name=shown, detail="starting")

    def line(self, name: str, text: str) -> None:
        if text.startswith("  ") and name in self._bars:
            detail = text.rpartition(": ")[2]
            share = re.match(r"([\d,]+)/([\d,]+) ", detail)
            if share:
                done, total = (int(number.replace(",", "")) for number in share.groups())
                self._progress.update(self._bars[name], completed=done, total=total)
            self._progress.update(self._bars[name], detail=detail)
        else:
            super().line(name, text)

    def copied(self, name: str, why: str) -> None:
        super().copied(name, why)
        self._advance(name)

    def done(self, name: str, seconds: float) -> None:
        super().done(name, seconds)
        self._advance(name)

    def failed(self, name: str, failure: Failure) -> None:
        super().failed(name, failure)
        self._advance(name)

    def _advance(self, name: str) -> None:
        detail = f"{self._done} of {self._total}"
        self._progress.update(self._overall, completed=self._done, detail=detail)
        if name in self._bars:
            self._progress.remove_task(self._bars.pop(name))

    def close(self) -> None:
        self._progress.stop()
        self._console.share(None)


def job_display(console: TerminalConsole) -> PlainJobs:
    """The display for this terminal."""
    return LiveJobs(console) if console.is_live else PlainJobs(console)
