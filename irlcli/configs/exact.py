"""Hyperparameters of what is solved exactly: the gridworld, MaxEnt IRL, Figure 2, the positive controls."""

from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from irlcli.configs.fields import (
    MAX_COUNT,
    Count,
    Fraction,
    Grouping,
    NonNegative,
    NonNegativeCount,
    Positive,
)


class GridworldConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The gridworld of paper Sec. 5.1. Part of a dataset's identity, and recorded with it.

    ``horizon`` [steps] is that of experts and learner. At the goal an episode ends
    (``terminal``) or stays to the horizon (``absorbing``).
    """

    size: Annotated[int, Meta(ge=5, le=1024)] = 8
    horizon: Count = 32
    goal: Literal["terminal", "absorbing"] = "absorbing"
    p_slip: Annotated[float, Meta(ge=0, lt=1)] = 0.2


class MaxEntConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tractable maximum-entropy IRL (paper Sec. 4.2, 5.1, App. A, C).

    ``grouping`` and ``penalty`` are those of :class:`irlcli.configs.schema.AIRLConfig`. The reward
    is an MLP's scalar output (``features = "learned"``) or linear in the ``inputs`` of a state.
    ``held_out`` episodes of each setting's expert measure the likelihood. lambda is zero for the first
    ``penalty_warmup_iterations``; none if unset.
    """

    grouping: Grouping = "pooled"
    penalty: str = "none"
    penalty_weight: NonNegative = 0.05
    penalty_warmup_iterations: NonNegativeCount | UnsetType = UNSET
    l2: NonNegative = 0.0
    features: Literal["learned", "linear"] = "learned"
    inputs: Literal["one-hot", "coordinates"] = "one-hot"
    hidden: Count = 32
    iterations: Count = 1000
    learning_rate: Positive = 1e-3
    held_out: Count = 200


class Figure2Config(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Paper Fig. 2 as numbers: ``seeds`` datasets, the lambdas of IRM, the L2 weights of ERM.

    The datasets' seeds begin at 1000: smaller ones are for trying things out.
    """

    seeds: Annotated[int, Meta(ge=2)] = 20
    first_seed: NonNegativeCount = 1000
    episodes: tuple[Count, ...] = (400, 25, 3)
    penalty_weights: tuple[NonNegative, ...] = (0.01, 0.05, 0.2, 1.0)
    l2s: tuple[NonNegative, ...] = (1e-3, 1e-2, 1e-1, 1.0)


class CuedLabelsConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Colored MNIST without images, and the linear unit tests (:mod:`irlcli.controls.cued_labels`).

    Attributes:
        strengths: share of the labels that the colour agrees with, in each setting trained on.
        noise: share of the labels that the digit does not agree with.
        unit_steps, unit_samples: of the linear unit tests.
    """

    seeds: Annotated[int, Meta(ge=2)] = 10
    samples: Annotated[int, Meta(ge=2, le=100_000)] = 80
    strengths: tuple[Fraction, ...] = (0.9, 0.8)
    unseen: Fraction = 0.1
    noise: Fraction = 0.25
    hidden: Annotated[int, Meta(ge=1, le=1024)] = 16
    steps: Count = 500
    warmup: NonNegativeCount = 100
    learning_rate: Positive = 5e-3
    unit_steps: Count = 800
    unit_samples: Annotated[int, Meta(ge=2, le=100_000)] = 200


class CuedMapsConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The exact positive control of IRL (:mod:`irlcli.controls.cued_maps`).

    Attributes:
        seeds: draws of the maps, from ``first_seed``; smaller ones are for trying things out.
        value: of a good cell in the true reward, per step.
        texture: share of the cells in which the texture agrees with the quality, in every setting.
        strengths: the same share for the colour, in each setting trained on; ``unseen`` elsewhere.
        episodes: demonstrations per setting.
        warmup: iterations at lambda = 0.
        penalty_weights, l2s: lambda of each penalty, and the L2 of ERM.
        settings: numbers of settings trained on, for one colour and for two.
        spread: lowest and highest strength there.
        gaps: differences between the strengths of two settings, whose mean is that of ``strengths``.
        choices: strengths of the settings among which lambda is chosen by leaving each one out.
    """

    seeds: Annotated[int, Meta(ge=2)] = 20
    first_seed: NonNegativeCount = 1000
    size: Annotated[int, Meta(ge=2, le=64)] = 12
    horizon: Annotated[int, Meta(ge=1, le=1000)] = 8
    value: Positive = 2.0
    texture: Fraction = 0.75
    strengths: tuple[Fraction, ...] = (0.95, 0.8)
    unseen: Fraction = 0.1
    unseen_maps: Annotated[int, Meta(ge=1, le=100)] = 3
    episodes: Annotated[int, Meta(ge=1, le=100_000)] = 1000
    hidden: Annotated[int, Meta(ge=1, le=1024)] = 16
    iterations: Annotated[int, Meta(ge=2, le=MAX_COUNT)] = 400
    warmup: Count = 150
    learning_rate: Positive = 1e-2
    penalty_weights: tuple[NonNegative, ...] = (1.0, 10.0, 100.0, 1000.0, 10000.0)
    l2s: tuple[NonNegative, ...] = (0.01, 0.1, 1.0)
    settings: tuple[Annotated[int, Meta(ge=1, le=100)], ...] = (2, 3, 5, 10)
    spread: tuple[Fraction, Fraction] = (0.65, 0.95)
    gaps: tuple[Fraction, ...] = (0.0, 0.05, 0.1, 0.15, 0.2)
    choices: tuple[tuple[Fraction, ...], ...] = ((0.95, 0.875, 0.8), (0.95, 0.8, 0.35))


class ControlConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The positive controls of ``irl run control``."""

    labels: CuedLabelsConfig = CuedLabelsConfig()
    maps: CuedMapsConfig = CuedMapsConfig()
