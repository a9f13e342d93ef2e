"""The Ant's symmetries.

Its four legs are equal, so naming another one the first leg describes the same state: the torso's own
axes turn by quarters of a circle, and the joints change places. A reflection of the world at the
vertical plane through the goal keeps the progress, too. Together these are the eight symmetries of a
square.

Where hind legs have another length, only one of the reflections is left. Where a goal to one side is
part of the setting, a reflection would show the goal of another setting, so only the turns are left.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlcli.symmetries import Symmetries

# What the ankles' axes make of a turn: the sign of each leg's range, see ``irlcli.envs.ant.env``.
_ANKLES = np.array([1.0, -1.0, -1.0, 1.0])
# The leg in each leg's place after a reflection that swaps the torso's left and right, y and -y.
_OPPOSITE = [3, 2, 1, 0]
_ORIENTATION = slice(1, 5)


def symmetries(settings: Sequence[Mapping[str, Any]]) -> Symmetries:
    """Those that hold in each of ``settings``, keyword arguments of the environment."""
    legs = any(each.get("leg_length", 1.0) != 1.0 for each in settings)
    goal = any({"goal_y", "direction"} & each.keys() for each in settings)
    if legs:
        # The hind legs are at -y. Left and right swap places, then front and back.
        elements = [(0, False), (2, True)]
    else:
        elements = [(turns, mirrored) for mirrored in (False, True) for turns in range(4)]
    if goal:
        elements = [element for element in elements if not element[1]]
    pairs = [_element(turns, mirrored, 2 if goal else 0) for turns, mirrored in elements]
    observations, actions = (np.stack(part).astype(np.float32) for part in zip(*pairs, strict=True))
    return Symmetries(observations, actions, _ORIENTATION)


def _element(turns: int, mirrored: bool, tail: int) -> tuple[np.ndarray, np.ndarray]:
    """The maps of observations [27 + tail] and actions [8]: a reflection or none, then quarter turns."""
    joints = _turned(turns) @ (_reflected() if mirrored else np.eye(8))
    # x, y, z of a vector, and of an axis of rotation, under y -> -y; the quaternion's are an axis's.
    vector = np.diag([1.0, -1.0, 1.0]) if mirrored else np.eye(3)
    axis = -vector if mirrored else vector
    orientation = np.eye(4)
    orientation[:3, :3] = axis
    # q -> q r, where r turns by 90 degrees about z for each turn.
    s, c = np.sin(np.pi / 4 * turns), np.cos(np.pi / 4 * turns)
    right = np.array([[c, s, 0, 0], [-s, c, 0, 0], [0, 0, c, s], [0, 0, -s, c]])
    blocks = [np.eye(1), right @ orientation, joints, vector, axis, joints, np.eye(tail)]
    whole = np.zeros((27 + tail, 27 + tail))
    start = 0
    for block in blocks:
        end = start + len(block)
        whole[start:end, start:end] = block
        start = end
    return whole, joints


def _turned(turns: int) -> np.ndarray:
    """Leg ``k`` becomes what leg ``k + turns`` was [8, 8]; hip and ankle of each."""
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
