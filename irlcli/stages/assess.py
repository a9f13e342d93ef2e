"""A learned reward, measured on a bank of policies of mixed quality.

The bank only measures: no reward and no policy learns from it.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from irlcli.errors import UsageError
from irlcli.stages.base import (
    EnvironmentKey,
    From,
    Job,
    Request,
    Source,
    Stage,
    environment_key,
    frozen_reward,
)


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A policy of the bank in one setting; see :class:`irlcli.report.reward_quality.Member`."""

    policy: str
    kind: str
    setting: str
    ceiling: float | None = None

    @property
    def role(self) -> str:
        """Name of its recorded episodes among the stage's inputs."""
        return f"{self.setting} {self.policy}"


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What an assessment depends on, besides the reward and the recorded episodes."""

    environment: EnvironmentKey
    bank: tuple[Entry, ...]


def request(
    reward: Source | From,
    env: str,
    bank: Mapping[Entry, Request],
    reward_label: str = "",
) -> Request:
    """How well ``reward`` (a ``reward.pt``) ranks the policies of ``bank``.

    ``bank`` maps each entry to its recorded episodes (:mod:`irlcli.stages.record`).

    Outputs ``assessment.json``, ``bank.parquet`` (a row per episode), ``scatter.png`` and
    ``scatter.svg``.

    Raises:
        UsageError: the bank has fewer than two policies in a setting.
    """
    places = list(dict.fromkeys(entry.setting for entry in bank))
    for place in places:
        if sum(entry.setting == place for entry in bank) < 2:
            raise UsageError(
                f"the bank has one policy in {place}, so no correlation is defined",
                "a bank needs two policies or more",
            )
    parameters = Parameters(environment=environment_key(env), bank=tuple(bank))
    inputs: dict[str, Source | From] = {"reward": reward}
    inputs |= {entry.role: From(recorded) for entry, recorded in bank.items()}
    label = f"assess {env} {', '.join(places)}"
    label += f" by the reward of {reward_label}" if reward_label else ""
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Score every recorded episode by the reward, and compare with the true returns."""
    import numpy as np
    import pyarrow as pa

    from irlcli.data.demonstrations import read_demonstrations
    from irlcli.data.descriptions import LearnedReward
    from irlcli.data.outputs import write_json
    from irlcli.data.parquet import write_table
    from irlcli.data.tensors import load_reward_file
    from irlcli.errors import IntegrityError
    from irlcli.report import scatter
    from irlcli.report.assessment import assess
    from irlcli.report.reward_quality import Member
    from irlcli.store import read_json

    p: Parameters = job.parameters
    env, horizon = p.environment.name, p.environment.max_episode_steps
    model, origin = load_reward_file(job.inputs["reward"])

    def returns(entry: Entry, ceiling: float | None = None) -> np.ndarray:
        frozen = frozen_reward(p.environment, entry.setting, model, origin, ceiling)
        return np.array([frozen.of_episode(t, bounded=True) for t in episodes[entry]])

    episodes, experts = {}, {}
    for entry in p.bank:
        directory = job.inputs[entry.role]
        recorded = read_demonstrations(directory)
        if recorded.env != env or list(recorded.trajectories) != [entry.setting]:
            raise IntegrityError(f"{directory} holds no episodes in {env} {entry.setting}")
        episodes[entry] = recorded.trajectories[entry.setting]
        if entry.kind == "expert":
            experts[entry.setting] = entry
    members, rows = [], []
    for index, entry in enumerate(p.bank):
        # What an absorbing state earns counts up to the horizon.
        absorbing = origin.airl.fixed_horizon
        member = Member(
            policy=entry.policy,
            kind=entry.kind,
            setting=entry.setting,
            true=np.array([t.episode_return for t in episodes[entry]]),
            learned=returns(entry),
            steps=np.array(
                [horizon if absorbing and t.terminated else len(t) for t in episodes[entry]]
            ),
            progress=read_json(job.inputs[entry.role] / "summary.json")["mean_progress"],
        )
        if entry.ceiling is not None and entry.setting in experts:
            member = member._replace(
                ceiling=entry.ceiling,
                paid=returns(entry, entry.ceiling),
                expert_paid=returns(experts[entry.setting], entry.ceiling),
            )
        members.append(member)
        rows += [
            {
                "setting": entry.setting,
                "policy": entry.policy,
                "kind": entry.kind,
                "episode": k,
                "true_return": float(member.true[k]),
                "learned_return": float(member.learned[k]),
                "length": len(t),
                "terminated": t.terminated,
            }
            for k, t in enumerate(episodes[entry])
        ]
        job.console.progress(index + 1, len(p.bank), "policies", {})
    reward = LearnedReward(method=origin.method, seed=origin.seed, settings=origin.settings)
    assessment = assess(env, reward, members)
    write_json(job.output / "assessment.json", msgspec.to_builtins(assessment))
    write_table(pa.Table.from_pylist(rows), job.output / "bank.parquet")
    scatter.draw_bank(job.output, assessment)


STAGE = Stage("assess", 1, run)
