"""Registration of the environments with gymnasium, and their construction from a setting.

Gymnasium 1 has no plugin entry points. Import this module to register the environments; then
``gymnasium.make("irlcli/LunarLander-v0", bounce=0.5)`` works.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pkgutil import resolve_name
from typing import Any

import gymnasium
import numpy as np

from irlcli.envs.adapted import Adapted, prints_aside
from irlcli.envs.code import code_of
from irlcli.envs.cue import CueWorld
from irlcli.envs.own import check_code, module_of
from irlcli.envs.registry import ENVIRONMENTS, environment
from irlcli.envs.spec import Code, Cue, EnvironmentSpec, Own
from irlcli.errors import (
    IrlError,
    StageFailed,
    UsageError,
    described,
    first_line,
    imported,
    own_line,
)
from irlcli.interventions import Setting, cue_in, env_kwargs, without_cue

# What this process imported, as it was then: Python imports a module once.
_imported: dict[tuple[str, tuple[str, ...]], Code] = {}


def register() -> None:
    """Register every environment with gymnasium; a second call changes nothing."""
    for spec in ENVIRONMENTS.values():
        if spec.gym_id not in gymnasium.registry:
            gymnasium.register(
                spec.gym_id,
                entry_point=spec.entry_point,
                max_episode_steps=spec.max_episode_steps,
            )


def make(env: str, setting: Setting, render_mode: str | None = None) -> gymnasium.Env:
    """Make the environment of one setting, without gymnasium's own wrappers and time limit.

    Raises:
        UsageError: the environment is unknown, does not have one of the interventions, or refuses
            its arguments.
    """
    return factory(env, setting)(render_mode=render_mode)


def factory(env: str, setting: Setting) -> Callable[..., gymnasium.Env]:
    """What makes the environment of one setting, as :func:`make` does, also in other processes.

    Raises:
        UsageError: the environment is unknown, or does not have one of the interventions.
    """
    spec, plain = environment(env), without_cue(env, setting)
    world = partial(build, spec, env_kwargs(env, plain), str(setting))
    cue = cue_in(env, setting)
    return world if cue is None else partial(_with_cue, world, *cue)


def _with_cue(
    world: Callable[..., gymnasium.Env], cue: Cue, strength: float, render_mode: str | None = None
) -> CueWorld:
    return CueWorld(world(render_mode=render_mode), cue, strength)


def build(
    spec: EnvironmentSpec,
    arguments: dict[str, Any],
    setting: str = "default",
    render_mode: str | None = None,
) -> gymnasium.Env:
    """Make the environment ``spec`` with ``arguments``.

    Raises:
        UsageError: as :func:`make`, or spaces that no policy here has.
        StageFailed: a library is missing, or the environment's code changed since it was planned or
            imported.
    """
    if render_mode is not None:
        arguments = arguments | {"render_mode": render_mode}
    if spec.own is None:
        _require(spec)
        # Environments that were added since this module was imported.
        register()
        imported(f"environment {spec.name!r}", spec.entry_point)
        return gymnasium.make(spec.gym_id, **arguments).unwrapped
    inner = _own(spec, spec.own, arguments, f"{spec.name} {setting}")
    world = Adapted(inner, spec.name, spec.max_episode_steps)
    discrete = not isinstance(world.action_space, gymnasium.spaces.Box)
    if discrete != spec.discrete_actions:
        found = "discrete" if discrete else "continuous"
        raise UsageError(
            f"{spec.own.source}: the actions of {spec.name} are {found}, not as env.actions says",
            f'write actions = "{found}" in [env], or omit it',
        )
    return world


def _require(spec: EnvironmentSpec) -> None:
    """Import the library that ``spec`` needs.

    Raises:
        StageFailed: it is missing or broken.
    """
    if spec.needs is None:
        return
    try:
        import_module(spec.needs.module)
    except ModuleNotFoundError:
        raise StageFailed(
            f"{spec.name} needs {spec.needs.name}, which is not installed", spec.needs.hint
        ) from None
    except Exception as error:
        # With MUJOCO_GL=osmesa, MuJoCo raises an AttributeError where OSMesa is missing.
        raise StageFailed(
            f"{spec.name} needs {spec.needs.name}, which cannot be imported: {first_line(error)[:300]}",
            "check its installation and its environment variables; --debug shows where it fails",
        ) from error


def observed_of(spec: EnvironmentSpec) -> tuple[int | None, bool]:
    """The time limit [steps] that an environment registered, if any; whether actions are discrete.

    Raises:
        UsageError, StageFailed: as :func:`build`.
    """
    assert spec.own is not None
    world = Adapted(_own(spec, spec.own, {}, spec.name), spec.name)
    world.close()
    # The id may lack a version, which Gymnasium then chooses.
    made = world.unwrapped.spec
    steps = None if made is None else gymnasium.spec(made.id).max_episode_steps
    return steps, not isinstance(world.action_space, gymnasium.spaces.Box)


@prints_aside()
def _own(spec: EnvironmentSpec, own: Own, arguments: dict[str, Any], where: str) -> gymnasium.Env:
    """An environment from outside the package, with the wrappers that its registration asks for."""
    keywords = own.arguments | arguments
    try:
        _import(spec, own)
        if own.id is not None:
            # The time limit of the TOML file holds, not that of the registration.
            return gymnasium.make(
                own.id, max_episode_steps=-1, disable_env_checker=True, **keywords
            )
        module, _, name = spec.entry_point.partition(":")
        kind = getattr(import_module(module), name, None)
        if not (isinstance(kind, type) and issubclass(kind, gymnasium.Env)):
            raise UsageError(
                f"{own.source}: {spec.entry_point!r} is not a class derived from gymnasium.Env",
                "name such a class, or register a function with gymnasium and name its id",
            )
        return kind(**keywords)
    except IrlError:
        raise
    except (gymnasium.error.UnregisteredEnv, gymnasium.error.DeprecatedEnv) as error:
        raise UsageError(
            f"{own.source}: env.id: {first_line(error)[:300]}",
            "name a registered id, with its version as in Hopper-v5",
        ) from error
    except (Exception, SystemExit) as error:
        if "render_mode" in arguments and "render_mode" in str(error):
            raise UsageError(
                f"{where} draws no pictures: its constructor refuses render_mode='rgb_array'",
                'irl play needs an environment whose metadata lists the render mode "rgb_array"',
            ) from error
        named = dict.fromkeys(keywords, "env.arguments")
        named |= {k.argument: f"knobs.{name}.argument" for name, k in spec.knobs.items()}
        given = ", ".join(f"{name}={value!r} ({named[name]})" for name, value in keywords.items())
        raise UsageError(
            f"{where} cannot be made{f' with {given}' if given else ''}: {described(error)[:300]}",
            "the environment's own code refuses this; --debug shows where",
        ) from error


def _import(spec: EnvironmentSpec, own: Own) -> None:
    """Import the module of an environment, once, if it is the code that was planned with.

    A description from an artefact of others must not make code run that it does not know.
    """
    module = module_of(own.id, spec.entry_point)
    # Two environments may share a module and read different files.
    alone, with_files = (module, ()), (module, own.files)
    if with_files not in _imported:
        check_code(spec)
        try:
            import_module(module)
        except (Exception, SystemExit) as error:
            line = own_line(error)
            raise UsageError(
                f"{own.source}: {module} cannot be imported: {described(error)[:300]}"
                f"{f' ({line})' if line else ''}",
                "correct the module, or install what it imports",
            ) from error
        _imported[with_files] = code_of(module, own.files, own.directory, own.source)
        now = code_of(module, (), own.directory, own.source)
        if _imported.setdefault(alone, now) != now:
            del _imported[with_files]
    if _imported.get(with_files) != own.code:
        raise StageFailed(
            f"{own.source}: {module} changed since this process imported it",
            "run the same command again; in a notebook, restart Python",
        )


register()


def transition_reward(env: str) -> Callable[..., np.ndarray] | None:
    """The true reward [B] as a function of (s, a, s'); None where it depends on more than that."""
    name = environment(env).transition_reward
    if name is None:
        return None
    return resolve_name(name)
