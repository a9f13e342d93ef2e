"""``irl transfer``."""

from typing import Annotated

import typer

from irlcli.cli import arguments
from irlcli.cli.options import Env, Name, Seed, stage_command
from irlcli.cli.session import StageSession
from irlcli.errors import UsageError
from irlcli.experiments import references
from irlcli.stages import transfer as stage
from irlcli.stages.train_airl import describe


@stage_command
def transfer(
    session: StageSession,
    reward: Annotated[str, typer.Option(help="Learned reward: reward.pt or its artefact.")],
    ood: Annotated[
        str, typer.Option(help="Setting: VALUE, KNOB=VALUE, or KNOB for its OOD value.")
    ],
    env: Env = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Train a new policy on a frozen reward in an unseen setting."""
    source, origin = references.tensor_file(session.store, reward, "reward")
    arguments.check_env(reward, origin.env, env)
    config = session.config(origin.env)
    settings = arguments.named_settings(origin.env, config, ood, "ood", origin)
    if len(settings) != 1:
        names = ", ".join(str(setting) for setting in settings)
        raise UsageError(
            f"--ood {ood!r} names {len(settings)} settings: {names}", "transfer to one at a time"
        )
    label = f"{describe(origin.airl)} seed {origin.seed}"
    request = stage.request(source, origin.env, settings[0], config.transfer, seed, label)
    session.deliver([request], name)
