"""When adversarial training may end before its budget.

The rule sees neither a true return nor an unseen setting. The student imitates when the discriminator
cannot tell its samples from the expert's: the cross-entropy nears ln 2, that of guessing. Once it is
near and rises no further, more rounds only repeat themselves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# Students that fail stop rising, too, but far below ln 2.
NEAR_CHANCE = 0.95 * math.log(2.0)


def plateaued(cross_entropies: Sequence[float], rounds: int) -> bool:
    """Whether the mean of the last ``rounds`` rounds is near chance and no higher than before.

    ``cross_entropies`` [R] are the discriminator's, one a round. Before means the ``rounds`` rounds
    before the last ones.
    """
    if len(cross_entropies) < 2 * rounds:
        return False
    before, last = np.mean(np.reshape(cross_entropies[-2 * rounds :], (2, rounds)), axis=1)
    return bool(last >= NEAR_CHANCE and last <= before)


def cross_entropies(rows: Sequence[Mapping[str, Any]], first_round: int) -> list[float]:
    """Each round's mean over the settings, from ``first_round`` on; ``rows`` as training logs them."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if row["round"] >= first_round:
            found.setdefault(row["round"], []).append(row["cross_entropy"])
    return [float(np.mean(found[index])) for index in sorted(found)]
