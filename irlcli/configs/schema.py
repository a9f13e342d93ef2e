"""Every hyperparameter, with its type, bounds and default.

A field is part of every key it can influence; :mod:`irlcli.configs.relevance` says where one
cannot.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from irlcli.configs.exact import ControlConfig, Figure2Config, GridworldConfig, MaxEntConfig
from irlcli.configs.fields import (
    MAX_COUNT,
    Activation,
    Averaged,
    Columns,
    Count,
    Discount,
    Dropout,
    Finite,
    Fraction,
    Grouping,
    Members,
    NonNegative,
    NonNegativeCount,
    Positive,
    Quantile,
    Schedule,
    Widths,
)
from irlcli.interventions import Setting

# Torch's. See PPOConfig.adam_eps.
ADAM_EPS = 1e-8
# What a field means that is unset, where a value means the same. In keys it is left out.
UNSET_MEANS: dict[str, Any] = {
    "adam_eps": ADAM_EPS,
    "restarts": 1,
    "per_setting": False,
    "dropout": 0.0,
    "columns": (),
    "averaged_rounds": 1,
    "averaged_by": "rounds",
    "symmetries": False,
    "shared_absorbing": False,
    "penalty_warmup_iterations": 0,
}


class PPOConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """PPO (paper App. C names the values of rl-baselines3-zoo). ``linear`` falls to zero.

    ``log_std_init``, ``log_std_max``, ``use_sde`` and ``sde_sample_freq`` are for continuous actions only.

    Attributes:
        n_envs: worlds stepped together.
        n_steps: steps of each world in a rollout.
        rollouts_per_round: rollouts, each followed by an update, between two fresh starts.
        log_std_max: cap on the policy's log standard deviation. The environment clips actions,
            so noise beyond the bounds costs the policy nothing.
        use_sde: gSDE: noise is held for ``sde_sample_freq`` steps (None: for a rollout).
        adam_eps: what Adam adds to the root of a gradient's second moment. Unset: 1e-8, torch's;
            stable-baselines3 has 1e-5, which slows down weights with smaller gradients.
    """

    # Bounded, so that no file can ask for more worlds or steps than memory holds.
    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 16
    n_steps: Annotated[int, Meta(ge=1, le=65536)] = 1024
    rollouts_per_round: Count = 1
    batch_size: Annotated[int, Meta(ge=2, le=MAX_COUNT)] = 512
    n_epochs: Count = 4
    learning_rate: Positive = 1e-3
    learning_rate_schedule: Schedule = "constant"
    clip_range: Positive = 0.2
    clip_range_schedule: Schedule = "constant"
    gamma: Discount = 0.999
    gae_lambda: Fraction = 0.98
    ent_coef: NonNegative = 0.01
    ent_coef_schedule: Schedule = "constant"
    vf_coef: NonNegative = 0.5
    max_grad_norm: Positive = 0.5
    net_arch: Widths = (64, 64)
    activation: Activation = "tanh"
    ortho_init: bool = True
    normalise_observations: bool = False
    normalise_rewards: bool = False
    log_std_init: Finite = 0.0
    log_std_max: Finite | None = None
    use_sde: bool = False
    sde_sample_freq: Count | None = None
    adam_eps: Positive | UnsetType = UNSET

    @property
    def steps_per_round(self) -> int:
        """Of all worlds together."""
        return self.rollouts_per_round * self.n_steps * self.n_envs

    def rounds(self, total_steps: int) -> int:
        """Rounds that make up at least ``total_steps``."""
        return -(-total_steps // self.steps_per_round)


class ExpertConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A policy trained on the true reward. ``bar`` is the mean true return that it must reach."""

    total_steps: Count = 1_000_000
    bar: Finite | None = None
    ppo: PPOConfig = PPOConfig()


class SACConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SAC (Haarnoja et al. 2018), for continuous actions only.

    Attributes:
        n_envs: worlds stepped together.
        n_steps: steps of each world in a round. Every round starts new episodes.
        train_freq: steps of each world between two updates, of ``gradient_steps`` minibatches each.
        learning_starts: uniformly random steps, counted over all worlds.
        buffer_size: transitions kept for replay.
        tau: weight of the new parameters in the target network.
        ent_coef: temperature of the entropy bonus; None: learned.
        normalise_rewards: by the running deviation of their discounted sums, when sampled.
    """

    n_envs: Annotated[int, Meta(ge=1, le=1024)] = 16
    n_steps: Annotated[int, Meta(ge=1, le=65536)] = 1024
    train_freq: Count = 4
    gradient_steps: Count = 16
    learning_starts: NonNegativeCount = 10_000
    # Bounded, so that no file can ask for more than memory holds.
    buffer_size: Annotated[int, Meta(ge=1, le=4_000_000)] = 300_000
    batch_size: Annotated[int, Meta(ge=2, le=65536)] = 256
    learning_rate: Positive = 3e-4
    gamma: Discount = 0.99
    tau: Annotated[float, Meta(gt=0, le=1)] = 0.005
    ent_coef: NonNegative | None = None
    net_arch: Widths = (256, 256)
    activation: Activation = "relu"
    normalise_observations: bool = True
    normalise_rewards: bool = True

    @property
    def steps_per_round(self) -> int:
        """Of all worlds together."""
        return self.n_steps * self.n_envs

    def rounds(self, total_steps: int) -> int:
        """Rounds that make up at least ``total_steps``."""
        return -(-total_steps // self.steps_per_round)


class FromStudentConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Retraining that begins as the reward's student: few steps, a rate that falls to zero."""

    total_steps: Count = 250_000
    learning_rate: Positive = 1e-4


class TransferConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A new policy on a frozen reward (paper Sec. 5.3).

    Attributes:
        algorithm: a key of :data:`irlcli.rl.ALGORITHMS`.
        ceiling: every step's reward is at most this quantile of g on the demonstrations; None: g
            has no bound. A step that ends the episode also earns the series of its absorbing state
            (``airl.fixed_horizon``), each term bounded.
        from_student: replaces the budget and the learning rate with ``--start student``.
        restarts: policies trained one after the other, each from other random weights. The one with
            the highest learned return is kept. ``--start student`` ignores it.
        restart_steps: environment steps of each restart. Only the one that is kept is then trained
            to the whole budget. Unset: each restart has the whole budget.
        restart_episodes: over which the learned return of a restart is measured; 100 by default.
    """

    algorithm: str = "ppo"
    total_steps: Count = 1_000_000
    ceiling: Quantile | None = None
    ppo: PPOConfig = PPOConfig()
    sac: SACConfig = SACConfig()
    from_student: FromStudentConfig = FromStudentConfig()
    restarts: Count | UnsetType = UNSET
    restart_steps: Count | UnsetType = UNSET
    restart_episodes: Count | UnsetType = UNSET

    @property
    def algorithm_config(self) -> PPOConfig | SACConfig:
        """The config of ``algorithm``; all but SAC take PPO's."""
        return self.sac if self.algorithm == "sac" else self.ppo


class DemonstrationConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Episodes per setting, sampled from the stochastic expert unless ``deterministic``.

    ``full_length``: only episodes that last until the time limit; more are recorded instead of the
    others. For tasks in which an episode that ends early has failed.
    """

    episodes: Count = 10
    deterministic: bool = False
    full_length: bool = False


class ChallengerConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Policies trained from random weights on the current reward, as later on the frozen one.

    A challenger is trained on the current g, in the settings trained on. Its episodes are
    negatives, so the reward corrects the states that a new policy goes through. This g is not yet
    divided by its deviation, as the frozen one is, so ``ppo.normalise_rewards`` should be true.

    Attributes:
        life: rounds after which the next challenger starts from random weights; 0 for none. The last
            one is cut short unless ``life`` divides the number of rounds.
        share: weight of the cross-entropy between challengers and experts in the loss.
        ceiling: quantile of g on the demonstrations that bounds a challenger's reward.
        replay_episodes_per_round, replay_capacity: episodes of each setting that a round adds, and the
            most that are kept; all past rounds are equally likely.
        per_setting: each setting has a challenger of its own, as a retrained policy acts in one
            setting only, in its share of the worlds. Otherwise one acts in all. Unset is false.
        ppo: as that of the retrained policies where a settings file is silent; with as many worlds
            as the student.
    """

    life: NonNegativeCount = 0
    share: Fraction = 0.5
    ceiling: Quantile = 0.9
    replay_episodes_per_round: Count = 2
    replay_capacity: Count = 200
    per_setting: bool | UnsetType = UNSET
    ppo: PPOConfig = PPOConfig()


class AIRLConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Adversarial IRL (paper Sec. 4.3, Algorithm 1, App. C).

    Unset fields are in no key, so that rewards made before they existed keep their keys;
    :data:`UNSET_MEANS` has what they mean.

    Attributes:
        learner: a key of :data:`irlcli.learners.LEARNERS`.
        grouping: which demonstrations share a risk. ``pooled``: all, by count of episodes. ``balanced``: all,
            settings weighted equally. ``per-setting``: a risk for each setting. ``shuffled``: as
            many risks, over episodes dealt out at random (the control).
        penalty: of the risks; see :mod:`irlcli.penalties`. ``penalty_weight`` is lambda, zero for
            the warm-up rounds and then raised linearly over the ramp rounds.
        penalty_scaling: w multiplies the whole ``logit``, or only f (``reward``).
        penalty_estimate: ``unbiased`` (product of what two half-batches give) or ``square``.
        logit: what the discriminator is the sigmoid of: ``f-log-pi`` (paper Eq. 2), or ``f``.
        shaping: f has the shaping term gamma h(s') - h(s); otherwise f is g.
        learning_rate_schedule: of the discriminator. ``linear`` falls to zero over the rounds, so
            that the last challengers meet a reward that hardly changes any more.
        gradient_penalty: weight of the mean squared gradient of g by its input, between the
            policy's samples and the expert's. It keeps g from saturating.
        weight_decay: decoupled (AdamW), so that its strength does not depend on lambda.
        batch_size: demonstrated samples of the discriminator's minibatch, per setting. The policy has as
            many samples.
        replay_share: share of the discriminator's policy samples that come from past rounds;
            each round adds ``replay_episodes_per_round`` episodes a setting, of which
            ``replay_capacity`` are kept.
        pairing: the policy's samples of a risk come from the same setting (``matched``) or from
            all (``pooled``). Without effect where ``grouping`` is ``pooled``: there each setting has
            its demonstrations' share of the policy's samples.
        policy_reward: ``f-log-pi`` (Algorithm 1), ``f`` or ``g``.
        fixed_horizon: an episode that ends early continues in an absorbing state.
        actions: what g and log pi see: the policy's samples (``sampled``), or what the environment
            clips them to (``executed``).
        bc_epochs: epochs of behavioural cloning before the first round.
        dropout: probability that a hidden unit of the discriminator is omitted in an update.
        columns: the entries of the observation that the reward sees, as indices; negative ones count
            from the end. The policy sees all. Empty is all.
        averaged_rounds: the reward that leaves training is the mean of g after so many rounds,
            spaced as ``averaged_by`` says, up to the last. Each represents the rounds since the one
            before; early ones may lie in the penalty's warm-up. 1 is the last g alone.
        averaged_by: the space between these rounds: the same number of ``rounds``, or the same sum of
            the discriminator's ``learning-rate``, so that early rounds count more when it falls.
        plateau_rounds: training ends before ``total_steps`` when the discriminator's cross-entropy is
            near chance and has not risen for so many rounds, those of the penalty's warm-up and ramp
            not counted (:mod:`irlcli.learners.stopping`). Unset: training takes all steps.
        symmetries: the discriminator sees images of its samples under the environment's symmetries, see
            :mod:`irlcli.learners.images`.
        shared_absorbing: every episode that ends early continues in the same absorbing state, which
            the reward knows by an input of its own (Kostrikov et al. 2019). Otherwise in one that keeps
            the final observation, so that the reward can tell a landing from a crash. Needs
            ``shaping = false``.
        select: the round that is kept: ``last``, the best on held-out ``episodes``, or the best in
            one setting (``leg-length=1x``), which is left out of training. Scored every
            ``select_every`` rounds, a setting over ``select_episodes``.
    """

    learner: str = "airl"
    grouping: Grouping = "pooled"
    penalty: str = "none"
    penalty_weight: NonNegative = 10.0
    penalty_warmup_rounds: NonNegativeCount = 10
    penalty_ramp_rounds: NonNegativeCount = 10
    penalty_scaling: Literal["logit", "reward"] = "logit"
    penalty_estimate: Literal["unbiased", "square"] = "unbiased"
    total_steps: Count = 1_000_000
    state_only: bool = False
    hidden: Widths = (32, 32)
    activation: Activation = "tanh"
    logit: Literal["f-log-pi", "f"] = "f-log-pi"
    shaping: bool = True
    learning_rate: Positive = 3e-4
    learning_rate_schedule: Schedule = "constant"
    gradient_penalty: NonNegative = 0.0
    weight_decay: NonNegative = 1e-4
    max_grad_norm: Positive = 1.0
    updates_per_round: Count = 10
    batch_size: Annotated[int, Meta(ge=2, le=MAX_COUNT, multiple_of=2)] = 256
    replay_share: Fraction = 0.5
    replay_episodes_per_round: Count = 2
    replay_capacity: Count = 100
    pairing: Literal["matched", "pooled"] = "matched"
    policy_reward: Literal["f-log-pi", "f", "g"] = "f-log-pi"
    fixed_horizon: bool = True
    actions: Literal["sampled", "executed"] = "sampled"
    bc_epochs: NonNegativeCount = 0
    select: str = "last"
    select_every: Count = 10
    select_episodes: Count = 10
    challenger: ChallengerConfig = ChallengerConfig()

    ppo: PPOConfig = PPOConfig()
    dropout: Dropout | UnsetType = UNSET
    columns: Columns | UnsetType = UNSET
    averaged_rounds: Members | UnsetType = UNSET
    averaged_by: Averaged | UnsetType = UNSET
    plateau_rounds: Count | UnsetType = UNSET
    symmetries: bool | UnsetType = UNSET
    shared_absorbing: bool | UnsetType = UNSET

    @property
    def selecting_setting(self) -> str | None:
        """The setting in which the round that is kept earns most, if one selects."""
        return None if self.select in ("last", "episodes") else self.select


class InterventionConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Paper Table 2: the values trained on (``id``) and the held-out ones (``ood``).

    Attributes:
        episodes: demonstrations of each value trained on, or one count for all, in place of
            ``demonstrations.episodes``.
        expert, airl, transfer: in a file, this knob's overrides of ``[expert]``, ``[airl]`` and
            ``[transfer]``; once loaded, the whole configs. Challengers follow ``transfer``.
    """

    id: tuple[str, ...]
    ood: tuple[str, ...]
    episodes: tuple[Count, ...] = ()
    expert: ExpertConfig | None = None
    airl: AIRLConfig | None = None
    transfer: TransferConfig | None = None


class EvaluationConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Return of a policy over whole episodes."""

    episodes: Count = 20
    deterministic: bool = False


class CloneConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A behavioural clone of the demonstrations. Its network and actions are those of ``airl``."""

    epochs: Count = 30


class AssessmentConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How ``irl assess`` measures a reward.

    Attributes:
        noise: probabilities with which the clone takes a random action instead of its own.
    """

    noise: tuple[Fraction, ...] = (0.0, 0.1, 0.25, 0.5, 0.75)


class Config(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be configured for one environment."""

    interventions: dict[str, InterventionConfig] = {}
    expert: ExpertConfig = ExpertConfig()
    demonstrations: DemonstrationConfig = DemonstrationConfig()
    airl: AIRLConfig = AIRLConfig()
    transfer: TransferConfig = TransferConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    clone: CloneConfig = CloneConfig()
    assessment: AssessmentConfig = AssessmentConfig()
    gridworld: GridworldConfig = GridworldConfig()
    maxent: MaxEntConfig = MaxEntConfig()
    figure2: Figure2Config = Figure2Config()
    control: ControlConfig = ControlConfig()

    def expert_of(self, setting: Setting) -> ExpertConfig:
        """The config of the expert of ``setting``, with a knob's own, see :meth:`_of`."""
        return self._of("expert", setting)

    def airl_of(self, settings: Sequence[Setting]) -> AIRLConfig:
        """The config of a reward learned in ``settings``, with a knob's own, see :meth:`_of`."""
        return self._of("airl", *settings)

    def transfer_of(self, setting: Setting) -> TransferConfig:
        """The config of a policy retrained in ``setting``, with a knob's own, see :meth:`_of`."""
        return self._of("transfer", setting)

    def knobs_with(self, section: str, settings: Sequence[Setting]) -> list[str]:
        """The knobs in ``settings`` that have a ``section`` of their own."""
        knobs = {knob for setting in settings for knob in setting.knobs} & set(self.interventions)
        return sorted(k for k in knobs if getattr(self.interventions[k], section) is not None)

    def _of(self, section: str, *settings: Setting) -> Any:
        """The ``section`` of the one knob in ``settings`` that has its own; none counts beside another."""
        knobs = self.knobs_with(section, settings)
        where = self.interventions[knobs[0]] if len(knobs) == 1 else self
        return getattr(where, section)
