"""Classification problems with a cue that reverses: Colored MNIST without images, and linear ones.

Every function returns samples [R, E, 2, B, D] float32: R runs, E settings, labels 0 and 1, B samples
of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch


def coloured_digits(
    seeds: Sequence[int], count: int, noise: float, strengths: Sequence[float]
) -> torch.Tensor:
    """Colored MNIST (Arjovsky et al. 2019, Sec. 5.2) as what its two features tell of the label.

    The inputs are the digit's half, which is wrong for a share ``noise`` of the labels, and the
    colour, which agrees with the label in the share ``strengths`` [E]; both -1 or 1. The shares are
    exact up to rounding, so runs differ in the order of the samples only.
    """
    samples = np.empty((len(seeds), len(strengths), 2, count, 2), dtype=np.float32)
    wrong = round(noise * count)
    for e, strength in enumerate(strengths):
        agrees = np.ones((count, 2), dtype=np.float32)
        agrees[:wrong, 0] = -1.0
        for part in (slice(0, wrong), slice(wrong, count)):
            inside = agrees[part, 1]
            inside[round(strength * len(inside)) :] = -1.0
        for r, seed in enumerate(seeds):
            rng = np.random.default_rng((seed, e))
            for label in (0, 1):
                samples[r, e, label] = rng.permutation(agrees) * (2 * label - 1)
    return torch.from_numpy(samples)


def cows_and_camels(rng: np.random.Generator, count: int) -> np.ndarray:
    """Example 2: the animal always agrees with the label, in inputs of a hundredth of the background's
    size. The background agrees in 95, 97 and 99 %.

    The labels are equally frequent here; Aubin et al. let 30, 50 and 70 % be cows.
    """
    found = []
    for agreement in (0.95, 0.97, 0.99):
        for sign in (-1.0, 1.0):
            background = np.where(rng.random((count, 1)) < agreement, sign, -sign)
            means = np.hstack([np.full((count, 5), sign), np.repeat(background, 5, 1)])
            noisy = means + rng.normal(size=(count, 10)) / np.sqrt(10.0)
            found.append(noisy * np.repeat([0.01, 1.0], 5))
    return np.stack(found).reshape(3, 2, count, 10)


def small_margin(rng: np.random.Generator, count: int) -> np.ndarray:
    """Example 3: a small invariant margin beside a large one that points elsewhere in each setting."""
    found = []
    for _ in range(3):
        spurious = rng.normal(size=5)
        for sign in (-1.0, 1.0):
            means = np.concatenate([np.full(5, 0.1), spurious]) * sign
            found.append(means + 0.1 * rng.normal(size=(count, 10)))
    return np.stack(found).reshape(3, 2, count, 10)


# Draws B samples of each label in settings [E, 2, B, 10], five invariant inputs before five spurious.
Draw = Callable[[np.random.Generator, int], np.ndarray]
# The linear unit tests of Aubin et al. (2021), arXiv 2102.10867.
UNIT_TESTS: dict[str, Draw] = {"example 2": cows_and_camels, "example 3": small_margin}


def unit_test(draw: Draw, seeds: Sequence[int], count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Samples to learn from, and others of the same settings with the spurious inputs permuted.

    Permuted among all samples of a setting, so that they tell nothing of the label.
    """
    drawn = []
    for seed in seeds:
        rng = np.random.default_rng((seed, 3))
        # Both halves are of the same settings, whose directions are drawn once.
        drawn.append(draw(rng, 2 * count))
    samples = np.stack(drawn).astype(np.float32)
    return torch.from_numpy(samples[..., :count, :].copy()), permuted(
        samples[..., count:, :], seeds
    )


def permuted(samples: np.ndarray, seeds: Sequence[int]) -> torch.Tensor:
    """``samples`` with the last five inputs permuted among the samples of each setting."""
    mixed = samples.copy()
    for run, seed in zip(mixed, seeds, strict=True):
        rng = np.random.default_rng((seed, 4))
        for setting in run:
            flat = setting.reshape(-1, setting.shape[-1])
            flat[:, 5:] = flat[rng.permutation(len(flat)), 5:]
    return torch.from_numpy(mixed)
