"""Seeds derived from a purpose, so that no two uses of one seed share their random numbers."""

import zlib

import numpy as np


def derive(purpose: str, seed: int, index: int, count: int = 1) -> list[int]:
    """``count`` seeds below 2**31 for use ``index`` (at least -1) of ``purpose`` under ``seed``."""
    entropy = [zlib.crc32(purpose.encode()), seed, index + 1]
    return [int(x) for x in np.random.SeedSequence(entropy).generate_state(count) % 2**31]
