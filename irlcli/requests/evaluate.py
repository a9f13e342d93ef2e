"""``evaluate``: returns of policies, experts and baselines."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from irlcli import labels
from irlcli.data.descriptions import Evaluation, Reward
from irlcli.errors import UsageError
from irlcli.experiments import references
from irlcli.experiments.circumstances import by_own_reward
from irlcli.interventions import Setting, check_observed, parse_setting, without_cue
from irlcli.requests import arguments
from irlcli.requests.session import Session, StageSession
from irlcli.stages import evaluate as stage
from irlcli.stages.base import From, Request
from irlcli.store import Artefact


class _Asked(NamedTuple):
    """Where and how often to measure, whoever acts.

    Attributes:
        scorer, scored: the reward that also scores the episodes, and the stage's arguments for it;
            None and none without one.
    """

    where: arguments.Where
    env: str | None
    episodes: int | None
    seed: int
    scorer: Reward | None
    scored: Mapping[str, Any]


def evaluate(
    session: StageSession,
    *,
    policy: str | None,
    expert: bool,
    trained_in: str | None,
    random: bool,
    idle: bool,
    reward: str | None,
    ood: str | None,
    intervention: str | None,
    setting: Sequence[str],
    env: str | None,
    episodes: int | None,
    seed: int,
    name: str | None,
) -> list[Request]:
    """The returns of one agent; for experts a request each.

    Raises:
        UsageError: not exactly one agent, no settings, or contradictory options.
        NotFound: no such policy or reward.
    """
    given = sum([policy is not None, expert, random, idle])
    if given != 1:
        raise UsageError(
            f"{given or 'no'} agents are named, but one is needed",
            "give one of --policy REF, --expert, --random, --idle",
        )
    where = arguments.where(ood, intervention, setting)
    if trained_in is not None and not expert:
        raise UsageError("--trained-in selects experts, but --expert is missing", "add --expert")
    env = arguments.env_name(env)
    scorer: Reward | None = None
    scored: dict[str, Any] = {}
    if reward is not None:
        from irlcli.stages.train_airl import reward_label

        source, scorer = references.tensor_file(session.store, reward, "reward")
        arguments.check_env(reward, scorer.env, env)
        env = scorer.env
        scored = {"reward": source, "reward_label": reward_label(scorer.airl, scorer.seed)}
    asked = _Asked(where, env, episodes, seed, scorer, scored)
    if policy is not None:
        requests = [_of_policy(session, policy, asked)]
    else:
        agent: Literal["expert", "random", "idle"]
        agent = "expert" if expert else "random" if random else "idle"
        requests = _of_agent(session, agent, trained_in, asked)
    if name is not None and len(requests) > 1:
        raise UsageError(
            f"--name {name!r} cannot name {len(requests)} evaluations",
            "evaluate one expert at a time to name it",
        )
    return requests


def measured(session: Session, artefact: Artefact) -> tuple[Evaluation, dict[str, Any], bool]:
    """An evaluation for :func:`irlcli.report.returns.rows`."""
    scored = "reward" in artefact.manifest.record.inputs
    own = scored and by_own_reward(artefact, session.store.index())
    return references.summary(session.store, artefact), {}, own


def _of_policy(session: StageSession, policy: str, asked: _Asked) -> Request:
    where, scorer = asked.where, asked.scorer
    source, origin = references.tensor_file(session.store, policy, "policy")
    if scorer is not None:
        arguments.check_scorer(scorer.env, policy, origin.env)
    arguments.check_env(policy, origin.env, asked.env)
    config = session.config(origin.env, {"evaluation.episodes": asked.episodes})
    settings: Sequence[Setting]
    if where.given:
        settings = where.settings(origin.env, config, origin)
        # A retrained policy was trained where its reward was not.
        if where.kind == "ood" and origin.agent != "transfer":
            arguments.warn_of_seen(session.console, settings, origin, policy)
    else:
        settings = [parse_setting(origin.env, text) for text in origin.settings]
    if scorer is not None:
        check_observed(origin.env, scorer.settings, settings)
    label = f"{origin.agent} of {', '.join(origin.settings)}"
    if origin.method is not None:
        how = labels.retrained(
            origin.algorithm, origin.ceiling, origin.from_student, len(origin.restarts)
        )
        label = f"{origin.agent} {origin.method} {how}".strip() + f" of seed {origin.seed}"
    return stage.request(
        origin.env,
        settings,
        config.evaluation,
        source,
        seed=asked.seed,
        policy_label=label,
        **asked.scored,
    )


def _of_agent(
    session: StageSession,
    agent: Literal["expert", "random", "idle"],
    trained_in: str | None,
    asked: _Asked,
) -> list[Request]:
    env, where, seed, scored = asked.env, asked.where, asked.seed, asked.scored
    if env is None or not where.given:
        missing = [] if env is not None else ["--env ENV"]
        missing += (
            []
            if where.given
            else ["--intervention KNOB=VALUE,VALUE, --ood KNOB=VALUE or --setting default"]
        )
        raise UsageError(
            f"--{agent} needs an environment and the settings to evaluate in",
            f"add {' and '.join(missing)}",
        )
    config = session.config(env, {"evaluation.episodes": asked.episodes})
    settings = where.settings(env, config, asked.scorer)
    if agent != "expert":
        return [stage.request(env, settings, config.evaluation, agent=agent, seed=seed, **scored)]
    from irlcli.stages import train_expert

    experts: list[tuple[Setting, Sequence[Setting]]]
    if trained_in is None:
        experts = [(setting, [setting]) for setting in settings]
    else:
        trained = arguments.named_settings(env, config, trained_in, "id", "--trained-in")
        for setting in trained:
            check_observed(env, [str(setting)], settings)
        # Settings that differ in their cue only have one expert.
        worlds = dict.fromkeys(without_cue(env, setting) for setting in trained)
        experts = [(world, settings) for world in worlds]
    for own, _ in experts:
        arguments.warn_of_several(session.console, config, "expert", [without_cue(env, own)])
    return [
        stage.request(
            env,
            measured,
            config.evaluation,
            From(train_expert.demonstrator(env, own, config), "policy.pt"),
            seed=seed,
            policy_label=f"expert of {own}",
            **scored,
        )
        for own, measured in experts
    ]
