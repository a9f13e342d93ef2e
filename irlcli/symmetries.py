"""Symmetries: maps under which a transition stays equally probable and equally good."""

from typing import NamedTuple

import numpy as np

# Of products of float32.
_ATOL = 1e-4


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


def check_group(found: object, observation_size: int, action_size: int) -> None:
    """Check what an environment's author declares: K maps of D and of A numbers that form a group.

    Raises:
        ValueError: what is wrong.
    """
    if not isinstance(found, Symmetries):
        raise ValueError(f"expected irlcli.symmetries.Symmetries, not {type(found).__name__}")
    count = len(found.observations)
    for name, maps, size in (
        ("observations", found.observations, observation_size),
        ("actions", found.actions, action_size),
    ):
        if maps.shape != (count, size, size) or maps.dtype != np.float32:
            raise ValueError(
                f"{name} must be float32 {[count, size, size]}, not {maps.dtype} {list(maps.shape)}"
            )
        if not np.array_equal(maps[0], np.eye(size)):
            raise ValueError(f"the first map of {name} is not the identity")
    # Linear maps are equal if, and almost surely only if, they agree on one random vector.
    rng = np.random.default_rng(0)
    seen = found.observations @ rng.normal(size=observation_size)
    acted = found.actions @ rng.normal(size=action_size)
    images = np.concatenate([seen, acted], axis=1)
    if found.quaternion is not None:
        # Both signs of a quaternion describe one orientation.
        signed = images.copy()
        signed[:, found.quaternion] *= -1.0
        images = np.concatenate([images, signed])
    for first in range(count):
        after = [seen @ found.observations[first].T, acted @ found.actions[first].T]
        same = np.abs(np.concatenate(after, axis=1)[:, None] - images).max(-1) < _ATOL
        known = same.any(1)
        if not known.all():
            second = int(np.argmin(known))
            raise ValueError(f"map {first} after map {second} is none of the maps: no group")
        if not same[:, ::count].any():
            raise ValueError(f"no map undoes map {first}: no group")
