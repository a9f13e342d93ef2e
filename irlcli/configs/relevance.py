"""Which hyperparameters can matter: the others are set to their defaults before a key is made.

Each function returns an equal config in which every field that cannot influence the result has
one canonical value, so that requests for the same computation have the same key.
"""

from collections.abc import Iterable

from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from irlcli.configs.exact import MaxEntConfig
from irlcli.configs.schema import ADAM_EPS, AIRLConfig, Config, PPOConfig, SACConfig, TransferConfig
from irlcli.errors import UsageError, suggest
from irlcli.learners import LEARNERS
from irlcli.penalties import PENALTIES, READABLE, check_penalty
from irlcli.rl import ALGORITHMS

_PPO = PPOConfig()
_AIRL = AIRLConfig()
_MAXENT = MaxEntConfig()
# Not the field's default, which would be in the key of every retrained policy.
_RESTART_EPISODES = 100
_TRANSFER = TransferConfig()
# What a policy that begins as the student takes from it.
_OF_THE_STUDENT = (
    *("net_arch", "activation", "ortho_init", "normalise_observations"),
    *("log_std_init", "use_sde", "sde_sample_freq"),
)


def check_registered(config: Config) -> None:
    """Refuse names that are in no registry.

    Raises:
        UsageError: an unknown learner, algorithm or penalty; the message names the field.
    """
    _check_sections("", config.airl, config.transfer)
    _check_penalty("maxent", config.maxent.penalty, "maxent")
    for knob, listed in config.interventions.items():
        _check_sections(f"interventions.{knob}.", listed.airl, listed.transfer)


def _check_sections(prefix: str, airl: AIRLConfig | None, transfer: TransferConfig | None) -> None:
    if airl is not None:
        _check_known(f"{prefix}airl.learner", airl.learner, LEARNERS)
        _check_penalty(f"{prefix}airl", airl.penalty, "airl")
    if transfer is not None:
        _check_known(f"{prefix}transfer.algorithm", transfer.algorithm, ALGORITHMS)


def _check_penalty(section: str, penalty: str, learner: str) -> None:
    try:
        check_penalty(penalty, learner)
    except UsageError as error:
        raise UsageError(f"{section}.penalty: {error.message}", error.hint) from None


def relevant_ppo(ppo: PPOConfig, discrete_actions: bool, section: str) -> PPOConfig:
    """``ppo`` for an environment with discrete actions, or with continuous ones.

    Raises:
        UsageError: an option for continuous actions where they are discrete, a cap that gSDE
            ignores, or rollouts of a single sample; the message names ``section``, for example
            ``expert.ppo``.
    """
    if discrete_actions:
        for name in ("use_sde", "sde_sample_freq", "log_std_init", "log_std_max"):
            if getattr(ppo, name) != getattr(_PPO, name):
                raise UsageError(
                    f"{section}.{name} needs continuous actions", f"omit {section}.{name}"
                )
    if ppo.n_envs * ppo.n_steps < 2:
        raise UsageError(
            f"{section}: one world and one step make a rollout of a single sample",
            f"--set {section}.n_steps=2 or more",
        )
    if not ppo.use_sde:
        ppo = replace(ppo, sde_sample_freq=None)
    elif ppo.log_std_max is not None:
        raise UsageError(
            f"{section}.log_std_max does not bound the noise of gSDE",
            f"set {section}.log_std_max to none, or {section}.use_sde to false",
        )
    if ppo.adam_eps == ADAM_EPS:
        ppo = replace(ppo, adam_eps=UNSET)
    if ppo.ent_coef == 0.0:
        ppo = replace(ppo, ent_coef_schedule=_PPO.ent_coef_schedule)
    if not ppo.net_arch:
        ppo = replace(ppo, activation=_PPO.activation)
    # A minibatch is at most the whole rollout.
    return replace(ppo, batch_size=min(ppo.batch_size, ppo.n_envs * ppo.n_steps))


def check_actions(actions: str, discrete_actions: bool) -> None:
    """Refuse an ``airl.actions`` that discrete actions, which have no bounds, do not have.

    Raises:
        UsageError: it needs continuous actions.
    """
    if discrete_actions and actions != _AIRL.actions:
        raise UsageError(f"airl.actions = {actions} needs continuous actions", "omit airl.actions")


def relevant_airl(airl: AIRLConfig, discrete_actions: bool, terminates: bool = True) -> AIRLConfig:
    """``airl`` with every field reset that its method, replay, selection and actions do not use.

    Args:
        airl: as configured.
        discrete_actions: of the environment.
        terminates: whether an episode of the environment may end before the time limit.

    Raises:
        UsageError: an unknown learner or penalty, options that contradict each other or do not fit the
            actions; or as :func:`relevant_ppo`.
    """
    _check_known("airl.learner", airl.learner, LEARNERS)
    check_penalty(airl.penalty, "airl")
    airl = replace(airl, **LEARNERS[airl.learner].fixes)
    check_actions(airl.actions, discrete_actions)
    if not terminates:
        airl = replace(airl, fixed_horizon=_AIRL.fixed_horizon)
    airl = _penalty(airl)
    airl = _network(airl)
    airl = _kept_rounds(airl)
    if airl.grouping == "pooled":
        airl = replace(airl, pairing=_AIRL.pairing)
    if airl.logit == "f":
        # w multiplies f, with either scaling.
        airl = replace(airl, penalty_scaling=_AIRL.penalty_scaling)
    if not airl.shaping and airl.policy_reward == "g":
        airl = replace(airl, policy_reward="f")
    airl = _symmetric(airl)
    airl = _absorbing(airl, terminates)
    airl = _challenger(airl, discrete_actions)
    airl = _replay(airl)
    ppo = relevant_ppo(airl.ppo, discrete_actions, "airl.ppo")
    check_rate(ppo, airl.total_steps, "airl.total_steps", "airl.ppo")
    return replace(airl, ppo=ppo)


def _penalty(airl: AIRLConfig) -> AIRLConfig:
    if airl.penalty == "none" or airl.penalty_weight == 0.0:
        airl = replace(
            airl,
            penalty="none",
            penalty_weight=0.0,
            penalty_warmup_rounds=0,
            penalty_ramp_rounds=0,
            penalty_scaling=_AIRL.penalty_scaling,
            penalty_estimate=_AIRL.penalty_estimate,
        )
        if airl.grouping == "per-setting":
            # Without a penalty the mean of the settings' risks is all there is.
            airl = replace(airl, grouping="balanced")
    else:
        # A ramp of no rounds is one of a single round.
        airl = replace(airl, penalty_ramp_rounds=max(1, airl.penalty_ramp_rounds))
        unread = {*READABLE} - {*PENALTIES[airl.penalty].reads}
        airl = replace(airl, **{name: getattr(_AIRL, name) for name in unread})
    return airl


def _network(airl: AIRLConfig) -> AIRLConfig:
    if not airl.hidden:
        airl = replace(airl, activation=_AIRL.activation, dropout=UNSET)
    if not airl.dropout:
        airl = replace(airl, dropout=UNSET)
    if not airl.columns:
        airl = replace(airl, columns=UNSET)
    return airl


def _kept_rounds(airl: AIRLConfig) -> AIRLConfig:
    """Refuse two rules for the rounds that are kept; reset what the rule in use does not read."""
    if airl.averaged_by == "rounds" or airl.learning_rate_schedule == "constant":
        airl = replace(airl, averaged_by=UNSET)
    if airl.averaged_rounds in (UNSET, 1):
        airl = replace(airl, averaged_rounds=UNSET, averaged_by=UNSET)
    elif airl.select != "last":
        raise UsageError(
            f"airl.averaged_rounds = {airl.averaged_rounds} cannot be combined with airl.select = "
            f"{airl.select}: a mean of rounds has no best round",
            "--set airl.select=last, or --set airl.averaged_rounds=1",
        )
    if airl.plateau_rounds is not UNSET:
        for name, value, other in (
            ("select", airl.select, "last"),
            ("averaged_rounds", airl.averaged_rounds, UNSET),
        ):
            if value != other:
                raise UsageError(
                    f"airl.plateau_rounds = {airl.plateau_rounds} cannot be combined with airl.{name} "
                    f"= {value}: that takes the whole budget",
                    f"omit airl.plateau_rounds or airl.{name}",
                )
    if airl.select == "last":
        airl = replace(airl, select_every=_AIRL.select_every)
    if airl.select in ("last", "episodes"):
        airl = replace(airl, select_episodes=_AIRL.select_episodes)
    return airl


def _symmetric(airl: AIRLConfig) -> AIRLConfig:
    if not airl.symmetries:
        return replace(airl, symmetries=UNSET)
    if airl.logit != "f":
        raise UsageError(
            "airl.symmetries needs airl.logit = f: log pi of an image is not log pi of the sample",
            "--set airl.logit=f, or --set airl.symmetries=none",
        )
    return airl


def _absorbing(airl: AIRLConfig, terminates: bool) -> AIRLConfig:
    if not airl.shared_absorbing or not airl.fixed_horizon or not terminates:
        return replace(airl, shared_absorbing=UNSET)
    if airl.shaping:
        raise UsageError(
            "airl.shared_absorbing needs airl.shaping = false: the potential of an absorbing state "
            "that all share is not defined",
            "--set airl.shaping=false, or omit airl.shared_absorbing",
        )
    return airl


def _challenger(airl: AIRLConfig, discrete_actions: bool) -> AIRLConfig:
    if airl.challenger.life == 0:
        return replace(airl, challenger=_AIRL.challenger)
    if airl.logit != "f":
        raise UsageError(
            f"airl.challenger.life = {airl.challenger.life} needs logits without log pi: log "
            "pi of past challengers is not available",
            "--set airl.logit=f, and --set airl.policy_reward to f or g",
        )
    # Before what follows from the number of worlds: a minibatch is at most a rollout.
    ppo = replace(airl.challenger.ppo, n_envs=airl.ppo.n_envs)
    ppo = relevant_ppo(ppo, discrete_actions, "airl.challenger.ppo")
    if (
        ppo.learning_rate_schedule == "linear"
        and airl.challenger.life * ppo.rollouts_per_round == 1
    ):
        raise UsageError(
            "airl.challenger.life = 1 leaves no update: a learning rate that falls to zero needs more "
            "than one rollout",
            "--set airl.challenger.life=2 or more",
        )
    challenger = replace(airl.challenger, ppo=ppo, per_setting=airl.challenger.per_setting or UNSET)
    return replace(airl, challenger=challenger)


def _replay(airl: AIRLConfig) -> AIRLConfig:
    if airl.replay_share > 0.0:
        return airl
    return replace(
        airl,
        replay_episodes_per_round=_AIRL.replay_episodes_per_round,
        replay_capacity=_AIRL.replay_capacity,
        challenger=replace(
            airl.challenger,
            replay_episodes_per_round=_AIRL.challenger.replay_episodes_per_round,
            replay_capacity=_AIRL.challenger.replay_capacity,
        ),
    )


def relevant_transfer(
    transfer: TransferConfig, discrete_actions: bool, from_student: bool
) -> TransferConfig:
    """``transfer`` with every field reset that its algorithm and its start do not use.

    A policy that begins as the student has its network and its actions' deviation, takes the
    budget and the learning rate of ``transfer.from_student``, and has no restarts.

    Raises:
        UsageError: an unknown algorithm, or one or an option that does not fit the actions or the
            start, restarts longer than the budget, or a budget that leaves no update.
    """
    _check_known("transfer.algorithm", transfer.algorithm, ALGORITHMS)
    if from_student or transfer.restarts in (UNSET, 1):
        transfer = replace(transfer, restarts=UNSET, restart_steps=UNSET, restart_episodes=UNSET)
    else:
        if transfer.restart_episodes is UNSET:
            transfer = replace(transfer, restart_episodes=_RESTART_EPISODES)
        if transfer.restart_steps is not UNSET and transfer.restart_steps >= transfer.total_steps:
            raise UsageError(
                f"transfer.restart_steps = {transfer.restart_steps} is not below "
                f"transfer.total_steps = {transfer.total_steps}",
                "omit transfer.restart_steps: each restart then has the whole budget",
            )
    if transfer.algorithm == "sac":
        if discrete_actions:
            raise UsageError("SAC needs continuous actions", "use --algorithm ppo")
        if from_student:
            raise UsageError(
                "--start student needs PPO: SAC cannot load a student's network",
                "use --algorithm ppo",
            )
        sac = transfer.sac
        _check_updated(sac, transfer.total_steps, "transfer.total_steps")
        if transfer.restart_steps is not UNSET:
            _check_updated(sac, transfer.restart_steps, "transfer.restart_steps")
        if not sac.net_arch:
            sac = replace(sac, activation=_TRANSFER.sac.activation)
        return replace(transfer, ppo=_PPO, sac=sac, from_student=_TRANSFER.from_student)
    if from_student:
        transfer = replace(
            transfer,
            total_steps=transfer.from_student.total_steps,
            ppo=replace(
                transfer.ppo,
                learning_rate=transfer.from_student.learning_rate,
                learning_rate_schedule="linear",
                **{name: getattr(_PPO, name) for name in _OF_THE_STUDENT},
            ),
        )
    ppo = relevant_ppo(transfer.ppo, discrete_actions, "transfer.ppo")
    start = ".from_student" if from_student else ""
    check_rate(ppo, transfer.total_steps, f"transfer{start}.total_steps", "transfer.ppo")
    return replace(transfer, ppo=ppo, sac=_TRANSFER.sac, from_student=_TRANSFER.from_student)


def _check_updated(sac: SACConfig, budget: int, name: str) -> None:
    steps = sac.rounds(budget) * sac.steps_per_round
    if sac.learning_starts >= steps:
        raise UsageError(
            f"transfer.sac.learning_starts = {sac.learning_starts} leaves no update in {name}, which "
            f"is {steps} steps",
            f"--set transfer.sac.learning_starts={steps - 1} or less, or more {name}",
        )


def check_rate(ppo: PPOConfig, total_steps: int, budget: str, section: str) -> None:
    """Refuse a single rollout at a linear rate: after it, the rate is zero and nothing is learned.

    Args:
        ppo: how the policy learns.
        total_steps: for how many steps.
        budget, section: the fields that hold the two.

    Raises:
        UsageError: ``total_steps`` are at most one rollout.
    """
    rollout = ppo.n_envs * ppo.n_steps
    if ppo.learning_rate_schedule == "linear" and total_steps <= rollout:
        raise UsageError(
            f"{budget} = {total_steps} leaves no update: a learning rate that falls to zero needs more "
            f"than one rollout, here of {rollout} steps",
            f"--set {budget}={2 * rollout} or more, or fewer {section}.n_steps",
        )


def relevant_maxent(maxent: MaxEntConfig) -> MaxEntConfig:
    """``maxent`` with every field reset that its penalty and its features do not use.

    Raises:
        UsageError: a penalty that MaxEnt IRL does not have, or a warm-up that leaves it no iteration.
    """
    check_penalty(maxent.penalty, "maxent")
    if maxent.penalty == "none" or maxent.penalty_weight == 0.0:
        maxent = replace(maxent, penalty="none", penalty_weight=0.0)
        if maxent.grouping in ("per-setting", "shuffled"):
            # Both weigh settings equally, and only a penalty looks at the groups.
            maxent = replace(maxent, grouping="balanced")
    maxent = replace(maxent, penalty_warmup_iterations=_warmup(maxent))
    if maxent.features == "linear":
        maxent = replace(maxent, hidden=_MAXENT.hidden)
    return maxent


def _warmup(maxent: MaxEntConfig) -> int | UnsetType:
    warmup = maxent.penalty_warmup_iterations
    if maxent.penalty == "none" or not warmup:
        return UNSET
    if warmup >= maxent.iterations:
        raise UsageError(
            f"maxent.penalty_warmup_iterations = {warmup} leaves none of {maxent.iterations} "
            "iterations with a penalty",
            "set maxent.penalty_warmup_iterations below maxent.iterations",
        )
    return warmup


def _check_known(field: str, value: str, known: Iterable[str]) -> None:
    if value not in known:
        raise UsageError(f"unknown {field} {value!r}", suggest(value, known))
