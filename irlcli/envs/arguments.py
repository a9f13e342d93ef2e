"""Checks of the arguments and actions of the built-in environments."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from irlcli.envs.spec import Knob


def require(knob: Knob, value: Any) -> float:
    """``value`` of the keyword argument of ``knob``, as a float.

    Raises:
        ValueError: ``value`` is not a number within the knob's bounds.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not knob.low <= number <= knob.high:
        raise ValueError(
            f"{knob.argument} must lie in [{knob.low:g}, {knob.high:g}], not {value!r}"
        )
    return number


def is_finite(array: np.ndarray) -> bool:
    """Whether every entry of a vector is finite, and small enough to be squared."""
    # The dot product is much cheaper than ``np.isfinite(array).all()``.
    return math.isfinite(array.dot(array))


def clipped(action: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """``action`` as float64, clipped to the actuators' range from ``low`` to ``high`` [A] float64.

    Raises:
        ValueError: ``action`` does not have the bounds' shape, or is not finite.
    """
    action = np.asarray(action, dtype=np.float64)
    if action.shape != low.shape:
        raise ValueError(f"action must have shape {low.shape}, not {action.shape}")
    if not is_finite(action):
        raise ValueError(f"action must be finite, not {action.tolist()}")
    return np.minimum(np.maximum(action, low), high)
