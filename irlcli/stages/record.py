"""Whole episodes of one policy in one setting, step by step: a member of a bank of policies.

Any number of learned rewards can then score them without acting again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from irlcli.configs import EvaluationConfig
from irlcli.interventions import Setting, check_tabular, parse_setting
from irlcli.stages import evaluate
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import shown, summary_of

if TYPE_CHECKING:
    from irlcli.rl.policy import Policy


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What recorded episodes depend on, besides the policy."""

    environment: EnvironmentKey
    setting: str
    agent: evaluate.Agent
    noise: float
    seed: int
    evaluation: EvaluationConfig


def request(
    env: str,
    setting: Setting,
    evaluation: EvaluationConfig,
    policy: Source | From | None = None,
    agent: evaluate.Agent = "policy",
    noise: float = 0.0,
    seed: int = 0,
    policy_label: str = "",
) -> Request:
    """Episodes of ``policy`` (a ``policy.pt``), or of the random or idle agent, in ``setting``.

    They are the episodes of :func:`irlcli.stages.evaluate.request` with the same arguments. With
    probability ``noise`` an action is replaced by a uniformly random one.

    Outputs ``steps.parquet``, ``episodes.parquet`` and ``summary.json``.

    Raises:
        UsageError: a tabular environment.
    """
    check_tabular(env, "record", wanted=False)
    parameters = Parameters(
        environment=environment_key(env, [setting]),
        setting=str(setting),
        agent=agent,
        noise=noise,
        seed=seed,
        evaluation=evaluate.relevant_evaluation(evaluation, agent),
    )
    who = policy_label or (f"{agent}, noise {noise}" if noise else agent)
    label = f"record {who} in {env} {setting} seed {seed}"
    inputs = {} if policy is None else {"policy": policy}
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Roll out; episode k starts from the same state as episode k of an evaluation."""
    from irlcli.data.outputs import write_json
    from irlcli.data.streaming import write_demonstrations
    from irlcli.data.tensors import load_policy_file

    p: Parameters = job.parameters
    env = p.environment.name
    policy: Policy | str = p.agent
    if "policy" in job.inputs:
        policy, _ = load_policy_file(job.inputs["policy"])
    trajectories = evaluate.act(job, p.setting, policy, p.noise)
    means = summary_of(p.setting, trajectories)
    facts = {p.setting: shown(means["mean_return"], means["mean_progress"])}
    job.console.progress(1, 1, "settings", facts)
    write_demonstrations(job.output, env, [(parse_setting(env, p.setting), trajectories)], {})
    write_json(job.output / "summary.json", means)


STAGE = Stage("record", 1, run, reads=("assessment", "evaluation"))
