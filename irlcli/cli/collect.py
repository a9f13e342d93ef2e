"""``irl collect-experts``."""

from typing import Annotated

import typer

from irlcli.cli.demonstrations import deliver_demonstrations
from irlcli.cli.options import MAX_SEED, EachSetting, Name, RequiredEnv, stage_command
from irlcli.cli.session import StageSession
from irlcli.requests import collect as requested


@stage_command
def collect_experts(
    session: StageSession,
    env: RequiredEnv,
    intervention: Annotated[
        str | None,
        typer.Option(
            help="KNOB=VALUE,VALUE, or KNOB for its training values in the settings file."
        ),
    ] = None,
    setting: EachSetting = [],  # noqa: B006
    expert: Annotated[
        list[str],
        typer.Option(
            metavar="SETTING=EXPERT",
            help="Use this expert in SETTING instead of training one: policy.pt or its artefact; a .zip "
            "of stable-baselines3; or MODEL.zip+STATISTICS.pkl if it was trained under VecNormalize. "
            "Repeatable.",
        ),
    ] = [],  # noqa: B006
    trust: Annotated[
        bool,
        typer.Option(
            "--trust", help="Load the .zip and .pkl files of --expert: this runs the code in them."
        ),
    ] = False,
    episodes: Annotated[
        str | None,
        typer.Option(help="Per setting: 10, or 1,3,10 for three. Default: the settings file's."),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            max=MAX_SEED,
            help="Seed of the recorded episodes. The experts' seed is always 0.",
        ),
    ] = 0,
    name: Name = None,
) -> None:
    """Train an expert per setting and record its demonstrations."""
    request = requested.collect_experts(
        session,
        env=env,
        intervention=intervention,
        setting=setting,
        expert=expert,
        trust=trust,
        episodes=episodes,
        seed=seed,
    )
    found = deliver_demonstrations(session, request, name)
    if found is not None:
        requested.warn_of_missed_bars(session, found)
