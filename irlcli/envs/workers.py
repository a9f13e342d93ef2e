"""Environments stepped together by worker processes, with automatic resets.

Every worker steps its own share of the worlds as :class:`irlcli.envs.vector.VectorWorlds`
does; observations, actions and rewards cross in shared memory, only the episodes that ended
cross in messages. A world never sees another, so results do not depend on the number of
workers.
"""

from __future__ import annotations

import itertools
import multiprocessing
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any

import gymnasium
import numpy as np

from irlcli.envs.vector import Ended, VectorWorlds

_CLOSE_SECONDS = 5.0


class WorkerFailed(RuntimeError):
    """A worker process died, or an environment in it raised an error."""


@dataclass(frozen=True)
class _Shared:
    """The arrays that all processes see; worlds first."""

    actions: Any
    observations: Any
    rewards: Any
    action_shape: tuple[int, ...]
    observation_shape: tuple[int, ...]
    discrete: bool

    def views(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Actions, observations [N, D] float32 and rewards [N] float64 as numpy arrays."""
        dtype = np.int64 if self.discrete else np.float64
        return (
            np.frombuffer(self.actions, dtype=dtype).reshape(self.action_shape),
            np.frombuffer(self.observations, dtype=np.float32).reshape(self.observation_shape),
            np.frombuffer(self.rewards, dtype=np.float64),
        )


def _work(
    connection: Connection,
    factories: Sequence[Callable[[], gymnasium.Env]],
    max_episode_steps: int,
    first: int,
    shared: _Shared,
) -> None:
    """A worker's life: serve requests until told to stop or until the parent is gone.

    The parent's end of the pipe closes with the parent however it ends, so waiting for a
    request is also watching for the parent's death.
    """
    # Ctrl-C reaches the whole foreground group; what it means is the parent's decision.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    worlds: VectorWorlds | None = None
    last = first + len(factories)
    actions, observations, rewards = (view[first:last] for view in shared.views())
    try:
        worlds = VectorWorlds([factory() for factory in factories], max_episode_steps)
        while True:
            seeds = connection.recv()
            if seeds is None:
                ended: list[Ended] = []
                observations[:], rewards[:], ended = worlds.step(actions)
                connection.send([replace(end, world=first + end.world) for end in ended])
            else:
                observations[:] = worlds.reset(seeds)
                connection.send([])
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass
    except Exception as error:
        connection.send(f"{type(error).__name__}: {error}")
    finally:
        if worlds is not None:
            worlds.close()


class WorkerWorlds:
    """N environments shared out among worker processes; steps like ``VectorWorlds``.

    Args:
        factories: one picklable function per world that makes its environment; all of equal
            observation and action spaces.
        max_episode_steps: time limit after which an episode is truncated.
        workers: number of processes, at most one per world.

    Raises:
        ValueError: no factory, or a number of workers outside [1, N].
    """

    def __init__(
        self,
        factories: Sequence[Callable[[], gymnasium.Env]],
        max_episode_steps: int,
        workers: int = 2,
    ):
        if not factories:
            raise ValueError("at least one environment is needed")
        if not 1 <= workers <= len(factories):
            raise ValueError(f"workers must lie in [1, {len(factories)}], not {workers}")
        sample = factories[0]()
        self.observation_space = sample.observation_space
        self.action_space = sample.action_space
        sample.close()
        self.max_episode_steps = max_episode_steps
        self._size = len(factories)
        action_shape = (self._size, *self.action_space.shape)
        observation_shape = (self._size, *self.observation_space.shape)
        shared = _Shared(
            RawArray("d", int(np.prod(action_shape))),
            RawArray("f", int(np.prod(observation_shape))),
            RawArray("d", self._size),
            action_shape,
            observation_shape,
            isinstance(self.action_space, gymnasium.spaces.Discrete),
        )
        self._actions, self._observations, self._rewards = shared.views()
        bounds = [self._size * worker // workers for worker in range(workers + 1)]
        self._shares = list(itertools.pairwise(bounds))
        # A spawned process inherits no pipe end of its siblings, which would hide a death.
        context = multiprocessing.get_context("spawn")
        self._connections: list[Connection] = []
        self._processes: list[multiprocessing.process.BaseProcess] = []
        for first, last in self._shares:
            ours, theirs = context.Pipe()
            process = context.Process(
                target=_work,
                args=(theirs, factories[first:last], max_episode_steps, first, shared),
                daemon=True,
            )
            process.start()
            theirs.close()
            self._connections.append(ours)
            self._processes.append(process)

    def __len__(self) -> int:
        return self._size

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start a fresh episode in every environment; observations [N, D] float32.

        Raises:
            ValueError: another number of seeds than of environments.
            WorkerFailed: a worker died, or an environment raised an error; all are closed.
        """
        if len(seeds) != self._size:
            raise ValueError(f"{self._size} seeds are needed, not {len(seeds)}")
        self._ask([[int(seed) for seed in seeds[first:last]] for first, last in self._shares])
        return self._observations.copy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Ended]]:
        """Advance every environment by one action of ``actions`` [N] or [N, A].

        Returns observations [N, D] (already those of the next episode where one ended), true
        rewards [N] float64, and the episodes that ended.

        Raises:
            ValueError: actions of another shape, or not finite.
            WorkerFailed: a worker died, or an environment raised an error; all are closed.
        """
        actions = np.asarray(actions)
        if actions.shape != self._actions.shape:
            raise ValueError(f"actions must have shape {self._actions.shape}, not {actions.shape}")
        if not np.isfinite(actions).all():
            raise ValueError("actions must be finite")
        self._actions[:] = actions
        ended = self._ask([None] * len(self._shares))
        return self._observations.copy(), self._rewards.copy(), ended

    def close(self) -> None:
        """End every worker; closing twice does nothing."""
        for connection in self._connections:
            connection.close()
        for process in self._processes:
            process.join(_CLOSE_SECONDS)
            if process.is_alive():
                process.kill()
                process.join()
        self._connections = []
        self._processes = []

    def _ask(self, requests: Sequence[list[int] | None]) -> list[Ended]:
        """Send one request to each worker and gather the episodes that ended."""
        if not self._connections:
            raise WorkerFailed("the workers are closed")
        ended: list[Ended] = []
        try:
            for worker, request in enumerate(requests):
                self._exchange(worker, lambda connection, r=request: connection.send(r))
            for worker in range(len(requests)):
                answer = self._exchange(worker, lambda connection: connection.recv())
                if isinstance(answer, str):
                    raise WorkerFailed(f"worker {worker} ({self._worlds(worker)}): {answer}")
                ended.extend(answer)
        except BaseException:
            # An answer left unread would be taken for that of the next request.
            self.close()
            raise
        return ended

    def _exchange(self, worker: int, exchange: Callable[[Connection], Any]) -> Any:
        try:
            return exchange(self._connections[worker])
        except (EOFError, BrokenPipeError, ConnectionResetError):
            process = self._processes[worker]
            process.join(_CLOSE_SECONDS)
            code = process.exitcode
            cause = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
            raise WorkerFailed(f"worker {worker} ({self._worlds(worker)}) died: {cause}") from None

    def _worlds(self, worker: int) -> str:
        first, last = self._shares[worker]
        return f"world {first}" if last == first + 1 else f"worlds {first} to {last - 1}"
