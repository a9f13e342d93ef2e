"""The clock and the checks of a run, the same for every method. Both environments import this module.

CPU seconds are user and system time of the run's process from the start of training, without the
checks. Imports, reading the demonstrations and building worlds and networks come before. PyTorch has
one thread, and no method starts other processes.

A check is 10 whole episodes in each setting, in worlds of its own. Actions are the policy's modes:
that is how stable-baselines3 and the tutorials of imitation measure, and it draws no random number
of the training. The k-th check begins in the same states for every method and seed.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from irlcli.envs.registration import factory
from irlcli.envs.registry import environment
from irlcli.interventions import parse_setting
from irlcli.seeds import derive

# Fields of a run that name files of this machine.
_PATHS = ("file", "demos", "dataset")
EPISODES = 10
# A run is checked at the first end of a round after each multiple of so many steps.
EVERY = 25_000
GOALS = (0.8, 0.9)
_LIBRARIES = ("torch", "stable-baselines3", "gymnasium", "numpy", "Box2D", "pybullet", "imitation")

# Observations [N, D] -> actions [N] or [N, A].
Act = Callable[[np.ndarray], np.ndarray]


class Ended(Exception):
    """The run has ended and is recorded."""


def first_kept(shares: Sequence[float], goal: float) -> int | None:
    """The first check at which a run has ``goal`` and keeps it at the next one; None if none.

    A single check can be lucky. The second one, of other episodes, confirms the first, which counts.
    """
    for k in range(len(shares) - 1):
        if shares[k] >= goal and shares[k + 1] >= goal:
            return k
    return None


def share(returns: Sequence[float], targets: Sequence[float]) -> float:
    """The mean over the settings of the return divided by the expert's."""
    return sum(r / t for r, t in zip(returns, targets, strict=True)) / len(targets)


class Checks:
    """Checks a run, records it in a file, and ends it.

    Args:
        run: ``row``, ``settings``, ``targets`` (the experts' true returns), ``limit`` (CPU seconds)
            and ``file``, which appears when the run has ended.
    """

    def __init__(self, run: dict[str, Any]):
        self._run = run
        env = run["row"].split(".")[0]
        self._horizon = environment(env).max_episode_steps
        self._worlds = [
            [factory(env, parse_setting(env, text))() for _ in range(EPISODES)]
            for text in run["settings"]
        ]
        self._path = Path(run["file"])
        # An unfinished run begins again, in a file of its own.
        self._part = self._path.with_suffix(f".{os.getpid()}.part")
        self._parent = os.getppid()
        self._shares: list[float] = []
        self._due = EVERY
        versions = {name: _version(name) for name in _LIBRARIES}
        # The record is kept in the repository.
        about = {name: value for name, value in run.items() if name not in _PATHS}
        self._write({**about, "versions": versions})
        self._origin = time.process_time()

    def begin(self) -> None:
        """Start the clock."""
        self._origin = time.process_time()

    def after(self, steps: int, act: Act) -> None:
        """Called at the end of every round, after ``steps`` environment steps.

        Raises:
            Ended: the run has earned every goal, or is at its limit.
        """
        if os.getppid() != self._parent:
            raise SystemExit("the benchmark was killed")
        if steps < self._due:
            return
        self._due = (steps // EVERY + 1) * EVERY
        cpu = time.process_time() - self._origin
        returns = [self._true_return(worlds, act) for worlds in self._worlds]
        self._shares.append(share(returns, self._run["targets"]))
        self._write({"cpu_seconds": cpu, "steps": steps, "returns": returns})
        if first_kept(self._shares, max(GOALS)) is not None:
            self.end("goal")
        if cpu >= self._run["limit"]:
            self.end("limit")
        # What the check took does not count.
        self._origin = time.process_time() - cpu

    def end(self, why: str) -> NoReturn:
        """Record the end: ``goal``, ``limit``, or ``budget`` if its steps are used up.

        Raises:
            Ended: always.
        """
        self._write({"end": why})
        os.replace(self._part, self._path)
        raise Ended

    def _true_return(self, worlds: Sequence[Any], act: Act) -> float:
        seeds = derive("peers check", 0, len(self._shares), len(worlds))
        current = [w.reset(seed=s)[0] for w, s in zip(worlds, seeds, strict=True)]
        active, total = list(range(len(worlds))), 0.0
        for _ in range(self._horizon):
            actions = act(np.stack([current[i] for i in active]).astype(np.float32))
            running = []
            for i, action in zip(active, actions, strict=True):
                current[i], reward, terminated, truncated, _ = worlds[i].step(action)
                total += float(reward)
                if not (terminated or truncated):
                    running.append(i)
            active = running
            if not active:
                break
        return total / len(worlds)

    def _write(self, line: dict[str, Any]) -> None:
        with self._part.open("a") as file:
            file.write(json.dumps(line) + "\n")


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None
