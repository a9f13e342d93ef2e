"""Settings that are used together have the same actions, and observations of one size."""

from collections.abc import Sequence
from contextlib import closing

from irlcli.envs.registry import ENVIRONMENTS
from irlcli.errors import UsageError
from irlcli.interventions import Setting


def check_spaces(env: str, settings: Sequence[Setting]) -> None:
    """Refuse ``settings`` of an environment of one's own whose knobs change its spaces.

    Policies take the bounds of their actions from one world, whatever setting the others have.

    Raises:
        UsageError: two of them differ in their actions, or in the size of observations.
    """
    several = list(dict.fromkeys(settings))
    if env in ENVIRONMENTS or len(several) == 1:
        return
    (first, (actions, size)), *others = ((each, _spaces(env, each)) for each in several)
    for other, (other_actions, other_size) in others:
        if other_actions != actions:
            raise UsageError(
                f"{env} has actions in {actions} with {first}, in {other_actions} with {other}",
                "let the environment scale its actions, so that all settings have the same",
            )
        if other_size != size:
            raise UsageError(
                f"{env} has {size} numbers in an observation with {first}, {other_size} with {other}",
                "keep their size; with observed = true, values may differ from the default in it, "
                "not from each other",
            )


def _spaces(env: str, setting: Setting) -> tuple[object, int]:
    # Loads Gymnasium, which shipped environments do not need to be compared.
    from irlcli.envs.registration import make

    with closing(make(env, setting)) as world:
        assert world.observation_space.shape is not None
        return world.action_space, world.observation_space.shape[0]
