"""Returns of a policy over whole episodes: true, and by a learned reward if one is given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from irlcli.configs import EvaluationConfig
from irlcli.interventions import Setting, check_tabular, parse_setting
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import frozen_reward, shown, summary_of

if TYPE_CHECKING:
    from irlcli.rl.policy import Policy
    from irlcli.trajectories import Trajectory

Agent = Literal["policy", "random", "idle"]


# Without a ceiling the key has no such field.
class Parameters(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an evaluation depends on, besides the policy and the reward."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    agent: Agent
    seed: int
    evaluation: EvaluationConfig
    ceiling: float | None = None


def request(
    env: str,
    settings: Sequence[Setting],
    evaluation: EvaluationConfig,
    policy: Source | From | None = None,
    agent: Agent = "policy",
    seed: int = 0,
    policy_label: str = "",
    reward: Source | From | None = None,
    reward_label: str = "",
    ceiling: float | None = None,
) -> Request:
    """Episodes of ``policy`` (a ``policy.pt``), or of the random or idle agent, in ``settings``.

    With ``reward``, a ``reward.pt``, also the return by that reward, each step under ``ceiling``: a
    quantile of g on the demonstrations, or None for the reward as learned. The labels tell whose
    policy and reward these are; they are not part of the identity. Outputs ``episodes.parquet`` (a
    row per episode) and ``summary.json`` (means over the episodes that
    :func:`irlcli.trajectories.counted` selects).

    Raises:
        UsageError: a tabular environment.
    """
    check_tabular(env, "evaluate", wanted=False)
    texts = tuple(str(s) for s in settings)
    parameters = Parameters(
        environment=environment_key(env, settings),
        settings=texts,
        agent=agent,
        seed=seed,
        evaluation=relevant_evaluation(evaluation, agent),
        ceiling=None if reward is None else ceiling,
    )
    inputs = {
        role: source
        for role, source in (("policy", policy), ("reward", reward))
        if source is not None
    }
    label = f"evaluate {policy_label or agent} in {env} {', '.join(texts)} seed {seed}"
    label += f" by the reward of {reward_label}" if reward is not None else ""
    label += "" if parameters.ceiling is None else f" under ceiling {parameters.ceiling}"
    return Request(STAGE, parameters, inputs, label)


def relevant_evaluation(evaluation: EvaluationConfig, agent: Agent) -> EvaluationConfig:
    """``evaluation`` of ``agent``: the random and the idle one act alike, deterministic or not."""
    if agent == "policy":
        return evaluation
    return msgspec.structs.replace(evaluation, deterministic=False)


def act(job: Job, setting: str, policy: Policy | str, noise: float = 0.0) -> list[Trajectory]:
    """The episodes of ``policy``; episode k starts from the same state for every agent and method.

    The stage's parameters hold the environment, the seed and the evaluation.
    """
    from irlcli.rl.rollout import roll_out

    p = job.parameters
    env = p.environment.name
    found = roll_out(
        env,
        parse_setting(env, setting),
        policy,
        p.evaluation.episodes,
        p.seed,
        STAGE.name,
        p.evaluation.deterministic,
        noise,
    )
    job.warn_of_errors(setting, found)
    return found


def run(job: Job) -> None:
    """Roll out, and score by the reward if there is one."""
    import numpy as np

    from irlcli.data.outputs import write_json, write_rows
    from irlcli.data.tensors import load_policy_file, load_reward_file
    from irlcli.envs.spaces import check_spaces
    from irlcli.trajectories import counted

    p: Parameters = job.parameters
    policy: Policy | str = p.agent
    subject: dict[str, Any] = {"agent": p.agent, "env": p.environment.name}
    if "policy" in job.inputs:
        policy, origin = load_policy_file(job.inputs["policy"])
        subject = msgspec.to_builtins(origin)
        del subject["network"]
        env = p.environment.name
        together = [parse_setting(env, text) for text in (*p.settings, *origin.settings)]
        check_spaces(env, together)
    document = {"policy": subject}
    if "reward" in job.inputs:
        model, learned = load_reward_file(job.inputs["reward"])
        document["reward"] = msgspec.to_builtins(learned.origin)
    rows, summary = [], []
    for index, text in enumerate(p.settings):
        if "reward" in job.inputs:
            frozen = frozen_reward(p.environment, text, model, learned, p.ceiling)
        trajectories = act(job, text, policy)
        here: list[dict[str, Any]] = [
            {
                "setting": text,
                "episode": k,
                "seed": t.seed,
                "true_return": t.episode_return,
                "progress": t.progress,
                "length": len(t),
                "terminated": t.terminated,
                "error": t.error or "",
            }
            for k, t in enumerate(trajectories)
        ]
        whole = counted(trajectories)
        means = summary_of(text, whole)
        means["episodes"] = len(trajectories)
        means["stopped"] = sum(t.error is not None for t in trajectories)
        means["terminated"] = float(np.mean([t.terminated for t in whole]))
        if "reward" in job.inputs:
            learned_returns = {t: frozen.of_episode(t) for t in trajectories}
            for row, trajectory in zip(here, trajectories, strict=True):
                row["learned_return"] = learned_returns[trajectory]
            means["mean_learned_return"] = float(np.mean([learned_returns[t] for t in whole]))
        rows += here
        summary.append(means)
        facts = {text: shown(means["mean_return"], means["mean_progress"])}
        job.console.progress(index + 1, len(p.settings), "settings", facts)
    write_rows(job.output / "episodes.parquet", rows)
    write_json(job.output / "summary.json", document | {"settings": summary})


STAGE = Stage("evaluate", 4, run, reads=("evaluation",))
