"""lambda by leaving one training setting out: model selection that touches no OOD setting."""

import math
from collections.abc import Sequence
from typing import Literal

import msgspec

from irlcli.configs import AIRLConfig, EvaluationConfig
from irlcli.errors import UsageError
from irlcli.interventions import Setting
from irlcli.penalties import PENALTIES
from irlcli.stages import evaluate, train_airl
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the choice depends on, besides the evaluations that it compares."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    weights: tuple[float, ...]
    seed: int


def request(
    demos: Source | From,
    env: str,
    settings: Sequence[Setting],
    airl: AIRLConfig,
    evaluation: EvaluationConfig,
    weights: Sequence[float] | Literal["own"],
    seed: int = 0,
) -> Request:
    """Choose the weight whose students have the best mean return in the left-out settings.

    ``own`` are those that :data:`irlcli.penalties.PENALTIES` has for the penalty of ``airl``.

    For each weight and setting, ``airl`` is trained on the other settings, and the student that
    ``airl.select`` keeps is evaluated in the one left out: what is scored is what is deployed.
    Outputs ``choice.json``.

    Raises:
        UsageError: fewer than two weights; fewer than two settings, or than three if the penalty
            compares settings or their labels are shuffled; a method without penalty; a round that
            is selected by one of the settings; worlds that the settings cannot share equally, with
            one left out and all together.
    """
    texts = tuple(str(s) for s in settings)
    candidates = _candidates(airl, texts, weights)
    _check_worlds(airl.ppo.n_envs, len(texts))
    inputs = {}
    for weight in candidates:
        config = msgspec.structs.replace(airl, penalty_weight=weight)
        for left_out in settings:
            others = [s for s in settings if s != left_out]
            learned = train_airl.request(demos, env, others, config, seed)
            student = From(learned, "policy.pt")
            label = f"student of {train_airl.describe(config)} seed {seed}"
            measured = evaluate.request(
                env, [left_out], evaluation, student, seed=seed, policy_label=label
            )
            inputs[_role(weight, str(left_out))] = From(measured, "summary.json")
    parameters = Parameters(
        environment=environment_key(env, settings), settings=texts, weights=candidates, seed=seed
    )
    label = f"choose-penalty {train_airl.method_of(airl)} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, inputs, label)


def _candidates(
    airl: AIRLConfig, settings: Sequence[str], weights: Sequence[float] | Literal["own"]
) -> tuple[float, ...]:
    """The weights to compare, in order, after a check that settings can be left out."""
    if airl.penalty == "none":
        raise UsageError(
            "--choose-penalty chooses the weight of a penalty, and this method has no penalty",
            "--method irm has one",
        )
    penalty = PENALTIES[airl.penalty]
    candidates = tuple(sorted(set(penalty.candidates if weights == "own" else weights)))
    if len(settings) < 2:
        raise UsageError(
            f"{settings[0]} is the only setting, so none can be left out",
            "set lambda instead of choosing it",
        )
    if len(candidates) < 2:
        raise UsageError(
            "--choose-penalty needs at least two different candidates",
            "for example --choose-penalty 0.1,1,10",
        )
    if (penalty.compares or airl.grouping == "shuffled") and len(settings) < 3:
        raise UsageError(
            f"--choose-penalty leaves a setting out, and {train_airl.method_of(airl)} needs at least two "
            f"of the others: {len(settings)} settings are too few",
            "set lambda instead of choosing it, or train in three settings or more",
        )
    if airl.select in settings:
        raise UsageError(
            f"--choose-penalty leaves every setting out in turn, also {airl.select}",
            "select the last round, or by episodes",
        )
    return candidates


def _check_worlds(n_envs: int, settings: int) -> None:
    """Refuse worlds that the trials, in one setting fewer, or the reward cannot share equally."""
    if n_envs % (settings - 1) or n_envs % settings:
        raise UsageError(
            f"airl.ppo.n_envs = {n_envs}: --choose-penalty trains in {settings - 1} settings, with one "
            f"left out, and in all {settings}, and these cannot both share the worlds equally",
            f"--set airl.ppo.n_envs to a multiple of {math.lcm(settings - 1, settings)}",
        )


def _role(weight: float, setting: str) -> str:
    return f"lambda {weight!r} without {setting}"


def run(job: Job) -> None:
    """Compare the mean scores; of weights that tie, the smallest is chosen."""
    from irlcli.data import descriptions
    from irlcli.data.outputs import write_json
    from irlcli.store import read_json

    p: Parameters = job.parameters
    scores = []
    for weight in p.weights:
        row = {}
        for text in p.settings:
            path = job.inputs[_role(weight, text)]
            summary = descriptions.parse(read_json(path), descriptions.Evaluation, path)
            row[text] = summary.settings[0].mean_return
        scores.append(row)
    means = [sum(row.values()) / len(row) for row in scores]
    choice = descriptions.PenaltyChoice(
        env=p.environment.name,
        weights=p.weights,
        scores=tuple(scores),
        chosen=p.weights[means.index(max(means))],
        ties=means.count(max(means)),
    )
    write_json(job.output / "choice.json", msgspec.to_builtins(choice))


# Challengers learn with the PPO of retrained policies, and these with that of the experts.
STAGE = Stage("choose-penalty", 3, run, reads=("airl", "transfer.ppo", "expert.ppo", "evaluation"))
