"""Symmetries of the joints of an ant, in PyBullet and in MuJoCo.

Its four legs are equal, so naming another one the first leg describes the same state: the torso's own
axes turn by quarters of a circle, and the joints change places. A reflection of the world at the
vertical plane through the goal keeps the progress, too. Together these are the eight symmetries of a
square.

Leg k has a hip and an ankle, and points to the torso's 45 + 90 k degrees.
"""

import numpy as np

# The sign of the angles to which each leg's ankle bends.
_ANKLES = np.array([1.0, -1.0, -1.0, 1.0])
# The leg in each leg's place after a reflection that swaps the torso's left and right, y and -y.
_OPPOSITE = [3, 2, 1, 0]
# x, y, z of a vector, and of an axis of rotation, under y -> -y.
VECTOR = np.diag([1.0, -1.0, 1.0])
AXIS = -VECTOR


def elements(hind_legs_differ: bool) -> list[tuple[int, bool]]:
    """Quarter turns, after a reflection or none, that keep the legs; the identity first."""
    if hind_legs_differ:
        # The hind legs are at -y. Left and right swap places, then front and back.
        return [(0, False), (2, True)]
    return [(turns, mirrored) for mirrored in (False, True) for turns in range(4)]


def joints(turns: int, mirrored: bool) -> np.ndarray:
    """The map of the joints [8, 8], hip and ankle of each leg, of one of :func:`elements`.

    After a reflection hips turn the other way, and ankles bend the same way.
    """
    turned = _moved([(leg + turns) % 4 for leg in range(4)], 1.0)
    return turned @ (_moved(_OPPOSITE, -1.0) if mirrored else np.eye(8))


def _moved(olds: list[int], hips: float) -> np.ndarray:
    """Each leg becomes what the one in ``olds`` was [8, 8]; ``hips`` is the sign of the hips' angles."""
    matrix = np.zeros((8, 8))
    for leg, old in enumerate(olds):
        matrix[2 * leg, 2 * old] = hips
        matrix[2 * leg + 1, 2 * old + 1] = _ANKLES[leg] * _ANKLES[old]
    return matrix
