"""Options that several commands share, and the decorators that add them to a command."""

import functools
import inspect
import os
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from irlcli.cli import complete
from irlcli.cli.session import Session, StageSession
from irlcli.requests.session import DEFAULT_PROFILE, DEFAULT_STORE

Ref = Annotated[str, typer.Argument(help="Artefact: path, name, or id prefix of 3+ digits.")]
# As irlcli.configs.fields.MAX_COUNT, whose package a light command does not load.
MAX_SEED = 2**53
Seed = Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Seed of everything random.")]
Name = Annotated[str | None, typer.Option(help="Name to give the artefact.")]
_ENV = typer.Option(
    help="Environment, e.g. lunar-lander, or a TOML file that describes one.",
    autocompletion=complete.environments,
)
Env = Annotated[str | None, _ENV]
RequiredEnv = Annotated[str, _ENV]
_SETTING = "KNOB=VALUE, or of several knobs KNOB=VALUE,KNOB=VALUE."
OneSetting = Annotated[list[str], typer.Option("--setting", help=f"Setting: {_SETTING}")]
EachSetting = Annotated[
    list[str], typer.Option("--setting", help=f"One setting: {_SETTING} Repeatable.")
]


def directory(text: str) -> Path:
    """The directory that an option names.

    Raises:
        BadParameter: no text, which as a path would be the working directory.
    """
    if not text:
        raise typer.BadParameter("the path is empty")
    return Path(text)


def writable_directory(text: str) -> Path:
    """The directory that an option names to write to, checked before any work is done.

    Raises:
        BadParameter: it cannot be written or created.
    """
    # Not Path.resolve, which raises where links form a circle.
    there = directory(text).absolute()
    while not os.path.lexists(there):
        there = there.parent
    if not there.is_dir():
        raise typer.BadParameter(f"{there} is not a directory")
    if not os.access(there, os.W_OK | os.X_OK):
        raise typer.BadParameter(f"{there} is not writable")
    return Path(text)


_Store = Annotated[
    Path,
    typer.Option(envvar="IRL_STORE", help="Artefact store.", parser=directory, metavar="PATH"),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Directory to copy the report's files to.",
        parser=writable_directory,
        metavar="PATH",
    ),
]
_Json = Annotated[bool, typer.Option("--json", help="Print versioned JSON on stdout.")]
_Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def _store_session(
    store: _Store = DEFAULT_STORE, as_json: _Json = False, debug: _Debug = False
) -> Session:
    # main() reads --debug from the arguments: an error may come before they are parsed.
    return Session(store, as_json)


def _stage_session(
    profile: Annotated[
        str, typer.Option(help="smoke, standard or paper.", autocompletion=complete.profiles)
    ] = DEFAULT_PROFILE,
    settings: Annotated[
        Path | None, typer.Option(help="TOML file that overrides the profile.")
    ] = None,
    overrides: Annotated[
        list[str],
        typer.Option(
            "--set",
            help="FIELD=VALUE, e.g. airl.total_steps=100000. Repeatable. "
            "For an unknown FIELD the nearest ones are named.",
        ),
    ] = [],  # noqa: B006
    sources: Annotated[
        list[str],
        typer.Option(
            "--from",
            help="Store to copy missing artefacts from, a directory or a URL, repeatable. "
            "[env var: IRL_FROM]",
        ),
    ] = [],  # noqa: B006
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what would be done.")] = False,
    wait: Annotated[
        bool, typer.Option(help="Wait while another process makes the same artefact.")
    ] = True,
    workers: Annotated[int, typer.Option(min=1, help="Processes that step environments.")] = 1,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress on stderr.")] = False,
    tensorboard: Annotated[
        Path | None,
        typer.Option(
            help="Also write the metrics to this TensorBoard directory.",
            parser=writable_directory,
            metavar="PATH",
        ),
    ] = None,
    store: _Store = DEFAULT_STORE,
    as_json: _Json = False,
    debug: _Debug = False,
) -> StageSession:
    return StageSession(
        store,
        as_json,
        profile=profile,
        file=settings,
        overrides=overrides,
        sources=sources or sources_of_environment(),
        dry_run=dry_run,
        wait=wait,
        workers=workers,
        quiet=quiet,
        tensorboard=tensorboard,
    )


def sources_of_environment() -> list[str]:
    """The stores that ``IRL_FROM`` names."""
    text = os.environ.get("IRL_FROM")
    return _places(text) if text else []


def _places(text: str) -> list[str]:
    """Directories and URLs separated by ``:``, which URLs also contain."""
    return re.findall(r"\w[\w+.-]*://[^/:]*(?::\d+)?[^:]*|[^:]+", text)


def store_command(function: Callable[..., None]) -> Callable[..., None]:
    """A command ``function(session, ...)`` on a :class:`Session`: --store, --json, --debug."""
    return _with_options(function, _store_session)


def gc_command(function: Callable[..., None]) -> Callable[..., None]:
    """As :func:`store_command`, for a command that deletes, and so must not block ``gc``."""
    return _with_options(function, _store_session, reads=False)


def stage_command(function: Callable[..., None]) -> Callable[..., None]:
    """A command ``function(session, ...)`` that runs stages in a :class:`StageSession`."""
    return _with_options(function, _stage_session)


def planning_command(function: Callable[..., None]) -> Callable[..., None]:
    """As :func:`stage_command`, for a command that always works as with --dry-run."""
    return _with_options(function, _stage_session, dry_run=True)


def _with_options(
    function: Callable[..., None],
    open_session: Callable[..., Session | StageSession],
    reads: bool = True,
    **fixed: object,
) -> Callable[..., None]:
    """``function`` with the parameters of ``open_session``, but ``fixed``, for its session."""
    declared = inspect.signature(open_session).parameters
    common = {name: p for name, p in declared.items() if name not in fixed}
    own = list(inspect.signature(function).parameters.values())[1:]

    @functools.wraps(function)
    def run(**values: object) -> None:
        session = open_session(**fixed, **{name: values.pop(name) for name in common})
        with session.reading() if reads else nullcontext():
            function(session, **values)

    parameters = [p.replace(kind=p.KEYWORD_ONLY) for p in (*own, *common.values())]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run
