"""All environments by name. Importing this module does not import any environment.

A name is that of a built-in environment, of one described by a TOML file, or of one that an
installed package announces in the entry-point group ``irlcli.environments``.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from irlcli.envs.ant.spec import SPEC as ANT
from irlcli.envs.gridworld.spec import SPEC as GRIDWORLD
from irlcli.envs.half_cheetah.spec import SPEC as HALF_CHEETAH
from irlcli.envs.lunar_lander.spec import SPEC as LUNAR_LANDER
from irlcli.envs.mujoco.spec import MUJOCO_ROBOTS
from irlcli.envs.reacher.spec import SPEC as REACHER
from irlcli.envs.spec import EnvironmentSpec
from irlcli.errors import UsageError, suggest

ENVIRONMENTS: dict[str, EnvironmentSpec] = {
    spec.name: spec
    for spec in (LUNAR_LANDER, ANT, HALF_CHEETAH, REACHER, *MUJOCO_ROBOTS, GRIDWORLD)
}
# Environments from outside the package that this process knows.
_KNOWN: dict[str, EnvironmentSpec] = {}


def environment(name: str) -> EnvironmentSpec:
    """The environment called ``name``.

    Names may come from untrusted files, so a name is never read as a path.

    Raises:
        UsageError: no environment has this name.
        NotFound: the module of an announced environment cannot be imported.
    """
    if name in ENVIRONMENTS:
        return ENVIRONMENTS[name]
    if name in _KNOWN:
        return _KNOWN[name]
    from irlcli.envs.announced import announced, read_announced

    spec = read_announced(name)
    if spec is not None:
        return introduce(spec)
    hint = suggest(name, [*ENVIRONMENTS, *_KNOWN, *announced()])
    file = "or give a TOML file"
    if name.endswith(".toml"):
        file = "in Python, irlcli.envs.registry.resolve(FILE).name is the name of the file's environment"
    raise UsageError(f"unknown environment {name!r}", f"{hint}; {file}")


def resolve(ref: str) -> EnvironmentSpec:
    """The environment that a user means by ``ref``: its name, or a TOML file that describes it.

    A file is read anew each time; from then on its environment's name is known.

    Raises:
        UsageError: no environment has this name; or the file is malformed.
        NotFound: there is no such file, or the environment's module cannot be imported.
    """
    if not ref.endswith(".toml"):
        try:
            return environment(ref)
        except UsageError as error:
            file = f"{ref}.toml"
            if os.path.isfile(file):
                raise UsageError(error.message, f"did you mean the file {file}?") from None
            raise
    from irlcli.envs.own import read_environment

    return introduce(read_environment(Path(ref)))


def introduce(spec: EnvironmentSpec) -> EnvironmentSpec:
    """Let the name of an environment from outside the package stand for ``spec`` from now on."""
    _KNOWN[spec.name] = spec
    return spec


def is_known(name: str) -> bool:
    """Whether an environment of this name is built in or was introduced."""
    return name in ENVIRONMENTS or name in _KNOWN


def forget() -> None:
    """Forget every environment that was introduced."""
    _KNOWN.clear()


@contextmanager
def apart() -> Iterator[None]:
    """Begin without the environments that were introduced; afterwards they have their names again.

    Each call from Python takes an environment from the file or the artefact that it names, as a
    command does.
    """
    before = dict(_KNOWN)
    forget()
    try:
        yield
    finally:
        _KNOWN.update(before)
