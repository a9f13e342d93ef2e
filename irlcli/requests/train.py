"""``train-airl`` and ``train-maxent``: rewards from demonstrations."""

import msgspec

from irlcli.configs.load import unseen_settings
from irlcli.data import descriptions
from irlcli.errors import UsageError
from irlcli.experiments.inputs import source_in
from irlcli.experiments.references import demonstrations
from irlcli.interventions import check_tabular, overlap, parse_setting
from irlcli.methods import METHODS
from irlcli.penalties import maxent_methods
from irlcli.requests import arguments
from irlcli.requests.session import StageSession
from irlcli.stages import choose_penalty as choice
from irlcli.stages import clone as clone_stage
from irlcli.stages import train_airl as airl_stage
from irlcli.stages import train_maxent as maxent_stage
from irlcli.stages.base import Request, Source
from irlcli.store import read_json


def train_airl(
    session: StageSession,
    *,
    demos: str,
    method: str | None,
    grouping: str | None,
    penalty: str | None,
    penalty_weight: float | None,
    choose_penalty: str | None,
    select: str | None,
    state_only: bool | None,
    env: str | None,
    seed: int,
    name: str | None,
) -> Request | None:
    """A reward and a student, or a behavioural clone. ``choose_penalty`` is run here.

    None if lambda is to be chosen but nothing may be run.

    Raises:
        UsageError: unknown, contradictory or ineffective options, or a bad name.
        NotFound: no such demonstrations.
    """
    known = arguments.env_name(env)
    source, env, texts = demonstrations(session.store, demos)
    arguments.check_env(demos, env, known)
    settings = [parse_setting(env, text) for text in texts]
    arguments.warn_of_several(session.console, session.config(env), "airl", settings)
    if method in METHODS and not METHODS[method].learns_reward:
        of_a_reward = {
            "--grouping": grouping,
            "--penalty": penalty,
            "--penalty-weight": penalty_weight,
            "--choose-penalty": choose_penalty,
            "--select": select,
            "--state-only": state_only,
        }
        for option, value in of_a_reward.items():
            if value is not None:
                raise UsageError(
                    f"--method {method} takes no {option}: it learns no reward",
                    f"omit {option}; --set clone.epochs=N sets how long it learns",
                )
        return clone_stage.request(source, env, settings, session.config(env), seed)
    flags = {
        **arguments.method_fields("airl", method, grouping, penalty),
        "airl.penalty_weight": penalty_weight,
        "airl.select": str(parse_setting(env, select)) if select and "=" in select else select,
        "airl.state_only": state_only,
    }
    config = session.config(env, flags)
    airl = config.airl_of(settings)
    arguments.check_weighted(airl_stage.method_of(airl), METHODS, airl.penalty, penalty_weight)
    arguments.warn_of_weight(session.console, airl_stage.method_of(airl), airl)
    if (penalty_weight, choose_penalty) == (None, None) and not arguments.weights_set(
        session.overrides
    ):
        arguments.warn_of_scale(
            session.console, airl.penalty, airl.penalty_weight, "--penalty-weight"
        )
    basis: dict[str, Source] = {}
    if choose_penalty is not None:
        # A bad option must fail before the choice of lambda, which takes long.
        arguments.check_chosen(session.overrides, penalty_weight)
        if name is not None:
            session.store.check_name(name)
        weights = arguments.weights(choose_penalty)
        request = choice.request(source, env, settings, airl, config.evaluation, weights, seed)
        airl_stage.request(source, env, settings, airl, seed)
        chosen = _chosen(session, request)
        if chosen is None:
            return None
        weight, basis["penalty choice"] = chosen
        airl = msgspec.structs.replace(airl, penalty_weight=weight)
    return airl_stage.request(source, env, settings, airl, seed, basis)


def _chosen(session: StageSession, request: Request) -> tuple[float, Source] | None:
    """The lambda that ``request`` chooses, and the file that says so; None if nothing may be run."""
    prepared = session.prepare(request, "choice.json")
    if prepared is None:
        return None
    made, path = prepared
    found = descriptions.convert(read_json(path), descriptions.PenaltyChoice, path)
    session.console.say(f"{found} ({path})")
    return found.chosen, source_in(made, "choice.json")


def train_maxent(
    session: StageSession,
    *,
    demos: str,
    method: str | None,
    grouping: str | None,
    penalty: str | None,
    penalty_weight: float | None,
    l2: float | None,
    features: str | None,
    seed: int,
) -> Request:
    """A reward for the states of a gridworld.

    Raises:
        UsageError: unknown or ineffective options, or demonstrations of another environment.
        NotFound: no such demonstrations.
    """
    source, env, texts = demonstrations(session.store, demos)
    check_tabular(env, "train-maxent", wanted=True)
    flags = {
        **arguments.method_fields("maxent", method, grouping, penalty),
        "maxent.penalty_weight": penalty_weight,
        "maxent.l2": l2,
        "maxent.features": features,
    }
    config = session.config(env, flags)
    maxent = config.maxent
    name = f"{maxent.grouping} MaxEnt"
    arguments.check_weighted(name, maxent_methods(), maxent.penalty, penalty_weight)
    arguments.warn_of_weight(session.console, name, maxent)
    settings = [parse_setting(env, text) for text in texts]
    unseen = [
        setting
        for setting in unseen_settings(env, config)
        if not any(overlap(setting, trained) for trained in settings)
    ]
    return maxent_stage.request(source, env, settings, unseen, maxent, seed)
