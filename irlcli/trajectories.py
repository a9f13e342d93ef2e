"""Trajectories: frozen, validated, plain arrays. Time-indexed as s_0, a_0, r_0, s_1, ..., s_T."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of T >= 1 steps.

    Attributes:
        observations: [T + 1, D] float32, the final one included.
        actions: [T] or [T, K] int64, or [T, A] float32, as the policy sampled them.
        rewards: [T] float64, the true reward; NaN throughout if it is unknown.
        terminated: the environment ended the episode; its value afterwards is zero.
        truncated: a time limit ended it; its value afterwards is not zero.
        seed: what the environment was reset with; -1 if that is unknown.
        progress: sum of the environment's progress; NaN if it reports none or was not kept.
        error: the error on which the episode stopped, if any.

    Raises:
        ValueError: shapes, types or flags that do not fit, or numbers that are not finite.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool
    truncated: bool
    seed: int
    progress: float = math.nan
    error: str | None = None

    def __post_init__(self) -> None:
        steps = len(self.rewards)
        if steps < 1:
            raise ValueError("a trajectory needs at least one step")
        if self.observations.ndim != 2 or len(self.observations) != steps + 1:
            raise ValueError(
                f"{steps} rewards need observations [{steps + 1}, D], "
                f"not {list(self.observations.shape)}"
            )
        if len(self.actions) != steps or self.actions.ndim not in (1, 2):
            raise ValueError(
                f"{steps} rewards need {steps} actions, not {list(self.actions.shape)}"
            )
        if self.observations.dtype != np.float32 or self.rewards.dtype != np.float64:
            raise ValueError("observations are float32 and rewards float64")
        if self.actions.dtype not in (np.dtype(np.int64), np.dtype(np.float32)):
            raise ValueError(f"actions are int64 or float32, not {self.actions.dtype}")
        if self.terminated == self.truncated:
            raise ValueError("a whole episode is either terminated or truncated")
        for name in ("observations", "actions", "rewards"):
            array = getattr(self, name)
            unknown = name == "rewards" and np.isnan(array).all()
            if not (unknown or np.isfinite(array).all()):
                raise ValueError(f"{name} are not finite")
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def episode_return(self) -> float:
        """Undiscounted true return; NaN if the true reward is unknown."""
        return float(self.rewards.sum())


def counted(episodes: Sequence[Trajectory]) -> Sequence[Trajectory]:
    """Those of a policy's ``episodes`` over which its means are taken.

    An episode that an error stopped lacks the rewards of its other steps. Where these are negative it
    would look like a success, so it counts only if an error stopped all of them.
    """
    return [episode for episode in episodes if episode.error is None] or episodes


def unstopped(groups: Iterable[Sequence[Trajectory]], limit: int) -> list[int]:
    """The numbers k whose episode no error stopped in any of ``groups``, policies that are paired by k.

    All numbers of a policy whose episodes were all stopped are kept, as in :func:`counted`. Episodes
    read from a file hold no error; only an error truncates one before the time ``limit`` [steps].
    """
    stopped: set[int] = set()
    every: set[int] = set()
    for group in groups:
        here = {k for k, t in enumerate(group) if t.truncated and len(t) < limit}
        stopped |= here if len(here) < len(group) else set()
        every |= set(range(len(group)))
    return sorted(every - stopped) or sorted(every)


@dataclass(frozen=True, eq=False)
class Transitions:
    """B transitions (s, a, s'), stacked over episodes.

    Attributes:
        observations: [B, D] float32.
        actions: [B] or [B, K] int64, or [B, A] float32.
        next_observations: [B, D] float32.
        terminated: [B] bool; false where a time limit ended the episode.
        remaining: [B] int64, steps that were left of the horizon after a terminated step (the
            number of steps the absorbing state stands for), else 0.
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    terminated: np.ndarray
    remaining: np.ndarray

    def __len__(self) -> int:
        return len(self.actions)

    def take(self, rows: np.ndarray) -> Transitions:
        """The transitions at ``rows``."""
        return Transitions(*(getattr(self, f.name)[rows] for f in fields(self)))


def transitions(trajectories: Sequence[Trajectory], horizon: int) -> Transitions:
    """All transitions of ``trajectories``; ``horizon`` is the environment's time limit [steps].

    Raises:
        ValueError: no trajectory, or one longer than the horizon.
    """
    if not trajectories:
        raise ValueError("at least one trajectory is needed")
    longest = max(len(t) for t in trajectories)
    if longest > horizon:
        raise ValueError(f"a trajectory of {longest} steps exceeds the horizon of {horizon}")
    last = np.concatenate([np.arange(len(t)) == len(t) - 1 for t in trajectories])
    ends = np.concatenate([np.full(len(t), t.terminated) for t in trajectories]) & last
    lengths = np.concatenate([np.full(len(t), len(t)) for t in trajectories])
    return Transitions(
        observations=np.concatenate([t.observations[:-1] for t in trajectories]),
        actions=np.concatenate([t.actions for t in trajectories]),
        next_observations=np.concatenate([t.observations[1:] for t in trajectories]),
        terminated=ends,
        remaining=np.where(ends, horizon - lengths, 0).astype(np.int64),
    )


def join(parts: Sequence[Transitions]) -> Transitions:
    """The transitions of all ``parts``, one after the other."""
    return Transitions(
        *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Transitions))
    )


@dataclass(frozen=True, eq=False)
class Rollout:
    """T steps of N worlds, time first. ``s`` is ``observations``, ``s'`` ``next_observations``.

    A world's setting is its position: equal shares, setting-major (see :func:`world_settings`).

    Attributes:
        observations: [T, N, D] float32.
        actions: [T, N] or [T, N, K] int64, or [T, N, A] float32: the policy's samples. The
            environment clips those outside the action space.
        next_observations: [T, N, D] float32; where an episode ended, its final observation and
            not the first one of the next episode.
        log_probs: [T, N] float32, log pi(a|s) of the sampling policy; NaN from SAC, which trains on
            frozen rewards only.
        true_rewards: [T, N] float64.
        terminated, truncated: [T, N] bool.
        lengths: [T, N] int64, length of the episode that ended here, else 0.
        returns: [T, N] float64, true return of that episode.
        progress: [T, N] float64, progress of that episode; NaN if the environment reports none.
        errors: (world, message) of each episode that had to be ended.
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    log_probs: np.ndarray
    true_rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    lengths: np.ndarray
    returns: np.ndarray
    progress: np.ndarray
    errors: tuple[tuple[int, str], ...]

    def transitions(self, worlds: np.ndarray | slice, horizon: int) -> Transitions:
        """The transitions [T * n] of some of the worlds, time-major."""

        def flat(array: np.ndarray) -> np.ndarray:
            chosen = array[:, worlds]
            return chosen.reshape(-1, *chosen.shape[2:])

        terminated = flat(self.terminated)
        return Transitions(
            observations=flat(self.observations),
            actions=flat(self.actions),
            next_observations=flat(self.next_observations),
            terminated=terminated,
            remaining=np.where(terminated, horizon - flat(self.lengths), 0),
        )


def side_by_side(parts: Sequence[Rollout]) -> Rollout:
    """The rollouts of equally many steps as one, the worlds of the first part first."""
    arrays = {
        f.name: np.concatenate([getattr(part, f.name) for part in parts], axis=1)
        for f in fields(Rollout)
        if f.name != "errors"
    }
    firsts = np.cumsum([0, *(part.terminated.shape[1] for part in parts)]).tolist()
    errors = [
        (first + world, error)
        for first, part in zip(firsts, parts, strict=False)
        for world, error in part.errors
    ]
    return Rollout(**arrays, errors=tuple(errors))


def world_settings(worlds: int, settings: int) -> np.ndarray:
    """Index [worlds] of each world's setting: equal shares, setting-major."""
    return np.arange(worlds) * settings // worlds


class ActionSpace(NamedTuple):
    """The actions of an environment.

    Attributes:
        discrete: whether an action is an index, or several.
        size: length of an action as a vector: A, or the number of choices of all indices.
        low, high: bounds [A] float32 of continuous actions; empty if discrete.
        choices: number of choices of each of several indices; empty if there is one.
    """

    discrete: bool
    size: int
    low: np.ndarray
    high: np.ndarray
    choices: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of an action: (), or (K,) for K indices, or (A,)."""
        if self.discrete:
            return (len(self.choices),) if self.choices else ()
        return (self.size,)

    @property
    def last(self) -> np.ndarray:
        """The largest index [], or [K] of several; indices start at 0."""
        return np.array(self.choices or self.size) - 1

    def outside(self, actions: np.ndarray, start: int | np.ndarray = 0) -> np.ndarray:
        """Which indices among ``actions`` [B] or [B, K] are no choice, if the first is ``start``."""
        return (actions < start) | (actions > start + self.last)
