"""``irl evaluate``."""

from typing import Annotated

import typer

from irlcli.cli import returns
from irlcli.cli.options import EachSetting, Env, Name, Seed, stage_command
from irlcli.cli.session import StageSession
from irlcli.report.returns import as_json
from irlcli.requests import evaluate as requested


@stage_command
def evaluate(
    session: StageSession,
    policy: Annotated[str | None, typer.Option(help="Policy: policy.pt or its artefact.")] = None,
    expert: Annotated[bool, typer.Option("--expert", help="The expert of each setting.")] = False,
    trained_in: Annotated[
        str | None,
        typer.Option(
            help="With --expert: the experts of KNOB=VALUE,... or KNOB (training values), each in all "
            "settings."
        ),
    ] = None,
    random: Annotated[
        bool, typer.Option("--random", help="The agent that acts uniformly at random.")
    ] = False,
    idle: Annotated[bool, typer.Option("--idle", help="The agent that does nothing.")] = False,
    reward: Annotated[
        str | None,
        typer.Option(help="Learned reward that also scores the episodes: reward.pt or artefact."),
    ] = None,
    ood: Annotated[
        str | None,
        typer.Option(
            help="Settings: VALUE,... of the policy's knob, KNOB=VALUE,... or KNOB (OOD values)."
        ),
    ] = None,
    intervention: Annotated[
        str | None, typer.Option(help="Settings: KNOB=VALUE,..., or KNOB (training values).")
    ] = None,
    setting: EachSetting = [],  # noqa: B006
    env: Env = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes per setting.")] = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Measure the return of a policy, an expert or a baseline."""
    requests = requested.evaluate(
        session,
        policy=policy,
        expert=expert,
        trained_in=trained_in,
        random=random,
        idle=idle,
        reward=reward,
        ood=ood,
        intervention=intervention,
        setting=setting,
        env=env,
        episodes=episodes,
        seed=seed,
        name=name,
    )
    artefacts = session.deliver(
        requests, name, lambda made: {"returns": as_json([requested.measured(session, made)])}
    )
    if artefacts and not session.as_json:
        returns.print_rows([requested.measured(session, made) for made in artefacts], stderr=True)
