"""The penalties of adversarial learners on classification problems whose answers are published."""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec.structs import replace

from irlcli.configs import CuedLabelsConfig
from irlcli.controls.methods import LabelMethod
from irlcli.errors import UsageError
from irlcli.penalties import PENALTIES
from irlcli.stages.base import Job, Request, Stage
from irlcli.stages.running import run_parts

DIGITS = "coloured digits"
PROBLEMS = (DIGITS, "example 2", "example 3")
_DEFAULT = CuedLabelsConfig()


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the accuracies depend on."""

    problem: str
    methods: tuple[LabelMethod, ...]
    labels: CuedLabelsConfig


def methods(problem: str) -> tuple[LabelMethod, ...]:
    """ERM, every penalty of adversarial learners, and the controls.

    Every candidate for lambda on the digits, the largest one on the unit tests.
    """
    penalties = {n: p for n, p in PENALTIES.items() if "airl" in p.learners and n != "none"}
    found = [LabelMethod()]
    for name, penalty in penalties.items():
        weights = penalty.candidates if problem == DIGITS else penalty.candidates[-1:]
        found += [LabelMethod(penalty=name, weight=weight) for weight in weights]
    if problem != DIGITS:
        return (*found, LabelMethod(oracle=True))
    found += [
        LabelMethod(penalty=name, weight=penalties[name].candidates[-1], shuffled=True)
        for name in ("irmv1", "vrex", "iga")
    ]
    return (*found, LabelMethod(dropout=0.5))


def request(problem: str, labels: CuedLabelsConfig) -> Request:
    """Train :func:`methods` on ``problem``. Outputs ``accuracy.parquet``, a row per method and seed.

    Raises:
        UsageError: fewer than two settings to train on, or a warm-up as long as the training.
    """
    if len(labels.strengths) < 2:
        raise UsageError(
            f"control.labels.strengths has {len(labels.strengths)} setting, and penalties that "
            "compare settings need two",
            "for example --set control.labels.strengths=[0.9,0.8]",
        )
    if labels.warmup >= labels.steps:
        raise UsageError(
            f"control.labels.warmup = {labels.warmup} leaves none of {labels.steps} steps with a "
            "penalty",
            "set control.labels.warmup below control.labels.steps",
        )
    own = ("unit_steps", "unit_samples")
    others = ("steps", "warmup", "samples", "strengths", "unseen", "noise", "hidden")
    unread = own if problem == DIGITS else others
    canonical = replace(labels, **{name: getattr(_DEFAULT, name) for name in unread})
    parameters = Parameters(problem=problem, methods=methods(problem), labels=canonical)
    return Request(STAGE, parameters, {}, f"control-labels {problem}")


def run(job: Job) -> None:
    """Train one method after the other, all seeds of a method side by side."""
    import torch

    from irlcli.controls import classifier, cued_labels
    from irlcli.data.outputs import write_rows

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    c = p.labels
    seeds = range(c.seeds)
    if p.problem == DIGITS:
        schedule = classifier.Schedule(c.steps, c.warmup, c.learning_rate)
        trained, unseen = (
            cued_labels.coloured_digits(seeds, c.samples, c.noise, strengths)
            for strengths in (c.strengths, (c.unseen,))
        )
        invariant, hidden = trained, c.hidden
    else:
        schedule = classifier.Schedule(c.unit_steps, c.unit_steps // 4, c.learning_rate)
        draw = cued_labels.UNIT_TESTS[p.problem]
        trained, unseen = cued_labels.unit_test(draw, seeds, c.unit_samples)
        invariant, hidden = cued_labels.permuted(trained.numpy(), seeds), 0

    def rows_of(method: LabelMethod) -> list[dict[str, Any]]:
        networks = classifier.train(
            invariant if method.oracle else trained,
            method,
            schedule,
            hidden,
            seeds,
        )
        found = [classifier.accuracy(networks, x).mean(1).tolist() for x in (trained, unseen)]
        return [
            {"problem": p.problem, "method": str(method), "seed": seed, "trained": a, "unseen": b}
            for seed, a, b in zip(seeds, *found, strict=True)
        ]

    rows = run_parts(job, p.methods, rows_of, "methods")
    write_rows(job.output / "accuracy.parquet", rows)


STAGE = Stage("control-labels", 2, run, reads=("control",))
