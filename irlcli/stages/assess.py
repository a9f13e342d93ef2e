"""A learned reward, measured on a bank of policies of mixed quality.

The bank only measures: no reward and no policy learns from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from irlcli.envs.registry import environment
from irlcli.interventions import parse_setting
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import frozen_reward

if TYPE_CHECKING:
    import numpy as np

    from irlcli.data.descriptions import Reward
    from irlcli.learners.reward_model import RewardModule
    from irlcli.report.reward_quality import Member
    from irlcli.trajectories import Trajectory


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """A policy of the bank in one setting; see :class:`irlcli.report.reward_quality.Member`.

    ``ceiling`` and ``gamma`` are those of a retrained policy's training.
    """

    policy: str
    kind: str
    setting: str
    ceiling: float | None = None
    gamma: float | None = None

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
    """
    texts = list(dict.fromkeys(entry.setting for entry in bank))
    settings = [parse_setting(env, text) for text in texts]
    parameters = Parameters(environment=environment_key(env, settings), bank=tuple(bank))
    inputs: dict[str, Source | From] = {"reward": reward}
    inputs |= {entry.role: From(recorded) for entry, recorded in bank.items()}
    label = f"assess {env} {', '.join(texts)}"
    label += f" by the reward of {reward_label}" if reward_label else ""
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Score the recorded episodes by the reward, and compare with the true returns.

    Episode k counts only if an error stopped it for no policy: it is compared between them.
    """
    import numpy as np
    import torch

    from irlcli.data.outputs import write_json, write_rows
    from irlcli.data.tensors import load_reward_file
    from irlcli.report import scatter
    from irlcli.report.assessment import assess
    from irlcli.trajectories import unstopped

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    model, origin = load_reward_file(job.inputs["reward"])
    recorded = {entry: _episodes(job, entry) for entry in p.bank}
    kept = unstopped(recorded.values(), p.environment.max_episode_steps)
    episodes = {entry: [group[k] for k in kept] for entry, group in recorded.items()}
    left_out = len(recorded[p.bank[0]]) - len(kept)
    experts = {entry.setting: entry for entry in p.bank if entry.kind == "expert"}

    def returns(entry: Entry) -> np.ndarray:
        frozen = frozen_reward(p.environment, entry.setting, model, origin)
        return np.array([frozen.of_episode(t) for t in episodes[entry]])

    def gaps(entry: Entry, expert: Entry) -> tuple[np.ndarray, np.ndarray]:
        """The expert's learned returns minus those of a retrained policy, plain and discounted."""
        frozen = frozen_reward(
            p.environment, entry.setting, model, origin, entry.ceiling, entry.gamma
        )
        plain, discounted = (
            [of(e) - of(t) for e, t in zip(episodes[expert], episodes[entry], strict=True)]
            for of in (frozen.of_episode, frozen.discounted)
        )
        return np.array(plain), np.array(discounted)

    members, rows = [], []
    for index, entry in enumerate(p.bank):
        # What an absorbing state earns counts up to the horizon.
        horizon = p.environment.max_episode_steps if origin.airl.fixed_horizon else None
        member = _member(job, entry, episodes[entry], returns(entry), horizon)
        if entry.gamma is not None and entry.setting in experts:
            gap, discounted = gaps(entry, experts[entry.setting])
            member = member._replace(ceiling=entry.ceiling, gap=gap, discounted_gap=discounted)
        # The mean progress is that of all recorded episodes.
        members.append(member._replace(progress=None) if left_out else member)
        rows += _rows(member, episodes[entry], kept)
        job.console.progress(index + 1, len(p.bank), "policies", {})
    epic, epic_missing = _epic_distances(p.environment, model, origin, episodes)
    assessment = assess(p.environment.name, origin.origin, members, epic, epic_missing)
    assessment = replace(assessment, left_out=left_out)
    write_json(job.output / "assessment.json", msgspec.to_builtins(assessment))
    write_rows(job.output / "bank.parquet", rows)
    scatter.draw_bank(job.output, assessment)


def _member(
    job: Job,
    entry: Entry,
    episodes: Sequence[Trajectory],
    learned: np.ndarray,
    horizon: int | None,
) -> Member:
    """``entry`` with its returns; ``horizon`` counts for an episode that ended, None for none."""
    import numpy as np

    from irlcli.report.reward_quality import Member
    from irlcli.store import read_json

    return Member(
        policy=entry.policy,
        kind=entry.kind,
        setting=entry.setting,
        true=np.array([t.episode_return for t in episodes]),
        learned=learned,
        steps=np.array([horizon if horizon and t.terminated else len(t) for t in episodes]),
        progress=read_json(job.inputs[entry.role] / "summary.json")["mean_progress"],
    )


def _rows(
    member: Member, episodes: Sequence[Trajectory], numbers: Sequence[int]
) -> list[dict[str, Any]]:
    """A row for each of ``episodes``, which have these ``numbers`` in the recording."""
    return [
        {
            "setting": member.setting,
            "policy": member.policy,
            "kind": member.kind,
            "episode": number,
            "true_return": float(member.true[k]),
            "learned_return": float(member.learned[k]),
            "length": len(t),
            "terminated": t.terminated,
        }
        for k, (number, t) in enumerate(zip(numbers, episodes, strict=True))
    ]


def _episodes(job: Job, entry: Entry) -> Sequence[Trajectory]:
    from irlcli.data.demonstrations import read_demonstrations

    recorded = read_demonstrations(job.inputs[entry.role])
    recorded.require(job.parameters.environment.name, [entry.setting])
    return recorded.trajectories[entry.setting]


def _epic_distances(
    where: EnvironmentKey,
    model: RewardModule,
    origin: Reward,
    episodes: Mapping[Entry, Sequence[Trajectory]],
) -> tuple[dict[str, float | None], str]:
    """By setting, over steps of the random agent and of the setting's expert (or the student).

    Without a true reward of transitions none, and the reason.
    """
    from irlcli.envs.registration import transition_reward
    from irlcli.report.epic import epic_distance
    from irlcli.trajectories import transitions

    true = transition_reward(where.name)
    if true is None:
        what = environment(where.name).unobserved
        if what is None:
            return {}, f"{where.name} names no function of transitions as its true reward"
        return {}, f"the true reward of {where.name} also depends on {what}"
    found = {}
    for setting in dict.fromkeys(entry.setting for entry in episodes):
        here = {entry.kind: group for entry, group in episodes.items() if entry.setting == setting}
        good = here.get("expert", here.get("student", ()))
        data = transitions([*here["random"], *good], where.max_episode_steps)
        learned = frozen_reward(where, setting, model, origin).g_over_scale
        found[setting] = epic_distance(true, learned, data, origin.network.gamma)
    return found, ""


STAGE = Stage("assess", 8, run, reads=("assessment",))
