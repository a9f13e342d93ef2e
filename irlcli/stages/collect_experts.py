"""Demonstrations of each setting's own expert, as one Parquet dataset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET, UnsetType

from irlcli.configs import Config, GridworldConfig
from irlcli.data.descriptions import MOST_EPISODES
from irlcli.envs.registry import environment
from irlcli.errors import StageFailed, UsageError
from irlcli.interventions import Setting, check_observed, parse_setting, without_cue
from irlcli.stages import train_expert
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import shown, summary_of

if TYPE_CHECKING:
    from irlcli.rl.policy import Policy
    from irlcli.trajectories import Trajectory

_SAVED = ".zip"
# The role of an input, before the setting.
_NORMALISER = "normaliser"
# To find episodes of full length, at most so many times the wanted number are recorded.
_ATTEMPTS = 20


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a dataset depends on, besides its experts."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    episodes: tuple[int, ...]
    deterministic: bool
    full_length: bool | UnsetType
    seed: int


class TabularParameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a gridworld's dataset depends on: its experts are part of the computation."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    episodes: tuple[int, ...]
    seed: int
    gridworld: GridworldConfig


def request(
    env: str,
    settings: Sequence[Setting],
    config: Config,
    seed: int = 0,
    episodes: Sequence[int] | None = None,
    experts: Mapping[Setting, Source] | None = None,
    trust: bool = False,
    normalisers: Mapping[Setting, Source] | None = None,
) -> Request:
    """Demonstrations in ``settings``; ``episodes`` is one count for all or one for each.

    ``experts`` replace those that would be trained: a ``policy.pt``, or a ``.zip`` that
    stable-baselines3 saved, and for one that was trained under its VecNormalize the statistics in
    ``normalisers``. Loading either file runs the code that it holds, so ``trust`` is needed.

    Outputs ``steps.parquet``, ``episodes.parquet`` and ``summary.json``.

    Raises:
        UsageError: counts that do not fit the settings, settings with different observations, an
            expert of another one or of a tabular environment, or a ``.zip`` without ``trust``.
    """
    _check_experts(env, settings, experts or {}, trust)
    check_observed(env, [str(settings[0])], settings[1:])
    counts = tuple(episodes) if episodes else (config.demonstrations.episodes,)
    if len(counts) == 1:
        counts *= len(settings)
    if min(counts) < 1:
        raise UsageError(
            f"--episodes {min(counts)}: a setting needs at least one episode", "record at least 1"
        )
    if len(counts) != len(settings):
        raise UsageError(
            f"{len(counts)} episode counts for {len(settings)} settings",
            "give one count for all settings or one for each",
        )
    if sum(counts) > MOST_EPISODES:
        raise UsageError(
            f"{sum(counts):,} episodes are more than the {MOST_EPISODES:,} of one dataset",
            "record fewer, or spread them over several seeds",
        )
    texts = tuple(str(s) for s in settings)
    label = f"collect-experts {env} {', '.join(texts)} seed {seed}"
    shared: dict[str, Any] = {
        "environment": environment_key(env, settings),
        "settings": texts,
        "episodes": counts,
        "seed": seed,
    }
    if environment(env).tabular:
        tabular = TabularParameters(**shared, gridworld=config.gridworld)
        return Request(TABULAR_STAGE, tabular, {}, label)
    recorded = config.demonstrations
    parameters = Parameters(
        **shared,
        deterministic=recorded.deterministic,
        full_length=recorded.full_length or UNSET,
    )
    # Experts do not depend on the seed of the sampling: every dataset shares them.
    acting: dict[str, Source | From] = {}
    for s in settings:
        trained = From(train_expert.demonstrator(env, s, config), "policy.pt")
        acting[f"expert {s}"] = (experts or {}).get(s, trained)
    acting |= {f"{_NORMALISER} {s}": source for s, source in (normalisers or {}).items()}
    return Request(STAGE, parameters, acting, label)


def _check_experts(
    env: str, settings: Sequence[Setting], experts: Mapping[Setting, Source], trust: bool
) -> None:
    for setting, expert in experts.items():
        if setting not in settings:
            names = ", ".join(str(s) for s in settings)
            raise UsageError(
                f"--expert names {setting}, which is not among the settings to demonstrate: {names}",
                "name experts of these settings only",
            )
        if environment(env).tabular:
            raise UsageError(f"{env} takes no experts: value iteration finds them", "omit --expert")
        if expert.path.suffix == _SAVED and not trust:
            raise UsageError(
                f"{expert.path}: stable-baselines3 unpickles such a file, which runs the code in it",
                "add --trust if you trust whoever made the file",
            )


def run(job: Job) -> None:
    """Roll every expert out in its own setting."""
    from irlcli.envs.spaces import check_spaces
    from irlcli.store import file_digest

    p: Parameters = job.parameters
    env = p.environment.name
    check_spaces(env, [parse_setting(env, text) for text in p.settings])
    found = (_episodes(job, text, n) for text, n in zip(p.settings, p.episodes, strict=True))
    metadata = {
        "experts": {text: file_digest(job.inputs[f"expert {text}"]) for text in p.settings},
        "deterministic": p.deterministic,
    }
    _record(job, found, metadata)


def _episodes(job: Job, text: str, wanted: int) -> list[Trajectory]:
    """``wanted`` episodes of the expert of setting ``text``.

    Raises:
        StageFailed: too few episodes last until the time limit, where only such are wanted.
    """
    from irlcli.rl.rollout import roll_out

    p: Parameters = job.parameters
    env, expert = p.environment.name, _expert(job, text)
    found: list[Trajectory] = []
    for attempt in range(_ATTEMPTS):
        # Of the setting's own, so that they are the same whatever else the dataset holds.
        purpose = f"{STAGE.name} {text}" + (f" again {attempt}" if attempt else "")
        setting = parse_setting(env, text)
        episodes = roll_out(env, setting, expert, wanted, p.seed, purpose, p.deterministic)
        if not p.full_length:
            return episodes
        found += [t for t in episodes if len(t) == p.environment.max_episode_steps]
        recorded = wanted * (attempt + 1)
        facts = {text: f"full length in {len(found)} of {recorded}"}
        job.console.progress(min(len(found), wanted), wanted, "episodes", facts)
        if len(found) >= wanted:
            if len(found) < recorded / 2:
                job.console.warn(
                    f"only {len(found)} of {recorded} episodes of the expert in {text} last until the time "
                    "limit: demonstrations of full length may earn far more than its mean"
                )
            return found[:wanted]
    raise StageFailed(
        f"{len(found)} of {_ATTEMPTS * wanted} episodes of the expert in {env} {text} last until the time "
        f"limit, but {wanted} are wanted",
        "train the expert for longer, record fewer with --episodes, or any with "
        "--set demonstrations.full_length=false",
    )


def _expert(job: Job, text: str) -> Policy:
    """The expert of setting ``text``, ours or a saved model of stable-baselines3."""
    from irlcli.data.tensors import load_policy_file
    from irlcli.rl.saved import File, load_saved

    env, path = job.parameters.environment.name, job.inputs[f"expert {text}"]
    if path.suffix != _SAVED:
        return load_policy_file(path)[0]
    beside = job.inputs.get(f"{_NORMALISER} {text}")
    saved, *statistics = (File(str(f), f.read_bytes()) for f in (path, beside) if f)
    # It acts in the setting without a cue, as every expert does.
    return load_saved(saved, env, without_cue(env, parse_setting(env, text)), *statistics)


def run_tabular(job: Job) -> None:
    """Sample the policy that value iteration finds in each setting, ties broken at random."""
    from irlcli.envs.gridworld import tasks as gridworlds

    p: TabularParameters = job.parameters
    found = (
        gridworlds.sample(text, p.gridworld, episodes, (p.seed, index))
        for index, (text, episodes) in enumerate(zip(p.settings, p.episodes, strict=True))
    )
    metadata = {"experts": "value iteration", "gridworld": msgspec.to_builtins(p.gridworld)}
    _record(job, found, metadata)


def _record(job: Job, found: Iterable[list[Trajectory]], metadata: Mapping[str, Any]) -> None:
    """Report each setting's demonstrations as they are made, then write them all."""
    from irlcli.data.outputs import write_json
    from irlcli.data.streaming import write_demonstrations

    p: Parameters | TabularParameters = job.parameters
    groups, summary = [], []
    for index, (text, trajectories) in enumerate(zip(p.settings, found, strict=True)):
        job.warn_of_errors(text, trajectories)
        groups.append((parse_setting(p.environment.name, text), trajectories))
        summary.append(summary_of(text, trajectories))
        facts = {text: shown(summary[-1]["mean_return"], summary[-1]["mean_progress"])}
        job.console.progress(index + 1, len(p.settings), "settings", facts)
    write_demonstrations(job.output, p.environment.name, groups, metadata)
    write_json(job.output / "summary.json", {"env": p.environment.name, "settings": summary})


# The command compares experts with their bar.
STAGE = Stage("collect-experts", 2, run, reads=("demonstrations", "expert.bar"))
TABULAR_STAGE = Stage(
    "collect-experts",
    2,
    run_tabular,
    reads=("demonstrations.episodes", "expert.bar", "gridworld"),
)
