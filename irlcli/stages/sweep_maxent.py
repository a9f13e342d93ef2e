"""Every method of paper Fig. 2 on many datasets at once: the rewards, and how good they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import asdict, replace

from irlcli.configs import Config, Figure2Config, GridworldConfig, MaxEntConfig
from irlcli.configs.relevance import relevant_maxent
from irlcli.interventions import Setting, check_tabular
from irlcli.labels import weight_text
from irlcli.penalties import penalty_version
from irlcli.stages import collect_experts
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Stage, environment_key
from irlcli.stages.running import warn_of_labels
from irlcli.stages.train_maxent import indexed, judge, read_gridworld, side_by_side

if TYPE_CHECKING:
    import numpy as np

    from irlcli.learners.occupancy import IndexedDemonstrations
    from irlcli.tabular import StackedMDPs

# The penalties that Figure 2 compares; the paper's L2 weight of ERM and its lambdas of IRM.
FIGURE2_PENALTIES = ("irmv1", "closed-form")
PAPER_L2 = 1e-3
PAPER_PENALTY_WEIGHTS = (0.01, 0.05)
_NAMES = {"pooled": "erm", "balanced": "erm-balanced", "per-setting": "irm"}


class SweepVariant(msgspec.Struct, frozen=True, kw_only=True):
    """One method of the sweep; the fields are those of :class:`irlcli.configs.MaxEntConfig`."""

    grouping: str
    penalty: str = "none"
    penalty_weight: float = 0.0
    l2: float = 0.0

    def __str__(self) -> str:
        """For example ``erm l2 0.1`` or ``irm-shuffled irmv1 0.05``."""
        parts = [_NAMES.get(self.grouping, f"irm-{self.grouping}")]
        if self.penalty != "none":
            parts.append(f"{self.penalty} {weight_text(self.penalty_weight)}")
        if self.l2:
            parts.append(f"l2 {weight_text(self.l2)}")
        return " ".join(parts)


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the sweep depends on, besides its datasets (``seeds``, in the order of the inputs).

    ``shared`` has the hyperparameters of all variants; what they replace is at its default.
    ``penalty_versions`` has the penalties whose version is not 1.
    """

    environment: EnvironmentKey
    settings: tuple[str, ...]
    unseen: tuple[str, ...]
    seeds: tuple[int, ...]
    variants: tuple[SweepVariant, ...]
    gridworld: GridworldConfig
    shared: MaxEntConfig
    penalty_versions: dict[str, int] | UnsetType = UNSET


def variants(penalty_weights: Sequence[float], l2s: Sequence[float]) -> tuple[SweepVariant, ...]:
    """The baselines, then each penalty at every lambda, with true and with shuffled labels.

    With lambda 0 both are ERM-balanced, which is therefore the low end of every sweep over lambda.
    """
    weights = sorted({*penalty_weights, *PAPER_PENALTY_WEIGHTS} - {0.0})
    found = [SweepVariant(grouping="pooled", l2=l2) for l2 in sorted({*l2s, PAPER_L2, 0.0})]
    found.append(SweepVariant(grouping="balanced"))
    found += [
        SweepVariant(grouping=grouping, penalty=penalty, penalty_weight=weight)
        for penalty in FIGURE2_PENALTIES
        for grouping in ("per-setting", "shuffled")
        for weight in weights
    ]
    return tuple(found)


def _shared(config: Config) -> MaxEntConfig:
    """The hyperparameters of all variants; what the variants replace is at its default."""
    penalised = SweepVariant(
        grouping="per-setting", penalty=FIGURE2_PENALTIES[0], penalty_weight=1.0
    )
    relevant = relevant_maxent(replace(config.maxent, **asdict(penalised)))
    return replace(relevant, **asdict(SweepVariant(grouping="pooled")))


def _penalty_versions() -> dict[str, int]:
    found = {name: penalty_version(name) for name in FIGURE2_PENALTIES}
    return {name: version for name, version in found.items() if isinstance(version, int)}


def _datasets(env: str, settings: Sequence[Setting], config: Config) -> dict[int, Request]:
    """The demonstrations that the sweep learns from, by seed."""
    f: Figure2Config = config.figure2
    return {
        seed: collect_experts.request(env, settings, config, seed, f.episodes)
        for seed in range(f.first_seed, f.first_seed + f.seeds)
    }


def request(
    env: str, settings: Sequence[Setting], unseen: Sequence[Setting], config: Config
) -> Request:
    """Fit all :func:`variants` to every dataset, and judge the rewards.

    Outputs ``rewards.parquet`` (a row per variant and seed) and ``quality.parquet`` (a row per
    variant, seed and setting, of ``settings`` and of ``unseen``).

    Raises:
        UsageError: an environment that is not tabular, or counts that do not fit the settings.
    """
    check_tabular(env, "sweep-maxent", wanted=True)
    texts = tuple(str(s) for s in settings)
    requests = _datasets(env, settings, config)
    parameters = Parameters(
        environment=environment_key(env),
        settings=texts,
        unseen=tuple(str(s) for s in unseen),
        seeds=tuple(requests),
        variants=variants(config.figure2.penalty_weights, config.figure2.l2s),
        gridworld=config.gridworld,
        shared=_shared(config),
        penalty_versions=_penalty_versions() or UNSET,
    )
    inputs = {f"demonstrations {seed}": From(demos) for seed, demos in requests.items()}
    label = f"sweep-maxent {env} {', '.join(texts)} {len(requests)} datasets"
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Fit all variants and datasets of one penalty side by side, one penalty after the other."""
    import numpy as np
    import torch

    from irlcli.data import tensors
    from irlcli.data.outputs import write_rows
    from irlcli.envs.gridworld import tasks

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    settings = tasks.stacked(p.settings, p.gridworld)
    demos = {}
    for seed in p.seeds:
        path = job.inputs[f"demonstrations {seed}"]
        _, episodes = read_gridworld(path, p.environment.name, p.settings)
        demos[seed] = indexed(settings, episodes, p.gridworld)
        if seed == p.seeds[0]:
            warn_of_labels(job, [len(group) for group in episodes])
    penalties = list(dict.fromkeys(v.penalty for v in p.variants))
    state = tensors.restore(job.checkpoints.load(), {"rewards", "fit"}, job.checkpoints.discard)
    with tensors.fitting(job.output.parent):
        rewards = [] if state is None else [tensor.numpy() for tensor in state["rewards"]]
    runs: list[tuple[SweepVariant, int]] = []
    for k, penalty in enumerate(penalties):
        chosen = list(product([v for v in p.variants if v.penalty == penalty], p.seeds))
        runs += chosen
        if k == len(rewards):
            rewards.append(_fit(job, settings, demos, chosen, rewards, state and state["fit"]))
            state = None
    reward = np.concatenate(rewards)
    rows: list[dict[str, Any]] = [
        {"variant": str(v), **asdict(v), "seed": seed, "reward": reward[r]}
        for r, (v, seed) in enumerate(runs)
    ]
    write_rows(job.output / "rewards.parquet", rows)
    rows = [
        {
            "variant": str(v),
            **asdict(v),
            "seed": seed,
            "setting": text,
            "seen": seen,
            **{name: float(array[r, e]) for name, array in measures.items()},
        }
        for texts, seen, measures in judge(
            p.settings, p.unseen, p.gridworld, reward, p.shared.held_out
        )
        for r, (v, seed) in enumerate(runs)
        for e, text in enumerate(texts)
    ]
    write_rows(job.output / "quality.parquet", rows)


def _fit(
    job: Job,
    settings: StackedMDPs,
    demos: Mapping[int, IndexedDemonstrations],
    runs: Sequence[tuple[SweepVariant, int]],
    rewards: Sequence[np.ndarray],
    state: Any,
) -> np.ndarray:
    """The rewards [R, S] of ``runs`` (variant, seed), all of one penalty.

    ``rewards`` are those of earlier penalties, ``state`` is where an interrupted fit stood.
    """
    import torch

    from irlcli.data import tensors
    from irlcli.envs.gridworld import tasks

    p: Parameters = job.parameters
    each = [(replace(p.shared, **asdict(v)), demos[seed], seed) for v, seed in runs]
    learner = side_by_side(settings, p.gridworld, each)
    if state is not None:
        with tensors.fitting(job.output.parent):
            learner.load_state_dict(state)
    # Larger fits take longer, so progress counts iterations of single rewards.
    before = p.shared.iterations * sum(map(len, rewards))
    total = p.shared.iterations * len(p.variants) * len(p.seeds)

    def after_record() -> None:
        done = before + learner.iterations * len(runs)
        job.console.progress(done, total, "iterations", {})
        kept = [torch.as_tensor(reward) for reward in rewards]
        job.checkpoints.offer(
            lambda: tensors.to_bytes({"rewards": kept, "fit": learner.state_dict()})
        )

    with tasks.usable_input():
        return learner.fit(p.shared.iterations, after_record=after_record)


STAGE = Stage("sweep-maxent", 3, run, reads=("maxent", "figure2"))
