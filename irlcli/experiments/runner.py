"""Plan, run, resume, publish: from a request to an artefact.

``Runner(store).run(request)`` is all there is to the Python API; the command line does the same.
"""

import gc
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from irlcli.errors import IntegrityError, Interrupted, StageFailed, UsageError
from irlcli.experiments import provenance
from irlcli.stages.base import Console, From, Job, Request, Source, Stage
from irlcli.store import (
    Artefact,
    KeyRecord,
    Resolved,
    Scratch,
    Store,
    content_digest,
    digest,
    directory_outputs,
    file_digest,
)

CHECKPOINT_SECONDS = 10.0

Status = Literal["HIT", "RUN", "RESUME", "BLOCKED"]


class Silent(Console):
    """A console that shows nothing, for use from Python; any other has the same methods."""

    def progress(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> None:
        pass

    def warn(self, message: str) -> None:
        pass

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        pass

    def start(self, label: str, resumed: bool) -> None:
        pass

    def finish(self, label: str, artefact: Artefact, hit: bool) -> None:
        pass

    def wait(self, label: str, holder: str) -> None:
        pass


class Step(NamedTuple):
    """One line of a plan: what would happen to a request, and why."""

    status: Status
    label: str
    why: str
    artefact: Artefact | None = None


@contextmanager
def _file_errors_of(label: str) -> Iterator[None]:
    """A full disk or a file that cannot be written, as the failure of the stage ``label``."""
    try:
        yield
    except OSError as error:
        raise StageFailed(
            f"{label}: {error.strerror or error}"
            + (f": {error.filename}" if error.filename else ""),
            "nothing was published: mend the cause and run the same command again; it goes on from "
            "the last checkpoint, if there is one",
        ) from error


class Runner:
    """Turns requests into artefacts of one store.

    Args:
        store: a store or its directory.
        console: told of progress; silent by default.
        wait: wait for another process that makes the same artefact, instead of failing.
        command: the command line to record, so that a damaged artefact can say how to repair it.
        checkpoint_seconds: least time between two checkpoints [s].
        workers: processes that step the environments; no part of any artefact's identity.
    """

    def __init__(
        self,
        store: Store | Path | str,
        console: Any = None,
        wait: bool = True,
        command: list[str] | None = None,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        workers: int = 1,
    ):
        self.store = store if isinstance(store, Store) else Store(store)
        self.console = console if console is not None else Silent()
        self.wait = wait
        self.command = command or []
        self.checkpoint_seconds = checkpoint_seconds
        self.workers = workers

    def plan(self, request: Request) -> list[Step]:
        """What :meth:`run` would do, inputs first; nothing is computed or written."""
        steps: dict[str, Step] = {}
        self._plan(request, steps)
        return list(steps.values())

    def _plan(self, request: Request, steps: dict[str, Step]) -> tuple[str, Step]:
        """What ``request`` is known by among ``steps``, and its step."""
        inputs: dict[str, str] = {}
        known: dict[str, str] = {}
        missing = []
        for role, source in request.inputs.items():
            if isinstance(source, Source):
                inputs[role] = known[role] = source.sha256
                continue
            known[role], step = self._plan(source.request, steps)
            if step.artefact is None:
                missing.append(step.label)
            else:
                inputs[role] = _source(step.artefact, source.output).sha256
        if missing:
            step = Step("BLOCKED", request.label, f"waits for {', '.join(missing)}")
        else:
            step = self._plan_ready(request, self._record(request, inputs))
        # By what it is, not by its label, which leaves things out that tell requests apart.
        parameters = msgspec.to_builtins(request.parameters)
        name = digest([request.stage.name, request.stage.version, parameters, known])
        steps.setdefault(name, step)
        return name, step

    def _plan_ready(self, request: Request, record: KeyRecord) -> Step:
        artefact = self.store.find(record.key)
        if artefact is not None:
            return Step("HIT", request.label, f"{artefact.directory}", artefact)
        if self.store.has_checkpoint(record.key):
            return Step(
                "RESUME",
                request.label,
                "a checkpoint is there: the run was interrupted or is at work",
            )
        return Step("RUN", request.label, f"no artefact has the key {record.key[:12]}")

    def run(self, request: Request) -> Artefact:
        """The artefact of ``request``: found, or made after everything it needs.

        Raises:
            StageFailed: the stage could not finish, or the disk is full or not writable.
            IntegrityError: an input is damaged.
            Busy: another process works on it, or collects, and this runner does not wait.
            Interrupted: a signal asked to stop; the checkpoint has been saved.
        """
        with _file_errors_of(request.label):
            self.store.create()
            # From the first artefact that is found to the last one that is made of it.
            with self.store.in_use(self.wait, partial(self.console.wait, "the store")):
                return self._run(request)

    def _run(self, request: Request) -> Artefact:
        sources: dict[str, Source] = {}
        for role, source in request.inputs.items():
            if isinstance(source, From):
                source = _source(self._run(source.request), source.output)
            sources[role] = source
        record = self._record(request, {role: s.sha256 for role, s in sources.items()})
        artefact = self.store.find(record.key)
        if artefact is None:
            with _file_errors_of(request.label):
                artefact = self._make(request, record, sources)
        else:
            self.console.finish(request.label, artefact, hit=True)
        return artefact

    def _record(self, request: Request, inputs: Mapping[str, str]) -> KeyRecord:
        parameters = msgspec.to_builtins(request.parameters)
        return KeyRecord(request.stage.name, request.stage.version, parameters, dict(inputs))

    def _make(self, request: Request, record: KeyRecord, sources: Mapping[str, Source]) -> Artefact:
        gc.enable()
        on_wait = partial(self.console.wait, request.label)
        with self.store.working_on(record.key, self.wait, on_wait) as scratch:
            # The process that held the lock may have made it.
            artefact = self.store.find(record.key)
            if artefact is not None:
                self.console.finish(request.label, artefact, hit=True)
                return artefact
            inputs = {role: self._checked(source) for role, source in sources.items()}
            checkpoints = _Checkpoints(
                request.stage, scratch, self.console, self.checkpoint_seconds
            )
            self.console.start(request.label, checkpoints.load() is not None)
            output = scratch.new_output()
            job = Job(request.parameters, inputs, output, checkpoints, self.console, self.workers)
            with checkpoints.listening():
                try:
                    request.stage.run(job)
                except StageFailed as error:
                    raise StageFailed(f"{request.label}: {error.message}", error.hint) from error
            origin = provenance.record(self.command, self.workers, checkpoints.attempts())
            origin["inputs"] = {role: _address(source) for role, source in sources.items()}
            published = self.store.publish(record, output, origin)
        if published.diverged is not None:
            self.console.warn(
                f"{request.label} gave other bytes than {published.diverged.id}, which holds the "
                f"key: this result is kept as {published.artefact.id}"
            )
        self.console.finish(request.label, published.artefact, hit=False)
        if checkpoints.stop_requested:
            # A stage without rounds ends before it can answer the signal; what follows must not run.
            raise Interrupted(
                f"stopped after {request.label}", "run the same command again to go on from it"
            )
        return published.diverged or published.artefact

    def _checked(self, source: Source) -> Path:
        """The path of an input whose bytes are what the key says."""
        if source.artefact is None:
            # It was hashed when the run was planned, which may be hours ago.
            if source_of(Resolved(None, source.path)).sha256 != source.sha256:
                raise IntegrityError(
                    f"{source.path} changed since it was asked for", "run the same command again"
                )
            return source.path
        if source.path != source.artefact.directory:
            relative = source.path.relative_to(source.artefact.directory).as_posix()
            return self.store.open(source.artefact, relative)
        for output in source.artefact.manifest.outputs:
            self.store.open(source.artefact, output.path)
        return source.path


class _Checkpoints:
    """A stage's checkpoints: throttled by time, and where a stop signal is answered."""

    def __init__(self, stage: Stage, scratch: Scratch, console: Any, seconds: float):
        self._stage = stage
        self._libraries = provenance.libraries()
        self._clock = provenance.Clock()
        self._earlier: tuple[provenance.Attempt, ...] = ()
        self._scratch = scratch
        self._console = console
        self._seconds = seconds
        self._last = time.monotonic()
        self.stop_requested = False
        self._state: bytes | None = None
        try:
            stored = scratch.load()
            if stored is not None:
                header, self._state = provenance.decode(stored, stage.name, stage.version)
                self._earlier = header.attempts
        except ValueError as error:
            console.warn(f"the checkpoint cannot be used ({error}): starting over")
            scratch.discard_checkpoint()

    def load(self) -> bytes | None:
        return self._state

    def attempts(self) -> tuple[provenance.Attempt, ...]:
        """Every process's part in the work so far, this one's last."""
        return (*self._earlier, self._clock.attempt())

    def offer(self, state: Callable[[], bytes]) -> None:
        now = time.monotonic()
        if self.stop_requested or now - self._last >= self._seconds:
            header = provenance.Header(
                schema=provenance.SCHEMA,
                stage=self._stage.name,
                stage_version=self._stage.version,
                libraries=self._libraries,
                attempts=self.attempts(),
            )
            self._scratch.save(header.encode(state()))
            self._last = now
        if self.stop_requested:
            raise Interrupted(
                "stopped; a checkpoint was written", "run the same command again to go on from it"
            )

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Let SIGINT and SIGTERM ask for a stop at the end of the round; a second one insists."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def handle(number: int, frame: Any) -> None:
            if self.stop_requested:
                raise KeyboardInterrupt
            self.stop_requested = True
            self._console.warn("stopping at the end of this round (once more to stop at once)")

        previous = {s: signal.signal(s, handle) for s in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def source_of(resolved: Resolved) -> Source:
    """A resolved reference as a stage's input.

    Raises:
        UsageError: a foreign directory without files, or one that cannot be read.
        IntegrityError: a directory that holds links, pipes or names no artefact could have.
    """
    if resolved.artefact is not None:
        return _source(resolved.artefact, resolved.output)
    try:
        if resolved.path.is_file():
            return Source(resolved.path, file_digest(resolved.path))
        outputs = directory_outputs(resolved.path)
        if not outputs:
            raise UsageError(f"{resolved.path} holds no files", "name a file or an artefact")
        return Source(resolved.path, content_digest(outputs))
    except OSError as error:
        raise UsageError(
            f"{resolved.path} cannot be read ({error.strerror})", "name a file or an artefact"
        ) from None
    except ValueError as error:
        raise IntegrityError(
            f"{resolved.path}: {error}", "name a directory of plain files, or an artefact"
        ) from None


def _source(artefact: Artefact, output: str | None) -> Source:
    if output is None:
        return Source(artefact.directory, artefact.manifest.content, artefact)
    return Source(artefact.directory / output, artefact.output(output).sha256, artefact)


def _address(source: Source) -> str:
    """Where an input was when it was read: inside the store, or a foreign path."""
    if source.artefact is None:
        return str(source.path.absolute())
    return f"{source.artefact.id}/{source.path.relative_to(source.artefact.directory)}"
