"""Computes the missing steps of a plan: one process per missing artefact, several at a time.

A step whose inputs exist is started; one that exists already, here or in another store, needs no
process. A failed step stops only what depends on it.
"""

import os
import shlex
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from queue import Empty, SimpleQueue
from typing import Protocol

from irlcli.errors import Interrupted, IrlError
from irlcli.experiments.failures import LAST_LINES, Failure, failure
from irlcli.experiments.plan import Plan
from irlcli.experiments.runner import Runner
from irlcli.experiments.signals import stop_requests
from irlcli.store import Artefact

_POLL_SECONDS = 0.05
# From the mildest to the worst: busy, interrupted, missing reference, usage, failed, integrity.
_SEVERITY = (75, 130, 3, 2, 1, 4)


@dataclass
class Outcome:
    """The result of each step, by name."""

    existed: list[str] = field(default_factory=list)
    copied: list[str] = field(default_factory=list)
    made: list[str] = field(default_factory=list)
    failed: dict[str, Failure] = field(default_factory=dict)
    blocked: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def exit_code(self) -> int:
        """That of the worst failure; 0 without one, 130 if a signal stopped the run."""
        if self.interrupted:
            return 130
        codes = {failure.code for failure in self.failed.values()}
        # A code of none of our errors is a crash.
        return max(codes, key=lambda c: _SEVERITY.index(c if c in _SEVERITY else 1), default=0)


class Display(Protocol):
    """What is shown while steps are made."""

    def begin(self, total: int, done: int) -> None:
        """``done`` of ``total`` steps exist at the start."""

    def start(self, name: str) -> None:
        """A process was started for a step."""

    def line(self, name: str, text: str) -> None:
        """A line that the process wrote to stderr."""

    def copied(self, name: str, why: str) -> None:
        """A step's artefact was copied from another store."""

    def done(self, name: str, seconds: float) -> None:
        """A step's artefact exists now."""

    def failed(self, name: str, failure: Failure) -> None:
        """A step failed."""

    def stopping(self, again: str = "to stop at once") -> None:
        """A signal asked to stop; running steps write a checkpoint.

        ``again`` is why somebody would repeat the signal.
        """


class _Child:
    """A process that makes one step."""

    def __init__(self, name: str, command: Sequence[str], lines: SimpleQueue):
        self.name = name
        self.started = time.monotonic()
        #: Whether it waits for a process of another run.
        self.waits = False
        self.last: deque[str] = deque(maxlen=LAST_LINES)
        # A process group of its own: Ctrl-C on the terminal reaches it through this process only.
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            process_group=0,
        )
        self._reader = threading.Thread(target=self._read, args=(lines,), daemon=True)
        self._reader.start()

    def _read(self, lines: SimpleQueue) -> None:
        assert self.process.stderr is not None
        for raw in self.process.stderr:
            text = raw.decode("utf-8", "replace").rstrip()
            self.last.append(text)
            if text.startswith(("WAIT ", "RUN ", "RESUME ")):
                self.waits = text.startswith("WAIT ")
            lines.put((self.name, text))

    def stop(self, at_once: bool) -> None:
        """Ask for a stop at the next checkpoint, or kill it with all that it started."""
        if self.process.poll() is not None:
            return
        if at_once:
            os.killpg(self.process.pid, signal.SIGKILL)
        else:
            # SIGTERM may reach the whole process tree: the step counts this signal and one of them once.
            self.process.send_signal(signal.SIGUSR2)

    def failure(self) -> Failure:
        """Why it failed, after its end."""
        # What it started may keep the pipe open.
        self._reader.join(timeout=1.0)
        return failure(self.process.returncode, self.last)


class Execution:
    """Runs what a plan is missing, each step in a process of its own, and names all artefacts.

    Args:
        plan: what to make.
        runner: copies from other stores; runs no stage here.
        command: the command line of the process that makes the step of that name.
        jobs: processes at a time.
        display: receives what happens.
    """

    def __init__(
        self,
        plan: Plan,
        runner: Runner,
        command: Callable[[str], Sequence[str]],
        jobs: int,
        display: Display,
    ):
        self._plan = plan
        self._runner = runner
        self._command = command
        self._jobs = jobs
        self._display = display
        self._waiting = list(plan.tasks)
        self._done: set[str] = set()
        self._running: dict[str, _Child] = {}
        self._lines: SimpleQueue = SimpleQueue()
        self._signals = 0
        self._passed_on = 0
        self._outcome = Outcome()

    def run(self) -> Outcome:
        """Make the missing steps, several at a time, until all exist or nothing more can be made."""
        there = [name for name in self._waiting if self._plan.step(name).status == "HIT"]
        for name in there:
            self._finish(name)
        self._outcome.existed.extend(there)
        self._display.begin(len(self._plan.tasks), len(there))
        if self._waiting:
            with stop_requests(self._signal):
                try:
                    self._loop()
                finally:
                    for child in self._running.values():
                        child.stop(at_once=False)
        return replace(self._outcome, blocked=self._waiting, interrupted=self._signals > 0)

    def _loop(self) -> None:
        while True:
            if not self._signals:
                self._start_ready()
            if self._signals:
                self._stop()
            if not self._running:
                return
            self._show_lines()
            for child in list(self._running.values()):
                if child.process.poll() is not None:
                    self._end(child)

    def _start_ready(self) -> None:
        for name in list(self._waiting):
            if self._is_full or self._signals:
                return
            if not self._done.issuperset(self._plan.needs[name]):
                continue
            status = self._plan.step(name).status
            if status == "HIT":
                self._take(name)
                self._outcome.existed.append(name)
                self._display.done(name, 0.0)
            elif status == "FOUND" and self._copy(name):
                self._take(name)
                self._outcome.copied.append(name)
            else:
                self._waiting.remove(name)
                self._running[name] = _Child(name, self._command(name), self._lines)
                self._display.start(name)

    @property
    def _is_full(self) -> bool:
        # A process that waits for another run's does nothing, so one more may run. If the other run
        # stops, both compute.
        waits = any(child.waits for child in self._running.values())
        return len(self._running) >= self._jobs + waits

    def _copy(self, name: str) -> bool:
        """Copy a step's artefact; otherwise a process makes it, or waits for another one."""
        why = self._plan.step(name).why
        copied = None
        # The process that is started instead tries again, and reports what is wrong.
        with suppress(IrlError):
            copied = self._runner.copy(self._plan.tasks[name].request, self._plan.lookup)
        self._plan.lookup.forget_missing()
        if copied is not None:
            self._display.copied(name, why)
        return copied is not None

    def _end(self, child: _Child) -> None:
        del self._running[child.name]
        self._show_lines()
        if child.process.returncode == 0:
            self._plan.lookup.forget_missing()
            if self._plan.step(child.name).status == "HIT":
                self._take(child.name)
                self._outcome.made.append(child.name)
                self._display.done(child.name, time.monotonic() - child.started)
                return
            why = Failure(
                1, "its process ended, but the artefact is missing", "run the same command again"
            )
        else:
            why = child.failure()
            # The traceback is that process's own: only a command that runs no other one shows it.
            if "--debug" in why.hint:
                words = [word for word in self._command(child.name) if word != "--expect"]
                words = [word for word in words if word != self._plan.identities[child.name]]
                again = shlex.join(["irl", *words[words.index("run") :], "--debug"])
                why = why._replace(hint=f"{why.hint}: `{again}`")
        code = child.process.returncode
        if self._signals and (code < 0 or code in (0, Interrupted.exit_code)):
            self._waiting.append(child.name)
            return
        self._outcome.failed[child.name] = why
        self._display.failed(child.name, why)

    def _take(self, name: str) -> None:
        """Finish a step that exists now. If it chose a lambda, later requests change."""
        self._finish(name)
        if self._plan.chooses(name):
            self._plan.refresh()

    def _finish(self, name: str) -> None:
        if name in self._waiting:
            self._waiting.remove(name)
        self._done.add(name)
        artefact: Artefact | None = self._plan.step(name).artefact
        if artefact is not None:
            self._runner.store.set_name(name, artefact)

    def _show_lines(self) -> None:
        """Pass on what the processes wrote; wait a moment if they wrote nothing."""
        try:
            name, text = self._lines.get(timeout=_POLL_SECONDS)
            while True:
                self._display.line(name, text)
                name, text = self._lines.get_nowait()
        except Empty:
            pass

    def _stop(self) -> None:
        """Forward a signal to every process: SIGUSR2 for the first one, SIGKILL for the second."""
        if not self._passed_on:
            self._display.stopping()
        for child in self._running.values():
            if self._passed_on < min(self._signals, 2):
                child.stop(at_once=self._signals > 1)
        self._passed_on = min(self._signals, 2)

    def _signal(self) -> None:
        """A signal asks the processes to stop; a second one kills them."""
        self._signals += 1
