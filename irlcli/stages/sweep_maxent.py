"""Every method of paper Fig. 2 on many datasets at once: rewards, and how good they are."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec

from irlcli.configs import Config, Figure2Config, GridworldConfig, MaxEntConfig
from irlcli.interventions import Setting, check_tabular
from irlcli.stages import collect_experts
from irlcli.stages.base import From, Job, Request, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the sweep depends on, besides its datasets (``seeds``, in the order of the inputs).

    Of ``maxent``, the method, the penalty and its weight, and l2 are swept over.
    """

    env: str
    settings: tuple[str, ...]
    unseen: tuple[str, ...]
    seeds: tuple[int, ...]
    penalty_weights: tuple[float, ...]
    l2s: tuple[float, ...]
    gridworld: GridworldConfig
    maxent: MaxEntConfig


class Variant(NamedTuple):
    """One method as fitted; ``shuffled`` deals the demonstrations out to settings at random."""

    method: str
    penalty: str
    penalty_weight: float
    l2: float
    shuffled: bool

    def __str__(self) -> str:
        parts = [self.method]
        if self.l2:
            parts.append(f"l2 {self.l2:g}")
        if self.method == "irm":
            parts.append(f"{self.penalty} {self.penalty_weight:g}")
        if self.shuffled:
            parts.append("shuffled")
        return " ".join(parts)


PENALTIES = ("irmv1", "closed-form")
PAPER_L2 = 1e-3
PAPER_PENALTY_WEIGHTS = (0.01, 0.05)


def variants(penalty_weights: Sequence[float], l2s: Sequence[float]) -> Iterator[Variant]:
    """The baselines, then for each penalty its lambdas and the paper's with shuffled labels.

    IRM with lambda 0 is ERM-balanced, which therefore stands at the low end of every sweep.
    """
    yield Variant("erm", PENALTIES[0], 0.0, 0.0, False)
    for l2 in sorted({*l2s, PAPER_L2} - {0.0}):
        yield Variant("erm", PENALTIES[0], 0.0, l2, False)
    yield Variant("erm-balanced", PENALTIES[0], 0.0, 0.0, False)
    for penalty in PENALTIES:
        for weight in sorted({*penalty_weights, *PAPER_PENALTY_WEIGHTS} - {0.0}):
            yield Variant("irm", penalty, weight, 0.0, False)
        for weight in PAPER_PENALTY_WEIGHTS:
            yield Variant("irm", penalty, weight, 0.0, True)


def datasets(env: str, settings_: Sequence[Setting], config: Config) -> list[Request]:
    """The demonstrations that the sweep learns from, one request a seed."""
    f: Figure2Config = config.figure2
    return [
        collect_experts.request(env, settings_, config, seed, f.episodes)
        for seed in range(f.first_seed, f.first_seed + f.seeds)
    ]


def request(
    env: str, settings_: Sequence[Setting], unseen: Sequence[Setting], config: Config
) -> Request:
    """Fit all :func:`variants` to every dataset, and judge the rewards.

    Outputs ``rewards.parquet`` (a row per variant and seed) and ``quality.parquet`` (a row per
    variant, seed and setting, of ``settings_`` and of ``unseen``).

    Raises:
        UsageError: an environment that is not tabular, or counts that do not fit the settings.
    """
    check_tabular(env, "sweep-maxent", wanted=True)
    texts = tuple(str(s) for s in settings_)
    requests = datasets(env, settings_, config)
    parameters = Parameters(
        env=env,
        settings=texts,
        unseen=tuple(str(s) for s in unseen),
        seeds=tuple(r.parameters.seed for r in requests),
        penalty_weights=config.figure2.penalty_weights,
        l2s=config.figure2.l2s,
        gridworld=config.gridworld,
        maxent=config.maxent,
    )
    inputs = {f"demonstrations {r.parameters.seed}": From(r) for r in requests}
    label = f"sweep-maxent {env} {', '.join(texts)} {len(requests)} datasets"
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """One fit a penalty, of all its variants and seeds side by side."""
    import numpy as np
    import pyarrow as pa
    import torch

    from irlcli.data import tensors as checkpoints
    from irlcli.data.parquet import write_table
    from irlcli.envs.gridworld import tasks as gridworlds
    from irlcli.learners import maxent

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    grid = p.gridworld
    settings = gridworlds.stacked(p.settings, grid)
    occupancy: dict[bool, list[Any]] = {False: [], True: []}
    for seed in p.seeds:
        path = job.inputs[f"demonstrations {seed}"]
        _, dataset = gridworlds.read(path, p.env, p.settings)
        demos = gridworlds.indexed(settings, list(dataset.trajectories.values()), grid)
        counts = demos.counts
        for shuffled in (False, True):
            if shuffled:
                demos = maxent.shuffle_settings(demos, seed)
            occupancy[shuffled].append(maxent.expert_occupancy(settings, demos, grid.horizon))
    found = list(variants(p.penalty_weights, p.l2s))
    state = checkpoints.restore(job.checkpoints.load(), {"rewards", "fit"}, job.console.warn)
    with checkpoints.fitting(job.output.parent, Exception):
        rewards = [] if state is None else [tensor.numpy() for tensor in state["rewards"]]
    while len(rewards) < len(PENALTIES):
        penalty = PENALTIES[len(rewards)]
        chosen = [v for v in found if v.penalty == penalty]
        fit = _fit(
            job,
            settings,
            [seed for _ in chosen for seed in p.seeds],
            [v for v in chosen for _ in p.seeds],
            np.concatenate([occupancy[v.shuffled] for v in chosen]),
            counts,
            rewards,
            None if state is None else state["fit"],
        )
        rewards.append(fit.reward)
        state = None
    runs = [(v, seed) for kind in PENALTIES for v in found if v.penalty == kind for seed in p.seeds]
    reward = np.concatenate(rewards)
    rows = [
        {"variant": str(v), **v._asdict(), "seed": seed, "reward": reward[r]}
        for r, (v, seed) in enumerate(runs)
    ]
    write_table(pa.Table.from_pylist(rows), job.output / "rewards.parquet")
    rows = []
    for texts, seen in ((p.settings, True), (p.unseen, False)):
        measures = gridworlds.quality(texts, grid, reward, p.maxent.held_out) if texts else {}
        rows += [
            {
                "variant": str(v),
                **v._asdict(),
                "seed": seed,
                "setting": text,
                "seen": seen,
                **{name: float(array[r, e]) for name, array in measures.items()},
            }
            for r, (v, seed) in enumerate(runs)
            for e, text in enumerate(texts)
        ]
    write_table(pa.Table.from_pylist(rows), job.output / "quality.parquet")


def _fit(job, settings, seeds, runs, occupancy, counts, rewards, state):
    """Fit one reward for each of ``runs`` (variants), all of one penalty; ``rewards`` are done."""
    import numpy as np
    import torch

    from irlcli.data import tensors as checkpoints
    from irlcli.envs.gridworld import tasks as gridworlds
    from irlcli.learners import maxent

    p: Parameters = job.parameters
    m = p.maxent

    def after_record(done, state):
        total = m.iterations * len(PENALTIES)
        job.console.progress(m.iterations * len(rewards) + done, total, "iterations", {})
        job.checkpoints.offer(
            lambda: checkpoints.to_bytes(
                {"rewards": [torch.as_tensor(r) for r in rewards], "fit": state()}
            )
        )

    with gridworlds.usable_input(), checkpoints.fitting(job.output.parent, maxent.UnfitState):
        return maxent.fit(
            settings,
            gridworlds.inputs(m.inputs, p.gridworld),
            occupancy,
            np.stack([maxent.setting_weights(v.method, counts) for v in runs]),
            np.array([v.penalty_weight for v in runs]),
            np.array([v.l2 for v in runs]),
            seeds,
            penalty_kind=runs[0].penalty,
            horizon=p.gridworld.horizon,
            hidden=m.hidden if m.features == "learned" else 0,
            iterations=m.iterations,
            learning_rate=m.learning_rate,
            state=state,
            after_record=after_record,
        )


STAGE = Stage("sweep-maxent", 1, run)
