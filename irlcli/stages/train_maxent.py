"""Maximum-entropy IRL on a gridworld's demonstrations, solved exactly (paper Sec. 4.2, 5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from irlcli import labels
from irlcli.configs import GridworldConfig, MaxEntConfig
from irlcli.configs.relevance import relevant_maxent
from irlcli.errors import IntegrityError
from irlcli.interventions import Setting, check_tabular
from irlcli.methods import method_name
from irlcli.penalties import check_risks, penalty_version
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import warn_of_labels

if TYPE_CHECKING:
    import numpy as np

    from irlcli.learners.maxent import MaxEnt
    from irlcli.learners.occupancy import IndexedDemonstrations
    from irlcli.tabular import StackedMDPs
    from irlcli.trajectories import Trajectory


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a learned reward depends on, besides its demonstrations, which record their grid."""

    environment: EnvironmentKey
    settings: tuple[str, ...]
    unseen: tuple[str, ...]
    seed: int
    maxent: MaxEntConfig
    penalty_version: int | msgspec.UnsetType = msgspec.UNSET


def request(
    demos: Source | From,
    env: str,
    settings: Sequence[Setting],
    unseen: Sequence[Setting],
    maxent: MaxEntConfig,
    seed: int = 0,
) -> Request:
    """A reward learned from ``demos``, recorded in ``settings`` of ``env``.

    Outputs ``reward.pt`` (a tensor file of kind ``tabular-reward``), its description as JSON,
    ``metrics.parquet`` with a row per record and setting, and ``quality.json``: how the policy
    that is optimal for the reward performs at the true task, in ``settings`` and in ``unseen``.

    Raises:
        UsageError: an environment that is not tabular, a penalty that MaxEnt IRL does not have, or
            one that compares settings where there is one.
    """
    check_tabular(env, "train-maxent", wanted=True)
    texts = tuple(str(s) for s in settings)
    relevant = relevant_maxent(maxent)
    parameters = Parameters(
        environment=environment_key(env),
        settings=texts,
        unseen=tuple(str(s) for s in unseen),
        seed=seed,
        maxent=relevant,
        penalty_version=penalty_version(relevant.penalty),
    )
    check_risks(relevant.penalty, relevant.grouping, len(texts))
    label = f"train-maxent {describe(relevant)} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, {"demonstrations": demos}, label)


def describe(maxent: MaxEntConfig) -> str:
    """How the reward is learned, for labels: see :func:`irlcli.labels.learned`."""
    return labels.learned(msgspec.to_builtins(maxent))


def run(job: Job) -> None:
    """Fit the reward, then judge it in every setting."""
    import torch

    from irlcli.data import descriptions, tensors
    from irlcli.data.outputs import write_json, write_rows
    from irlcli.envs.gridworld import tasks

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    m = p.maxent
    grid, episodes = read_gridworld(job.inputs["demonstrations"], p.environment.name, p.settings)
    if m.grouping == "shuffled":
        warn_of_labels(job, [len(group) for group in episodes])
    settings = tasks.stacked(p.settings, grid)
    learner = side_by_side(settings, grid, [(m, indexed(settings, episodes, grid), p.seed)])
    names = set(learner.state_dict())
    state = tensors.restore(job.checkpoints.load(), names, job.checkpoints.discard)
    if state is not None:
        with tensors.fitting(job.output.parent):
            learner.load_state_dict(state)

    def after_record() -> None:
        job.console.progress(learner.iterations, m.iterations, "iterations", {})
        job.checkpoints.offer(lambda: tensors.to_bytes(learner.state_dict()))

    with tasks.usable_input():
        reward = learner.fit(m.iterations, after_record=after_record)
    description = descriptions.TabularReward(
        env=p.environment.name,
        settings=p.settings,
        method=method_name(msgspec.structs.asdict(m)),
        seed=p.seed,
        gridworld=grid,
        maxent=m,
    )
    weights = {"reward": torch.as_tensor(reward[0]), **learner.networks.state_dict()}
    tensors.save(job.output / "reward.pt", "tabular-reward", description, weights)
    write_json(job.output / "reward.json", msgspec.to_builtins(description))
    write_rows(job.output / "metrics.parquet", _metrics(learner, p.settings))
    write_json(job.output / "quality.json", {"settings": _quality(p, grid, reward)})


def _metrics(learner: MaxEnt, settings: Sequence[str]) -> list[dict[str, Any]]:
    """A row per record and setting."""
    return [
        {
            "iteration": record.iteration,
            "setting": text,
            "log_likelihood": float(record.log_likelihood[0, e]),
            "optimised_penalty": float(record.penalty[0]),
            "occupancy_gap": float(record.occupancy_gap[0, e]),
        }
        for record in learner.records
        for e, text in enumerate(settings)
    ]


def _quality(p: Parameters, grid: GridworldConfig, reward: np.ndarray) -> list[dict[str, Any]]:
    """A row per setting, seen or unseen."""
    return [
        {"setting": text, "seen": seen, **{k: _number(a[0, e]) for k, a in measures.items()}}
        for texts, seen, measures in judge(p.settings, p.unseen, grid, reward, p.maxent.held_out)
        for e, text in enumerate(texts)
    ]


def read_gridworld(
    directory: Path, env: str, texts: Sequence[str]
) -> tuple[GridworldConfig, list[tuple[Trajectory, ...]]]:
    """The grid of the demonstrations in ``directory``, and their episodes by setting.

    Raises:
        IntegrityError: damaged, or of another environment, or without one of the settings.
    """
    from irlcli.data.demonstrations import read_demonstrations

    demos = read_demonstrations(directory)
    demos.require(env, texts)
    try:
        grid = msgspec.convert(demos.metadata["gridworld"], GridworldConfig)
    except (KeyError, msgspec.ValidationError) as error:
        raise IntegrityError(
            f"the demonstrations in {directory} do not describe their gridworld ({error})"
        ) from None
    return grid, [demos.trajectories[text] for text in texts]


def indexed(
    settings: StackedMDPs, episodes: Sequence[Sequence[Trajectory]], grid: GridworldConfig
) -> IndexedDemonstrations:
    """The episodes of each setting as state and action indices.

    Raises:
        UsageError: episodes of another grid, or longer than its horizon.
    """
    from irlcli.envs.gridworld import tasks
    from irlcli.envs.gridworld.env import state_indices
    from irlcli.learners.occupancy import demonstrations

    with tasks.usable_input():
        states = [[state_indices(t.observations, grid.size) for t in group] for group in episodes]
        actions = [[t.actions for t in group] for group in episodes]
        return demonstrations(settings, states, actions, grid.horizon)


def side_by_side(
    settings: StackedMDPs,
    grid: GridworldConfig,
    runs: Sequence[tuple[MaxEntConfig, IndexedDemonstrations, int]],
) -> MaxEnt:
    """The learner of a reward for each of ``runs`` (config, demonstrations, seed).

    The configs differ at most in the grouping, lambda and L2.
    """
    import numpy as np

    from irlcli.envs.gridworld import tasks
    from irlcli.learners.maxent import MaxEnt, group_risks

    m = runs[0][0]
    return MaxEnt(
        settings,
        tasks.features(m.inputs, grid),
        [group_risks(settings, d, own.grouping, grid.horizon, s) for own, d, s in runs],
        np.array([own.penalty_weight for own, _, _ in runs]),
        np.array([own.l2 for own, _, _ in runs]),
        [seed for _, _, seed in runs],
        penalty=m.penalty,
        horizon=grid.horizon,
        hidden=m.hidden if m.features == "learned" else 0,
        learning_rate=m.learning_rate,
        penalty_warmup=m.penalty_warmup_iterations or 0,
    )


def judge(
    seen: Sequence[str],
    unseen: Sequence[str],
    grid: GridworldConfig,
    reward: np.ndarray,
    held_out: int,
) -> Iterator[tuple[Sequence[str], bool, dict[str, np.ndarray]]]:
    """How good ``reward`` [R, S] is in the settings that are ``seen``, then in those that are not.

    The held-out episodes are ``held_out`` new ones of each setting's own expert, the same for
    every reward.

    Yields E settings, whether they are seen, and each measure [R, E] by name.

    Raises:
        UsageError: a goal that cannot be reached, or a grid too large to solve.
    """
    from irlcli.envs.gridworld import tasks
    from irlcli.learners.tabular_quality import assess

    for texts, is_seen in ((seen, True), (unseen, False)):
        if not texts:
            continue
        settings = tasks.stacked(texts, grid)
        # A dataset's entropy is two numbers, so three are never a dataset's.
        episodes = [tasks.sample(t, grid, held_out, (0, e, held_out)) for e, t in enumerate(texts)]
        demos = indexed(settings, episodes, grid)
        with tasks.usable_input():
            quality = assess(settings, reward, grid.horizon, demos)
        yield texts, is_seen, vars(quality)


def _number(x: float) -> float | None:
    """JSON has no NaN, so the rank correlation of a constant value becomes null."""
    return None if x != x else float(x)


STAGE = Stage("train-maxent", 3, run, reads=("maxent",))
