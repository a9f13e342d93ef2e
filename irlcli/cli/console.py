"""Output: data on stdout; progress, tables and messages on stderr.

Rich is imported only to draw on a terminal. A cache hit prints one line without it.
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
from irlcli.labels import duration

if TYPE_CHECKING:
    from irlcli.store import Artefact

JSON_VERSION = 1
_PLAIN_SECONDS = 10.0
_MAX_MESSAGE, _MAX_HINT = 900, 4000
_MAX_RUN_NAME = 150
# Printed text may come from a file. It must not control the terminal or fake a second line.
_CONTROLS = dict.fromkeys(
    [*range(32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A)], "?"
)
_CONTROLS_BUT_NEWLINE = {code: c for code, c in _CONTROLS.items() if code != ord("\n")}


class Pace:
    """How fast a stage works, in words."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._first_done: int | None = None

    def words(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> str:
        """Speed, time left, and ``facts``."""
        now = time.monotonic()
        if self._first_done is None:
            # The first steps of a resumed stage were done by an earlier process.
            self._first_done, self._started = done, now
        rate = (done - self._first_done) / (now - self._started) if now > self._started else 0.0
        left = f"{duration((total - done) / rate)} left" if rate > 0 else ""
        speed = f"{rate:,.0f} {unit}/s" if rate >= 10 else ""
        parts = [speed, left, *(f"{name} {fact}" for name, fact in facts.items())]
        return "  ".join(p for p in parts if p)


class TerminalConsole:
    """Progress of stages on stderr: a live bar on a terminal, plain lines elsewhere."""

    def __init__(self, quiet: bool = False, tensorboard: Path | None = None):
        self._quiet = quiet
        self._live: Any = None
        self._task: Any = None
        self._label = self._key = ""
        self._pace, self._printed = Pace(), 0.0
        self._tensorboard = tensorboard
        self._writer: Any = None
        #: Whether anything was written for TensorBoard.
        self.wrote_scalars = False
        if tensorboard is not None:
            _require_tensorboard()
        #: Whether a live display can be drawn.
        self.is_live = sys.stderr.isatty() and os.environ.get("TERM") != "dumb" and not quiet

    def share(self, live: Any) -> None:
        """Print above another live display; None when that display has ended."""
        self._live = live

    def start(self, label: str, resumed: bool, key: str = "") -> None:
        """A stage starts; ``resumed`` from a checkpoint or not. ``key`` names its TensorBoard run."""
        self._label, self._key = label, key
        self._pace, self._printed = Pace(), time.monotonic() - _PLAIN_SECONDS
        self._close_live()
        self.say(f"{'RESUME' if resumed else 'RUN'} {label}")

    def progress(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> None:
        """Progress of the running stage."""
        detail = self._pace.words(done, total, unit, facts)
        now = time.monotonic()
        if self.is_live:
            self._draw(done, total, detail)
        elif now - self._printed >= _PLAIN_SECONDS or done >= total:
            self._printed = now
            self.say(f"  {self._label}: {done:,}/{total:,} {unit}  {detail}")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Write metrics to TensorBoard if ``--tensorboard`` was given."""
        if self._tensorboard is None:
            return
        if self._writer is None:
            # File systems limit a name, mostly to 255 bytes; the key tells equal beginnings apart.
            name = f"{self._label[:_MAX_RUN_NAME]} {self._key[:8]}"
            directory = name.replace(" ", "_").replace(",", "")
            self.wrote_scalars = True
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(self._tensorboard / directory))
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def warn(self, message: str) -> None:
        """Print a warning, also with ``--quiet``."""
        self._print(f"warning: {message}", style="bold yellow")

    def hint(self, text: str) -> None:
        """Print the hint of a warning, also with ``--quiet``."""
        self._print(f"hint: {text}")

    def wait(self, label: str, holder: str) -> None:
        """Another process makes the same artefact, or runs gc."""
        self.say(f"WAIT {label}: {holder} is at work on it")

    def finish(self, label: str, artefact: Artefact, hit: bool) -> None:
        """A stage ended, or its artefact existed (``hit``)."""
        self.close()
        self.say(f"{'HIT' if hit else 'DONE'} {label}: {artefact.directory}")

    def found(self, label: str, artefact: Artefact, where: Path | str) -> None:
        """An artefact was copied from the store ``where``."""
        self._close_live()
        self.say(f"FOUND {label}: {artefact.directory}, copied from {where}")

    def close(self) -> None:
        """Restore the terminal, and write what TensorBoard still has to get."""
        self._close_live()
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _draw(self, done: int, total: int, detail: str) -> None:
        if self._live is None:
            from rich.progress import BarColumn, TaskProgressColumn

            self._live = live_display(BarColumn(bar_width=12), TaskProgressColumn())
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


def live_display(*columns: Any) -> Any:
    """Bars on stderr with ``columns`` and details; on a narrow terminal only the details shrink."""
    from rich.console import Console
    from rich.progress import Progress, TextColumn
    from rich.table import Column

    shrinking = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    details = TextColumn("{task.fields[detail]}", markup=False, table_column=shrinking)
    console = Console(stderr=True)
    return Progress(*columns, details, console=console, transient=True, expand=True)


def printable(text: str) -> str:
    """``text`` as one line without control characters."""
    # Almost always there is nothing to translate, which takes a hundred times as long.
    return text if text.isascii() and text.isprintable() else text.translate(_CONTROLS)


def prepare_streams() -> None:
    """Make stdout UTF-8 in every locale, and open closed standard streams on the null device.

    File names that are not valid text are printed as their bytes.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # Otherwise the next file that is opened would get the stream's descriptor.
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(encoding="utf-8", errors="surrogateescape")


def hang_up() -> NoReturn:
    """End the program quietly because the reader closed the pipe (exit 128 + SIGPIPE)."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            # Otherwise Python would print an error when it flushes at shutdown.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(141)


def _write(text: str, stream: TextIO) -> None:
    try:
        print(text, file=stream, flush=True)
    except BrokenPipeError:
        from irlcli.experiments.signals import stop_requested

        if stream is sys.stderr and stop_requested():
            # Its reader died of the same Ctrl-C. The checkpoint is still to be written.
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        else:
            hang_up()


def counted(number: int, noun: str) -> str:
    """``1 job`` or ``2 jobs``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def print_note(text: str) -> None:
    """Lines for the reader on stderr, beside the data."""
    _write(text.translate(_CONTROLS_BUT_NEWLINE), sys.stderr)


def print_data(text: str) -> None:
    """Lines of data on stdout. Ends the program quietly if the reader has closed the pipe."""
    _write(text.translate(_CONTROLS_BUT_NEWLINE), sys.stdout)


def print_json(kind: str, value: Mapping[str, Any]) -> None:
    """One JSON document on stdout, with the version of its schema."""
    print_data(json.dumps({"version": JSON_VERSION, "kind": kind, **value}, sort_keys=True))


def number(value: float | None, digits: int = 1) -> str:
    """``value`` as a table shows it."""
    return "-" if value is None else f"{value:.{digits}f}"


def print_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    title: str = "",
    stderr: bool = False,
    optional: Sequence[str] = (),
) -> None:
    """A table; plain text with aligned columns if the stream is not a terminal.

    Of the columns ``optional``, those are left out in which every cell is ``-``.

    On a terminal cells are wrapped between words. Where the words are too wide, each row becomes a
    block of lines: no number, id or name is ever cut.
    """
    stream = sys.stderr if stderr else sys.stdout
    shown = [
        i
        for i, column in enumerate(columns)
        if column not in optional or any(row[i] != "-" for row in rows)
    ]
    columns, rows = [columns[i] for i in shown], [[row[i] for i in shown] for row in rows]
    title, *columns = (printable(text) for text in (title, *columns))
    rows = [[printable(str(cell)) for cell in row] for row in rows]
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

    terminal = Console(stderr=stderr)
    fitting = _widths(columns, rows, terminal.width)
    if fitting is None:
        _write("\n".join([*([title] if title else []), *_blocks(columns, rows)]), stream)
        return
    table = Table(title=Text(title) if title else None, title_justify="left")
    for column, width in zip(columns, fitting, strict=True):
        table.add_column(Text(column), width=width, overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    terminal.print(table)


def _widths(columns: Sequence[str], rows: Sequence[Sequence[str]], total: int) -> list[int] | None:
    """The width of each column in a table as wide as ``total``; None if a word would be cut."""
    from rich.cells import cell_len

    cells = list(zip(columns, *rows, strict=True))
    widths = [max(cell_len(word) for cell in of for word in cell.split() or [""]) for of in cells]
    # A border before each cell and after the last, and a space on either side of each.
    spare = total - 3 * len(columns) - 1 - sum(widths)
    if spare < 0:
        return None
    for index, of in enumerate(cells):
        wider = min(spare, max(map(cell_len, of)) - widths[index])
        widths[index] += wider
        spare -= wider
    return widths


def _blocks(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A block of lines for each row: its heads, then its other cells, each beside its column.

    The heads are the first cell and those of columns without a name.
    """
    if not rows:
        return ["  ".join(columns)]
    margin = max(map(len, columns))
    lines = []
    for row in rows:
        named = list(zip(columns, row, strict=True))
        heads = [cell for name, cell in [("", row[0]), *named[1:]] if not name]
        lines.append("  ".join(heads).rstrip())
        lines += [f"  {n.ljust(margin)}  {cell}" for n, cell in named[1:] if n and cell]
    return lines


def print_error(error: IrlError, as_json: bool) -> None:
    """One line and its hint on stderr; with ``--json`` also a document on stdout."""
    message, hint = _shortened(error.message, _MAX_MESSAGE), _shortened(error.hint, _MAX_HINT)
    if as_json:
        document = {"message": message, "hint": hint, "exit_code": error.exit_code}
        print_json("error", {**document, **error.details})
    _write(f"error: {message}".translate(_CONTROLS), sys.stderr)
    if hint:
        _write(f"hint: {hint}".translate(_CONTROLS), sys.stderr)


def _shortened(text: str, most: int) -> str:
    """``text`` without its middle if it is longer than ``most`` characters."""
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def _require_tensorboard() -> None:
    """Fail before the work, not after its first round, if TensorBoard is missing."""
    import importlib.util

    if importlib.util.find_spec("tensorboard") is None:
        raise UsageError(
            "--tensorboard needs the package tensorboard, which is not installed",
            f"{sys.executable} -m pip install tensorboard, or omit --tensorboard",
        )
