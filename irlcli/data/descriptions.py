"""Descriptions that files carry: of rewards, policies, datasets, evaluations and summaries.

A file may come from anywhere, so each description is validated here before a field of it is used.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from irlcli.configs.exact import GridworldConfig, MaxEntConfig
from irlcli.configs.fields import (
    Activation,
    Columns,
    Discount,
    Finite,
    Members,
    Positive,
    Quantile,
    Widths,
)
from irlcli.configs.schema import AIRLConfig
from irlcli.envs.registry import environment
from irlcli.errors import IntegrityError, UsageError, first_line
from irlcli.interventions import parse_setting
from irlcli.labels import weight_text

# In a dataset: reading demonstrations validates each episode by itself.
MOST_EPISODES = 100_000
Size = Annotated[int, Meta(ge=1, le=4096)]
Settings = Annotated[tuple[str, ...], Meta(min_length=1)]
# Of a method or an algorithm.
Name = Annotated[str, Meta(max_length=100)]
# In the order of reports.
Agent = Literal["expert", "student", "transfer", "clone", "random", "idle"]


Quantiles = Annotated[tuple[Finite, ...], Meta(min_length=101, max_length=101)]


class RewardNetwork(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True
):
    """Arguments of :func:`irlcli.learners.reward_model.build`."""

    observation_size: Size
    action_size: Size
    discrete: bool
    state_only: bool
    hidden: Widths
    activation: Activation
    gamma: Discount
    shaping: bool
    columns: Columns = ()
    choices: Annotated[tuple[Size, ...], Meta(max_length=4096)] = ()
    members: Members = 1
    shared_absorbing: bool = False


class Selected(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The deployed round and its score: a mean log-likelihood, or a mean true return."""

    round: Annotated[int, Meta(ge=0)]
    score: Finite


class RewardOrigin(Struct, frozen=True, kw_only=True):
    """How a reward was learned, in the documents of what was measured by it."""

    method: Name
    seed: int
    settings: tuple[str, ...]


class Reward(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """``reward.json``, and the description inside ``reward.pt``.

    ``scale`` is the standard deviation of g on the training data. ``quantiles`` are the 0, 1, ...
    100 % quantiles of g on the demonstrations. ``selected`` is None if the last round is deployed.
    ``stopped_after`` are the rounds before ``airl.plateau_rounds`` ended the training; None if the
    budget was used.
    """

    env: str
    settings: Settings
    method: Name
    seed: int
    airl: AIRLConfig
    network: RewardNetwork
    scale: Positive
    quantiles: Quantiles
    selected: Selected | None = None
    stopped_after: Annotated[int, Meta(ge=1)] | None = None

    @property
    def origin(self) -> RewardOrigin:
        """How it was learned."""
        return RewardOrigin(method=self.method, seed=self.seed, settings=self.settings)

    @property
    def selected_in(self) -> str | None:
        """The setting whose true return chose the round, if one did."""
        return self.airl.selecting_setting


class TabularReward(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``reward.json`` of train-maxent, and the description inside its ``reward.pt``."""

    env: str
    settings: Settings
    method: Name
    seed: int
    gridworld: GridworldConfig
    maxent: MaxEntConfig


class PolicyNetwork(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True
):
    """The network that :func:`irlcli.rl.policy.load_policy` rebuilds.

    PPO's actor-critic, or, if ``squashed``, SAC's actor.
    """

    net_arch: Widths
    activation: Activation
    normalise_observations: bool
    use_sde: bool
    squashed: bool = False


class Policy(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """``policy.json``, and the description inside ``policy.pt``.

    ``settings`` are those the policy was trained in. A retrained policy also names the reward it
    was trained on (``method``, ``reward_seed``, ``reward_settings``) and how it was trained:
    by which algorithm, under which ceiling, whether it began as that reward's student, and, with
    ``transfer.restarts``, what each restart earned of the learned reward. ``selected_in`` is the
    setting whose true return chose a student's round.
    """

    agent: Agent
    env: str
    settings: Settings
    seed: int
    network: PolicyNetwork
    method: Name | None = None
    reward_seed: int | None = None
    reward_settings: tuple[str, ...] | None = None
    algorithm: Name = "ppo"
    ceiling: Quantile | None = None
    from_student: bool = False
    restarts: tuple[Finite, ...] = ()
    selected_in: str | None = None


class EnvironmentName(Struct, frozen=True, kw_only=True):
    """The part of a stage's ``environment`` that planning needs."""

    name: str


class Dataset(Struct, frozen=True, kw_only=True):
    """What planning needs to know about demonstrations."""

    environment: EnvironmentName
    settings: Settings

    @property
    def env(self) -> str:
        """Name of its environment."""
        return self.environment.name


class Subject(Struct, frozen=True, kw_only=True):
    """The evaluated policy; ``settings`` are those it was trained in."""

    agent: Agent
    env: str
    settings: tuple[str, ...] = ()
    method: Name | None = None
    seed: int | None = None
    reward_seed: int | None = None
    algorithm: Name = "ppo"
    ceiling: Quantile | None = None
    from_student: bool = False
    restarts: tuple[Finite, ...] = ()
    selected_in: str | None = None

    @property
    def learning_seed(self) -> int | None:
        """The seed that comparisons use: of the reward learning, or of a policy without a reward."""
        return self.seed if self.reward_seed is None else self.reward_seed


class Returns(Struct, frozen=True, kw_only=True):
    """Mean returns in one setting; the learned return is the mean of g / scale per episode.

    An error stopped ``stopped`` of the ``episodes``. The means leave these out, unless they are all.
    """

    setting: str
    episodes: Annotated[int, Meta(ge=1)]
    stopped: Annotated[int, Meta(ge=0)]
    mean_return: Finite
    std_return: Finite | None = None
    mean_progress: Finite | None = None
    mean_learned_return: Finite | None = None
    mean_length: Finite | None = None
    terminated: Finite | None = None


class Evaluation(Struct, frozen=True, kw_only=True):
    """``summary.json`` of an evaluation; ``reward`` is None if only true returns were measured."""

    policy: Subject
    reward: RewardOrigin | None = None
    settings: Annotated[tuple[Returns, ...], Meta(min_length=1)]


Verdict = Literal["matches the expert", "wrong reward", "optimisation fell short"]


class Measured(Struct, frozen=True, kw_only=True):
    """A mean over episodes and its standard error, None for a single episode."""

    mean: Finite
    error: Finite | None


class Interval(Struct, frozen=True, kw_only=True):
    """A number and its 95 % bootstrap interval; None with too few samples."""

    value: Finite
    low: Finite | None = None
    high: Finite | None = None


class Agreement(Struct, frozen=True, kw_only=True):
    """Correlations of learned with true return over ``policies``; None where undefined."""

    policies: int
    spearman: Interval | None
    pearson: Interval | None


class RegretSplit(Struct, frozen=True, kw_only=True):
    """Why a retrained policy earns less than the setting's expert.

    Attributes:
        true_regret: true return of the expert minus the policy's.
        learned_gap: learned return of the expert minus the policy's, both under ``ceiling``.
        discounted_gap: the same of discounted returns, which the policy's training maximises.
        ceiling: of the rewards that the policy was trained on, as a quantile of g on the
            demonstrations; None without.
        verdict: None where the expert earns no more than the random agent.
        clear: whether the differences that decide the verdict exceed two standard errors: of the
            regret to the allowed one and, unless it matches the expert, of the learned returns, whose
            two gaps must then have the same sign.
        from_student: whether the policy began as the reward's student.
    """

    policy: str
    true_regret: Measured
    learned_gap: Measured
    verdict: Verdict | None
    clear: bool
    ceiling: Finite | None = None
    from_student: bool = False
    discounted_gap: Measured | None = None


class BankEntry(Struct, frozen=True, kw_only=True):
    """A policy of the bank in one setting: mean returns over episodes."""

    policy: str
    kind: str
    setting: str
    true: Measured
    learned: Measured
    progress: Finite | None


class Assessed(Struct, frozen=True, kw_only=True):
    """What a reward is worth in one setting, or in all together (``setting`` is then empty).

    Attributes:
        expert_minus_idle: learned reward per step, expert minus idle, in standard deviations of
            g; None without an expert.
        return_distance: episode-return correlation pseudometric (Gleave et al. 2021).
        epic: EPIC distance (the same paper); None where the true reward is not known as a function
            of a transition.
        retrained: every policy retrained on the reward in this setting.
    """

    setting: str
    overall: Agreement
    lower_half: Agreement
    expert_minus_idle: Measured | None = None
    return_distance: Finite | None = None
    epic: Finite | None = None
    retrained: tuple[RegretSplit, ...] = ()


class Assessment(Struct, frozen=True, kw_only=True):
    """``assessment.json``: a learned reward, measured on a bank of policies.

    ``epic_missing`` says why there is no EPIC distance; empty if there is one. ``left_out`` is how many
    of each policy's episodes do not count, because an error stopped them for one policy.
    """

    env: str
    reward: RewardOrigin
    settings: Annotated[tuple[Assessed, ...], Meta(min_length=1)]
    pooled: Assessed | None
    bank: tuple[BankEntry, ...]
    epic_missing: str = ""
    left_out: Annotated[int, Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        for s in self.settings:
            kinds = {e.kind for e in self.bank if e.setting == s.setting}
            if s.retrained and not {"expert", "random"} <= kinds:
                raise ValueError(f"the bank has no expert or no random agent in {s.setting}")

    @property
    def weak_experts(self) -> list[tuple[str, str]]:
        """The settings whose expert earns no more than the random or the idle agent, and that agent.

        Beside the random one no verdict is given.
        """
        earned = {(e.setting, e.kind): e.true.mean for e in self.bank}
        return [
            (s.setting, agent)
            for s in self.settings
            for agent in ("random", "idle")
            if {(s.setting, agent), (s.setting, "expert")} <= set(earned)
            and earned[s.setting, "expert"] <= earned[s.setting, agent]
        ]


class HintContrast(Struct, frozen=True, kw_only=True):
    """How a reward depends on each hint of :mod:`irlcli.envs.cue` in one setting.

    Each is the difference between g with the hint at 1 and g with the hint at -1, in standard
    deviations of g, mean over ``steps``.
    """

    setting: str
    steps: Annotated[int, Meta(ge=1)]
    cue: Finite
    texture: Finite


class CueContrast(Struct, frozen=True, kw_only=True):
    """``cue.json``: how a learned reward depends on the cue alone.

    ``scale`` is the standard deviation of g on the training data.
    """

    env: str
    reward: RewardOrigin
    scale: Positive
    settings: Annotated[tuple[HintContrast, ...], Meta(min_length=1)]


class PenaltyChoice(Struct, frozen=True, kw_only=True):
    """``choice.json``: the mean true return in each left-out setting, and the weight chosen.

    ``scores`` has one dict per weight, from the left-out setting to the true return. ``ties`` is
    the number of weights with the best mean; the smallest of them is chosen.
    """

    env: str
    weights: tuple[float, ...]
    scores: tuple[dict[str, float], ...]
    chosen: float
    ties: int

    def __post_init__(self) -> None:
        if len(self.scores) != len(self.weights):
            raise ValueError(f"it has scores for {len(self.scores)} of {len(self.weights)} weights")
        if self.chosen not in self.weights:
            raise ValueError(f"it chose {self.chosen:g}, which is no candidate")

    def __str__(self) -> str:
        tried, chosen = ",".join(map(weight_text, self.weights)), weight_text(self.chosen)
        if self.ties > 1:
            return f"lambda {chosen} is the smallest of {self.ties} equally good ones of {tried}"
        return f"lambda {chosen} was the best of {tried}"


class SettingSummary(Struct, frozen=True, kw_only=True):
    """The demonstrations of one setting. Imported ones may have no true reward."""

    setting: str
    episodes: Annotated[int, Meta(ge=1)]
    mean_return: Finite | None
    std_return: Finite | None
    mean_progress: Finite | None
    mean_length: Finite


class DemonstrationSummary(Struct, frozen=True, kw_only=True):
    """``summary.json`` of collect-experts and import."""

    env: str
    settings: tuple[SettingSummary, ...]


class SettingQuality(Struct, frozen=True, kw_only=True):
    """Quality of the policy that is optimal for a tabular reward, in one setting."""

    setting: str
    seen: bool
    goal_probability: Finite | None
    true_return: Finite | None
    value_difference: Finite | None
    rank_correlation: Finite | None
    log_likelihood: Finite


class Quality(Struct, frozen=True, kw_only=True):
    """``quality.json`` of train-maxent."""

    settings: tuple[SettingQuality, ...]


Form = TypeVar("Form", Reward, TabularReward, Policy, Dataset, Evaluation)
AnyForm = TypeVar("AnyForm", bound=Struct)


def convert(value: Any, form: type[AnyForm], source: Path | str) -> AnyForm:
    """``value`` (JSON) as a ``form``; names of environments and settings are not checked.

    Raises:
        IntegrityError: another form; the message names ``source``.
    """
    try:
        return msgspec.convert(value, form)
    except (msgspec.ValidationError, RecursionError) as error:
        raise _malformed(source, error) from None


def parse(value: Any, form: type[Form], source: Path | str) -> Form:
    """``value`` (JSON) as a ``form`` whose environment and settings exist.

    Raises:
        IntegrityError: another form or an unknown name; the message names ``source``.
    """
    description = convert(value, form, source)
    try:
        if isinstance(description, Evaluation):
            env, settings = description.policy.env, [s.setting for s in description.settings]
        else:
            env, settings = description.env, description.settings
        try:
            environment(env)
        except UsageError as error:
            raise IntegrityError(
                f"{source}: its description names an {error.message}",
                "if the environment is your own, name its TOML file with --env, or the store that the file "
                "lies in with --store",
            ) from None
        for setting in settings:
            parse_setting(env, setting)
    except UsageError as error:
        raise _malformed(source, error) from None
    return description


def _malformed(source: Path | str, error: Exception) -> IntegrityError:
    return IntegrityError(f"{source}: its description is malformed ({first_line(error)[:300]})")
