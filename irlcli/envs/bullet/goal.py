"""The goal that a walking robot moves toward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from irlcli.envs.arguments import require
from irlcli.envs.bullet.knobs import WALKER_KNOBS

GOAL_DISTANCE = 1000.0


class Goal:
    """A point about 1 km away, fixed or drawn for each episode.

    Args:
        goal_y: the goal is (1000, goal_y), with goal_y in [-10000, 10000].
        direction: the goal is 1000 m away in this direction, in degrees counter-clockwise from
            x, in [-180, 180]. A pair gives the range of a uniform draw per episode.

    Without either, the goal is (1000, 0) and is not observed.

    Raises:
        ValueError: both are given, a value is out of range, or the range is empty.
    """

    def __init__(self, goal_y: float | None, direction: float | Sequence[float] | None):
        if goal_y is not None and direction is not None:
            raise ValueError(
                f"goal_y and direction exclude each other, not {goal_y!r} and {direction!r}"
            )
        self.observed = goal_y is not None or direction is not None
        self._y = 0.0 if goal_y is None else require(WALKER_KNOBS["goal-y"], goal_y)
        self._range = None if direction is None else _angle_range(direction)

    def draw(self, random: np.random.Generator) -> tuple[float, float]:
        """The goal's x and y for one episode."""
        if self._range is None:
            return GOAL_DISTANCE, self._y
        low, high = self._range
        angle = math.radians(low if low == high else random.uniform(low, high))
        return GOAL_DISTANCE * math.cos(angle), GOAL_DISTANCE * math.sin(angle)

    def observation(self, goal: tuple[float, float]) -> list[float]:
        """The unit vector toward ``goal`` if the goal is observed, else an empty list."""
        norm = math.hypot(*goal)
        return [goal[0] / norm, goal[1] / norm] if self.observed else []


def _angle_range(direction: Any) -> tuple[float, float]:
    """Smallest and largest angle of ``direction``, in degrees.

    Raises:
        ValueError: ``direction`` is neither an angle nor a non-empty range of angles.
    """
    ends = (direction, direction) if np.ndim(direction) == 0 else tuple(direction)
    if len(ends) != 2:
        raise ValueError(f"direction must be one angle or a pair, not {direction!r}")
    low, high = (require(WALKER_KNOBS["direction"], end) for end in ends)
    if low > high:
        raise ValueError(f"direction must be (smaller, larger), not {direction!r}")
    return low, high
