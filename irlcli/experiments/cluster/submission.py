"""The missing steps of a plan as jobs: submitted, and watched."""

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import Busy, StageFailed
from irlcli.experiments.cluster.arrays import Array, job_arrays
from irlcli.experiments.cluster.job import StepJob
from irlcli.experiments.cluster.queue import Queue, queued
from irlcli.experiments.cluster.records import LOCK, Record, Submitted, new_record
from irlcli.experiments.execute import Display, Outcome
from irlcli.experiments.failures import Failure
from irlcli.experiments.plan import Plan
from irlcli.experiments.runner import Runner
from irlcli.experiments.signals import stop_requests

_LONGEST_PAUSE = 20.0
# A controller that restarts, or is too busy to answer, comes back.
_SILENCE_SECONDS = 600.0
# Why a job waits that starts in time.
_ORDINARY = ("None", "Dependency", "Priority", "Resources", "BeginTime", "JobArrayTaskLimit")


class JobCommand(NamedTuple):
    """How the job of a step is run.

    Attributes:
        words: the command line that makes the step of that name.
        directory: its working directory.
        requeues: how often it may be requeued.
        at_a_time: jobs, where the queue itself sets no limit.
    """

    words: Callable[[str], Sequence[str]]
    directory: Path
    requeues: int
    at_a_time: int


class Submission:
    """The jobs for what a plan is missing.

    Args:
        plan: what to make.
        runner: copies from other stores, and names artefacts.
        queue: where the jobs run.
        command: how the job of a step is run.
        display: receives what happens.
    """

    def __init__(
        self, plan: Plan, runner: Runner, queue: Queue, command: JobCommand, display: Display
    ):
        self._plan = plan
        self._runner = runner
        self._queue = queue
        self._command = command
        self._display = display
        self._ids: dict[str, str] = {}
        self._records: dict[str, Record] = {}
        # Steps that wait for others, or for a free place.
        self._unstarted: list[str] = []
        self._arrays: list[Array] = []
        self._record: Record | None = None
        # Steps whose jobs have not ended; since when they run, and are gone from the queue [s].
        self._alive: set[str] = set()
        self._running: dict[str, float] = {}
        self._gone: dict[str, float] = {}
        self._started = time.monotonic()
        self._lost: set[str] = set()
        self._explained: set[str] = set()
        self._signals = 0
        self._outcome = Outcome()

    def submit(self) -> int:
        """Submit what is missing and not in the queue; returns how many jobs that are.

        Raises:
            UsageError, StageFailed: Slurm refuses the jobs, or a node cannot use the store.
        """
        store, console = self._runner.store, self._runner.console
        self._take_what_exists()
        missing = [name for name in self._plan.tasks if not self._exists(name)]
        self._display.begin(len(self._plan.tasks), len(self._plan.tasks) - len(missing))
        if not missing:
            return 0

        def wait_for(holder: str) -> None:
            console.warn(f"waiting for {holder}, which submits jobs for this store")

        with store.working_on(LOCK, wait=True, on_wait=wait_for):
            if not self._find_queued(missing):
                return 0
            self._queue.probe(store, console)
            # The probe may have waited for hours. What is no longer in the queue may have been made.
            gone = self._find_queued(missing)
            new = self._still_missing(gone)
            if not new:
                return 0
            absent = {*new, *self._ids}
            needs = {name: [n for n in self._plan.needs[name] if n in absent] for name in new}
            self._arrays = job_arrays(needs)
            self._record = new_record(store, self._queue.place)
            if self._queue.starts_what_waits:
                for array in self._arrays:
                    self._submit(array.names, array.after, array.matching)
            else:
                self._unstarted = [name for array in self._arrays for name in array.names]
        return len(new)

    def watch(self) -> Outcome:
        """Wait until every job has ended, or a signal asks to stop.

        The jobs of Slurm continue after a signal. Those of this machine stop at a checkpoint, and a
        second signal ends the wait for that.

        Raises:
            StageFailed: the queue did not answer for ten minutes.
        """
        self._alive = set(self._ids)
        self._started = answered = time.monotonic()
        with stop_requests(self._stop):
            while (self._alive or self._unstarted) and not self._stopped:
                if self._unstarted:
                    self._alive |= self._start_ready(len(self._alive))
                try:
                    states = self._queue.states()
                except StageFailed:
                    if time.monotonic() - answered > _SILENCE_SECONDS:
                        raise
                else:
                    answered = time.monotonic()
                    self._poll(states, answered)
                    if not self._alive:
                        if not any(map(self._ready, self._unstarted)):
                            break
                        continue
                self._pause(time.monotonic() - self._started)
            if self._stopped and not self._queue.starts_what_waits:
                self._stop_jobs()
        done = {*self._outcome.existed, *self._outcome.copied, *self._outcome.made}
        blocked = [n for n in self._plan.tasks if n not in done and n not in self._outcome.failed]
        return replace(self._outcome, blocked=blocked, interrupted=self._stopped)

    def _poll(self, states: Mapping[str, str], now: float) -> None:
        """Show how far the jobs are that have not ended, and note those that have."""
        self._plan.lookup.forget_missing()
        for name in [task for task in self._plan.tasks if task in self._alive]:
            state = states.get(self._ids[name])
            if state is None:
                last = now - self._gone.setdefault(name, now) > self._queue.lag
                if self._ended(name, last):
                    self._alive.remove(name)
                continue
            self._gone.pop(name, None)
            if state.startswith("RUNNING"):
                if name not in self._running:
                    self._running[name] = now
                    self._display.start(name)
                self._show_progress(name)
            else:
                self._explain(name, state)

    def _stop_jobs(self) -> None:
        """Cancel the jobs that this run started, and wait until they have ended."""
        self._display.stopping("to leave without waiting")
        own = [name for name in self._alive if self._records[name] is self._record]
        ids = {self._ids[name] for name in own}
        self._queue.cancel(ids)
        while self._signals < 2 and not ids.isdisjoint(self._queue.states()):
            time.sleep(0.5)
            # A job that had just started did not listen yet.
            self._queue.cancel(ids)
        self._plan.lookup.forget_missing()
        for name in own:
            self._ended(name, last=False)

    def _find_queued(self, names: Sequence[str]) -> list[str]:
        """Note the jobs of steps that are in the queue; returns the other steps."""
        there = queued(self._plan, self._queue, self._runner.store)
        self._ids = {name: there[name].job for name in names if name in there}
        self._records = {name: there[name].record for name in self._ids}
        return [name for name in names if name not in there]

    def _take_what_exists(self) -> None:
        """Name what is in the store; copy what another store has."""
        for name, task in self._plan.tasks.items():
            step = self._plan.step(name)
            if step.status == "FOUND" and self._runner.copy(task.request, self._plan.lookup):
                self._plan.lookup.forget_missing()
                self._outcome.copied.append(name)
                step = self._plan.step(name)
            elif step.status == "HIT":
                self._outcome.existed.append(name)
            if step.status == "HIT" and step.artefact is not None:
                self._runner.store.set_name(name, step.artefact)
        if self._outcome.copied and any(map(self._plan.chooses, self._plan.tasks)):
            # A copied step may choose a lambda. What other runs made meanwhile is seen as well.
            self._plan.refresh()

    def _still_missing(self, names: Sequence[str]) -> list[str]:
        """``names`` without what jobs of other runs have made meanwhile, which is named."""
        self._plan.lookup.forget_missing()
        made = [name for name in names if self._exists(name)]
        for name in made:
            self._ended(name, last=False)
        return [name for name in names if name not in made]

    def _exists(self, name: str) -> bool:
        return self._plan.step(name).status == "HIT"

    def _submit(self, names: Sequence[str], after: Sequence[str], matching: int | None) -> None:
        assert self._record is not None
        jobs = [
            StepJob(
                name,
                tuple(self._command.words(name)),
                str(self._command.directory),
                str(self._record.notes),
                self._command.requeues,
            )
            for name in names
        ]
        array = None
        if matching is not None:
            array = self._ids[self._arrays[matching].names[0]].partition("_")[0]
        ids = self._queue.submit(jobs, self._record.logs, [self._ids[n] for n in after], array)
        submitted = [
            Submitted(name, self._plan.identities[name], job)
            for name, job in zip(names, ids, strict=True)
        ]
        for step in submitted:
            self._ids[step.name], self._records[step.name] = step.job, self._record
        try:
            self._record.add(submitted)
        except BaseException:
            # Nobody would find them again.
            self._queue.cancel(ids)
            raise

    def _ready(self, name: str) -> bool:
        return all(self._exists(need) for need in self._plan.needs[name])

    def _start_ready(self, running: int) -> set[str]:
        """Start jobs whose inputs exist, where the queue does not do so itself; returns their steps.

        A step that another submission has started meanwhile is watched instead.
        """
        ready = [name for name in self._unstarted if self._ready(name)]
        started: set[str] = set()
        if ready and running < self._command.at_a_time:
            try:
                # A signal must be heard, so nothing waits for another command that submits.
                with self._runner.store.working_on(LOCK, wait=False):
                    started = self._start(ready, self._command.at_a_time - running)
            except Busy:
                time.sleep(0.5)
        handled = {*self._ids, *self._outcome.made}
        self._unstarted = [name for name in self._unstarted if name not in handled]
        return started

    def _start(self, ready: Sequence[str], most: int) -> set[str]:
        """Start at most ``most`` jobs, or find them in the queue; returns their steps."""
        there = queued(self._plan, self._queue, self._runner.store)
        # A step that is no longer in the queue may have been made.
        self._plan.lookup.forget_missing()
        started: set[str] = set()
        for name in ready:
            if self._stopped:
                break
            if self._exists(name):
                self._ended(name, last=False)
                continue
            if name in there:
                self._ids[name], self._records[name] = there[name].job, there[name].record
            elif len(started) < most:
                self._submit([name], (), None)
            else:
                continue
            started.add(name)
        return started

    def _ended(self, name: str, last: bool) -> bool:
        """Whether the outcome of a step is known whose job has left the queue.

        ``last``: its files have had the time to become visible.
        """
        step = self._plan.step(name)
        if step.status == "HIT" and step.artefact is not None:
            self._runner.store.set_name(name, step.artefact)
            self._outcome.made.append(name)
            if self._plan.chooses(name):
                self._plan.refresh()
            since = self._running.get(name, self._started)
            self._display.done(name, time.monotonic() - since)
            return True
        if not self._lost.isdisjoint(self._plan.needs[name]):
            # Slurm removed it with the job that it depended on.
            self._lost.add(name)
            return True
        failure = self._records[name].failure(self._ids[name])
        if failure is None and not last:
            return False
        self._lost.add(name)
        if all(self._exists(need) for need in self._plan.needs[name]):
            if failure is None:
                log = self._records[name].log(self._ids[name])
                failure = Failure(
                    1,
                    f"job {self._ids[name]} ended without a result: cancelled or killed",
                    f"its log: {log}" if log else "run the same command again",
                )
            self._outcome.failed[name] = failure
            self._display.failed(name, failure)
        return True

    def _show_progress(self, name: str) -> None:
        line = self._records[name].last_line(self._ids[name])
        # Stages indent their progress lines.
        if line.startswith("  "):
            self._display.line(name, line)

    def _explain(self, name: str, state: str) -> None:
        """Say once for each reason why Slurm does not start a job, unless time alone helps."""
        found = re.fullmatch(r"PENDING \((.+)\)", state)
        if found and found[1] not in _ORDINARY and found[1] not in self._explained:
            self._explained.add(found[1])
            text = f"warning: Slurm does not start job {self._ids[name]}: {found[1]}"
            self._display.line(name, text)

    def _pause(self, elapsed: float) -> None:
        """Poll less often the longer the jobs have run."""
        limit = time.monotonic() + min(_LONGEST_PAUSE, 0.5 + elapsed / 20)
        while time.monotonic() < limit and not self._stopped:
            time.sleep(0.1)

    @property
    def _stopped(self) -> bool:
        return self._signals > 0

    def _stop(self) -> None:
        self._signals += 1
