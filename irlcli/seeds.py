"""Seeds derived from a purpose, so that two uses of one seed do not share random numbers.

Exceptions: random actions in a built-in environment (:func:`irlcli.rl.rollout.roll_out`); by torch
and NumPy from one seed, the noise of a trained policy's actions and its minibatches; the images
under symmetries that all settings share before the first round of AIRL; MaxEnt's held-out episodes,
where the k-th trained and the k-th unseen setting share a stream; the start states in which a lambda
is chosen for reward seed 0, which are those of the evaluations; and the exact controls, which seed
generators of their own (:mod:`irlcli.controls`).
"""

import zlib

import numpy as np


def derive(purpose: str, seed: int, index: int, count: int = 1) -> list[int]:
    """Derive ``count`` seeds, each below 2**31.

    Args:
        purpose: what the random numbers are for, such as ``"replay"``.
        seed: the run's seed, at least 0.
        index: number of the use within the purpose, such as a round; at least -1.
        count: number of seeds.
    """
    entropy = [zlib.crc32(purpose.encode()), seed, index + 1]
    return [int(x) for x in np.random.SeedSequence(entropy).generate_state(count) % 2**31]
