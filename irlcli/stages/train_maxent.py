"""Maximum-entropy IRL on a gridworld's demonstrations, solved exactly (paper Sec. 4.2, 5.1)."""

from collections.abc import Sequence

import msgspec

from irlcli.configs import MaxEntConfig
from irlcli.interventions import Setting, check_tabular
from irlcli.stages.base import From, Job, Request, Source, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a learned reward depends on, besides its demonstrations, which say of which grid."""

    env: str
    settings: tuple[str, ...]
    unseen: tuple[str, ...]
    seed: int
    maxent: MaxEntConfig


def request(
    demos: Source | From,
    env: str,
    settings_: Sequence[Setting],
    unseen: Sequence[Setting],
    maxent: MaxEntConfig,
    seed: int = 0,
) -> Request:
    """A reward learned from ``demos``, recorded in ``settings_`` of ``env``.

    Outputs ``reward.pt`` (a tensor file of kind ``tabular-reward``), its description as JSON,
    ``metrics.parquet`` with a row per record and setting, and ``quality.json``: how the policy
    that is optimal for the reward fares at the true task, in ``settings_`` and in ``unseen``.

    Raises:
        UsageError: an environment that is not tabular.
    """
    check_tabular(env, "train-maxent", wanted=True)
    texts = tuple(str(s) for s in settings_)
    parameters = Parameters(
        env=env, settings=texts, unseen=tuple(str(s) for s in unseen), seed=seed, maxent=maxent
    )
    kind = f" {maxent.penalty} lambda {maxent.penalty_weight:g}" if maxent.method == "irm" else ""
    label = f"train-maxent {maxent.method}{kind} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, {"demonstrations": demos}, label)


def run(job: Job) -> None:
    """Fit one reward; checkpoints after each record of the fit's progress."""
    import numpy as np
    import torch

    from irlcli.data import descriptions
    from irlcli.data import tensors as checkpoints
    from irlcli.data.outputs import write_json, write_metrics
    from irlcli.envs.gridworld import tasks as gridworlds
    from irlcli.learners import maxent

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    m = p.maxent
    grid, dataset = gridworlds.read(job.inputs["demonstrations"], p.env, p.settings)
    settings = gridworlds.stacked(p.settings, grid)
    demos = gridworlds.indexed(settings, list(dataset.trajectories.values()), grid)

    def after_record(done, state):
        job.console.progress(done, m.iterations, "iterations", {})
        job.checkpoints.offer(lambda: checkpoints.to_bytes(state()))

    names = {"iterations", "networks", "optimizer", "records"}
    with gridworlds.usable_input(), checkpoints.fitting(job.output.parent, maxent.UnfitState):
        fit = maxent.fit(
            settings,
            gridworlds.inputs(m.inputs, grid),
            maxent.expert_occupancy(settings, demos, grid.horizon)[None],
            maxent.setting_weights(m.method, demos.counts)[None],
            np.array([m.penalty_weight if m.method == "irm" else 0.0]),
            np.array([m.l2]),
            [p.seed],
            penalty_kind=m.penalty,
            horizon=grid.horizon,
            hidden=m.hidden if m.features == "learned" else 0,
            iterations=m.iterations,
            learning_rate=m.learning_rate,
            state=checkpoints.restore(job.checkpoints.load(), names, job.console.warn),
            after_record=after_record,
        )
    description = descriptions.TabularReward(
        env=p.env, settings=p.settings, method=m.method, seed=p.seed, gridworld=grid, maxent=m
    )
    tensors = {"reward": torch.as_tensor(fit.reward[0]), **fit.networks.state_dict()}
    checkpoints.save(job.output / "reward.pt", "tabular-reward", description, tensors)
    write_json(job.output / "reward.json", msgspec.to_builtins(description))
    write_metrics(
        job.output,
        [
            {
                "iteration": int(i),
                "setting": text,
                "log_likelihood": float(fit.objective[k, 0, e]),
                "penalty": float(fit.penalty[k, 0, e]),
                "occupancy_gap": float(fit.gap[k, 0, e]),
            }
            for k, i in enumerate(fit.iterations)
            for e, text in enumerate(p.settings)
        ],
    )
    rows = []
    for texts, seen in ((p.settings, True), (p.unseen, False)):
        if not texts:
            continue
        found = gridworlds.quality(texts, grid, fit.reward, m.held_out)
        rows += [
            {"setting": text, "seen": seen, **{k: _number(a[0, e]) for k, a in found.items()}}
            for e, text in enumerate(texts)
        ]
    write_json(job.output / "quality.json", {"settings": rows})


def _number(x: float) -> float | None:
    """JSON has no NaN: the rank correlation of a constant value is null."""
    return None if x != x else float(x)


STAGE = Stage("train-maxent", 1, run)
