"""True returns of evaluations, side by side: which agent, in which setting, over which seeds."""

# math instead of statistics: a cache hit prints returns, and statistics is slow to import.
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, get_args

from irlcli import labels
from irlcli.data.descriptions import Agent, Evaluation, Subject
from irlcli.errors import UsageError
from irlcli.interventions import covers, parse_setting
from irlcli.report.agents import title

# A summary, the parameters behind it that seeds share, and whether its reward is the policy's own.
EvaluationRun = tuple[Evaluation, Mapping[str, Any], bool]

_ORDER = get_args(Agent)
_HINT = "runs in one row may differ only in the seed of the reward learning: report the others separately"


class AgentRow(NamedTuple):
    """One agent in one setting, a sample over seeds.

    Attributes:
        returns: mean true return of each policy. One policy under several rewards is no sample of
            true returns.
        episodes: per seed.
        progress: mean over policies; None if the environment reports none.
        learned: mean learned return over policies and rewards; None if no reward was given.
    """

    agent: str
    env: str
    setting: str
    returns: tuple[float, ...]
    episodes: int
    progress: float | None = None
    learned: float | None = None

    @property
    def mean(self) -> float:
        """Mean over seeds."""
        return math.fsum(self.returns) / len(self.returns)

    @property
    def deviation(self) -> float | None:
        """Standard deviation over seeds (n - 1); None for one policy."""
        if len(self.returns) < 2:
            return None
        squares = math.fsum((x - self.mean) ** 2 for x in self.returns)
        return math.sqrt(squares / (len(self.returns) - 1))


def rows(evaluations: Iterable[EvaluationRun]) -> list[AgentRow]:
    """A row per agent, method and setting: experts first, random and idle last.

    An agent that was scored by another reward than its own has a row for each method of such
    rewards. Its seeds are then pairs: the policy's and the reward's.

    Args:
        evaluations: ``summary.json``, the parameters behind it that must not differ between seeds,
            and whether the reward that scored the policy is the policy's own.

    Raises:
        UsageError: a row has the same seed twice, or seeds that differ in one of those parameters.
    """
    parameters_of: dict[tuple[int, str, str, str], Mapping[str, Any]] = {}
    groups: dict[tuple[int, str, str, str], dict[tuple, tuple]] = {}
    for summary, parameters, own in evaluations:
        policy, reward = summary.policy, summary.reward
        order = _ORDER.index(policy.agent)
        for item in summary.settings:
            agent = agent_name(policy, item.setting)
            seeds = [policy.seed if policy.reward_seed is None else policy.reward_seed]
            if reward is not None and not own:
                agent += f" under {title(reward.method)}'s reward"
                seeds.append(reward.seed)
            key = (order, agent, policy.env, item.setting)
            first = parameters_of.setdefault(key, parameters)
            for name in sorted({*first, *parameters}):
                if first.get(name) != parameters.get(name):
                    raise UsageError(
                        f"runs of {agent} in {item.setting} differ in {name}: "
                        f"{first.get(name, 'unset')} and {parameters.get(name, 'unset')}",
                        _HINT,
                    )
            if tuple(seeds) in groups.get(key, {}):
                if seeds == [None]:
                    raise UsageError(
                        f"{agent} in {item.setting} appears twice: it is one agent, whatever the "
                        "seed of its episodes",
                        "name one evaluation of it",
                    )
                which = " under the reward of seed ".join(map(str, seeds))
                raise UsageError(f"two runs of {agent} in {item.setting} have seed {which}", _HINT)
            values = item.mean_return, item.episodes, item.mean_progress, item.mean_learned_return
            groups.setdefault(key, {})[tuple(seeds)] = values
    found = []
    for (_, agent, env, setting), items in sorted(groups.items()):
        _, episodes, progress, learned = zip(*items.values(), strict=True)
        policies: dict[Any, list[float]] = {}
        for (seed, *_), (true_return, *_) in items.items():
            policies.setdefault(seed, []).append(true_return)
        returns = tuple(math.fsum(each) / len(each) for each in policies.values())
        found.append(
            AgentRow(agent, env, setting, returns, min(episodes), _mean(progress), _mean(learned))
        )
    return found


def as_json(evaluations: Iterable[EvaluationRun]) -> list[dict[str, Any]]:
    """A document for each of the :func:`rows`."""
    return [
        {
            "agent": row.agent,
            "env": row.env,
            "setting": row.setting,
            "returns": list(row.returns),
            "mean": row.mean,
            "std_over_seeds": row.deviation,
            "mean_progress": row.progress,
            "mean_learned_return": row.learned,
            "episodes_per_seed": row.episodes,
        }
        for row in rows(evaluations)
    ]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known and len(known) == len(values) else None


def agent_name(policy: Subject, setting: str) -> str:
    """What ``policy`` is called in ``setting``.

    ``expert``, ``expert of bounce=0.1`` where that is another setting, ``random``, ``idle``,
    ``AIRL-IRM retrained policy``, ``AIRL-IRM student, zero-shot``, or ``AIRL-IRM student, in
    distribution`` where its demonstrations cover the setting.
    """
    agent = policy.agent
    if agent == "expert" and policy.settings and setting not in policy.settings:
        return f"expert of {', '.join(policy.settings)}"
    method = title(policy.method or "")
    if agent == "transfer":
        how = labels.retrained(
            policy.algorithm, policy.ceiling, policy.from_student, len(policy.restarts)
        )
        return f"{method} retrained policy" + (f" {how}" if how else "")
    if agent == "student":
        demonstrated = (parse_setting(policy.env, text) for text in policy.settings)
        seen = any(covers(s, parse_setting(policy.env, setting)) for s in demonstrated)
        return f"{method} student, {'in distribution' if seen else 'zero-shot'}"
    return agent
