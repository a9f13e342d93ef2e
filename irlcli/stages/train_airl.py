"""Adversarial IRL from demonstrations (paper Algorithm 1), with any grouping and penalty."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Any, Literal

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from irlcli import labels
from irlcli.configs import AIRLConfig
from irlcli.configs.relevance import relevant_airl, relevant_ppo
from irlcli.envs.registry import environment
from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import Setting, check_tabular, parse_setting
from irlcli.methods import method_name
from irlcli.penalties import check_risks, penalty_version
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import (
    deciding_score,
    run_training,
    warn_of_failures,
    warn_of_labels,
    warn_of_shared_ends,
)

if TYPE_CHECKING:
    from irlcli.learners.airl import AIRL
    from irlcli.learners.selection import BestRound
    from irlcli.rl.worlds import Worlds
    from irlcli.symmetries import Symmetries
    from irlcli.trajectories import Trajectory


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a learned reward depends on, besides its demonstrations."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    seed: int
    airl: AIRLConfig
    penalty_version: int | UnsetType = UNSET
    selection_version: int | UnsetType = UNSET
    # 2: what is left over of every setting is dealt to the same groups. 3: weights in single precision.
    shuffling_version: Literal[3] | UnsetType = UNSET


def request(
    demos: Source | From,
    env: str,
    settings: Sequence[Setting],
    airl: AIRLConfig,
    seed: int = 0,
    basis: Mapping[str, Source | From] | None = None,
) -> Request:
    """A reward and a student learned from those of ``demos`` that are of ``settings``.

    ``basis`` are further artefacts that the parameters follow from: part of the lineage.

    Outputs ``reward.pt``, ``policy.pt`` (the student), their descriptions as JSON, and
    ``metrics.parquet`` with one row per round and setting.

    Raises:
        UsageError: a tabular environment, gSDE, worlds that the settings cannot share equally,
            minibatches too small for shuffled settings, rollouts of a single sample, a selection by
            something that the demonstrations do not hold, or a penalty that compares settings where
            there is one.
    """
    check_tabular(env, "train-airl", wanted=False)
    if airl.ppo.use_sde:
        raise UsageError(
            "airl.ppo.use_sde: AIRL needs log pi(a|s) of the action taken, but gSDE's noise lasts "
            "several steps",
            "omit it; airl.ppo.log_std_init sets how much the policy explores",
        )
    texts = tuple(str(s) for s in settings)
    _check_selection(airl, texts)
    trained = len(_trained(airl, texts))
    if airl.ppo.n_envs % trained:
        raise UsageError(
            f"airl.ppo.n_envs = {airl.ppo.n_envs}: the worlds cannot be shared equally by {trained} settings",
            f"--set airl.ppo.n_envs to a multiple of {trained}",
        )
    relevant = _relevant(airl, env, trained)
    parameters = Parameters(
        environment=environment_key(env, settings),
        settings=texts,
        seed=seed,
        airl=relevant,
        penalty_version=penalty_version(relevant.penalty),
        selection_version=_selection_version(relevant),
        shuffling_version=3 if relevant.grouping == "shuffled" else UNSET,
    )
    check_risks(relevant.penalty, relevant.grouping, trained)
    label = f"train-airl {describe(relevant)} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, {"demonstrations": demos, **(basis or {})}, label)


def _relevant(airl: AIRLConfig, env: str, trained: int) -> AIRLConfig:
    """The config as keys have it, checked against the environment and the number of settings."""
    spec = environment(env)
    if airl.symmetries is True and spec.symmetries is None:
        raise UsageError(f"airl.symmetries: {env} has no symmetries", "--set airl.symmetries=none")
    relevant = relevant_airl(airl, spec.discrete_actions, spec.terminates)
    _check_rounds(relevant)
    if trained == 1:
        # There is nothing to share, and no other setting to draw from.
        challenger = replace(relevant.challenger, per_setting=UNSET)
        relevant = replace(relevant, challenger=challenger, pairing=AIRLConfig().pairing)
    if relevant.challenger.per_setting is True:
        # Each challenger has a share of the worlds.
        share = replace(relevant.challenger.ppo, n_envs=airl.ppo.n_envs // trained)
        relevant_ppo(share, spec.discrete_actions, "airl.challenger.ppo")
    if airl.grouping == "shuffled" and airl.batch_size < 2 * trained:
        raise UsageError(
            f"airl.batch_size = {airl.batch_size} cannot hold an even number of samples of each of "
            f"{trained} settings",
            f"--set airl.batch_size={2 * trained} or more",
        )
    return relevant


def method_of(airl: AIRLConfig) -> str:
    """The method's name."""
    return method_name(msgspec.structs.asdict(airl))


def describe(airl: AIRLConfig) -> str:
    """How the reward is learned, for labels: see :func:`irlcli.labels.learned`."""
    return labels.learned(msgspec.to_builtins(airl))


def reward_label(airl: AIRLConfig, seed: int) -> str:
    """A learned reward, for the labels of what is made with it."""
    return f"{describe(airl)} seed {seed}"


def _selection_version(airl: AIRLConfig) -> int | UnsetType:
    """In keys where a round is selected by a setting, or from rounds with a penalty."""
    # 2: none is selected before lambda has its full value. 3: the student knows the setting.
    if airl.selecting_setting is not None:
        return 3
    return 2 if airl.select != "last" and airl.penalty != "none" else UNSET


def _check_selection(airl: AIRLConfig, settings: Sequence[str]) -> None:
    if airl.select not in ("last", "episodes", *settings):
        raise UsageError(
            f"airl.select = {airl.select!r} is not in the demonstrations",
            f"one of: last, episodes, {', '.join(settings)}",
        )
    if airl.select in settings and len(settings) == 1:
        raise UsageError(
            f"without {airl.select} no setting is left to train on", "select by episodes"
        )


def _check_rounds(airl: AIRLConfig) -> None:
    rounds, averaged = airl.ppo.rounds(airl.total_steps), airl.averaged_rounds or 1
    if airl.penalty != "none" and airl.penalty_warmup_rounds >= rounds:
        raise UsageError(
            f"airl.penalty_warmup_rounds = {airl.penalty_warmup_rounds} leaves no round with a "
            f"penalty: training has {rounds}",
            f"--set airl.penalty_warmup_rounds={rounds - 1}, or --set airl.total_steps="
            f"{(airl.penalty_warmup_rounds + 1) * airl.ppo.steps_per_round} or more",
        )
    if averaged > rounds:
        raise UsageError(
            f"airl.averaged_rounds = {averaged}, but training has {rounds} rounds",
            f"--set airl.averaged_rounds={rounds} or less, or --set airl.total_steps="
            f"{averaged * airl.ppo.steps_per_round} or more",
        )
    # Rounds that count towards a plateau; stopping in the last round saves nothing.
    compared = rounds - 1 - airl.penalty_warmup_rounds - airl.penalty_ramp_rounds
    if airl.plateau_rounds and 2 * airl.plateau_rounds > compared:
        largest = compared // 2
        raise UsageError(
            f"airl.plateau_rounds = {airl.plateau_rounds} needs {2 * airl.plateau_rounds} rounds "
            f"before the last, after lambda has its full value: training has {max(compared, 0)}",
            f"--set airl.plateau_rounds={largest} or less"
            if largest > 0
            else "omit airl.plateau_rounds",
        )


def _trained(airl: AIRLConfig, settings: Sequence[str]) -> tuple[str, ...]:
    """The settings that are trained on: all but one that selects."""
    return tuple(text for text in settings if text != airl.select)


def run(job: Job) -> None:
    """Alternate policy rounds and discriminator rounds, all settings together."""
    from irlcli.data.descriptions import Selected
    from irlcli.data.outputs import write_policy, write_reward, write_rows
    from irlcli.learners.scoring import SMALLEST_SCALE
    from irlcli.rl.challengers import Challengers
    from irlcli.rl.loop import Training
    from irlcli.rl.ppo import PPOTrainer
    from irlcli.rl.worlds import make_worlds

    p: Parameters = job.parameters
    env, airl = p.environment.name, p.airl
    settings = _trained(airl, p.settings)
    _warn_of_rounds(job)
    episodes, held_out = _episodes(job, settings)
    parsed = [parse_setting(env, text) for text in settings]
    with ExitStack() as stack:

        def worlds_of(chosen: Sequence[Setting], count: int) -> Worlds:
            return stack.enter_context(closing(make_worlds(env, chosen, count, job.workers)))

        worlds = worlds_of(parsed, airl.ppo.n_envs)
        trainer = PPOTrainer(
            worlds, airl.ppo, airl.total_steps, p.seed, STAGE.name, keep_moments=airl.bc_epochs > 0
        )
        learner = _learner(p, settings, episodes, held_out, worlds, trainer.rounds)
        selector = _selector(job, learner, held_out, trainer.rounds)
        challengers = None
        if airl.challenger.life > 0:
            theirs = [worlds]
            if airl.challenger.per_setting is True:
                share = airl.ppo.n_envs // len(parsed)
                theirs = [worlds_of([setting], share) for setting in parsed]
            challengers = Challengers(theirs, airl.challenger, learner, p.seed, STAGE.name)
        training = Training(
            trainer,
            source=learner,
            settings=settings,
            learner=learner,
            selector=selector,
            challengers=challengers,
            ends=_at_a_plateau(airl, len(settings)),
        )
        rows = run_training(job, training)
    if learner.scale <= SMALLEST_SCALE:
        job.console.warn("g is constant on the training data: no policy can be trained on it")
    stopped = training.rounds_done if training.rounds_done < trainer.rounds else None
    origin = {
        "env": env,
        "settings": settings,
        "method": method_of(airl),
        "seed": p.seed,
    }
    write_policy(
        job.output,
        trainer.policy,
        airl.ppo,
        agent="student",
        selected_in=airl.selecting_setting,
        **origin,
    )
    selected = None
    if selector is not None:
        selected = Selected(round=selector.best["round"], score=selector.best["score"])
    write_reward(job.output, learner, airl=airl, selected=selected, stopped_after=stopped, **origin)
    write_rows(job.output / "metrics.parquet", rows)


def _warn_of_rounds(job: Job) -> None:
    """Warn if training ends before lambda has its full value, or within a challenger's life."""
    from irlcli.learners.discriminator import penalty_weight_at

    airl: AIRLConfig = job.parameters.airl
    warmup, ramp = airl.penalty_warmup_rounds, airl.penalty_ramp_rounds
    rounds = airl.ppo.rounds(airl.total_steps)
    if airl.penalty != "none" and warmup + ramp > rounds:
        last = penalty_weight_at(rounds - 1, airl.penalty_weight, warmup, ramp)
        job.console.warn(
            f"lambda reaches {last:g} of {airl.penalty_weight:g}: warm-up and ramp take "
            f"{warmup + ramp} rounds, training has {rounds}"
        )
    life = airl.challenger.life
    if life and rounds % life:
        job.console.warn(
            f"the last challenger has {rounds % life} of {life} rounds (airl.challenger.life): "
            f"training has {rounds}"
        )


def _episodes(
    job: Job, settings: Sequence[str]
) -> tuple[list[Sequence[Trajectory]], list[Sequence[Trajectory]]]:
    """The demonstrations of each of ``settings``, and those that are held out to select by."""
    from irlcli.data.demonstrations import read_demonstrations
    from irlcli.learners.selection import hold_out

    p: Parameters = job.parameters
    demos = read_demonstrations(job.inputs["demonstrations"])
    demos.require(p.environment.name, p.settings)
    episodes: list[Sequence[Trajectory]] = [demos.trajectories[text] for text in settings]
    held_out: list[Sequence[Trajectory]] = []
    if p.airl.select == "episodes":
        try:
            parts = [hold_out(group) for group in episodes]
        except ValueError as error:
            raise UsageError(str(error), "select by a setting, or record more episodes") from None
        episodes, held_out = [kept for kept, _ in parts], [scored for _, scored in parts]
    if p.airl.fixed_horizon:
        by_setting = dict(zip(settings, episodes, strict=True))
        warn_of_failures(job, by_setting, demos.metadata.get("deterministic"))
        if p.airl.shared_absorbing:
            warn_of_shared_ends(job, by_setting)
    if p.airl.grouping == "shuffled":
        warn_of_labels(job, [len(group) for group in episodes])
    return episodes, held_out


def _learner(
    p: Parameters,
    settings: Sequence[str],
    episodes: Sequence[Sequence[Trajectory]],
    held_out: Sequence[Sequence[Trajectory]],
    worlds: Worlds,
    rounds: int,
) -> AIRL:
    """The learner of ``p``, before its first round. What is held out is checked, too."""
    from irlcli.learners import learner
    from irlcli.learners.actions import check_fit
    from irlcli.rl.worlds import action_space, observation_size
    from irlcli.trajectories import transitions

    env, airl = p.environment.name, p.airl
    size = observation_size(worlds.observation_space)
    beyond = [column for column in airl.columns or () if not -size <= column < size]
    if beyond:
        raise UsageError(
            f"airl.columns: observations in {env} {settings[0]} have {size} entries, so there is no "
            f"entry {beyond[0]}",
            f"name some of {-size} to {size - 1}",
        )
    actions, horizon = action_space(worlds.action_space), p.environment.max_episode_steps
    try:
        for group in held_out:
            check_fit(transitions(group, horizon), size, actions)
        return learner(airl.learner)(
            episodes,
            airl,
            worlds=len(worlds),
            rounds=rounds,
            horizon=horizon,
            observation_size=size,
            actions=actions,
            seed=p.seed,
            symmetries=_symmetries(p, settings, size, actions.size),
        )
    except ValueError as error:
        raise IntegrityError(f"{env}: {error}") from None


def _symmetries(
    p: Parameters, settings: Sequence[str], observation_size: int, action_size: int
) -> Symmetries | None:
    from irlcli.envs.declared_symmetries import symmetries

    if p.airl.symmetries is not True:
        return None
    env = p.environment.name
    parsed = [parse_setting(env, text) for text in settings]
    return symmetries(env, parsed, observation_size, action_size)


def _selector(
    job: Job, learner: AIRL, held_out: Sequence[Sequence[Trajectory]], rounds: int
) -> BestRound | None:
    """What decides which round is kept, by ``airl.select``; none keeps the last."""
    from irlcli.learners.discriminator import full_weight_from
    from irlcli.learners.selection import BestRound, log_likelihood
    from irlcli.rl.rollout import roll_out

    p: Parameters = job.parameters
    airl = p.airl
    if airl.select == "last":
        return None

    def likelihood(policy: Any) -> float:
        return log_likelihood(policy, learner.view, held_out)

    def true_return(policy: Any) -> float:
        # From the same first states in every round.
        where = parse_setting(p.environment.name, airl.select)
        found = roll_out(
            p.environment.name, where, policy, airl.select_episodes, p.seed, "selection"
        )
        return deciding_score(job, airl.select, found, lambda t: t.episode_return)

    score = likelihood if airl.select == "episodes" else true_return
    first = full_weight_from(airl.penalty_warmup_rounds, airl.penalty_ramp_rounds)
    return BestRound(score, learner, airl.select_every, rounds, first)


def _at_a_plateau(airl: AIRLConfig, settings: int) -> Callable[[Sequence[Mapping[str, Any]]], bool]:
    """The rule that stops before the last round, as a function of the rows so far."""
    from irlcli.learners.stopping import cross_entropies, plateaued

    rounds = airl.plateau_rounds
    if isinstance(rounds, UnsetType):
        return lambda _: False
    # The loss changes until lambda has its full value. With a penalty this is one round later than
    # full_weight_from().
    first = airl.penalty_warmup_rounds + airl.penalty_ramp_rounds

    def stop(rows: Sequence[Mapping[str, Any]]) -> bool:
        return plateaued(cross_entropies(rows[-2 * rounds * settings :], first), rounds)

    return stop


# Challengers learn with the PPO of retrained policies, and these with that of the experts.
STAGE = Stage("train-airl", 5, run, reads=("airl", "transfer.ppo", "expert.ppo"))
