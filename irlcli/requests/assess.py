"""``assess``: how well a learned reward ranks policies of mixed quality."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from irlcli.envs.registry import environment
from irlcli.errors import UsageError
from irlcli.experiments import bank, references
from irlcli.experiments.inputs import checked
from irlcli.interventions import Setting, check_observed, parse_setting
from irlcli.requests import arguments
from irlcli.requests.session import StageSession
from irlcli.stages import assess as stage
from irlcli.stages.base import Request
from irlcli.stages.train_airl import reward_label

if TYPE_CHECKING:
    from irlcli.stages.base import Source


class Assessing(NamedTuple):
    """An assessment.

    ``retrain`` is the command line that retrains a policy on the reward; None if its bank has one.
    """

    request: Request
    retrain: str | None


def assess(
    session: StageSession,
    *,
    reward: str,
    ood: str | None,
    intervention: str | None,
    setting: Sequence[str],
    demos: str | None,
    episodes: int | None,
    env: str | None,
    seed: int,
) -> Assessing:
    """An assessment of ``reward`` on the policies that the store holds, and on new ones.

    Warns if it lacks demonstrations or experts.

    Raises:
        UsageError: contradictory or unsuitable options.
        NotFound: no such reward or demonstrations.
    """
    where = arguments.where(ood, intervention, setting)
    known = arguments.env_name(env)
    source, origin = references.tensor_file(session.store, reward, "reward")
    arguments.check_env(reward, origin.env, known)
    # Before the bank acts, which takes long.
    checked(session.store, source)
    config = session.config(origin.env, {"evaluation.episodes": episodes})
    settings = [parse_setting(origin.env, text) for text in origin.settings]
    if where.given:
        settings = where.settings(origin.env, config, origin)
    finder = bank.Finder(session.store, session.runner().lookup(), config)
    shown, cloned = finder.demonstrations(source), origin.settings
    if demos is not None:
        shown, cloned = _given(session, demos, origin.env, origin.settings)
    policies = finder.policies(source, origin, settings, shown, cloned, seed)
    if shown is None:
        session.console.warn(
            "the bank has no noisy clones: the store lacks the demonstrations that this reward "
            "was learned from; name them with --demos"
        )
    _warn_of_experts(session, origin.env, settings, policies)
    request = stage.request(
        source,
        origin.env,
        bank.bank(origin.env, settings, config, policies, seed),
        reward_label(origin.airl, origin.seed),
    )
    retrain = None
    if not any(e.kind in ("retrained", "from-student") for e in request.parameters.bank):
        # A built-in environment is known from the reward, and so is one that its artefact describes.
        file = _file(origin.env)
        named = () if file is None else ("--env", file)
        retrain = session.suggestion(
            "transfer", "--reward", reward, *named, "--setting", str(settings[0])
        )
    return Assessing(request, retrain)


def _file(env: str) -> str | None:
    """The TOML file that describes ``env``; None for a built-in one, or one that an artefact describes."""
    own = environment(env).own
    return None if own is None or own.directory is None else own.source


def _given(
    session: StageSession, demos: str, env: str, learned: Sequence[str]
) -> "tuple[Source, tuple[str, ...]]":
    source, of, settings = references.demonstrations(session.store, demos)
    if of != env:
        raise UsageError(
            f"{demos!r} are demonstrations of {of}, not of {env}",
            "name demonstrations of the reward's environment",
        )
    check_observed(env, learned, [parse_setting(env, text) for text in settings])
    return source, tuple(settings)


def _warn_of_experts(
    session: StageSession, env: str, settings: Sequence[Setting], policies: bank.Policies
) -> None:
    for setting in policies.substitutes:
        session.console.warn(
            f"the expert of {setting} in the bank is not the one who demonstrated, which no artefact of "
            "the store holds: regret and verdicts refer to the one in the bank"
        )
    named = env if environment(env).own is None else _file(env) or "FILE.toml"
    for setting in map(str, settings):
        if setting not in policies.experts:
            line = session.suggestion("evaluate", "--expert", "--env", named, "--setting", setting)
            session.console.warn(
                f"no expert of {setting} with this config, so no regret and no expert minus idle: "
                f"`{line}` trains it"
            )
