"""An environment from outside the package, as policies and learners here see it.

Observations become vectors [D] float32, continuous actions vectors [A], several indices a vector [K],
and the first discrete action is 0. Mistakes in the environment's own code are reported as such.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from numbers import Real
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete

from irlcli.errors import StageFailed, UsageError, described, first_line, own_line

# The largest that the description of a reward or a policy may hold.
_LARGEST_OBSERVATION = 4096
# Training computes in float32.
_LARGEST_REWARD = float(np.finfo(np.float32).max)


@contextmanager
def prints_aside() -> Iterator[None]:
    """What an environment prints goes to stderr: stdout is the data of commands."""
    with redirect_stdout(sys.stderr):
        yield


class Adapted(gymnasium.Wrapper):
    """``env`` with flat spaces.

    Args:
        env: the environment.
        name: what messages call it.
        limit: the time limit [steps] of its description, which cuts the episodes outside this class;
            None: not known yet.

    Raises:
        UsageError: spaces that no policy here has.
    """

    def __init__(self, env: gymnasium.Env, name: str, limit: int | None = None):
        super().__init__(env)
        self._name = name
        self._limit = limit
        self._steps = 0
        try:
            observations, actions = env.observation_space, env.action_space
        except AttributeError as error:
            raise UsageError(
                f"{name}: {first_line(error)}",
                "every environment has an observation_space and an action_space",
            ) from error
        self.observation_space = _flat_observations(observations, name)
        self.action_space = _flat_actions(actions, name)
        self._actions: Any = actions
        self._last = np.zeros(0, np.float32)

    @prints_aside()
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        try:
            observation, info = self.env.reset(seed=seed, options=options)
        except (Exception, SystemExit) as error:
            raise self._failed("reset", error) from error
        self._last = self._seen(observation, "reset")
        self._steps = 0
        return self._last.copy(), info

    @prints_aside()
    def step(self, action: Any) -> Any:
        try:
            found = self.env.step(self._taken(action))
        except (Exception, SystemExit) as error:
            raise self._failed("step", error) from error
        if not isinstance(found, tuple) or len(found) != 5:
            what = f"{len(found)} values" if isinstance(found, tuple) else type(found).__name__
            raise self._wrong(
                "step", f"returned {what}, not (observation, reward, terminated, truncated, info)"
            )
        observation, reward, terminated, truncated, info = found
        info = self._reported(info)
        try:
            reward = float(reward)
        except (TypeError, ValueError) as error:
            raise self._wrong(
                "step", f"returned the reward {reward!r}: it must be a number"
            ) from error
        if not abs(reward) <= _LARGEST_REWARD:
            if info["error"] is None:
                what = f"returned the reward {reward}: it must be finite in float32"
                raise self._wrong("step", what)
            reward = 0.0
        terminated, truncated = (
            self._flag("terminated", terminated),
            self._flag("truncated", truncated),
        )
        self._steps += 1
        if truncated and not terminated and info["error"] is None:
            self._check_limit()
        truncated = truncated or info["error"] is not None
        # A simulation that failed has no next state: the last one stands for it.
        failed = None if info["error"] is None else self._last
        self._last = self._seen(observation, "step", failed)
        return self._last.copy(), reward, terminated, truncated, info

    @prints_aside()
    def close(self) -> None:
        try:
            self.env.close()
        except (Exception, SystemExit) as error:
            raise self._failed("close", error) from error

    def _taken(self, action: Any) -> Any:
        """``action`` as the environment takes it: of its type, within its bounds, and a copy."""
        space = self._actions
        if isinstance(space, Discrete):
            return action + space.start
        action = np.asarray(action, space.dtype).reshape(space.shape)
        if isinstance(space, MultiDiscrete):
            return action + space.start
        return np.clip(action, space.low, space.high)

    def _seen(self, observation: Any, method: str, instead: np.ndarray | None = None) -> np.ndarray:
        try:
            # A copy: the environment may return one array in every step.
            flat = np.array(observation, dtype=np.float32).reshape(-1)
        except (TypeError, ValueError) as error:
            raise self._wrong(method, "returned an observation that is no array") from error
        if flat.shape != self.observation_space.shape:
            raise self._wrong(
                method,
                f"returned an observation of size {flat.size}, but its space has size "
                f"{(self.observation_space.shape or ())[0]}",
            )
        if np.isfinite(flat).all():
            return flat
        if instead is None:
            raise self._wrong(method, "returned an observation that is not finite")
        return instead

    def _check_limit(self) -> None:
        """Refuse another time limit than the description's: the learners rely on that one."""
        if self._limit is not None and self._steps < self._limit:
            raise UsageError(
                f"{self._name}: step() truncated an episode after {self._steps} of {self._limit} steps",
                f"set max_episode_steps = {self._steps} in [env] if that is its time limit, or return "
                "terminated = True where an episode ends for another reason",
            )

    def _flag(self, name: str, value: Any) -> bool:
        if np.size(value) != 1 or value not in (0, 1):
            raise self._wrong("step", f"returned a {name} that is not true or false")
        return bool(value)

    def _reported(self, info: Any) -> dict[str, Any]:
        """``info`` with a finite number as progress, if any, and text as error, if any."""
        if not isinstance(info, dict):
            raise self._wrong("step", "returned an info that is no dictionary")
        progress, error = info.get("progress", 0.0), info.get("error")
        if not (isinstance(progress, Real) and math.isfinite(progress)):
            raise self._wrong("step", 'returned an info["progress"] that is not a finite number')
        none = error is None or (np.size(error) <= 1 and not error)
        text = None if none else str(error) or "unknown error"
        found = info | {"error": text}
        return found | {"progress": float(progress)} if "progress" in info else found

    def _failed(self, method: str, error: BaseException) -> StageFailed:
        line = own_line(error)
        return self._wrong(method, f"raised {described(error)}{f' ({line})' if line else ''}")

    def _wrong(self, method: str, what: str) -> StageFailed:
        return StageFailed(
            f"{self._name}: {method}() {what}",
            "the environment's own code does this; `irl envs check` tests it",
        )


def first_index(world: gymnasium.Env) -> int | np.ndarray:
    """What the environment itself calls index 0 of an action: a number, or [K] of several indices."""
    start = getattr(world.env.action_space, "start", 0) if isinstance(world, Adapted) else 0
    return start.reshape(-1) if isinstance(start, np.ndarray) else int(start)


def counted_from(space: gymnasium.Space, start: int | np.ndarray) -> gymnasium.Space:
    """``space`` with indices that begin at ``start``, as :func:`first_index` gives it."""
    if isinstance(space, Discrete):
        return Discrete(int(space.n), start=int(start))
    if isinstance(space, MultiDiscrete):
        return MultiDiscrete(space.nvec, start=np.broadcast_to(start, space.nvec.shape))
    return space


def _flat_observations(space: gymnasium.Space, name: str) -> Box:
    if not isinstance(space, Box):
        raise UsageError(
            f"{name} has observations in {type(space).__name__}, but only Box is supported",
            "wrap the environment in gymnasium.wrappers.FlattenObservation",
        )
    size = math.prod(space.shape)
    if not 1 <= size <= _LARGEST_OBSERVATION:
        raise UsageError(
            f"{name} has observations of {size} numbers",
            f"policies and rewards here take 1 to {_LARGEST_OBSERVATION}",
        )
    return Box(space.low.reshape(-1).astype(np.float32), space.high.reshape(-1).astype(np.float32))


def _flat_actions(space: gymnasium.Space, name: str) -> Box | Discrete | MultiDiscrete:
    if isinstance(space, Discrete):
        return Discrete(int(space.n))
    if isinstance(space, MultiDiscrete):
        return MultiDiscrete(space.nvec.reshape(-1).astype(np.int64))
    if not isinstance(space, Box):
        raise UsageError(
            f"{name} has actions in {type(space).__name__}, but only Box, Discrete and "
            "MultiDiscrete are supported",
            "wrap the environment so that its actions are one of these",
        )
    if space.dtype.kind != "f":
        raise UsageError(
            f"{name} has actions in a Box of {space.dtype}, but only a Box of floats is supported",
            "use MultiDiscrete for whole numbers",
        )
    low, high = (b.reshape(-1).astype(np.float32) for b in (space.low, space.high))
    if not low.size or not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise UsageError(
            f"{name} has actions without finite bounds",
            "bound them, for example with gymnasium.wrappers.RescaleAction",
        )
    return Box(low, high)
