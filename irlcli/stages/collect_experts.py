"""Demonstrations of each setting's own expert, as one Parquet dataset."""

from collections.abc import Sequence
from typing import Any

import msgspec

from irlcli.errors import UsageError
from irlcli.interventions import Setting, environment, parse_setting
from irlcli.settings import GridworldSettings, Settings
from irlcli.stages import From, Job, Request, Stage, train_expert

# Episodes become Python objects when a dataset is read; see dataset.py.
_MOST_EPISODES = 100_000


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a dataset depends on, besides its experts."""

    env: str
    physics: int
    settings: tuple[str, ...]
    episodes: tuple[int, ...]
    deterministic: bool
    seed: int


class TabularParameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a gridworld's dataset depends on: its experts are part of the computation."""

    env: str
    settings: tuple[str, ...]
    episodes: tuple[int, ...]
    seed: int
    gridworld: GridworldSettings


def request(
    env: str,
    settings_: Sequence[Setting],
    config: Settings,
    seed: int = 0,
    episodes: Sequence[int] | None = None,
) -> Request:
    """Demonstrations in ``settings_``; ``episodes`` is one count for all or one for each.

    Outputs ``steps.parquet``, ``episodes.parquet`` and ``summary.json``.

    Raises:
        UsageError: counts that do not fit the settings.
    """
    counts = tuple(episodes) if episodes else (config.demonstrations.episodes,)
    if len(counts) == 1:
        counts *= len(settings_)
    if min(counts) < 1:
        raise UsageError(f"{min(counts)} episodes are no demonstrations", "record at least 1")
    if len(counts) != len(settings_):
        raise UsageError(
            f"{len(counts)} episode counts for {len(settings_)} settings",
            "give one count for all settings or one for each",
        )
    if sum(counts) > _MOST_EPISODES:
        raise UsageError(
            f"{sum(counts):,} episodes are more than the {_MOST_EPISODES:,} of one dataset",
            "record fewer, or spread them over several seeds",
        )
    texts = tuple(str(s) for s in settings_)
    label = f"collect-experts {env} {', '.join(texts)} seed {seed}"
    shared = {"env": env, "settings": texts, "episodes": counts, "seed": seed}
    if environment(env).tabular:
        tabular = TabularParameters(**shared, gridworld=config.gridworld)
        return Request(TABULAR_STAGE, tabular, {}, label)
    parameters = Parameters(
        **shared,
        physics=environment(env).physics,
        deterministic=config.demonstrations.deterministic,
    )
    # Experts do not depend on the seed of the sampling: every dataset shares them.
    experts = {
        f"expert {s}": From(train_expert.request(env, s, 0, config.expert_of(s)), "policy.pt")
        for s in settings_
    }
    return Request(STAGE, parameters, experts, label)


def run(job: Job) -> None:
    """Roll every expert out in its own setting."""
    from irlcli import rl
    from irlcli.checkpoints import load_policy_file
    from irlcli.dataset import write_demonstrations
    from irlcli.stages.outputs import shown, warn_of_errors, write_json
    from irlcli.store import file_digest

    p: Parameters = job.parameters
    groups, summary = [], []
    for index, (text, episodes) in enumerate(zip(p.settings, p.episodes, strict=True)):
        setting = parse_setting(p.env, text)
        policy, _ = load_policy_file(job.inputs[f"expert {text}"])
        # Of the setting's own, so that they are the same whatever else the dataset holds.
        purpose = f"{STAGE.name} {text}"
        trajectories = rl.roll_out(
            p.env, setting, policy, episodes, p.seed, purpose, p.deterministic
        )
        warn_of_errors(job, text, trajectories)
        groups.append((setting, trajectories))
        summary.append(_summary(text, trajectories))
        facts = {text: shown(summary[-1]["mean_return"], summary[-1]["mean_progress"])}
        job.console.progress(index + 1, len(p.settings), "settings", facts)
    metadata = {
        "experts": {text: file_digest(job.inputs[f"expert {text}"]) for text in p.settings},
        "deterministic": p.deterministic,
    }
    write_demonstrations(job.output, p.env, groups, metadata)
    write_json(job.output / "summary.json", {"env": p.env, "settings": summary})


def run_tabular(job: Job) -> None:
    """Sample the policy that value iteration finds in each setting, ties broken at random."""
    from irlcli.dataset import write_demonstrations
    from irlcli.stages import gridworlds
    from irlcli.stages.outputs import write_json

    p: TabularParameters = job.parameters
    groups, summary = [], []
    for index, (text, episodes) in enumerate(zip(p.settings, p.episodes, strict=True)):
        trajectories = gridworlds.sample(text, p.gridworld, episodes, (p.seed, index))
        groups.append((parse_setting(p.env, text), trajectories))
        summary.append(_summary(text, trajectories))
        facts = {text: f"return {summary[-1]['mean_return']:.0f}"}
        job.console.progress(index + 1, len(p.settings), "settings", facts)
    metadata = {"experts": "value iteration", "gridworld": msgspec.to_builtins(p.gridworld)}
    write_demonstrations(job.output, p.env, groups, metadata)
    write_json(job.output / "summary.json", {"env": p.env, "settings": summary})


def _summary(text: str, trajectories: Sequence[Any]) -> dict[str, Any]:
    """One setting's expert in numbers."""
    import numpy as np

    returns = np.array([t.episode_return for t in trajectories])
    progress = float(np.mean([t.progress for t in trajectories]))
    return {
        "setting": text,
        "episodes": len(returns),
        "mean_return": float(returns.mean()),
        "std_return": float(returns.std(ddof=1)) if len(returns) > 1 else None,
        "mean_progress": None if np.isnan(progress) else progress,
        "mean_length": float(np.mean([len(t) for t in trajectories])),
    }


STAGE = Stage("collect-experts", 2, run)
TABULAR_STAGE = Stage("collect-experts", 2, run_tabular)
