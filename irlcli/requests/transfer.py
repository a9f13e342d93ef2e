"""``transfer``: policies on frozen rewards."""

from collections.abc import Sequence

from irlcli.errors import UsageError, suggest
from irlcli.experiments import references
from irlcli.interventions import parse_setting
from irlcli.requests import arguments
from irlcli.requests.session import StageSession
from irlcli.stages import transfer as stage
from irlcli.stages.base import Request
from irlcli.stages.train_airl import reward_label

_STARTS = ("scratch", "student")


def transfer(
    session: StageSession,
    *,
    reward: str,
    ood: str | None,
    intervention: str | None,
    setting: Sequence[str],
    algorithm: str | None,
    start: str,
    env: str | None,
    seed: int,
) -> Request:
    """A policy that is trained on ``reward`` in one setting.

    Raises:
        UsageError: not exactly one setting, or an unknown or unsuitable option.
        NotFound: no such reward, or no student beside it.
    """
    if start not in _STARTS:
        raise UsageError(f"unknown --start {start!r}", suggest(start, _STARTS))
    given = {"--ood": ood, "--intervention": intervention, "--setting": ",".join(setting) or None}
    options = [option for option, text in given.items() if text is not None]
    if len(options) != 1:
        raise UsageError(
            f"{' and '.join(options)} both name a setting" if options else "no setting is named",
            "give one of --ood SETTING, --intervention SETTING, --setting KNOB=VALUE,KNOB=VALUE",
        )
    env = arguments.env_name(env)
    source, origin = references.tensor_file(session.store, reward, "reward")
    arguments.check_env(reward, origin.env, env)
    config = session.config(origin.env, {"transfer.algorithm": algorithm})
    settings = arguments.where(ood, intervention, setting).settings(origin.env, config, origin)
    if len(settings) != 1:
        names = ", ".join(str(setting) for setting in settings)
        raise UsageError(
            f"{options[0]} {given[options[0]]!r} names {len(settings)} settings: {names}",
            "transfer to one at a time",
        )
    if ood is not None:
        arguments.warn_of_seen(session.console, settings, origin, reward)
    learned = {k for text in origin.settings for k in parse_setting(origin.env, text).knobs}
    new = [knob for knob in settings[0].knobs if knob not in learned]
    if new:
        session.console.warn(
            f"{reward!r} was learned in settings that do not change {' or '.join(new)}: it may not "
            "hold there"
        )
    arguments.warn_of_several(session.console, config, "transfer", settings)
    label = reward_label(origin.airl, origin.seed)
    return stage.request(
        source,
        origin.env,
        settings[0],
        config.transfer_of(settings[0]),
        seed,
        label,
        references.student_beside(session.store, source, origin) if start == "student" else None,
    )
