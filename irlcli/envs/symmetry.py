"""The symmetries that an environment declares."""

from collections.abc import Sequence
from typing import Any

from irlcli.envs.registry import environment
from irlcli.errors import StageFailed, UsageError, described, imported
from irlcli.interventions import Setting, env_kwargs
from irlcli.symmetries import Symmetries, check_group


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
    module, _, name = place.partition(":")
    function = getattr(imported(f"environment {env!r}", module), name, None)
    if function is None:
        raise StageFailed(
            f"{module} has no function {name!r}",
            f"define {name}(settings), or declare no symmetries",
        )
    arguments = [env_kwargs(env, setting) for setting in settings]
    try:
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
