"""What a person sees: progress and tables on stderr, data on stdout.

Rich is loaded only where something is drawn: a hit prints one line without it.
"""

from __future__ import annotations

import io
import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from irlcli.errors import IrlError, UsageError

if TYPE_CHECKING:
    from irlcli.store import Artefact

JSON_VERSION = 1
_PLAIN_SECONDS = 10.0
_MAX_MESSAGE, _MAX_HINT = 900, 4000
# What a file says may reach the screen: it must not drive the terminal, nor forge a second line.
_CONTROLS = dict.fromkeys([*range(32), *range(127, 160), *range(0x202A, 0x202F)], "?")
_CONTROLS_BUT_NEWLINE = {code: c for code, c in _CONTROLS.items() if code != ord("\n")}


class TerminalConsole:
    """Progress of stages on stderr: a live bar on a terminal, plain lines elsewhere."""

    def __init__(self, quiet: bool = False, tensorboard: Path | None = None):
        self._quiet = quiet
        self._live = None
        self._task = None
        self._label = ""
        self._started = self._printed = 0.0
        self._first_done: int | None = None
        self._tensorboard = tensorboard
        self._writer = None
        if tensorboard is not None:
            _require_tensorboard(tensorboard)
        self._rich = sys.stderr.isatty() and os.environ.get("TERM") != "dumb" and not quiet

    @property
    def is_live(self) -> bool:
        """Whether a live display can be drawn."""
        return self._rich

    def share(self, live: Any) -> None:
        """Print above the live display of somebody else; None when that has ended."""
        self._live = live

    def start(self, label: str, resumed: bool) -> None:
        """A stage begins; ``resumed`` if from a checkpoint."""
        self._label = label
        self._started, self._first_done = time.monotonic(), None
        self._printed = self._started - _PLAIN_SECONDS
        self._close_live()
        self.say(f"{'RESUME' if resumed else 'RUN'} {label}")

    def progress(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> None:
        """How far the present stage is."""
        now = time.monotonic()
        if self._first_done is None:
            # A resumed stage did not do its first steps in this process.
            self._first_done, self._started = done, now
        rate = (done - self._first_done) / (now - self._started) if now > self._started else 0.0
        left = f"{duration((total - done) / rate)} left" if rate > 0 else ""
        speed = f"{rate:,.0f} {unit}/s" if rate >= 10 else ""
        parts = [speed, left, *(f"{name} {fact}" for name, fact in facts.items())]
        detail = "  ".join(p for p in parts if p)
        if self._rich:
            self._draw(done, total, detail)
        elif now - self._printed >= _PLAIN_SECONDS or done >= total:
            self._printed = now
            self.say(f"  {self._label}: {done:,}/{total:,} {unit}  {detail}")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Mirror metrics to TensorBoard, if asked."""
        if self._tensorboard is None:
            return
        if self._writer is None:
            directory = self._label.replace(" ", "_").replace(",", "")
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(self._tensorboard / directory))
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def warn(self, message: str) -> None:
        """Say it whatever else is shown."""
        self._print(f"warning: {message}", style="bold yellow")

    def wait(self, label: str, holder: str) -> None:
        """Another process makes the same artefact, or collects."""
        self.say(f"WAIT {label}: {holder} is at work on it")

    def finish(self, label: str, artefact: Artefact, hit: bool) -> None:
        """A stage ended, or its artefact was there."""
        self._close_live()
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self.say(f"{'HIT' if hit else 'DONE'} {label}: {artefact.directory}")

    def found(self, label: str, artefact: Artefact, where: Path) -> None:
        """An artefact was copied from the store ``where``."""
        self._close_live()
        self.say(f"FOUND {label}: {artefact.directory}, copied from {where}")

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._close_live()

    def _draw(self, done: int, total: int, detail: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
        from rich.table import Column

        if self._live is None:
            self._live = Progress(
                BarColumn(bar_width=12),
                TaskProgressColumn(),
                TextColumn(
                    "{task.fields[detail]}",
                    markup=False,
                    table_column=Column(no_wrap=True, overflow="ellipsis"),
                ),
                console=Console(stderr=True),
                transient=True,
            )
            self._task = self._live.add_task("", total=total, detail=detail)
            self._live.start()
        self._live.update(self._task, completed=done, total=total, detail=detail)

    def _close_live(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def say(self, text: str) -> None:
        if not self._quiet:
            self._print(text)

    def _print(self, text: str, style: str = "") -> None:
        text = text.translate(_CONTROLS)
        if self._live is not None:
            self._live.console.print(text, style=style, markup=False, highlight=False)
        elif style and sys.stderr.isatty() and "NO_COLOR" not in os.environ:
            _write(f"\x1b[1;33m{text}\x1b[0m", sys.stderr)
        else:
            _write(text, sys.stderr)


def prepare_streams() -> None:
    """Make stdout UTF-8 in every locale, and give a closed standard stream a place to go.

    File names that are no text come out as the bytes they are.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # Else the next file opened, an artefact's perhaps, would have its descriptor.
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(encoding="utf-8", errors="surrogateescape")


def hang_up() -> NoReturn:
    """The quiet end of a program whose output nobody reads any more (128 + SIGPIPE)."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            # Python would complain again when it flushes at shutdown.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(141)


def _write(text: str, stream: TextIO) -> None:
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        hang_up()


def print_note(text: str) -> None:
    """Lines for the reader on stderr, beside the data."""
    _write(text.translate(_CONTROLS_BUT_NEWLINE), sys.stderr)


def print_data(text: str) -> None:
    """Lines of data on stdout. Ends the program quietly if the reader has closed the pipe."""
    _write(text.translate(_CONTROLS_BUT_NEWLINE), sys.stdout)


def print_json(kind: str, value: Mapping[str, Any]) -> None:
    """One JSON document on stdout, with the version of its form."""
    print_data(json.dumps({"version": JSON_VERSION, "kind": kind, **value}, sort_keys=True))


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", stderr: bool = False
) -> None:
    """A table for people; plain text with aligned columns where the stream is no terminal."""
    stream = sys.stderr if stderr else sys.stdout
    rows = [[str(cell).translate(_CONTROLS) for cell in row] for row in rows]
    if not stream.isatty():
        widths = [max(len(r[i]) for r in [columns, *rows]) for i in range(len(columns))]
        lines = [title] if title else []
        for row in [columns, *rows]:
            cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
            lines.append("  ".join(cells).rstrip())
        _write("\n".join(lines), stream)
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title or None, title_justify="left")
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    Console(stderr=stderr).print(table)


def print_error(error: IrlError, as_json: bool) -> None:
    """One line and its hint on stderr; with ``--json`` a document on stdout too."""
    message, hint = _shortened(error.message, _MAX_MESSAGE), _shortened(error.hint, _MAX_HINT)
    if as_json:
        document = {"message": message, "hint": hint, "exit_code": error.exit_code}
        print_json("error", {**document, **error.details})
    _write(f"error: {message}".translate(_CONTROLS), sys.stderr)
    if hint:
        _write(f"hint: {hint}".translate(_CONTROLS), sys.stderr)


def _shortened(text: str, most: int) -> str:
    """``text`` without its middle where what it quotes is very long."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def duration(seconds: float) -> str:
    """``1:23`` or ``1:02:03``."""
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _require_tensorboard(directory: Path) -> None:
    """Say before the work, not after its first round, that the mirror cannot be written."""
    import importlib.util

    if directory.exists() and not directory.is_dir():
        raise UsageError(f"--tensorboard {directory} is no directory", "name one, or a new one")
    if importlib.util.find_spec("tensorboard") is None:
        raise UsageError(
            "--tensorboard needs the package tensorboard, which is not installed",
            f"{sys.executable} -m pip install tensorboard, or leave --tensorboard away",
        )
