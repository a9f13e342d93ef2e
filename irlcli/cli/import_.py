"""``irl import``."""

from typing import Annotated

import typer

from irlcli.cli.demonstrations import deliver_demonstrations
from irlcli.cli.options import EachSetting, Name, RequiredEnv, stage_command
from irlcli.cli.session import StageSession
from irlcli.requests.collect import import_demonstrations


@stage_command
def import_(
    session: StageSession,
    recordings: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE...",
            help="FILE.parquet, minari:DATASET, or a directory of imitation's trajectories; one for "
            "all settings, or one per setting.",
        ),
    ],
    env: RequiredEnv,
    intervention: Annotated[
        str | None,
        typer.Option(
            help="Settings of the episodes: KNOB=VALUE,VALUE, or KNOB for its training values in the "
            "settings file."
        ),
    ] = None,
    setting: EachSetting = [],  # noqa: B006
    setting_column: Annotated[
        str | None,
        typer.Option(
            help="Column, or key of an episode's metadata, that names its setting. Default "
            "for one source of several settings: `setting`."
        ),
    ] = None,
    cut: Annotated[
        bool,
        typer.Option(
            "--cut",
            help="Cut longer episodes at the time limit, count those without an end as truncated, "
            "leave out empty ones. Otherwise they are refused.",
        ),
    ] = False,
    name: Name = None,
) -> None:
    """Turn demonstrations recorded elsewhere into an artefact like that of collect-experts."""
    request = import_demonstrations(
        session,
        recordings=recordings,
        env=env,
        intervention=intervention,
        setting=setting,
        setting_column=setting_column,
        cut=cut,
    )
    deliver_demonstrations(session, request, name)
