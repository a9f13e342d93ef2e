"""Symmetries: maps under which a transition stays equally probable and equally good."""

from typing import NamedTuple

import numpy as np


class Symmetries(NamedTuple):
    """A group of K linear maps of observations [D] and actions [A]; the first is the identity.

    If a transition (s, a, s') is possible, its image under an element is equally probable, and has the
    same true reward.

    Attributes:
        observations: [K, D, D] float32.
        actions: [K, A, A] float32.
        quaternion: columns of an orientation, which a quaternion and its negative describe alike:
            images take the one whose last number is not negative. None: there is no orientation.
    """

    observations: np.ndarray
    actions: np.ndarray
    quaternion: slice | None = None
