"""``irl export``."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

import typer

from irlcli.cli import console as out
from irlcli.cli.options import Env, Ref, store_command
from irlcli.cli.session import Session
from irlcli.envs.registry import environment
from irlcli.errors import UsageError, suggest
from irlcli.experiments import references
from irlcli.experiments.inputs import checked
from irlcli.experiments.recordings import minari_directory
from irlcli.requests import arguments


@store_command
def export(
    session: Session,
    what: Annotated[str, typer.Argument(help="demos or reward.")],
    ref: Ref,
    to: Annotated[
        str,
        typer.Option(
            help="For demos: parquet:FILE or minari:DATASET. For a reward: torch-export:FILE.pt2."
        ),
    ],
    env: Env = None,
) -> None:
    """Write demonstrations or a learned reward in a form that other tools read."""
    known = arguments.env_name(env)
    kind, _, name = to.partition(":")
    if what not in _TARGETS:
        raise UsageError(f"{what!r} cannot be exported", suggest(what, _TARGETS))
    if kind not in _TARGETS[what] or not name:
        forms = " or ".join(f"--to {form}:NAME" for form in _TARGETS[what])
        raise UsageError(f"{what} cannot be exported to {to!r}", f"write {forms}")
    path = _TARGETS[what][kind](session, ref, name, known)
    if session.as_json:
        out.print_json("export", {"what": what, "form": kind, "path": str(path)})
    else:
        out.print_data(str(path))


def _demos_to_parquet(session: Session, ref: str, name: str, known: str | None) -> Path:
    source, env, _ = references.demonstrations(session.store, ref)
    arguments.check_env(ref, env, known)
    directory = checked(session.store, source)
    with _new_file(session, Path(name)) as path:
        from irlcli.data.exchange.transitions import write_transitions
        from irlcli.data.steps import shifted
        from irlcli.data.streaming import read_stream

        settings, steps = read_stream(directory)
        spec = environment(env)
        start = _spaces(env, settings[0])[2] if spec.own and spec.discrete_actions else 0
        write_transitions(path, env, settings, shifted(steps, start))
    return Path(name)


def _demos_to_minari(session: Session, ref: str, name: str, known: str | None) -> Path:
    source, env, _ = references.demonstrations(session.store, ref)
    arguments.check_env(ref, env, known)
    directory = checked(session.store, source)
    dataset = minari_directory(name).parent
    if os.path.lexists(dataset):
        raise UsageError(f"Minari has a dataset {name!r} already", "raise its version: -v1")
    dataset.parent.mkdir(parents=True, exist_ok=True)
    with _new_file(session, dataset) as path:
        from irlcli.data.exchange.minari import declare_namespace, write_minari
        from irlcli.data.steps import shifted
        from irlcli.data.streaming import read_stream
        from irlcli.interventions import parse_setting

        texts, steps = read_stream(directory)
        *spaces, start = _spaces(env, texts[0])
        settings = [parse_setting(env, text) for text in texts]
        path.mkdir()
        write_minari(path / "data", name, env, settings, shifted(steps, start), (*spaces,))
    declare_namespace(name)
    return dataset


def _spaces(env: str, setting: str) -> tuple[Any, Any, Any]:
    """The spaces of observations and actions as the environment counts them, and the first index."""
    from contextlib import closing

    from irlcli.envs.adapted import counted_from, first_index
    from irlcli.envs.registration import make
    from irlcli.interventions import parse_setting

    with closing(make(env, parse_setting(env, setting))) as world:
        start = first_index(world)
        return world.observation_space, counted_from(world.action_space, start), start


def _reward_to_torch(session: Session, ref: str, name: str, known: str | None) -> Path:
    with _new_file(session, Path(name)) as path:
        from irlcli.data.exchange.torch_export import write_reward
        from irlcli.rewards import reward_in

        reward = reward_in(session.store, ref)
        arguments.check_env(ref, reward.env, known)
        write_reward(path, reward.module(), reward.about())
    return Path(name)


def _new_file(session: Session, path: Path) -> AbstractContextManager[Path]:
    if os.path.lexists(path):
        raise UsageError(f"{path} exists", "name another file, or remove it first")
    return session.whole_file(path, "--to")


_TARGETS: dict[str, dict[str, Callable[[Session, str, str, str | None], Path]]] = {
    "demos": {"parquet": _demos_to_parquet, "minari": _demos_to_minari},
    "reward": {"torch-export": _reward_to_torch},
}
