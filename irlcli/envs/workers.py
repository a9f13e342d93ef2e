"""Environments stepped together by worker processes, with automatic resets.

Every worker steps its own share of the worlds as :class:`irlcli.envs.vector.VectorWorlds`
does; observations, actions and rewards cross in shared memory, only the episodes that ended
cross in messages. A world never sees another, so results do not depend on the number of
workers. The worlds are dealt out like cards: those of one setting, which cost the same, stand
side by side.

A message is one byte, which is all that most steps need ("step"; "done, no episode ended"), or
the byte that says so and a pickle.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawArray
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from irlcli.envs.vector import Ended, VectorWorlds
from irlcli.errors import StageFailed

_CLOSE_SECONDS = 5.0
# What a pipe raises whose other end is gone.
_CLOSED = (EOFError, BrokenPipeError, ConnectionResetError)
_PLAIN, _PICKLED = b"0", b"1"


class WorkerFailed(StageFailed):
    """A worker process died, or an environment in it raised an error (exit 1)."""

    def __init__(self, message: str):
        super().__init__(message, "run the same command again to go on")


class _Channel(NamedTuple):
    """One end of a pair of pipes. ``None`` is the message that costs nothing."""

    incoming: Connection
    outgoing: Connection

    def send(self, message: Any) -> None:
        os.write(self.outgoing.fileno(), _PLAIN if message is None else _PICKLED)
        if message is not None:
            self.outgoing.send(message)

    def receive(self) -> Any:
        byte = os.read(self.incoming.fileno(), 1)
        if not byte:
            raise EOFError
        return self.incoming.recv() if byte == _PICKLED else None

    def close(self) -> None:
        self.incoming.close()
        self.outgoing.close()


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
    channel: _Channel,
    factories: Sequence[Callable[[], gymnasium.Env]],
    max_episode_steps: int,
    worker: int,
    workers: int,
    shared: _Shared,
) -> None:
    """A worker's life: serve requests until told to stop or until the parent is gone.

    The parent's end of the pipe closes with the parent however it ends, so waiting for a
    request is also watching for the parent's death.
    """
    # Ctrl-C reaches the whole foreground group; what it means is the parent's decision.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    worlds: VectorWorlds | None = None
    actions, observations, rewards = (view[worker::workers] for view in shared.views())
    try:
        worlds = VectorWorlds([factory() for factory in factories], max_episode_steps)
        while True:
            seeds = channel.receive()
            ended: list[Ended] = []
            if seeds is None:
                observations[:], rewards[:], ended = worlds.step(actions)
            else:
                observations[:] = worlds.reset(seeds)
            ended = [replace(end, world=worker + workers * end.world) for end in ended]
            channel.send(ended or None)
    except _CLOSED:
        pass
    except Exception as error:
        channel.send(f"{type(error).__name__}: {error}")
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
        # A spawned process inherits no pipe end of its siblings, which would hide a death.
        context = multiprocessing.get_context("spawn")
        self._channels: list[_Channel] = []
        self._processes: list[multiprocessing.process.BaseProcess] = []
        for worker in range(workers):
            (requests, ask), (answers, answer) = context.Pipe(False), context.Pipe(False)
            theirs = _Channel(requests, answer)
            share = factories[worker::workers]
            process = context.Process(
                target=_work,
                args=(theirs, share, max_episode_steps, worker, workers, shared),
                daemon=True,
            )
            process.start()
            theirs.close()
            self._channels.append(_Channel(answers, ask))
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
        workers = len(self._channels)
        shares = [[int(seed) for seed in seeds[worker::workers]] for worker in range(workers)]
        self._ask(shares)
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
        ended = self._ask([None] * len(self._channels))
        return self._observations.copy(), self._rewards.copy(), ended

    def close(self) -> None:
        """End every worker; closing twice does nothing."""
        for channel in self._channels:
            channel.close()
        for process in self._processes:
            process.join(_CLOSE_SECONDS)
            if process.is_alive():
                process.kill()
                process.join()
        self._channels = []
        self._processes = []

    def _ask(self, requests: Sequence[list[int] | None]) -> list[Ended]:
        """Send one request to each worker and gather the episodes that ended, by world."""
        if not self._channels:
            raise WorkerFailed("the workers are closed")
        ended: list[Ended] = []
        worker = 0
        try:
            for worker, request in enumerate(requests):
                self._channels[worker].send(request)
            for worker, channel in enumerate(self._channels):
                answer = channel.receive()
                if isinstance(answer, str):
                    raise WorkerFailed(f"{self._name(worker)}: {answer}")
                ended += answer or []
        except BaseException as error:
            # An answer left unread would be taken for that of the next request.
            failure = self._died(worker) if isinstance(error, _CLOSED) else error
            self.close()
            raise failure from None
        return sorted(ended, key=lambda end: end.world)

    def _died(self, worker: int) -> WorkerFailed:
        process = self._processes[worker]
        process.join(_CLOSE_SECONDS)
        code = process.exitcode
        cause = f"signal {-code}" if code is not None and code < 0 else f"exit status {code}"
        return WorkerFailed(f"{self._name(worker)} died: {cause}")

    def _name(self, worker: int) -> str:
        worlds = list(range(worker, self._size, len(self._channels)))
        return f"worker {worker} ({'world' if len(worlds) == 1 else 'worlds'} {str(worlds)[1:-1]})"
