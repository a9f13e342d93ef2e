"""True returns of evaluations, side by side: who acted, where, and how it varies over seeds."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from irlcli.data.descriptions import Evaluation, Subject
from irlcli.errors import UsageError
from irlcli.interventions import covers, parse_setting

_ORDER = ("expert", "student", "transfer", "random", "idle")
_WHAT = {"student": "zero-shot", "transfer": "transfer"}


@dataclass(frozen=True)
class Row:
    """One agent in one setting; the sample of the statistics is the seed, not the episode."""

    agent: str
    env: str
    setting: str
    returns: tuple[float, ...]  # mean true return of each seed
    episodes: int  # per seed
    progress: float | None = None  # mean over seeds; None if the environment reports none
    learned: float | None = None  # mean over seeds of what a learned reward pays per episode
    policies: int = 1  # one policy under several rewards is no sample of true returns

    @property
    def mean(self) -> float:
        """Mean over seeds."""
        return statistics.fmean(self.returns)

    @property
    def deviation(self) -> float | None:
        """Standard deviation over seeds; None for one policy."""
        return statistics.stdev(self.returns) if self.policies > 1 else None


def rows(evaluations: Iterable[tuple[Evaluation, Mapping[str, Any], bool]]) -> list[Row]:
    """Rows of evaluations, one per agent, method and setting: experts first, random and idle last.

    An agent that was measured by another reward than its own is a row for each method of that, its
    seeds pairs of the policy's and the reward's.

    Args:
        evaluations: ``summary.json``, the parameters behind it that no seed may change, and
            whether a reward that it measured by is the policy's own.

    Raises:
        UsageError: one seed of the reward learning twice in a row, or seeds that differ in one of
            those parameters.
    """
    made: dict[tuple[int, str, str, str], Mapping[str, Any]] = {}
    groups: dict[tuple[int, str, str, str], dict[tuple, tuple]] = {}
    for summary, parameters, own in evaluations:
        policy, reward = summary.policy, summary.reward
        order = _ORDER.index(policy.agent)
        for item in summary.settings:
            agent = agent_name(policy, item.setting)
            seeds = [policy.seed if policy.reward_seed is None else policy.reward_seed]
            if reward is not None and not own:
                agent += f" on airl-{reward.method}'s reward"
                seeds.append(reward.seed)
            key = (order, agent, policy.env, item.setting)
            values = item.mean_return, item.episodes, item.mean_progress, item.mean_learned_return
            if tuple(seeds) in groups.get(key, {}):
                raise UsageError(
                    f"{agent} in {item.setting} has seed {' under the reward of seed '.join(map(str, seeds))} twice",
                    "a row's sample is the seed: report runs that differ in anything else apart",
                )
            first = made.setdefault(key, parameters)
            for name in sorted(first | parameters):
                if first.get(name) != parameters.get(name):
                    raise UsageError(
                        f"runs of {agent} in {item.setting} differ in {name}: "
                        f"{first.get(name, 'unset')} and {parameters.get(name, 'unset')}",
                        "a row's sample is the seed: report runs that differ in anything else apart",
                    )
            groups.setdefault(key, {})[tuple(seeds)] = values
    found = []
    for (_, agent, env, setting), items in sorted(groups.items()):
        returns, episodes, *others = zip(*items.values(), strict=True)
        means = (None if None in values else statistics.fmean(values) for values in others)
        policies = len({seed for seed, *_ in items})
        found.append(Row(agent, env, setting, returns, min(episodes), *means, policies))
    return found


def agent_name(policy: Subject, setting: str) -> str:
    """``airl-irm transfer``, ``airl-erm zero-shot``, ``random``, ``idle``, or ``expert``.

    One that was trained in another setting than ``setting`` is ``expert of bounce=0.1``, a
    student where its demonstrations are from ``airl-erm in distribution``.
    """
    agent = policy.agent
    if agent == "expert" and policy.settings and setting not in policy.settings:
        return f"expert of {', '.join(policy.settings)}"
    shown = (parse_setting(policy.env, text) for text in policy.settings)
    if agent == "student" and any(covers(s, parse_setting(policy.env, setting)) for s in shown):
        return f"airl-{policy.method} in distribution"
    return f"airl-{policy.method} {_WHAT[agent]}" if agent in _WHAT else agent
