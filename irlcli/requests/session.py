"""What options are read and requests are run with: a store, configs, and a console."""

import re
import shlex
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from irlcli.errors import NotFound, UsageError
from irlcli.store import DEFAULT_ROOT, Artefact, Store

DEFAULT_STORE, DEFAULT_PROFILE = Path(DEFAULT_ROOT), "standard"
_SMOKE = "smoke"

if TYPE_CHECKING:
    from irlcli.configs import Config
    from irlcli.experiments.runner import RunConsole, Runner
    from irlcli.stages.base import Request
    from irlcli.store.sources import Place


def check_path(path: Path, option: str) -> None:
    """Refuse a path that ``option`` named and that no artefact could record.

    Raises:
        UsageError: it is not UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UsageError(
            f"the path {str(path)!r} is not UTF-8", f"name another one with {option}"
        ) from None


class Session:
    """The store that artefacts are looked up in.

    Args:
        store: its directory.
        console: receives progress and warnings.
        wait: wait for other processes, instead of raising Busy.
        read_only: nothing is written to the store.

    Raises:
        UsageError: ``store`` is a URL, or not UTF-8.
    """

    def __init__(
        self, store: Path, console: "RunConsole", wait: bool = True, read_only: bool = False
    ):
        # As a path it would be a directory here: a path has no empty parts, so `//` became `/`.
        if re.match(r"[A-Za-z][\w+.-]+:/", str(store)):
            raise UsageError(
                f"the store {store} is a URL, not a directory",
                "--from reads a store behind a URL; `irl push` and `irl pull` copy artefacts",
            )
        check_path(store, "--store")
        self.console = console
        self.store = Store(store, console.warn, read_only)
        self.wait = wait

    def reading(self) -> AbstractContextManager[None]:
        """Keep gc from deleting anything while artefacts are read."""
        return self.store.in_use(self.wait, partial(self.console.wait, "the store"))

    def artefact(self, ref: str) -> Artefact:
        """The artefact that ``ref`` names.

        Raises:
            NotFound: no such artefact, or a path outside the store.
        """
        resolved = self.store.resolve(ref)
        if resolved.artefact is None:
            kind = "directory" if resolved.path.is_dir() else "file"
            raise NotFound(
                f"{ref!r} is a {kind}, not an artefact of the store {self.store.root}",
                self.store.listing,
            )
        return resolved.artefact


class StageSession(Session):
    """A session that runs stages under a profile and its overrides.

    Args:
        profile, file, overrides: as for :func:`irlcli.configs.load_config`.
        asked: the overrides that this call gave; by default all.
        sources: other stores, directories or URLs, to copy missing artefacts from.
        command: the command line that artefacts record, so that a damaged one shows its repair.
        workers: processes that step environments.

    Raises:
        UsageError: an unknown profile, or a field that ``overrides`` set twice.
    """

    def __init__(
        self,
        store: Path,
        console: "RunConsole",
        *,
        profile: str,
        file: Path | None,
        overrides: Sequence[str],
        sources: Sequence[str | Path],
        command: Sequence[str],
        wait: bool = True,
        workers: int = 1,
        read_only: bool = False,
        asked: Sequence[str] | None = None,
    ):
        from irlcli.configs import check_profile

        check_profile(profile)
        _check_repeated(overrides)
        super().__init__(store, console, wait, read_only)
        self.profile = profile
        self.file = file
        # Settings file of a table; the session's own file is laid over it.
        self.table_file: Path | None = None
        self.overrides = list(overrides)
        self.asked = self.overrides if asked is None else list(asked)
        # Requests on which those to run depend.
        self.prepared: list[Request] = []
        self.sources = list(sources)
        self.command = list(command)
        self.workers = workers
        self._warned: set[str] = set()

    def config(
        self, env: str, flags: Mapping[str, Any] | None = None, overrides: Sequence[str] = ()
    ) -> "Config":
        """The config of ``env`` under this session's profile and overrides, then ``overrides``."""
        from irlcli.configs import file_without_profile, load_config

        source = file_without_profile(env, self.profile)
        if source:
            self._warn_once(
                f"{source} has no [profiles.{self.profile}]: its values outside [profiles] are used"
            )
        files = [file for file in (self.table_file, self.file) if file is not None]
        return load_config(env, self.profile, files, [*self.overrides, *overrides], flags)

    def config_words(self) -> list[str]:
        """The options that give another command line the same configs."""
        words = ["--profile", self.profile]
        words += [] if self.file is None else ["--settings", str(self.file)]
        return words + [word for item in self.overrides for word in ("--set", item)]

    def suggestion(self, *words: str) -> str:
        """The command line ``irl WORDS`` on this store and under these configs, for a hint."""
        configs = self.config_words()
        if self.profile == DEFAULT_PROFILE:
            configs = configs[2:]
        sources = [word for source in self.sources for word in ("--from", str(source))]
        return shlex.join(["irl", *words, *configs, *self.store.option, *sources])

    def runner(self) -> "Runner":
        """A runner on the session's store and those to copy from.

        Raises:
            NotFound: what ``--from`` names is not a store.
        """
        from irlcli.experiments.runner import Runner

        return Runner(
            self.store,
            self.console,
            self.wait,
            self.command,
            workers=self.workers,
            sources=self._places,
        )

    @cached_property
    def _places(self) -> "list[Place]":
        """The stores to copy from. They are opened once: a remote one remembers what it fetched."""
        if not self.sources:
            return []
        from irlcli.store.sources import open_sources

        return open_sources(self.sources, self.console.warn)

    def run(self, requests: Sequence["Request"], name: str | None = None) -> list[Artefact]:
        """The artefacts of ``requests``, in this order; the first one gets the name.

        Raises:
            UsageError: a bad name, before any work.
            IrlError: as for :meth:`irlcli.experiments.runner.Runner.run`.
        """
        if name is not None:
            # A bad name must fail before the work, not after it.
            self.store.check_name(name)
        runner = self.runner()
        artefacts = []
        # In a new store, too, gc must not delete an artefact before it has its name.
        self.store.create()
        with self.reading():
            try:
                for request in requests:
                    artefacts.append(runner.run(request))
            finally:
                self.console.close()
            if name is not None:
                self.store.set_name(name, artefacts[0])
        return artefacts

    def prepare(self, request: "Request", output: str) -> tuple[Artefact, Path] | None:
        """The artefact of ``request`` and its file ``output``; ``train-airl`` depends on them.

        The command line's session returns None with --dry-run if the artefact is missing.
        """
        self.prepared.append(request)
        (made,) = self.run([request])
        return made, self.store.open(made, output)

    def warn_of_unread(self, requests: Sequence["Request"], table: str | None = None) -> None:
        """Warn of a ``--set`` whose field or value ``requests`` and what they need do not hold.

        With the name of a ``table``, ``requests`` are all of its steps.
        """
        if not self.asked:
            return
        from irlcli.requests.overrides import behind, replaced, unread

        every = requests
        if table is None:
            every = [made for request in (*self.prepared, *requests) for made in behind(request)]
        for line in replaced(self.asked, every):
            self._warn_once(line)
        # A bank is looked for under the whole config.
        whole = table is None and any(request.stage.name == "assess" for request in every)
        reader = "stage of this command" if table is None else f"step of {table}"
        for item in () if whole else unread(self.asked, every):
            self._warn_once(f"no {reader} reads --set {item}")

    def warn_before(self, requests: Sequence["Request"]) -> None:
        """Warn of what is likely a mistake in one command's ``requests``."""
        self.warn_of_unread(requests)
        self._warn_of_smoke(requests)

    def _warn_of_smoke(self, requests: Sequence["Request"]) -> None:
        """Warn of inputs from the profile ``smoke``, which learns nothing, under another profile."""
        if self.profile == _SMOKE:
            return
        for request in requests:
            for source in request.inputs.values():
                # An input that another request makes has the session's profile.
                artefact = getattr(source, "artefact", None)
                if artefact is not None and _is_smoke(artefact.provenance()):
                    self._warn_once(
                        f"{artefact.manifest.record.stage} {artefact.id} was made with --profile "
                        f"{_SMOKE}, this command uses {self.profile}"
                    )

    def _warn_once(self, message: str) -> None:
        # A figure's report needs the steps of its table, which were looked at before.
        if message not in self._warned:
            self._warned.add(message)
            self.console.warn(message)


def _is_smoke(provenance: Mapping[str, Any]) -> bool:
    command = provenance.get("command") or []
    return f"--profile={_SMOKE}" in command or ["--profile", _SMOKE] in map(list, pairwise(command))


def _check_repeated(overrides: Sequence[str]) -> None:
    """Refuse a field that ``--set`` names twice: only the last value would count."""
    from irlcli.configs.load import field_of

    fields = [field_of(item) for item in overrides]
    for field in fields:
        if fields.count(field) > 1:
            raise UsageError(f"--set {field} is given twice", f"give {field} once")
