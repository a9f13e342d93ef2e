"""From a request to an artefact: plan, look up, compute, resume, publish.

The command line and :class:`irlcli.Lab` make every artefact by ``Runner(store).run(request)``.
"""

import errno
import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from irlcli.errors import Busy, Interrupted, StageFailed, file_failure
from irlcli.experiments.inputs import checked, source_in
from irlcli.experiments.introduce import described, other_description
from irlcli.experiments.signals import stop_requests
from irlcli.experiments.status import Lookup, Step, key_record
from irlcli.stages.base import Console, From, Job, Request, Source
from irlcli.store import Artefact, KeyRecord, Store

if TYPE_CHECKING:
    from irlcli.store.sources import Place

CHECKPOINT_SECONDS = 10.0


class RunConsole(Console, Protocol):
    """What a runner and a session tell the user, beside what their stages do."""

    def start(self, label: str, resumed: bool, key: str = "") -> None:
        """A stage starts; ``resumed`` from a checkpoint or not. Several keys can have one label."""

    def finish(self, label: str, artefact: Artefact, hit: bool) -> None:
        """A stage ended, or its artefact existed (``hit``)."""

    def found(self, label: str, artefact: Artefact, where: Path | str) -> None:
        """An artefact was copied from the store ``where``."""

    def wait(self, label: str, holder: str) -> None:
        """Another process makes the same artefact, or runs gc."""

    def say(self, text: str) -> None:
        """A line that is no warning."""

    def close(self) -> None:
        """No more output follows for now."""


class Silent(RunConsole):
    """A console that shows nothing."""

    def _ignore(self, *_: Any, **__: Any) -> None: ...

    progress = warn = scalars = start = finish = found = wait = say = close = _ignore


class Runner:
    """Turns requests into artefacts of one store.

    Args:
        store: a store or its directory.
        console: receives progress and warnings; silent by default.
        wait: wait for another process that makes the same artefact, instead of raising Busy.
        command: the command line to record, so that a damaged artefact shows how to repair it.
        checkpoint_seconds: least time between two checkpoints [s].
        workers: processes that step the environments; not part of any artefact's identity.
        sources: stores, on disk or behind URLs, that are only read. What one of them holds is
            copied from there, not computed.
    """

    def __init__(
        self,
        store: Store | Path | str,
        console: RunConsole | None = None,
        wait: bool = True,
        command: list[str] | None = None,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        workers: int = 1,
        sources: "Sequence[Place]" = (),
    ):
        self.store = store if isinstance(store, Store) else Store(store)
        self.console = Silent() if console is None else console
        self.wait = wait
        self.command = command or []
        self.checkpoint_seconds = checkpoint_seconds
        self.workers = workers
        self.sources = sources

    def lookup(self) -> Lookup:
        """A fresh look at the store and the sources."""
        return Lookup(self.store, self.sources)

    def plan(self, request: Request) -> list[Step]:
        """What :meth:`run` would do, inputs first. Nothing is computed, written or moved."""
        return self.lookup().chain(request)

    def run(self, request: Request) -> Artefact:
        """The artefact of ``request``: looked up, or computed after everything it needs.

        Raises:
            StageFailed: the stage could not finish, or the disk is full or not writable.
            IntegrityError: an input is damaged.
            Busy: another process computes it, or gc runs, and this runner does not wait.
            Interrupted: a signal requested a stop; the checkpoint has been saved.
        """
        with self._file_errors_of(request.label):
            self.store.create()
            # From the first artefact that is looked up to the last one that is made from it.
            with self.store.in_use(self.wait, partial(self.console.wait, "the store")):
                artefact = self._run(request, {})
        if other := other_description(request, artefact):
            self.console.warn(
                f"{artefact.id} holds another description of {other}, made before the file changed; "
                "commands that read it use that one, unless --env names the file"
            )
        return artefact

    def copy(self, request: Request, lookup: Lookup) -> Artefact | None:
        """A verified copy from one of the sources.

        None if none has it, or only a damaged one, or if another process works on it: this
        method does not wait.
        """
        record = lookup.record(request)
        if record is None:
            return None
        with (
            suppress(Busy),
            self._file_errors_of(request.label),
            self.store.working_on(record.key, wait=False),
        ):
            artefact = self.store.find(record.key)
            if artefact is None:
                copied = self._adopt(record)
                artefact = None if copied is None else copied[0]
            return artefact
        return None

    @contextmanager
    def _file_errors_of(self, label: str) -> Iterator[None]:
        """Report a full disk or a file that cannot be written as a failure of the stage ``label``."""
        try:
            yield
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            where = f" (store {self.store.root})" if full and not error.filename else ""
            raise StageFailed(
                f"{label}: {file_failure(error).message}{where}",
                "No partial output was written. Fix the problem and run the same command again: it "
                "resumes from the last checkpoint, if there is one.",
            ) from error

    def _run(self, request: Request, done: dict[str, Artefact]) -> Artefact:
        """``done`` are the artefacts of this run by key: each is made or announced once."""
        sources: dict[str, Source] = {}
        for role, source in request.inputs.items():
            if isinstance(source, From):
                source = source_in(self._run(source.request, done), source.output)
            sources[role] = source
        record = key_record(request, {role: s.sha256 for role, s in sources.items()})
        if record.key not in done:
            artefact = self.store.find(record.key)
            if artefact is None:
                with self._file_errors_of(request.label):
                    artefact = self._obtain(request, record, sources)
            else:
                self.console.finish(request.label, artefact, hit=True)
            done[record.key] = artefact
        return done[record.key]

    def _obtain(
        self, request: Request, record: KeyRecord, sources: Mapping[str, Source]
    ) -> Artefact:
        # The command line collects no garbage, but a stage runs long.
        gc.enable()
        on_wait = partial(self.console.wait, request.label)
        with self.store.working_on(record.key, self.wait, on_wait) as scratch:
            # The process that held the lock may have made it.
            artefact = self.store.find(record.key)
            if artefact is not None:
                self.console.finish(request.label, artefact, hit=True)
                return artefact
            copied = self._adopt(record)
            if copied is None:
                return self._compute(request, record, sources, scratch)
            artefact, where = copied
            self.console.found(request.label, artefact, where)
            return artefact

    def _adopt(self, record: KeyRecord) -> tuple[Artefact, Path | str] | None:
        """A verified copy of the artefact, and the source that has it; None if none has."""
        if not self.sources:
            return None
        from irlcli.store.sources import find_in

        found = find_in(self.sources, record.key)
        if found is None:
            return None
        published = self.store.adopt(found.store, found.artefact)
        if published is None:
            return None
        return published.diverged or published.artefact, found.store.root

    def _compute(
        self, request: Request, record: KeyRecord, sources: Mapping[str, Source], scratch: Any
    ) -> Artefact:
        # Imported here: a hit needs neither.
        from irlcli.experiments import provenance
        from irlcli.experiments.checkpoints import StageCheckpoints

        inputs = {role: checked(self.store, source) for role, source in sources.items()}
        scratch.inputs = [source.sha256 for source in sources.values()]
        checkpoints = StageCheckpoints(scratch, self.console, self.checkpoint_seconds)
        self.console.start(request.label, checkpoints.load() is not None, record.key)
        output = scratch.new_output()
        job = Job(request.parameters, inputs, output, checkpoints, self.console, self.workers)
        # To the end of publishing: a signal must not lose finished work.
        with stop_requests(checkpoints.request_stop):
            try:
                request.stage.run(job)
                command = provenance.by_id(self.command, self.store.resolved)
                origin = provenance.record(command, self.workers, checkpoints.attempts())
                environment = described(request)
                if environment is not None:
                    origin["environment"] = environment
                origin["inputs"] = {role: _address(source) for role, source in sources.items()}
                published = self.store.publish(record, output, origin)
            except BaseException as error:
                scratch.discard_output(output)
                if isinstance(error, StageFailed):
                    raise StageFailed(f"{request.label}: {error.message}", error.hint) from error
                raise
        if published.diverged is not None:
            self.console.warn(
                f"{request.label} differs from {published.diverged.id}, the stored result of the same "
                f"request, which commands continue to use; the new result is kept as "
                f"{published.artefact.id}"
            )
        self.console.finish(request.label, published.artefact, hit=False)
        if checkpoints.stop_requested:
            # A stage without rounds ends before it can answer the signal. Nothing may follow it.
            raise Interrupted(
                f"stopped after {request.label}", "run the same command again to continue"
            )
        return published.diverged or published.artefact


def _address(source: Source) -> str:
    """Where an input was when it was read: inside the store, or a foreign path."""
    if source.artefact is None:
        return str(source.path.absolute())
    return f"{source.artefact.id}/{source.path.relative_to(source.artefact.directory)}"
