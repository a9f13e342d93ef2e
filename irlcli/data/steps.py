"""A stream of recorded steps, checked on its way into a dataset.

Any number of steps passes through in pieces of bounded size, so neither import nor export holds a
dataset in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain, pairwise
from typing import Any

import numpy as np

from irlcli.errors import UsageError
from irlcli.trajectories import ActionSpace

# Steps in a piece: a row group of what is written.
PIECE = 1 << 16


@dataclass(frozen=True, eq=False)
class Steps:
    """B consecutive steps, episode after episode. The first and the last episode may be partial.

    Attributes:
        first: [B] bool, the step begins an episode.
        settings: [B] int64, index of the episode's setting.
        observations: [B, D] float32.
        actions: [B] or [B, K] int64, or [B, A] float32.
        rewards: [B] float64, the true reward; None if it is unknown.
        next_observations: [B, D] float32.
        terminated, truncated: [B] bool, the episode ends with this step.
        seeds: [B] int64, what the environment was reset with; -1 if that is unknown.
        place: where in its source a step of this piece stands, for messages.
    """

    first: np.ndarray
    settings: np.ndarray
    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray | None
    next_observations: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    seeds: np.ndarray
    place: Callable[[int], str]

    def __len__(self) -> int:
        return len(self.first)

    def take(self, rows: np.ndarray | slice) -> Steps:
        """The steps at ``rows``. Their places are lost."""
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "place"}
        taken: dict[str, Any] = {
            name: None if column is None else column[rows] for name, column in columns.items()
        }
        return Steps(**taken, place=nowhere)

    def times(self, before: int) -> np.ndarray:
        """t [B] of each step in its episode, of which ``before`` steps come before the first row."""
        rows = np.arange(len(self))
        start = np.maximum.accumulate(np.where(self.first, rows, -1))
        return np.where(start >= 0, rows - start, rows + before)

    @property
    def ended(self) -> np.ndarray:
        """[B] bool, whether the episode ends with this step."""
        return self.terminated | self.truncated

    def episode_numbers(self, before: int) -> np.ndarray:
        """The number [B] of each step's episode, of which ``before`` ended before the first row."""
        return before + np.searchsorted(np.flatnonzero(self.ended), np.arange(len(self)))


def mixed_rewards() -> UsageError:
    """Steps of sources with rewards beside steps of sources without."""
    return UsageError(
        "some sources have a true reward and others have none", "give all of them a reward, or none"
    )


def nowhere(_: int) -> str:
    """The place of steps that were checked already."""
    return "a step"


def joined(pieces: Sequence[Steps]) -> Steps:
    """The steps of all ``pieces``, one after the other.

    Raises:
        UsageError: some have rewards and others have none.
    """
    if len(pieces) == 1:
        return pieces[0]
    if len({piece.rewards is None for piece in pieces}) > 1:
        raise mixed_rewards()
    columns = {
        column.name: np.concatenate([getattr(piece, column.name) for piece in pieces])
        for column in fields(Steps)
        if column.name not in ("rewards", "place")
    }
    rewards = [piece.rewards for piece in pieces if piece.rewards is not None]
    return Steps(**columns, rewards=np.concatenate(rewards) if rewards else None, place=nowhere)


def pieces(parts: Iterable[Steps], size: int) -> Iterator[Steps]:
    """``parts`` divided anew into pieces of ``size`` steps and a last one that may be smaller.

    What is written then does not depend on how its source was divided.
    """
    waiting: list[Steps] = []
    count = 0
    for part in parts:
        waiting.append(part)
        count += len(part)
        if count < size:
            continue
        whole, begin = joined(waiting), 0
        for begin in range(0, count - size + 1, size):
            yield whole.take(slice(begin, begin + size))
        count -= begin + size
        waiting = [whole.take(slice(begin + size, None))] if count else []
    if waiting:
        yield joined(waiting)


def episodes(parts: Iterable[Steps]) -> Iterator[Steps]:
    """``parts``, which hold whole episodes, divided anew into one piece per episode."""
    waiting: list[Steps] = []
    for part in parts:
        begin = 0
        for end in np.flatnonzero(part.ended).tolist():
            yield joined([*waiting, part.take(slice(begin, end + 1))])
            waiting, begin = [], end + 1
        if begin < len(part):
            waiting.append(part.take(slice(begin, None)))


def shifted(parts: Iterable[Steps], start: int | np.ndarray) -> Iterator[Steps]:
    """``parts`` with actions whose first index is ``start``, where it was 0."""
    for part in parts:
        yield replace(part, actions=part.actions + start) if np.any(start) else part


@dataclass
class Irregular:
    """Episodes that are not whole, and how many were cut or left out.

    Attributes:
        cut: cut an episode at the horizon, count one without an end as truncated, and leave an
            empty one out. Otherwise each of them is refused.
        terminated: episodes that are terminated.
        terminated_at_limit: whole episodes that are terminated in their last possible step.
    """

    cut: bool
    long: int = 0
    unended: int = 0
    empty: int = 0
    terminated: int = 0
    terminated_at_limit: int = 0

    def found_empty(self, place: str) -> None:
        """An episode without steps.

        Raises:
            UsageError: it is not to be left out.
        """
        if not self.cut:
            raise UsageError(f"{place} has no steps", "--cut leaves empty episodes out")
        self.empty += 1


@dataclass
class Check:
    """Lets whole, finite episodes through that fit an environment.

    Attributes:
        horizon: time limit of the environment [steps].
        observation_size: D.
        actions: the environment's actions.
        where: environment and settings, for messages.
        irregular: what to do with episodes that are not whole.
        start: the first index of an action in ``parts``, [K] of several; 0 in what is let through.
    """

    horizon: int
    observation_size: int
    actions: ActionSpace
    where: str
    irregular: Irregular
    start: int | np.ndarray = 0
    _t: int = 0
    _ended: bool = True
    _setting: int = -1
    _seed: int = -1
    _next: np.ndarray = field(default_factory=lambda: np.empty(0, np.float32))

    def __call__(self, parts: Iterable[Steps]) -> Iterator[Steps]:
        """``parts`` with exactly one flag at the end of every episode.

        Raises:
            UsageError: naming the first step that cannot be used, and why.
        """
        closed: Iterator[Steps | None] = chain(parts, [None])
        for part, following in pairwise(closed):
            assert part is not None
            checked = self._checked(part, following is None or bool(following.first[0]))
            # A part beyond the time limit is empty now.
            if len(checked):
                yield checked

    def _checked(self, steps: Steps, complete: bool) -> Steps:
        """``steps``; ``complete`` if the last one is the last of its episode."""
        self._check_shapes(steps)
        if self.actions.discrete:
            steps = replace(steps, actions=steps.actions - self.start)
        self._check_numbers(steps)
        self._check_order(steps)
        t = steps.times(self._t)
        last = np.append(steps.first[1:], complete)
        ended = steps.ended
        long = t >= self.horizon
        unended = last & ~ended & (t < self.horizon - 1)
        if not self.irregular.cut:
            _refuse(
                steps,
                long,
                f"the episode has more than {self.horizon} steps, the time limit of {self.where}",
                "--cut cuts longer episodes there",
            )
            _refuse(
                steps,
                unended,
                "the episode stops here, neither terminated nor truncated",
                "--cut counts such an episode as truncated",
            )
        # At the horizon the time limit truncates, whether the source says so or not.
        at_limit = (t == self.horizon - 1) & ~ended
        self.irregular.long += int((at_limit & ~last).sum())
        self.irregular.unended += int(unended.sum())
        self.irregular.terminated += int((steps.terminated & ~long).sum())
        self.irregular.terminated_at_limit += int(
            (steps.terminated & (t == self.horizon - 1)).sum()
        )
        self._t = int(t[-1]) + 1
        self._ended, self._setting = bool(ended[-1]), int(steps.settings[-1])
        self._seed = int(steps.seeds[-1])
        self._next = steps.next_observations[-1]
        whole = replace(
            steps,
            truncated=(steps.truncated & ~steps.terminated) | at_limit | unended,
        )
        return whole.take(~long) if long.any() else whole

    def _check_shapes(self, steps: Steps) -> None:
        for name, array in (("obs", steps.observations), ("next_obs", steps.next_observations)):
            if array.shape != (len(steps), self.observation_size):
                raise UsageError(
                    f"{steps.place(0)}: {name} has {_numbers(array)}, but observations of "
                    f"{self.where} have {self.observation_size}",
                    "check --env and the settings: a goal is part of the observation",
                )
        found, wanted = steps.actions, self.actions
        fits = found.shape == (len(steps), *wanted.shape)
        if wanted.discrete:
            several = f"{len(wanted.choices)} " if wanted.choices else ""
            last = _listed(self.start + wanted.last)
            listed = f"{several}whole numbers from {_listed(self.start)} to {last}"
        else:
            listed = f"vectors of {wanted.size}"
        fits = fits and (found.dtype == np.int64) == wanted.discrete
        if not fits:
            kind = "whole" if found.dtype == np.int64 else "real"
            raise UsageError(
                f"{steps.place(0)}: action is of {kind} numbers, {_numbers(found)}, but actions of "
                f"{self.where} are {listed}",
                "check --env",
            )
        if wanted.discrete:
            outside = wanted.outside(found, self.start)
            bad = np.any(np.reshape(outside, (len(steps), -1)), axis=1)
            _refuse(steps, bad, f"action is not one of the {listed}", "check --env")

    def _check_numbers(self, steps: Steps) -> None:
        largest = float(np.finfo(np.float32).max)
        for name, array in (
            ("obs", steps.observations),
            ("next_obs", steps.next_observations),
            ("action", steps.actions),
            ("reward", steps.rewards),
        ):
            if array is None or array.dtype == np.int64:
                continue
            # Two numbers tell whether any is too large, or NaN.
            if not -largest <= array.min() <= array.max() <= largest:
                bad = ~(np.abs(array) <= largest).reshape(len(array), -1).all(1)
                _refuse(steps, bad, f"{name} is not finite", "numbers must be finite in float32")

    def _check_order(self, steps: Steps) -> None:
        goes_on = ~steps.first
        ended = np.append(self._ended, steps.ended[:-1])
        _refuse(
            steps,
            goes_on & ended,
            "the episode has steps after its end",
            "a terminated or truncated step is the last of its episode",
        )
        settings = np.append(self._setting, steps.settings[:-1])
        _refuse(
            steps,
            goes_on & (settings != steps.settings),
            "the setting changes within an episode",
            "each episode is of one setting",
        )
        seeds = np.append(self._seed, steps.seeds[:-1])
        _refuse(
            steps,
            goes_on & (seeds != steps.seeds),
            "the seed changes within an episode",
            "every step of an episode has the seed of its reset",
        )
        differs = goes_on.copy()
        differs[1:] &= (steps.next_observations[:-1] != steps.observations[1:]).any(1)
        differs[0] &= len(self._next) > 0 and bool((self._next != steps.observations[0]).any())
        _refuse(
            steps,
            differs,
            "obs differs from next_obs of the step before",
            "the steps of an episode must stand in the order in which they were made",
        )


def _listed(numbers: int | np.ndarray) -> str:
    return ", ".join(map(str, np.atleast_1d(numbers)))


def _numbers(array: np.ndarray) -> str:
    """What a row of ``array`` holds, in words."""
    return "1 number" if array.ndim == 1 else f"{array.shape[1]} numbers"


def _refuse(steps: Steps, bad: np.ndarray, message: str, hint: str) -> None:
    """Refuse the first step that is ``bad`` [B]."""
    if bad.any():
        raise UsageError(f"{steps.place(int(bad.argmax()))}: {message}", hint)
