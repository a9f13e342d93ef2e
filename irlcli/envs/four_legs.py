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
    """The map of the joints [8, 8], hip and ankle of each leg, of one of :func:`elements`."""
    return _turned(turns) @ (_reflected() if mirrored else np.eye(8))


def _turned(turns: int) -> np.ndarray:
    """Leg ``k`` becomes what leg ``k + turns`` was [8, 8]."""
    matrix = np.zeros((8, 8))
    for leg in range(4):
        old = (leg + turns) % 4
        matrix[2 * leg, 2 * old] = 1.0
        matrix[2 * leg + 1, 2 * old + 1] = _ANKLES[leg] * _ANKLES[old]
    return matrix


def _reflected() -> np.ndarray:
    """Left legs become right legs [8, 8]: hips turn the other way, ankles bend the same way."""
    matrix = np.zeros((8, 8))
    for leg, old in enumerate(_OPPOSITE):
        matrix[2 * leg, 2 * old] = -1.0
        matrix[2 * leg + 1, 2 * old + 1] = _ANKLES[leg] * _ANKLES[old]
    return matrix
