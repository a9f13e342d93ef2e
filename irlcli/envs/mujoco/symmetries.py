"""The symmetries of MuJoCo's Ant: what :mod:`irlcli.envs.four_legs` says, and a quaternion's sign.

A quaternion and its negative describe one orientation. MuJoCo changes the sign when the robot turns
once around, so both signs occur, and four quarter turns change it. With the signs there are twice as
many symmetries.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from irlcli.envs.four_legs import AXIS, VECTOR, elements, joints
from irlcli.symmetries import Symmetries

# The motors' legs, in MuJoCo's order of the motors.
_MOTORS = np.kron(np.eye(4)[[3, 0, 1, 2]], np.eye(2))
# A leg and its three bodies, on each of which a torque and a force act.
_BODIES_OF_A_LEG = 3


def ant(settings: Sequence[Mapping[str, Any]]) -> Symmetries:
    """Those that hold in each of ``settings``, keyword arguments of the environment."""
    legs = any(each.get("leg_length", 1.0) != 1.0 for each in settings)
    pairs = [
        _element(turns + again, mirrored) for again in (0, 4) for turns, mirrored in elements(legs)
    ]
    observations, actions = (np.stack(part).astype(np.float32) for part in zip(*pairs, strict=True))
    return Symmetries(observations, actions)


def _element(turns: int, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
    """The maps of observations [105] and actions [8]: a reflection or none, then quarter turns."""
    moved = joints(turns, mirrored)
    vector, axis = (VECTOR, AXIS) if mirrored else (np.eye(3), np.eye(3))
    # w, x, y, z. The last three are an axis's.
    orientation = block_diag(1.0, axis)
    # q -> q r, where r turns by 90 degrees about z for each turn.
    s, c = np.sin(np.pi / 4 * turns), np.cos(np.pi / 4 * turns)
    right = np.array([[c, 0, 0, -s], [0, c, s, 0], [0, -s, c, 0], [s, 0, 0, c]])
    # The angular velocity is in the torso's axes, everything else in the world's.
    own = np.round([[c * c - s * s, 2 * s * c, 0], [-2 * s * c, c * c - s * s, 0], [0, 0, 1]])
    touch = block_diag(axis, vector)
    hips = np.abs(moved[::2, ::2])
    legs = np.kron(hips, np.kron(np.eye(_BODIES_OF_A_LEG), touch))
    blocks = (1.0, right @ orientation, moved, vector, own @ axis, moved, touch, legs)
    return block_diag(*blocks), _MOTORS @ moved @ _MOTORS.T
