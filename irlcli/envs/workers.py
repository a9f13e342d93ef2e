"""Environments stepped together by worker processes, with automatic resets.

Each worker steps its share of the environments as :class:`irlcli.envs.vector.VectorWorlds` does.
Observations, actions and rewards pass through shared memory; only ended episodes are sent as
messages. The environments are independent, so results do not depend on the number of workers.

Worker k of n gets environments k, k + n, k + 2n, and so on. Environments of one setting are
neighbours and cost the same, so this balances the load.
"""

from __future__ import annotations

import atexit
import multiprocessing
import signal
import sys
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from irlcli.envs.vector import Ended, VectorWorlds
from irlcli.errors import IrlError, StageFailed, described

_CLOSE_SECONDS = 5.0
# Raised by a pipe whose other end is closed.
_CLOSED = (EOFError, BrokenPipeError, ConnectionResetError)


class WorkerFailed(StageFailed):
    """A worker process died, or an environment in it raised an error (exit 1)."""

    def __init__(self, message: str, hint: str = ""):
        super().__init__(message, hint or "run the same command again to resume")


class _InWorker(Exception):
    """The traceback of an error in a worker, the cause of a :class:`WorkerFailed`."""


class _Failure(NamedTuple):
    """An error in a worker, its hint and its traceback."""

    message: str
    hint: str
    traceback: str


@dataclass(frozen=True)
class _Shared:
    """The arrays in shared memory; their first axis is the environment."""

    actions: Any
    observations: Any
    rewards: Any
    action_shape: tuple[int, ...]
    observation_shape: tuple[int, ...]
    action_dtype: np.dtype

    def views(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Actions, observations [N, D] float32 and rewards [N] float64 as numpy arrays."""
        return (
            np.frombuffer(self.actions, dtype=self.action_dtype).reshape(self.action_shape),
            np.frombuffer(self.observations, dtype=np.float32).reshape(self.observation_shape),
            np.frombuffer(self.rewards, dtype=np.float64),
        )


@contextmanager
def _without_script() -> Iterator[None]:
    """A process started here does not run the user's script again, whose stage would wait for us."""
    main = vars(sys.modules["__main__"])
    known: dict[str, Any] = {n: main[n] for n in ("__file__", "__spec__") if n in main}
    main.update(dict.fromkeys(known))
    try:
        yield
    finally:
        main.update(known)


def _work(
    connection: Connection,
    factories: Sequence[Callable[[], gymnasium.Env]],
    max_episode_steps: int,
    worker: int,
    workers: int,
    shared: _Shared,
) -> None:
    """Serve requests until the parent closes its end of the pipe.

    The operating system closes that end when the parent ends for any reason, so no worker
    outlives its parent.
    """
    # Ctrl-C, `timeout` and schedulers signal the whole process group; the parent decides how to
    # react, and a worker ends when its pipe does.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR2):
        signal.signal(number, signal.SIG_IGN)
    actions, observations, rewards = (view[worker::workers] for view in shared.views())
    try:
        made = VectorWorlds([factory() for factory in factories], max_episode_steps)
        with closing(made) as worlds:
            while True:
                seeds = connection.recv()
                ended: list[Ended] = []
                if seeds is None:
                    # A copy: an environment may keep its last action.
                    observations[:], rewards[:], ended = worlds.step(actions.copy())
                else:
                    observations[:] = worlds.reset(seeds)
                connection.send([replace(end, world=worker + workers * end.world) for end in ended])
    except _CLOSED:
        pass
    except Exception as error:
        message, hint = described(error), ""
        if isinstance(error, IrlError):
            message, hint = error.message, error.hint
        # If another worker failed in the same step, the parent has closed the pipe.
        with suppress(*_CLOSED):
            connection.send(_Failure(message, hint, f"\n{traceback.format_exc()}"))


def _close(worlds: weakref.ref[WorkerWorlds]) -> None:
    alive = worlds()
    if alive is not None:
        alive.close()


class WorkerWorlds:
    """N environments distributed over worker processes, with the interface of ``VectorWorlds``.

    Args:
        factories: N >= 1 picklable functions, each of which makes one environment. All environments have
            equal observation and action spaces.
        max_episode_steps: time limit after which an episode is truncated.
        workers: number of processes, in [1, N].
    """

    def __init__(
        self,
        factories: Sequence[Callable[[], gymnasium.Env]],
        max_episode_steps: int,
        workers: int,
    ):
        sample = factories[0]()
        self.observation_space = sample.observation_space
        self.action_space = sample.action_space
        sample.close()
        self._size = len(factories)
        action_shape = (self._size, *(self.action_space.shape or ()))
        observation_shape = (self._size, *(self.observation_space.shape or ()))
        # Environments compute in their action's type, so it is the one that policies return.
        continuous = isinstance(self.action_space, gymnasium.spaces.Box)
        action_dtype = np.dtype(self.action_space.dtype if continuous else np.int64)
        shared = _Shared(
            RawArray("b", int(np.prod(action_shape)) * action_dtype.itemsize),
            RawArray("f", int(np.prod(observation_shape))),
            RawArray("d", self._size),
            action_shape,
            observation_shape,
            action_dtype,
        )
        self._actions, self._observations, self._rewards = shared.views()
        # A forked process would inherit its siblings' pipe ends and keep them open, which would
        # hide the death of a worker or of the parent.
        context = multiprocessing.get_context("spawn")
        self._connections: list[Connection] = []
        self._processes: list[multiprocessing.process.BaseProcess] = []
        for worker in range(workers):
            ours, theirs = context.Pipe()
            share = factories[worker::workers]
            process = context.Process(
                target=_work,
                args=(theirs, share, max_episode_steps, worker, workers, shared),
                daemon=True,
            )
            with _without_script():
                process.start()
            theirs.close()
            self._connections.append(ours)
            self._processes.append(process)
        # At exit, multiprocessing sends SIGTERM to its children and waits for them. These ignore it,
        # so their pipes must be closed before. What is registered last runs first.
        atexit.register(_close, weakref.ref(self))

    def __len__(self) -> int:
        return self._size

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Start an episode in every environment, and return observations [N, D] float32.

        Raises:
            WorkerFailed: a worker died, or an environment raised an error. All workers are ended.
        """
        workers = len(self._connections)
        shares = [[int(seed) for seed in seeds[worker::workers]] for worker in range(workers)]
        self._ask(shares)
        return self._observations.copy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[Ended]]:
        """Advance every environment by one action of ``actions`` [N], [N, K] or [N, A].

        Returns observations [N, D] float32, true rewards [N] float64, and the episodes that
        ended. Where an episode ended, the observation is the first one of the next episode.

        Raises:
            WorkerFailed: a worker died, or an environment raised an error. All workers are ended.
        """
        self._actions[:] = actions
        ended = self._ask([None] * len(self._connections))
        return self._observations.copy(), self._rewards.copy(), ended

    def close(self) -> None:
        """End every worker; a second call does nothing."""
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
        """Send each worker its seeds, or None to step; return the ended episodes in order of world."""
        if not self._connections:
            raise WorkerFailed("the workers are closed")
        ended: list[Ended] = []
        worker = 0
        try:
            for worker, request in enumerate(requests):
                self._connections[worker].send(request)
            for worker, connection in enumerate(self._connections):
                answer = connection.recv()
                if isinstance(answer, _Failure):
                    raise self._failed(worker, answer)
                ended += answer
        except BaseException as error:
            # An unread answer would be mistaken for the answer to the next request.
            failure = self._why_closed(worker) if isinstance(error, _CLOSED) else error
            self.close()
            raise failure from failure.__cause__
        return sorted(ended, key=lambda end: end.world)

    def _failed(self, worker: int, failure: _Failure) -> WorkerFailed:
        found = WorkerFailed(f"{self._name(worker)}: {failure.message}", failure.hint)
        found.__cause__ = _InWorker(failure.traceback)
        return found

    def _why_closed(self, worker: int) -> WorkerFailed:
        # A worker that failed before it was asked has left its reason.
        with suppress(*_CLOSED):
            answer = self._connections[worker].recv()
            if isinstance(answer, _Failure):
                return self._failed(worker, answer)
        process = self._processes[worker]
        process.join(_CLOSE_SECONDS)
        code = process.exitcode
        cause = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
        return WorkerFailed(f"{self._name(worker)} died: {cause}")

    def _name(self, worker: int) -> str:
        worlds = list(range(worker, self._size, len(self._connections)))
        return f"worker {worker} ({'world' if len(worlds) == 1 else 'worlds'} {str(worlds)[1:-1]})"
