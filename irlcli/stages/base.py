"""Stages: pure functions from (parameters, input artefacts) to an output directory.

A :class:`Request` says what is wanted; the runner finds it in the store or makes it. Planning
and cache hits import every stage module, so each imports torch, gymnasium, pyarrow and the like
inside ``run`` only.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import msgspec

from irlcli.envs.registry import environment
from irlcli.envs.spec import EnvironmentSpec
from irlcli.interventions import Setting
from irlcli.store import Artefact

if TYPE_CHECKING:
    from irlcli.trajectories import Trajectory


class Console(Protocol):
    """What a stage may tell the user."""

    def progress(self, done: int, total: int, unit: str, facts: Mapping[str, Any]) -> None:
        """How far the work is; ``facts`` are shown beside it."""

    def warn(self, message: str) -> None:
        """Something that the user must see."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Metrics of one round, for a mirror such as TensorBoard."""


class Checkpoints(Protocol):
    """Where a stage keeps what it needs to resume after being killed."""

    def load(self) -> bytes | None:
        """The last state saved for this key, or None."""

    def discard(self, reason: str) -> None:
        """Start over, with a warning: the last state cannot be used for this ``reason``."""

    def offer(self, state: Callable[[], bytes]) -> None:
        """Called at the end of every round: saves ``state()`` if a checkpoint is due.

        Raises:
            Interrupted: the user asked to stop; the state has been saved.
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

    def warn_of_errors(self, setting: str, trajectories: "Sequence[Trajectory]") -> None:
        """Name the episodes that stopped on an error."""
        for k, trajectory in enumerate(trajectories):
            if trajectory.error is not None:
                self.console.warn(f"{setting}, episode {k}: {trajectory.error}; it ended there")


class Stage(NamedTuple):
    """A kind of work. A change that alters results must raise ``version``.

    ``reads`` are the parts of a config that the stage and its command read, e.g. ``airl.ppo``: a
    ``--set`` of another field has no effect, so the user is warned. None: no warning.
    """

    name: str
    version: int
    run: Callable[[Job], None]
    reads: Sequence[str] | None = None


class Source(NamedTuple):
    """An input that exists: a file or an artefact's directory, known by its content's sha256.

    ``artefact`` is where it lives in the store; None for a path outside it.
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
    is what the user sees.
    """

    stage: Stage
    parameters: Any
    inputs: Mapping[str, Source | From]
    label: str


class OwnKey(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a key holds of an environment from outside the package, besides its horizon.

    Attributes:
        id, entry_point: how it is made; one of them.
        arguments: that are the same in every setting.
        knobs: the argument of each knob that the settings change, by the knob's name.
        whole: those of them whose argument is an ``int``, sorted.
        sha256: digest of its code; None for a package installed from an index.
        distribution, version: what its code was installed from; None for a loose file.
    """

    id: str | None = None
    entry_point: str | None = None
    arguments: dict[str, Any] = {}
    knobs: dict[str, str] = {}
    whole: tuple[str, ...] = ()
    sha256: str | None = None
    distribution: str | None = None
    version: str | None = None


class EnvironmentKey(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a key holds of an environment: a change of its physics or horizon changes the key."""

    name: str
    physics: int
    max_episode_steps: int
    own: OwnKey | None = None


def environment_key(env: str, settings: Sequence[Setting] | None = None) -> EnvironmentKey:
    """The key of the environment called ``env``, as its code is now.

    ``settings`` are those that are worked in; without them every knob of an environment from
    outside the package is part of its key.

    Raises:
        UsageError: unknown environment, or its code is not what this command began with.
        NotFound: its module cannot be imported.
    """
    spec = environment(env)
    if spec.own is not None:
        from irlcli.envs.own import check_code

        check_code(spec)
    return key_of(spec, spec.knobs if settings is None else {k for s in settings for k in s.knobs})


def key_of(spec: EnvironmentSpec, changed: Collection[str]) -> EnvironmentKey:
    """The key of the environment ``spec``; of one from outside the package, with the knobs ``changed``."""
    own = None
    if spec.own is not None:
        own = OwnKey(
            id=spec.own.id,
            entry_point=spec.entry_point or None,
            arguments=spec.own.arguments,
            knobs={name: spec.knobs[name].argument for name in sorted(changed)},
            whole=tuple(name for name in sorted(changed) if spec.knobs[name].whole),
            **spec.own.code._asdict(),
        )
    return EnvironmentKey(
        name=spec.name, physics=spec.physics, max_episode_steps=spec.max_episode_steps, own=own
    )
