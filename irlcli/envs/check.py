"""Whether an environment does what its description says: ``irl envs check``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import check_env

from irlcli.envs.adapted import Adapted, prints_aside
from irlcli.envs.declared_symmetries import symmetries
from irlcli.envs.registration import make
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
    """The smallest and the largest value of a knob, in its usual form."""
    match knob.forms[0]:
        case "triple":
            return [Value("triple", (x, x, x)) for x in (knob.low, knob.high)]
        case "range":
            return [Value("range", (knob.low, knob.high))]
        case form:
            return [Value(form, (x,)) for x in (knob.low, knob.high)]


def _episode(spec: EnvironmentSpec, setting: Setting) -> list[np.ndarray]:
    """An episode of random actions: observations [T + 1, D] and rewards [T]."""
    with closing(make(spec.name, setting)) as world:
        actions = np.random.default_rng(_SEED)
        world.action_space.seed(int(actions.integers(2**31)))
        observation, _ = world.reset(seed=_SEED)
        observations, rewards = [observation], []
        for _ in range(min(spec.max_episode_steps, _MOST_STEPS)):
            observation, reward, terminated, truncated, _ = world.step(world.action_space.sample())
            observations.append(observation)
            rewards.append(reward)
            if terminated or truncated:
                break
        return [np.stack(observations), np.array(rewards)]


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
    if not _equal(*(_episode(spec, Setting()) for _ in range(2))):
        raise _Wrong("two episodes of the same seed and the same actions differ")


def _check_symmetries(spec: EnvironmentSpec) -> None:
    with closing(make(spec.name, Setting())) as world:
        assert world.observation_space.shape is not None
        actions = gymnasium.spaces.flatdim(world.action_space)
        symmetries(spec.name, [Setting()], world.observation_space.shape[0], actions)


def _check_ends(spec: EnvironmentSpec, ends: Sequence[Setting]) -> None:
    for setting in ends:
        _episode(spec, setting)


def _check_one(spec: EnvironmentSpec, name: str) -> None:
    if not _equal(
        _episode(spec, Setting()), _episode(spec, Setting(((name, Value("multiplier", (1.0,))),)))
    ):
        raise _Wrong(
            "its episodes differ from those without it, with equal seeds and actions: let the constructor "
            "multiply, with a default of 1, or use absolute values"
        )


def _check_moves(spec: EnvironmentSpec, name: str, settings: Sequence[Setting]) -> None:
    episodes = [_episode(spec, setting) for setting in settings]
    sizes = [observations.shape[1] for observations, _ in episodes]
    if len(set(sizes)) > 1 and not spec.knobs[name].observed:
        raise _Wrong(
            f"observations have {sizes[0]} numbers by default and {sizes[-1]} with {settings[-1]}: "
            f"write observed = true in [knobs.{name}], or keep their size"
        )
    if all(_equal(episode, episodes[0]) for episode in episodes):
        raise _Wrong(
            f"episodes of {', '.join(map(str, settings))} are equal, with equal seeds and actions"
        )


def _equal(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
