"""Whether an environment does what its description says: ``irl envs check``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from itertools import zip_longest
from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from irlcli.envs.adapted import Adapted, prints_aside
from irlcli.envs.declared_symmetries import symmetries
from irlcli.envs.registration import make
from irlcli.envs.spaces import check_spaces
from irlcli.envs.spec import EnvironmentSpec, Knob
from irlcli.errors import IrlError, UsageError, first_line
from irlcli.interventions import Setting, Value

_MOST_STEPS = 200
# Of every episode.
_SEED = 0


class Found(NamedTuple):
    """The outcome of one check: what was checked, what is wrong (empty if nothing), and notes."""

    what: str
    wrong: str
    notes: tuple[str, ...] = ()


class _Wrong(Exception):
    """A check failed."""


def check(spec: EnvironmentSpec, listed: Mapping[str, Sequence[Setting]]) -> Iterator[Found]:
    """Every check of ``spec``, in order.

    If the environment cannot be made, the others are skipped; if a knob's bounds cannot be made, the
    others of this knob are.

    Args:
        spec: a known environment.
        listed: settings of each knob, by the knob's name, that its settings file lists.
    """
    made = _outcome("it can be made", partial(_episode, spec, Setting()))
    yield made
    if made.wrong:
        return
    yield _outcome("gymnasium's check_env", partial(_check_env, spec))
    yield _outcome("equal seeds give equal episodes", partial(_check_seeds, spec))
    if spec.symmetries is not None:
        yield _outcome("its symmetries", partial(_check_symmetries, spec))
    for name, knob in spec.knobs.items():
        ends = [Setting(((name, value),)) for value in _ends(knob)]
        bounds = _outcome(f"{name}: its bounds can be made", partial(_check_ends, spec, ends))
        yield bounds
        if bounds.wrong:
            continue
        if "multiplier" in knob.forms and knob.low <= 1 <= knob.high:
            yield _outcome(f"{name}: 1x is the default", partial(_check_one, spec, name))
        settings = [Setting(), *listed.get(name, ()), *ends]
        yield _outcome(f"{name}: it changes episodes", partial(_check_moves, spec, name, settings))


def _outcome(what: str, run: Callable[[], object]) -> Found:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            run()
            wrong = ""
        except UsageError as error:
            wrong = f"{error.message}; {error.hint}"
        except (_Wrong, IrlError) as error:
            wrong = first_line(error)
    own = [w.message for w in caught if isinstance(w.message, UserWarning)]
    return Found(what, wrong, tuple(dict.fromkeys(map(_plain, own))))


def _plain(message: BaseException) -> str:
    """The first line of an error or a warning, without gymnasium's colours."""
    line = first_line(message).replace("\x1b[33m", "").replace("\x1b[0m", "")
    return line.removeprefix("WARN: ")


def _ends(knob: Knob) -> list[Value]:
    """The smallest and the largest value of a knob, in each of its forms."""
    found: list[Value] = []
    for form in knob.forms:
        match form:
            case "triple":
                found += [Value("triple", (x, x, x)) for x in (knob.low, knob.high)]
            case "range":
                found.append(Value("range", (knob.low, knob.high)))
            case _:
                found += [Value(form, (x,)) for x in (knob.low, knob.high)]
    return found


def _episode(spec: EnvironmentSpec, setting: Setting) -> np.ndarray:
    """An episode of random actions in a world of its own, see :func:`_moves`."""
    with closing(make(spec.name, setting)) as world:
        return np.stack([*_moves(spec, world)])


def _moves(spec: EnvironmentSpec, world: gymnasium.Env, seed: int = _SEED) -> Iterator[np.ndarray]:
    """An episode of random actions: each step's observation and reward [D + 1]."""
    world.action_space.seed(int(np.random.default_rng(seed).integers(2**31)))
    observation, _ = world.reset(seed=seed)
    yield np.array([*observation, 0.0])
    for _ in range(min(spec.max_episode_steps, _MOST_STEPS)):
        observation, reward, terminated, truncated, _ = world.step(world.action_space.sample())
        yield np.array([*observation, reward])
        if terminated or truncated:
            return


def _together(spec: EnvironmentSpec, settings: Sequence[Setting]) -> list[np.ndarray]:
    """An episode of each setting, in worlds that are made first and then stepped in turn."""
    with ExitStack() as stack:
        worlds = [stack.enter_context(closing(make(spec.name, each))) for each in settings]
        steps = list(zip_longest(*(_moves(spec, world) for world in worlds)))
    return [np.stack([step for step in of if step is not None]) for of in zip(*steps, strict=True)]


@prints_aside()
def _check_env(spec: EnvironmentSpec) -> None:
    with closing(make(spec.name, Setting())) as world:
        # As its author wrote it: without the flat spaces, and without gymnasium's own wrappers.
        inner = world.env if isinstance(world, Adapted) else world
        while isinstance(inner, gymnasium.wrappers.OrderEnforcing):
            inner = inner.env
        try:
            check_env(inner, skip_render_check=True)
        except (Exception, SystemExit) as error:
            # It asserts, and an environment can raise anything.
            raise _Wrong(_plain(error)) from error


def _check_seeds(spec: EnvironmentSpec) -> None:
    with closing(make(spec.name, Setting())) as world:
        first, _, again = (np.stack([*_moves(spec, world, s)]) for s in (_SEED, _SEED + 1, _SEED))
    for what, other in (("", _episode(spec, Setting())), (", the second after others", again)):
        if not np.array_equal(first, other):
            raise _Wrong(f"two episodes of the same seed and the same actions differ{what}")


def _check_symmetries(spec: EnvironmentSpec) -> None:
    with closing(make(spec.name, Setting())) as world:
        assert world.observation_space.shape is not None
        actions = gymnasium.spaces.flatdim(world.action_space)
        symmetries(spec.name, [Setting()], world.observation_space.shape[0], actions)


def _check_ends(spec: EnvironmentSpec, ends: Sequence[Setting]) -> None:
    for setting in ends:
        _episode(spec, setting)


def _check_one(spec: EnvironmentSpec, name: str) -> None:
    written = Setting(((name, Value("multiplier", (1.0,))),))
    if not np.array_equal(_episode(spec, Setting()), _episode(spec, written)):
        raise _Wrong(
            "its episodes differ from those without it, with equal seeds and actions: let the constructor "
            "multiply, with a default of 1, or use absolute values"
        )


def _check_moves(spec: EnvironmentSpec, name: str, settings: Sequence[Setting]) -> None:
    # With an observed knob, the default is not used beside the others.
    compared = slice(1, None) if spec.knobs[name].observed else slice(None)
    check_spaces(spec.name, settings[compared])
    episodes = [_episode(spec, setting) for setting in settings]
    for setting, alone, beside in zip(settings, episodes, _together(spec, settings), strict=True):
        if not np.array_equal(alone, beside):
            raise _Wrong(
                f"an episode of {setting} differs when worlds of other settings exist, with equal seeds "
                "and actions: keep what a setting changes in the environment, not in its module or class"
            )
    first, *others = episodes[compared]
    if all(np.array_equal(episode, first) for episode in others):
        shown = ", ".join(map(str, settings[compared]))
        raise _Wrong(f"episodes of {shown} are equal, with equal seeds and actions")
