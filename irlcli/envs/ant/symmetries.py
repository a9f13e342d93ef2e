"""The symmetries of PyBullet's Ant: what :mod:`irlcli.envs.four_legs` says.

Where a goal to one side is part of the setting, a reflection would show the goal of another setting,
so only the turns are left.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from irlcli.envs.four_legs import AXIS, VECTOR, elements, joints
from irlcli.symmetries import Symmetries

_ORIENTATION = slice(1, 5)


def symmetries(settings: Sequence[Mapping[str, Any]]) -> Symmetries:
    """Those that hold in each of ``settings``, keyword arguments of the environment."""
    legs = any(each.get("leg_length", 1.0) != 1.0 for each in settings)
    goal = any({"goal_y", "direction"} & each.keys() for each in settings)
    found = [(turns, mirrored) for turns, mirrored in elements(legs) if not (goal and mirrored)]
    pairs = [_element(turns, mirrored, 2 if goal else 0) for turns, mirrored in found]
    observations, actions = (np.stack(part).astype(np.float32) for part in zip(*pairs, strict=True))
    return Symmetries(observations, actions, _ORIENTATION)


def _element(turns: int, mirrored: bool, tail: int) -> tuple[np.ndarray, np.ndarray]:
    """The maps of observations [27 + tail] and actions [8]: a reflection or none, then quarter turns."""
    moved = joints(turns, mirrored)
    vector, axis = (VECTOR, AXIS) if mirrored else (np.eye(3), np.eye(3))
    # x, y, z, w. The first three are an axis's.
    orientation = block_diag(axis, 1.0)
    # q -> q r, where r turns by 90 degrees about z for each turn.
    s, c = np.sin(np.pi / 4 * turns), np.cos(np.pi / 4 * turns)
    right = np.array([[c, s, 0, 0], [-s, c, 0, 0], [0, 0, c, s], [0, 0, -s, c]])
    # Height, orientation, angles, velocity, angular velocity, joints' speeds, and the goal.
    blocks = (1.0, right @ orientation, moved, vector, axis, moved, np.eye(tail))
    return block_diag(*blocks), moved
