"""True returns of evaluations, side by side: which agent, in which setting, over which seeds."""

# math instead of statistics: a cache hit prints returns, and statistics is slow to import.
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, get_args

from irlcli import labels
from irlcli.data.descriptions import Agent, Evaluation, Returns, Subject
from irlcli.errors import UsageError
from irlcli.interventions import covers, parse_setting
from irlcli.report.agents import title

# A summary, the parameters behind it that seeds share, and whether its reward is the policy's own.
EvaluationRun = tuple[Evaluation, Mapping[str, Any], bool]

# Order of the agent, agent, environment, setting.
_Group = tuple[int, str, str, str]
_ORDER = get_args(Agent)
_MOST_DIFFERENCES = 3
# As :func:`irlcli.experiments.circumstances.circumstances` names it.
_OTHER_REWARD = "reward."
_SHA256 = re.compile("[0-9a-f]{64}")


class AgentRow(NamedTuple):
    """One agent in one setting, a sample over seeds.

    Attributes:
        returns: mean true return of each policy. One policy under several rewards is no sample of
            true returns.
        episodes: per seed.
        stopped: how many episodes an error stopped, and of how many, over all policies. The means leave
            them out, unless they are all of a policy's.
        progress: mean over policies; None if the environment reports none.
        learned: mean learned return over policies and rewards; None if no reward was given.
    """

    agent: str
    env: str
    setting: str
    returns: tuple[float, ...]
    episodes: int
    stopped: tuple[int, int] = (0, 0)
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


class _Run(NamedTuple):
    """An evaluation in one setting: seed of the policy (and of a reward not its own), and what was measured."""

    seeds: tuple[int | None, ...]
    measured: Returns
    parameters: Mapping[str, Any]


def rows(evaluations: Iterable[EvaluationRun]) -> list[AgentRow]:
    """A row per agent, method and setting: experts first, random and idle last.

    An agent that was scored by another reward than its own has a row for each method of such
    rewards. Its seeds are then pairs: the policy's and the reward's. Runs that differ in one of up
    to three parameters besides the seed have a row for each of its values, which the agent's name
    tells.

    Args:
        evaluations: ``summary.json``, the parameters behind it that seeds share, and whether the
            reward that scored the policy is the policy's own.

    Raises:
        UsageError: a row has the same seed twice, or runs of an agent differ in more parameters.
    """
    groups: dict[_Group, list[_Run]] = {}
    for summary, parameters, own in evaluations:
        policy, reward = summary.policy, summary.reward
        order = _ORDER.index(policy.agent)
        for item in summary.settings:
            agent = agent_name(policy, item.setting)
            seeds = [policy.learning_seed]
            if reward is not None and not own:
                agent += f" under {title(reward.method)}'s reward"
                seeds.append(reward.seed)
            group = (order, agent, policy.env, item.setting)
            groups.setdefault(group, []).append(_Run(tuple(seeds), item, parameters))
    return [
        _row(f"{agent}{how}", env, setting, runs)
        for (_, agent, env, setting), group in sorted(groups.items(), key=lambda item: item[0])
        for how, runs in _by_parameters(agent, setting, group).items()
    ]


def _by_parameters(agent: str, setting: str, runs: Sequence[_Run]) -> dict[str, list[_Run]]:
    """Runs of equal parameters, by the parameters that tell them from the other runs."""
    names = sorted({name for run in runs for name in run.parameters})
    differing = [n for n in names if any(_value(run, n) != _value(runs[0], n) for run in runs)]
    if len(differing) > _MOST_DIFFERENCES:
        listed = ", ".join(differing[:_MOST_DIFFERENCES])
        raise UsageError(
            f"runs of {agent} in {setting} differ in {len(differing)} parameters: {listed}, ...",
            f"at most {_MOST_DIFFERENCES} can tell rows apart: report the others separately",
        )
    found: dict[str, list[_Run]] = {}
    for run in runs:
        how = "".join(f", {_field(name)} {_value(run, name)}" for name in differing)
        found.setdefault(how, []).append(run)
    return found


def _value(run: _Run, name: str) -> str:
    text = str(run.parameters.get(name, "unset")).removesuffix(".0")
    return text[:12] if _SHA256.fullmatch(text) else text


def _field(name: str) -> str:
    """``train-airl.airl.penalty_weight`` as ``--set`` names it: ``airl.penalty_weight``.

    With ``reward.`` before it where it is of another reward than the policy's own.
    """
    of = name.removeprefix(_OTHER_REWARD)
    field = of.partition(".")[2] if of.count(".") > 1 else of
    return _OTHER_REWARD + field if of != name else field


def _row(agent: str, env: str, setting: str, runs: Sequence[_Run]) -> AgentRow:
    by_seeds: dict[tuple[int | None, ...], Returns] = {}
    for seeds, item, _ in runs:
        if seeds in by_seeds and seeds[0] is None:
            raise UsageError(f"{agent} in {setting} appears twice", "name one evaluation of it")
        if seeds in by_seeds:
            which = " under the reward of seed ".join(map(str, seeds))
            raise UsageError(
                f"two runs of {agent} in {setting} have seed {which}", "name one of them"
            )
        by_seeds[seeds] = item
    policies: dict[int | None, list[Returns]] = {}
    for (seed, *_), item in by_seeds.items():
        policies.setdefault(seed, []).append(item)
    # Scored by several rewards, a policy acted in the same episodes.
    acted = [(of[0].stopped, of[0].episodes) for of in policies.values()]
    measured = by_seeds.values()
    return AgentRow(
        agent,
        env,
        setting,
        returns=tuple(
            math.fsum(item.mean_return for item in of) / len(of) for of in policies.values()
        ),
        episodes=min(item.episodes for item in measured),
        stopped=(sum(n for n, _ in acted), sum(of for _, of in acted)),
        progress=_mean([item.mean_progress for item in measured]),
        learned=_mean([item.mean_learned_return for item in measured]),
    )


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
            "stopped_episodes": row.stopped[0],
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
    distribution`` where its demonstrations cover the setting, and ``AIRL-IRM student, where its
    round was selected`` in the setting whose true return did so.
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
        if any(covers(s, parse_setting(policy.env, setting)) for s in demonstrated):
            return f"{method} student, in distribution"
        selected = setting == policy.selected_in
        return f"{method} student, {'where its round was selected' if selected else 'zero-shot'}"
    return agent
