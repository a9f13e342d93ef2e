"""What a command works with: a session of its options that prints what it finds and runs."""

import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from irlcli.cli import console as out
from irlcli.errors import RETRY, NotFound, StageFailed, UsageError, first_line
from irlcli.requests import session as base
from irlcli.requests.session import DEFAULT_STORE
from irlcli.store import Artefact

if TYPE_CHECKING:
    from irlcli.experiments.status import Step
    from irlcli.stages.base import Request


class Session(base.Session):
    """The store that a command reads, and how it prints."""

    def __init__(self, store: Path, as_json: bool):
        super().__init__(store, out.TerminalConsole())
        self.as_json = as_json

    def check_exists(self) -> None:
        """Refuse a store that does not exist: a mistyped path would look like an empty store.

        Raises:
            NotFound: the store's directory is missing.
        """
        if not self.store.root.exists():
            raise NotFound(
                f"there is no store at {self.store.root}",
                "name another with --store or IRL_STORE; a command that makes an artefact "
                "creates the store",
            )

    def check_file(self, path: Path, option: str) -> None:
        """Refuse a file to write, which ``option`` named, before any work is done.

        Raises:
            UsageError: it is a directory, or its directory does not exist or lies in the store.
        """
        if not path.parent.is_dir():
            raise UsageError(
                f"{path} cannot be written: {path.parent} is not a directory",
                "create the directory first",
            )
        if path.is_dir():
            raise UsageError(f"{path} is a directory", f"name a file with {option}")
        # Not Path.resolve, which raises where links form a circle.
        if Path(os.path.realpath(path)).is_relative_to(os.path.realpath(self.store.root)):
            raise UsageError(f"{path} lies in the store", f"name another file with {option}")

    @contextmanager
    def whole_file(self, path: Path, option: str) -> Iterator[Path]:
        """A file or directory to write, which takes the place of ``path`` once it is whole.

        Raises:
            UsageError: as :meth:`check_file`, or its directory is not writable.
        """
        import tempfile

        self.check_file(path, option)
        try:
            scratch = tempfile.TemporaryDirectory(dir=path.parent, prefix=".irl-")
        except OSError as error:
            raise UsageError(
                f"{path} cannot be written: {error.strerror or error}",
                f"name another file with {option}",
            ) from None
        before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        try:
            with scratch as directory:
                part = Path(directory) / path.name
                yield part
                os.replace(part, path)
        except OSError as error:
            if error.filename is not None:
                raise
            # PyArrow and HDF5 name no file where a disk is full.
            raise StageFailed(f"{path} cannot be written: {first_line(error)}", RETRY) from None
        finally:
            signal.signal(signal.SIGTERM, before)


class StageSession(base.StageSession):
    """A session that plans and runs stages, and prints the plan or the artefacts."""

    console: out.TerminalConsole

    def __init__(
        self,
        store: Path,
        as_json: bool,
        *,
        profile: str,
        file: Path | None,
        overrides: Sequence[str],
        sources: Sequence[str],
        dry_run: bool,
        wait: bool,
        workers: int,
        quiet: bool,
        tensorboard: Path | None,
    ):
        super().__init__(
            store,
            out.TerminalConsole(quiet, tensorboard),
            profile=profile,
            file=file,
            overrides=overrides,
            sources=sources,
            command=["irl", *sys.argv[1:]],
            wait=wait,
            workers=workers,
            read_only=dry_run,
        )
        self.as_json = as_json
        self.dry_run = dry_run
        self.tensorboard = tensorboard

    def place_words(self) -> list[str]:
        """The options that make another command use the same stores, waiting and workers."""
        # A cluster's job may not inherit IRL_STORE.
        plain = self.store.root == DEFAULT_STORE and not os.environ.get("IRL_STORE")
        words = [] if plain else ["--store", str(self.store.root)]
        words += [word for source in self.sources for word in ("--from", str(source))]
        words += [] if self.workers == 1 else ["--workers", str(self.workers)]
        words += [] if self.tensorboard is None else ["--tensorboard", str(self.tensorboard)]
        return words if self.wait else [*words, "--no-wait"]

    def deliver(
        self,
        requests: Sequence["Request"],
        name: str | None,
        details: Callable[[Artefact], Mapping[str, Any]] | None = None,
    ) -> list[Artefact]:
        """Run ``requests`` and print a line for each artefact; with ``--dry-run`` print the plan.

        Args:
            requests: what is wanted, in this order.
            name: name of the first artefact.
            details: what ``--json`` prints of an artefact besides its id and outputs.

        Returns:
            the artefacts; none with ``--dry-run``.
        """
        self.warn_before(requests)
        if self.dry_run:
            if name is not None:
                self.store.check_name(name)
            runner = self.runner()
            self.print_plan([step for request in requests for step in runner.plan(request)])
            return []
        artefacts = self.run(requests, name)
        if self.tensorboard is not None and not self.console.wrote_scalars:
            self.console.warn(
                f"nothing was written to {self.tensorboard}: only trainings of experts, of rewards by "
                "train-airl and of retrained policies write metrics, and none ran"
            )
        for artefact in artefacts:
            self.print_artefact(artefact, name, details)
        return artefacts

    def prepare(self, request: "Request", output: str) -> tuple[Artefact, Path] | None:
        """The artefact of ``request``, not printed, and its file ``output``.

        With ``--dry-run`` None if it is missing; the printed plan shows ``train-airl`` as blocked.
        """
        if not self.dry_run:
            return super().prepare(request, output)
        self.prepared.append(request)
        from irlcli.experiments.status import Step

        lookup = self.runner().lookup()
        step, path = lookup(request), lookup.file(request, output)
        if step.artefact is None or path is None:
            waiting = Step("BLOCKED", "train-airl", f"waits for {request.label}")
            self.print_plan([*lookup.chain(request), waiting])
            return None
        here = step.status == "HIT"
        return step.artefact, self.store.open(step.artefact, output) if here else path

    def print_plan(self, steps: Sequence["Step"]) -> None:
        """A line for each step: its status, its label, and why."""
        if self.as_json:
            import msgspec

            plan = [
                {
                    "status": s.status,
                    "request": s.label,
                    "why": s.why,
                    "key": s.key,
                    "parameters": msgspec.to_builtins(s.parameters),
                }
                for s in steps
            ]
            out.print_json("plan", {"steps": plan})
            return
        for step in steps:
            out.print_data(f"{step.status:8}{step.label}: {step.why}")

    def print_artefact(
        self,
        artefact: Artefact,
        name: str | None,
        details: Callable[[Artefact], Mapping[str, Any]] | None = None,
    ) -> None:
        """A line with the artefact's directory, or a JSON document."""
        if not self.as_json:
            out.print_data(str(artefact.directory))
            return
        document = {
            "id": artefact.id,
            "path": str(artefact.directory),
            "stage": artefact.manifest.record.stage,
            "name": name,
            "outputs": [output.path for output in artefact.manifest.outputs],
        }
        out.print_json("artefact", document | dict(details(artefact) if details else {}))
