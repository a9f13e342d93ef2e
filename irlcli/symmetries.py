"""Symmetries of an environment: images of a transition that are as possible, and as good, as itself."""

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
    for first in range(count):
        after = [[maps[first] @ maps[second] for maps in found[:2]] for second in range(count)]
        for second, products in enumerate(after):
            if not any(_same(found, k, products) for k in range(count)):
                raise ValueError(f"map {first} after map {second} is none of the maps: no group")
        if not any(_same(found, 0, products) for products in after):
            raise ValueError(f"no map undoes map {first}: no group")


def _same(group: Symmetries, element: int, products: list[np.ndarray]) -> bool:
    """Whether ``products`` are the maps of ``element``, up to the sign of the quaternion."""
    observations, actions = products
    signs = (1.0, -1.0) if group.quaternion is not None else (1.0,)
    for sign in signs:
        signed = observations.copy()
        if group.quaternion is not None:
            signed[group.quaternion] *= sign
        if np.allclose(signed, group.observations[element], atol=1e-4):
            return np.allclose(actions, group.actions[element], atol=1e-4)
    return False
