"""The exact positive control of IRL: MaxEnt on maps with a cue that reverses, all methods side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from irlcli.configs import CuedMapsConfig
from irlcli.controls.methods import MapMethod
from irlcli.errors import UsageError
from irlcli.penalties import PENALTIES
from irlcli.stages.base import Job, Request, Stage
from irlcli.stages.running import run_parts

_DEFAULT = CuedMapsConfig()


_ERM, _BALANCED = MapMethod(grouping="pooled"), MapMethod(grouping="balanced")
_ORACLE = MapMethod(grouping="pooled", sees="texture")
_FEATURES = ("linear", "learned")


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """Variants that are fitted to the same maps.

    Attributes:
        name: in the results.
        strengths: of the colour in each setting trained on. With several ``colours`` each seed
            draws theirs uniformly, between the lowest and the highest of these.
        features: ``learned`` or ``linear``.
        leave_out: whether each setting is also left out in turn, to choose lambda.
    """

    name: str
    strengths: tuple[float, ...]
    variants: tuple[MapMethod, ...]
    colours: int = 1
    features: str = "linear"
    leave_out: bool = False


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the results of one part of the control depend on."""

    part: str
    cases: tuple[Case, ...]
    maps: CuedMapsConfig


def parts(maps: CuedMapsConfig) -> dict[str, Request]:
    """The requests of all parts of the control, by name.

    Raises:
        UsageError: as :func:`cases`, or a warm-up that leaves no iteration with a penalty.
    """
    if maps.warmup >= maps.iterations:
        raise UsageError(
            f"control.maps.warmup = {maps.warmup} leaves none of {maps.iterations} iterations with "
            "a penalty",
            "set control.maps.warmup below control.maps.iterations",
        )
    found: dict[str, list[Case]] = {}
    for case in cases(maps):
        found.setdefault(case.name.partition(".")[0], []).append(case)
    return {name: request(name, chosen, maps) for name, chosen in found.items()}


def cases(maps: CuedMapsConfig) -> Iterator[Case]:
    """All cases of the control; the first word of a name is its part.

    Raises:
        UsageError: fewer than two settings where penalties compare them, or no lambda.
    """
    _check(maps)
    yield from _sweeps(maps)
    yield from _without_warmup(maps)
    yield from _numbers_of_settings(maps)
    yield from _gaps(maps)
    yield from _choices(maps)


def _check(maps: CuedMapsConfig) -> None:
    if not maps.penalty_weights:
        raise UsageError(
            "control.maps.penalty_weights is empty", "for example [1.0, 100.0, 10000.0]"
        )
    for field, listed in (("gaps", maps.gaps), ("settings", maps.settings)):
        # A value that is given twice would count each seed twice.
        if not listed or len({*listed}) < len(listed):
            problem = "has repeated values" if listed else "is empty"
            raise UsageError(
                f"control.maps.{field} {problem}: {list(listed)}", "give each value once"
            )
    for field, counts in (
        ("strengths", [len(maps.strengths)]),
        ("settings", maps.settings),
        ("choices", [len(strengths) - 1 for strengths in maps.choices]),
    ):
        if any(count < 2 for count in counts):
            raise UsageError(
                f"control.maps.{field} asks for {max(0, min(counts))} setting to train on, and "
                "penalties that compare settings need two",
                "give at least two settings, and three in each of control.maps.choices",
            )


def _weights(maps: CuedMapsConfig) -> tuple[float, ...]:
    """The lambdas, the smallest first."""
    return tuple(sorted({*maps.penalty_weights}))


def _strongest(maps: CuedMapsConfig, penalty: str) -> MapMethod:
    """``penalty`` at the largest lambda."""
    return MapMethod(penalty=penalty, penalty_weight=_weights(maps)[-1])


def _few(maps: CuedMapsConfig) -> tuple[MapMethod, ...]:
    """ERM, the oracle and the two best penalties."""
    return (_ERM, _ORACLE, _strongest(maps, "irmv1-full"), _strongest(maps, "vrex"))


def _sweeps(maps: CuedMapsConfig) -> Iterator[Case]:
    """Every penalty over its lambdas, with true and with shuffled labels."""
    swept: dict[str, tuple[MapMethod, ...]] = {
        "erm": (
            *(_ERM, _BALANCED, _ORACLE),
            *(MapMethod(grouping="pooled", l2=l2) for l2 in maps.l2s),
        )
    }
    for penalty in ("irmv1", "irmv1-full", "closed-form", "vrex", "group-dro"):
        weights = _weights(maps)
        if penalty == "group-dro":
            weights = PENALTIES[penalty].candidates
        true = tuple(MapMethod(penalty=penalty, penalty_weight=w) for w in weights)
        shuffled = tuple(replace(v, grouping="shuffled") for v in true)
        swept[penalty] = (*true, *(shuffled if penalty == "irmv1-full" else shuffled[-1:]))
    swept["irmv1-full"] += (replace(_strongest(maps, "irmv1-full"), warm=False),)
    for features in _FEATURES:
        for name, variants in swept.items():
            yield Case(
                name=f"{features}.{name}",
                strengths=maps.strengths,
                # An L2 of 0 is ERM.
                variants=tuple(dict.fromkeys(variants)),
                features=features,
            )


def _without_warmup(maps: CuedMapsConfig) -> Iterator[Case]:
    """The smallest and the largest lambda from the start."""
    weights = _weights(maps)
    cold = tuple(
        MapMethod(penalty=penalty, penalty_weight=weight, warm=False)
        for penalty in ("irmv1", "vrex")
        for weight in sorted({weights[0], weights[-1]})
    )
    for features in _FEATURES:
        yield Case(
            name=f"cold.{features}", strengths=maps.strengths, variants=cold, features=features
        )


def _numbers_of_settings(maps: CuedMapsConfig) -> Iterator[Case]:
    """More settings, with one colour and with two."""
    low, high = maps.spread
    for colours in (1, 2):
        for count in maps.settings:
            yield Case(
                name=f"settings.{count}.colours.{colours}",
                strengths=_spaced(low, high, count),
                variants=_few(maps),
                colours=colours,
            )


def _gaps(maps: CuedMapsConfig) -> Iterator[Case]:
    """Two settings whose strengths lie closer together or further apart."""
    middle = sum(maps.strengths) / len(maps.strengths)
    for gap in maps.gaps:
        ends = (round(middle + gap / 2, 9), round(middle - gap / 2, 9))
        if not 0.0 <= min(ends) <= max(ends) <= 1.0:
            raise UsageError(
                f"control.maps.gaps: {gap:g} around {middle:g} leaves [0, 1]: {ends[1]:g} and "
                f"{ends[0]:g}",
                f"a gap of at most {2 * min(middle, 1 - middle):g}",
            )
        yield Case(name=f"gap.{gap:g}", strengths=ends, variants=_few(maps))


def _choices(maps: CuedMapsConfig) -> Iterator[Case]:
    """lambda chosen by leaving each setting out in turn."""
    offered = tuple(MapMethod(penalty="irmv1-full", penalty_weight=w) for w in _weights(maps))
    for number, strengths in enumerate(maps.choices):
        yield Case(
            name=f"choice.{number + 1}",
            strengths=strengths,
            variants=(_BALANCED, *offered),
            leave_out=True,
        )


def _spaced(low: float, high: float, count: int) -> tuple[float, ...]:
    """``count`` strengths from ``high`` to ``low``, evenly spaced."""
    return tuple(round(high + (low - high) * k / (count - 1), 9) for k in range(count))


def request(name: str, chosen: Sequence[Case], maps: CuedMapsConfig) -> Request:
    """Fit the variants of every case to every seed's maps, and try the rewards in unseen ones.

    Outputs ``results.parquet``, a row per case, variant, seed and setting left out (-1: none).
    """
    # What the cases say already.
    unread = ["strengths", "settings", "spread", "gaps", "choices", "penalty_weights", "l2s"]
    if all(case.features == "linear" for case in chosen):
        unread.append("hidden")
    canonical = replace(maps, **{field: getattr(_DEFAULT, field) for field in unread})
    parameters = Parameters(part=name, cases=tuple(chosen), maps=canonical)
    return Request(STAGE, parameters, {}, f"control-maps {name}")


def run(job: Job) -> None:
    """Fit one case after the other; a checkpoint holds the results of those that are done."""
    import torch

    from irlcli.data.outputs import write_rows

    torch.set_num_threads(1)
    p: Parameters = job.parameters
    rows = run_parts(job, p.cases, lambda case: _rows(case, p.maps), "cases")
    write_rows(job.output / "results.parquet", rows)


def _rows(case: Case, m: CuedMapsConfig) -> list[dict[str, Any]]:
    """All variants and seeds side by side, once more without each setting if the case asks for it."""
    import numpy as np

    from irlcli.controls import cued_fits
    from irlcli.controls.cued_maps import hint_weights

    seeds = range(m.first_seed, m.first_seed + m.seeds)
    hidden = m.hidden if case.features == "learned" else 0
    strengths = np.empty((m.seeds, len(case.strengths), case.colours))
    strengths[...] = np.array(case.strengths)[:, None]
    if case.colours > 1:
        for r, seed in enumerate(seeds):
            rng = np.random.default_rng((seed, 5))
            ends = min(case.strengths), max(case.strengths)
            strengths[r] = rng.uniform(*ends, strengths[r].shape)
    data = cued_fits.dataset(m, strengths, seeds)
    rows = []
    for left_out in (-1, *(range(len(case.strengths)) if case.leave_out else ())):
        kept = data if left_out < 0 else cued_fits.without(data, left_out)
        fitted = cued_fits.fit(m, kept, case.variants, hidden, seeds)
        weights = hint_weights(fitted.reward)
        measures = {
            **cued_fits.unseen(m, fitted, seeds, case.colours)._asdict(),
            "pays_texture": weights[..., 0],
            "pays_colour": weights[..., 1:].mean(-1),
            "log_likelihood": fitted.log_likelihood,
            "penalty_before": fitted.penalty_before,
            "penalty": fitted.penalty,
        }
        if left_out >= 0:
            measures["held_out_risk"] = cued_fits.held_out_risk(m, data, left_out, fitted)
        rows += [
            {
                "case": case.name,
                "variant": str(variant),
                **msgspec.structs.asdict(variant),
                "seed": seed,
                "left_out": left_out,
                "held_out_risk": None,
                **{name: float(array[v, r]) for name, array in measures.items()},
            }
            for v, variant in enumerate(case.variants)
            for r, seed in enumerate(seeds)
        ]
    return rows


STAGE = Stage("control-maps", 3, run, reads=("control",))
