"""``irl play``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from irlcli.cli import console as out
from irlcli.cli.options import Env, OneSetting, Seed, store_command
from irlcli.cli.session import Session
from irlcli.configs import load_config
from irlcli.errors import UsageError
from irlcli.experiments import references
from irlcli.experiments.inputs import checked
from irlcli.interventions import Setting, check_observed, parse_setting
from irlcli.requests import arguments
from irlcli.stages.base import Source

if TYPE_CHECKING:
    from irlcli.data.descriptions import Reward
    from irlcli.learners.frozen import FrozenReward


@store_command
def play(
    session: Session,
    policy: Annotated[str, typer.Argument(help="Policy: policy.pt or its artefact.")],
    file: Annotated[Path, typer.Option("--out", help="GIF or MP4 to write.")],
    ood: Annotated[
        str | None,
        typer.Option(
            help="Further settings: VALUE,... of the policy's knob, KNOB=VALUE,... or KNOB."
        ),
    ] = None,
    setting: OneSetting = [],  # noqa: B006
    reward: Annotated[
        str | None,
        typer.Option(
            help="Learned reward whose return is drawn beside the true one; default: the one that "
            "the policy was trained on."
        ),
    ] = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Maximum number of steps to draw in each setting.")
    ] = 300,
    env: Env = None,
    seed: Seed = 0,
) -> None:
    """Draw a policy as a GIF or MP4, several settings side by side.

    The settings are those it was trained in, then those of --ood and --setting.
    """
    known = arguments.env_name(env)
    source, origin = references.tensor_file(session.store, policy, "policy")
    arguments.check_env(policy, origin.env, known)
    env = origin.env
    settings = [parse_setting(env, text) for text in origin.settings]
    added = arguments.where(ood, None, setting).settings(env, load_config(env), origin)
    settings += [one for one in added if one not in settings]
    if file.suffix.lower() not in (".gif", ".mp4"):
        raise UsageError(f"{str(file)!r} ends in neither .gif nor .mp4", "name such a file")
    session.check_file(file, "--out")
    scored_by = _scored_by(session, source, reward)
    if scored_by is not None:
        arguments.check_scorer(scored_by[1].env, policy, env)
        check_observed(env, scored_by[1].settings, settings)

    from irlcli.data.tensors import load_policy_file
    from irlcli.report.animation import film, write_gif, write_mp4

    player, _ = load_policy_file(checked(session.store, source))
    rewards = None if scored_by is None else _rewards(session, scored_by[0], env, settings)
    with session.whole_file(file, "--out") as part:
        write = write_mp4 if file.suffix.lower() == ".mp4" else write_gif
        write(part, film(player, env, settings, steps, seed, rewards))
    if session.as_json:
        document = {
            "path": str(file),
            "env": env,
            "settings": [str(s) for s in settings],
            "reward": None if scored_by is None else scored_by[1].method,
        }
        out.print_json("play", document)
    else:
        out.print_data(str(file))


def _scored_by(session: Session, policy: Source, ref: str | None) -> "tuple[Source, Reward] | None":
    """The reward whose return is drawn: ``ref``, or the one behind the policy, if there is one."""
    if ref is not None:
        return references.tensor_file(session.store, ref, "reward")
    return references.reward_behind(session.store, policy)


def _rewards(
    session: Session, source: Source, env: str, settings: Sequence[Setting]
) -> "list[FrozenReward]":
    """The reward in each of ``settings``."""
    from irlcli.data.tensors import load_reward_file
    from irlcli.stages.base import environment_key
    from irlcli.stages.running import frozen_reward

    model, origin = load_reward_file(checked(session.store, source))
    where = environment_key(env, settings)
    return [frozen_reward(where, str(setting), model, origin) for setting in settings]
