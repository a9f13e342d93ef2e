"""The symmetries that an environment declares."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from irlcli.envs.adapted import prints_aside
from irlcli.envs.registry import environment
from irlcli.errors import StageFailed, UsageError, described, imported
from irlcli.interventions import Setting, env_kwargs
from irlcli.symmetries import Symmetries

# Of products of float32.
_ATOL = 1e-4


def symmetries(
    env: str, settings: Sequence[Setting], observation_size: int, action_size: int
) -> Symmetries:
    """The symmetries that ``env``, which declares some, has in each of ``settings``.

    Args:
        observation_size: D.
        action_size: A, the width of the actions that the discriminator sees.

    Raises:
        UsageError: none holds in all of them.
        StageFailed: the function that returns them cannot be imported, fails, or returns no group of
            maps of these sizes.
    """
    place = environment(env).symmetries
    assert place is not None
    arguments = [env_kwargs(env, setting) for setting in settings]
    with prints_aside():
        function = imported(f"environment {env!r}", place)
    try:
        with prints_aside():
            found: Any = function(arguments)
        check_group(found, observation_size, action_size)
    except Exception as error:
        # The function can be anybody's.
        raise StageFailed(
            f"{place}: {described(error)[:300]}", "docs/extending.md says what it returns"
        ) from error
    if len(found.observations) == 1:
        raise UsageError(
            f"airl.symmetries = true: no symmetry of {env} holds in all of "
            f"{'; '.join(map(str, settings))}",
            "--set airl.symmetries=none",
        )
    return found


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
