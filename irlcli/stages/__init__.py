"""Stages: pure functions from (parameters, input artefacts) to an output directory.

A :class:`Request` says what is wanted; the runner finds it in the store or has it made. The
modules here are light: planning and cache hits read them, so each imports torch, gymnasium,
pyarrow and the like inside ``run`` only.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec

from irlcli.store import Artefact


class Console(Protocol):
    """What a stage may tell the person who waits for it."""

    def progress(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> None:
        """How far the work is; ``facts`` are shown beside it."""

    def warn(self, message: str) -> None:
        """Something that the person must see."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Metrics of one round, for a mirror such as TensorBoard."""


class Checkpoints(Protocol):
    """Where a stage keeps what it needs to go on after being killed."""

    def load(self) -> bytes | None:
        """The last state saved for this key, or None."""

    def offer(self, state: Callable[[], bytes]) -> None:
        """Called at the end of every round: saves ``state()`` if that is due.

        Raises:
            Interrupted: the person asked to stop; the state has been saved.
        """


class Job(NamedTuple):
    """What a stage works with: inputs by role (files or directories), and where to write.

    ``workers`` processes may step the environments; results do not depend on it.
    """

    parameters: Any
    inputs: Mapping[str, Path]
    output: Path
    checkpoints: Checkpoints
    console: Console
    workers: int = 1


class Stage(NamedTuple):
    """A kind of work. A change that alters results must raise ``version``."""

    name: str
    version: int
    run: Callable[[Job], None]


class Source(NamedTuple):
    """An input that exists: a file or an artefact's directory, known by its content's sha256.

    ``artefact`` is where it lives in the store; None for a foreign path.
    """

    path: Path
    sha256: str
    artefact: Artefact | None = None


class From(NamedTuple):
    """An input that another request makes: one of its outputs, or all of them (``None``)."""

    request: "Request"
    output: str | None = None


class Request(NamedTuple):
    """A stage with its parameters and inputs, all that its key depends on.

    ``parameters`` is a msgspec Struct; every field of it is part of the identity. ``label``
    is what a person is shown.
    """

    stage: Stage
    parameters: msgspec.Struct
    inputs: Mapping[str, Source | From]
    label: str
