"""``irl envs``."""

from typing import Annotated, Any

import typer

from irlcli.cli import complete
from irlcli.cli import console as out
from irlcli.cli.options import store_command
from irlcli.cli.session import Session
from irlcli.configs import PROFILES, Config, load_config
from irlcli.envs.announced import announced
from irlcli.envs.registry import ENVIRONMENTS, environment, resolve
from irlcli.envs.spec import EnvironmentSpec
from irlcli.errors import IrlError, StageFailed, UsageError, suggest
from irlcli.interventions import listed_settings

_ACTIONS = ("list", "show", "check")


@store_command
def envs(
    session: Session,
    action: Annotated[
        str,
        typer.Argument(metavar="list|show|check", autocompletion=lambda: list(_ACTIONS)),
    ],
    env: Annotated[
        str | None,
        typer.Argument(
            metavar="[ENV]",
            help="A name, or a TOML file that describes an environment.",
            autocompletion=complete.environments,
        ),
    ] = None,
) -> None:
    """List the environments, show one, or check one.

    list: built-in ones, and those that installed packages announce. show ENV: its knobs, settings and
    code. check ENV: gymnasium's check_env; equal seeds give equal episodes; every knob changes
    something and can be made at its bounds, and 1x changes nothing.
    """
    if action not in _ACTIONS:
        raise UsageError(f"unknown action {action!r}", suggest(action, _ACTIONS))
    if (env is None) != (action == "list"):
        needs = "takes no environment" if action == "list" else "needs an environment"
        form = "irl envs list" if action == "list" else f"irl envs {action} ENV"
        raise UsageError(f"envs {action} {needs}", f"write {form}")
    if env is None:
        _list(session)
        return
    spec = resolve(env)
    # A mistake in the settings of any profile is named here.
    configs = {profile: load_config(spec.name, profile) for profile in PROFILES}
    if action == "show":
        _show(session, spec, configs["standard"])
    else:
        _check(session, spec, configs["standard"])


def _list(session: Session) -> None:
    rows: list[dict[str, Any]] = [
        {"name": name, "from": "built in", "knobs": list(spec.knobs), "problem": None}
        for name, spec in ENVIRONMENTS.items()
    ]
    for name, distribution in announced().items():
        try:
            knobs, problem = list(environment(name).knobs), None
        except IrlError as error:
            knobs, problem = [], error.message
        rows.append({"name": name, "from": distribution, "knobs": knobs, "problem": problem})
    if session.as_json:
        out.print_json("environments", {"environments": rows})
        return
    out.print_table(
        ["environment", "from", "knobs"],
        [[row["name"], row["from"], ", ".join(row["knobs"]) or row["problem"]] for row in rows],
    )


def _show(session: Session, spec: EnvironmentSpec, config: Config) -> None:
    own = spec.own
    facts = {
        "name": spec.name,
        "made by": spec.entry_point or spec.gym_id,
        "time limit": f"{spec.max_episode_steps} steps",
        "actions": "discrete" if spec.discrete_actions else "continuous",
        "symmetries": spec.symmetries or "none declared",
    }
    if own is not None:
        version = own.code.version and f"{own.code.distribution} {own.code.version}"
        content = own.code.sha256 and f"content {own.code.sha256[:12]}"
        facts["code"] = ", ".join(part for part in (version, content) if part)
        facts["arguments"] = ", ".join(f"{k}={v!r}" for k, v in own.arguments.items())
    rows = []
    for name, knob in spec.knobs.items():
        listed = config.interventions.get(name)
        rows.append(
            {
                "knob": name,
                "argument": knob.argument,
                "forms": list(knob.forms),
                "low": knob.low,
                "high": knob.high,
                "trained": list(listed.id) if listed else [],
                "held out": list(listed.ood) if listed else [],
                "description": knob.description,
            }
        )
    if session.as_json:
        out.print_json("environment", {**facts, "knobs": rows})
        return
    for name, text in facts.items():
        if text:
            out.print_data(f"{name:12}{text}")
    columns = ["knob", "argument", "forms", "from", "to", "trained", "held out", "description"]
    cells = [[_cell(value) for value in row.values()] for row in rows]
    out.print_table(columns, cells)


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check(session: Session, spec: EnvironmentSpec, config: Config) -> None:
    from irlcli.envs.check import Found, check

    listed = {
        knob: listed_settings(spec.name, knob, (*values.id, *values.ood))
        for knob, values in config.interventions.items()
    }
    outcomes: list[Found] = []
    for found in check(spec, listed):
        outcomes.append(found)
        if not session.as_json:
            _print(found)
    checks = [found._asdict() for found in outcomes]
    failed = [found for found in outcomes if found.wrong]
    if session.as_json and not failed:
        out.print_json("check", {"environment": spec.name, "checks": checks})
    if failed:
        raise StageFailed(
            f"{len(failed)} of {len(outcomes)} checks of {spec.name} failed: "
            f"{'; '.join(found.what for found in failed)}",
            "docs/own-environments.md and docs/extending.md say what is expected",
            {"checks": checks},
        )


def _print(found: Any) -> None:
    out.print_data(f"{'FAIL' if found.wrong else 'PASS'}  {found.what}")
    for text in (found.wrong, *(f"note: {note}" for note in found.notes)):
        if text:
            out.print_data(f"      {text}")
