"""What a store holds of a request: planning without computing, writing or moving anything."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import msgspec

from irlcli.experiments.inputs import source_in
from irlcli.stages.base import From, Request, Source
from irlcli.store import Artefact, KeyRecord, Store

if TYPE_CHECKING:
    from irlcli.store.sources import Found, Place

Status = Literal["HIT", "FOUND", "RUN", "RESUME", "BLOCKED"]
STATUSES: tuple[Status, ...] = get_args(Status)


class Step(NamedTuple):
    """The state of one request.

    Attributes:
        status: ``HIT`` in the store, ``FOUND`` in another one, ``RUN`` or ``RESUME`` if it can be
            computed now, ``BLOCKED`` if an input is missing.
        label: the request's label.
        why: the reason for the status.
        artefact: of a HIT or FOUND; the latter lies in the other store.
        key: unknown while an input is missing.
        parameters: the request's, every one resolved.
        damaged: whether its artefact is there, but damaged.
    """

    status: Status
    label: str
    why: str
    artefact: Artefact | None = None
    key: str | None = None
    parameters: Any = None
    damaged: bool = False


class Identities:
    """Digests that are equal for equal requests."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Request, str]] = {}

    def __call__(self, request: Request) -> str:
        if id(request) not in self._known:
            inputs = {
                role: [self(source.request), source.output]
                if isinstance(source, From)
                else source.sha256
                for role, source in request.inputs.items()
            }
            whole = [request.stage.name, request.stage.version, request.parameters, inputs]
            # No key: canonical JSON would take a third of the time of planning 10,000 runs.
            encoded = msgspec.json.encode(whole, order="deterministic")
            self._known[id(request)] = request, hashlib.sha256(encoded).hexdigest()
        return self._known[id(request)][1]


class Lookup:
    """The states of requests. Each request is looked up once.

    Args:
        store: where artefacts are looked up first. It may be read-only or not exist yet.
        sources: stores, on disk or behind URLs, that are only read: they are looked into on a miss.
    """

    def __init__(self, store: Store, sources: "Sequence[Place]" = ()):
        self.store = store
        self._sources = sources
        # By identity. The request is kept, so that no other object can get its id.
        self._steps: dict[int, tuple[Request, Step]] = {}
        self._elsewhere: dict[str, Found | None] = {}

    def __call__(self, request: Request) -> Step:
        """The state of ``request``.

        Raises:
            NewerFormat: a newer version wrote its artefact.
        """
        if id(request) not in self._steps:
            step = self._look_up(request)._replace(parameters=request.parameters)
            self._steps[id(request)] = request, step
        return self._steps[id(request)][1]

    def chain(self, request: Request) -> list[Step]:
        """The states of ``request`` and all its ancestors, inputs first, equal requests once."""
        steps: dict[str, Step] = {}
        identities = Identities()

        def walk(request: Request) -> None:
            for source in request.inputs.values():
                if isinstance(source, From):
                    walk(source.request)
            # Labels leave things out that distinguish requests, so they cannot identify them.
            steps.setdefault(identities(request), self(request))

        walk(request)
        return list(steps.values())

    def file(self, request: Request, path: str) -> Path | None:
        """An output of ``request``, unchecked, also of another store; None if it was not made."""
        step = self(request)
        if step.artefact is None:
            return None
        found = self._elsewhere.get(step.key) if step.status == "FOUND" and step.key else None
        return (self.store if found is None else found.store).file(step.artefact, path)

    def forget(self) -> None:
        """Look again for everything."""
        self._steps.clear()

    def forget_missing(self) -> None:
        """Look again for everything that was not in the store."""
        self._steps = {i: kept for i, kept in self._steps.items() if kept[1].status == "HIT"}

    def record(self, request: Request) -> KeyRecord | None:
        """The key record of ``request``; None while an input is missing."""
        inputs: dict[str, str] = {}
        for role, source in request.inputs.items():
            if isinstance(source, Source):
                inputs[role] = source.sha256
                continue
            artefact = self(source.request).artefact
            if artefact is None:
                return None
            inputs[role] = source_in(artefact, source.output).sha256
        return key_record(request, inputs)

    def _look_up(self, request: Request) -> Step:
        label = request.label
        record = self.record(request)
        if record is None:
            sources = [s.request for s in request.inputs.values() if isinstance(s, From)]
            missing = [s.label for s in sources if self(s).artefact is None]
            return Step("BLOCKED", label, waiting(missing))
        key = record.key
        there = self.store.peek(key)
        if there.artefact is not None:
            return Step("HIT", label, str(there.artefact.directory), there.artefact, key)
        if there.problem is not None:
            return Step(
                "RUN",
                label,
                f"{there.problem}: the next run moves it to quarantine and exits with 4; "
                "run again to compute it",
                key=key,
                damaged=True,
            )
        found = self._find_elsewhere(key)
        if found is not None:
            return Step("FOUND", label, f"in {found.store.root}", found.artefact, key)
        if self.store.has_checkpoint(key):
            why = "a checkpoint exists: an earlier run was interrupted, or one is running now"
            return Step("RESUME", label, why, key=key)
        return Step("RUN", label, f"no artefact has the key {key[:12]}", key=key)

    def _find_elsewhere(self, key: str) -> "Found | None":
        """Looked up once: the other stores do not change, and what is damaged there is warned of."""
        if key not in self._elsewhere:
            # A hit does not load it.
            from irlcli.store.sources import find_in

            self._elsewhere[key] = find_in(self._sources, key)
        return self._elsewhere[key]


def waiting(missing: Sequence[str]) -> str:
    """What a blocked step waits for: the first three of ``missing``, and how many more."""
    more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
    return f"waits for {', '.join(missing[:3])}{more}"


def key_record(request: Request, inputs: Mapping[str, str]) -> KeyRecord:
    """The key record of ``request``, given the sha256 of each input."""
    stage, parameters = request.stage, msgspec.to_builtins(request.parameters)
    return KeyRecord(stage.name, stage.version, parameters, dict(inputs))
