"""Checks of the arguments that the robot environments take."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlcli.envs.arguments import require
from irlcli.envs.bullet.body import single
from irlcli.envs.bullet.knobs import WALKER_KNOBS

Friction = tuple[float, float, float]


def require_friction(friction: Sequence[float]) -> Friction:
    """Return the tangential, torsional and rolling coefficient in the importer's precision.

    Raises:
        ValueError: ``friction`` is not three numbers within the knob's bounds.
    """
    if np.shape(friction) != (3,):
        raise ValueError(
            f"friction must be three numbers (tangential, torsional, rolling), not {friction!r}"
        )
    kinds = ("tangential", "torsional", "rolling")
    tangential, torsional, rolling = (
        single(require(WALKER_KNOBS["friction"]._replace(argument=f"friction ({kind})"), value))
        for kind, value in zip(kinds, friction, strict=True)
    )
    return tangential, torsional, rolling
