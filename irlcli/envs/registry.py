"""All environments by name. Importing this module does not import any environment."""

from irlcli.envs.ant.spec import SPEC as ANT
from irlcli.envs.gridworld.spec import SPEC as GRIDWORLD
from irlcli.envs.half_cheetah.spec import SPEC as HALF_CHEETAH
from irlcli.envs.lunar_lander.spec import SPEC as LUNAR_LANDER
from irlcli.envs.reacher.spec import SPEC as REACHER
from irlcli.envs.spec import EnvironmentSpec
from irlcli.errors import UsageError, suggest

ENVIRONMENTS: dict[str, EnvironmentSpec] = {
    spec.name: spec for spec in (LUNAR_LANDER, ANT, HALF_CHEETAH, REACHER, GRIDWORLD)
}


def environment(name: str) -> EnvironmentSpec:
    """The environment called ``name``.

    Raises:
        UsageError: no environment has this name.
    """
    if name not in ENVIRONMENTS:
        raise UsageError(f"unknown environment {name!r}", suggest(name, ENVIRONMENTS))
    return ENVIRONMENTS[name]
