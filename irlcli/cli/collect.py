"""``irl collect-experts``."""

from typing import Annotated, Any

import typer

from irlcli.cli import arguments, complete
from irlcli.cli.options import Name, stage_command
from irlcli.cli.session import StageSession
from irlcli.data.descriptions import Collected
from irlcli.experiments.references import output
from irlcli.stages import collect_experts as stage


@stage_command
def collect_experts(
    session: StageSession,
    env: Annotated[
        str,
        typer.Option(help="Environment, e.g. lunar-lander.", autocompletion=complete.environments),
    ],
    intervention: Annotated[
        str, typer.Option(help="KNOB=VALUE,VALUE, or KNOB for its ID values in the settings file.")
    ],
    episodes: Annotated[
        str | None,
        typer.Option(help="Per setting: 10, or 1,3,10 for three. Default: the settings file's."),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(min=0, help="Seed of the recorded episodes. The experts' seed is always 0."),
    ] = 0,
    name: Name = None,
) -> None:
    """Train an expert per setting and record its demonstrations."""
    config = session.config(env)
    settings = arguments.named_settings(env, config, intervention, "id")
    listed = config.interventions.get(intervention)
    if episodes is not None:
        counts = arguments.counts(episodes)
    else:
        counts = listed.episodes if listed is not None else ()
    request = stage.request(env, settings, config, seed, counts)
    for artefact in session.deliver([request], name):
        _warn_of_missed_bars(session, artefact, config.expert.bar)


def _warn_of_missed_bars(session: StageSession, artefact: Any, bar: float | None) -> None:
    summary = output(session.store, artefact, "summary.json", Collected)
    for row in summary.settings:
        if bar is not None and row.mean_return < bar:
            session.console.warn(
                f"the expert of {summary.env} {row.setting} is below its bar: mean true return "
                f"{row.mean_return:.0f} over {row.episodes} episodes, bar {bar:.0f}"
            )
