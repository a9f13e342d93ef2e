"""``irl transfer``."""

from typing import Annotated

import typer

from irlcli.cli import complete
from irlcli.cli.options import Env, Name, OneSetting, Seed, stage_command
from irlcli.cli.session import StageSession
from irlcli.requests import transfer as requested


@stage_command
def transfer(
    session: StageSession,
    reward: Annotated[str, typer.Option(help="Learned reward: reward.pt or its artefact.")],
    ood: Annotated[
        str | None,
        typer.Option(help="Setting: VALUE, KNOB=VALUE, or KNOB if it has a single OOD value."),
    ] = None,
    intervention: Annotated[
        str | None,
        typer.Option(help="Setting: VALUE, KNOB=VALUE, or KNOB if it has a single ID value."),
    ] = None,
    setting: OneSetting = [],  # noqa: B006
    algorithm: Annotated[
        str | None,
        typer.Option(
            help=f"Retraining algorithm: {', '.join(complete.algorithms())}.",
            autocompletion=complete.algorithms,
        ),
    ] = None,
    start: Annotated[
        str,
        typer.Option(
            help="scratch: a random policy; student: the one trained while the reward was learned."
        ),
    ] = "scratch",
    env: Env = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Train a new policy on a frozen reward in one setting."""
    request = requested.transfer(
        session,
        reward=reward,
        ood=ood,
        intervention=intervention,
        setting=setting,
        algorithm=algorithm,
        start=start,
        env=env,
        seed=seed,
    )
    session.deliver([request], name)
