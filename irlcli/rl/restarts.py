"""Several trainings from different random weights, of which the one with the highest score is kept."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch

from irlcli.rl.loop import Row, State, Training
from irlcli.rl.policy import Policy


class Restarts:
    """A run of several :class:`~irlcli.rl.loop.Training`, one after the other.

    Args:
        begin: the training of a restart, by its index, from random weights.
        count: of restarts.
        score: of a trained policy; higher is better.

    Attributes:
        scores: of the restarts that are done.
    """

    def __init__(
        self, begin: Callable[[int], Training], count: int, score: Callable[[Policy], float]
    ):
        self._begin = begin
        self._count = count
        self._score = score
        self._past: list[Row] = []
        self._best: dict[str, Any] = {}
        self.scores: list[float] = []
        self._index = 0
        self._training = begin(0)

    def _start(self, index: int) -> None:
        self._index = index
        # Before the next one takes its memory.
        del self._training
        self._training = self._begin(index)

    @property
    def rows(self) -> list[Row]:
        """The rows of all restarts so far, each with the index of its ``restart``."""
        return self._past + self._numbered(self._training.rows)

    @property
    def policy(self) -> Policy:
        """The current restart's; after :meth:`run` the best."""
        return self._training.policy

    @property
    def steps(self) -> int:
        """Environment steps taken so far."""
        return self._index * self._training.planned_steps + self._training.steps

    @property
    def planned_steps(self) -> int:
        """Environment steps of all restarts."""
        return self._count * self._training.planned_steps

    def run(
        self,
        after_round: Callable[[Restarts, list[Row]], None],
        warn: Callable[[str], None],
    ) -> list[Row]:
        """Train to the end of the last restart and put the weights of the best one in place.

        Returns:
            All rows; ``kept`` says whether they are of the best restart.
        """
        for index in range(self._index, self._count):
            if index > self._index:
                self._past = self.rows
                self._start(index)
            self._training.run(lambda _, rows: after_round(self, self._numbered(rows)), warn)
            score = self._score(self.policy)
            # The first of equals.
            if not self.scores or score > max(self.scores):
                self._best = copy.deepcopy(self.policy.state_dict())
            self.scores.append(score)
        self.policy.load_state_dict(self._best)
        best = self.scores.index(max(self.scores))
        return [row | {"kept": row["restart"] == best} for row in self.rows]

    def _numbered(self, rows: Sequence[Row]) -> list[Row]:
        return [{"restart": self._index} | row for row in rows]

    def state_dict(self) -> State:
        """What a resumed run needs, besides the rows."""
        return {
            "scores": torch.tensor(self.scores, dtype=torch.float64),
            "best": self._best,
            "training": self._training.state_dict(),
        }

    def load_state_dict(self, state: State, rows: Sequence[Row]) -> None:
        """Continue from ``state_dict()`` and the ``rows`` of that moment."""
        self.scores = state["scores"].tolist()
        self._best = state["best"]
        self._start(len(self.scores))
        self._past = [row for row in rows if row["restart"] < self._index]
        own = [row for row in rows if row["restart"] == self._index]
        without = [{name: v for name, v in row.items() if name != "restart"} for row in own]
        self._training.load_state_dict(state["training"], without)
