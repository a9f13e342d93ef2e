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
        until: environment steps after which the restarts are compared. Only the best is trained to
            its end. None: each is trained to its end before.

    Attributes:
        scores: of the restarts that reached the comparison.
    """

    def __init__(
        self,
        begin: Callable[[int], Training],
        count: int,
        score: Callable[[Policy], float],
        until: int | None = None,
    ):
        self._begin = begin
        self._count = count
        self._score = score
        self._until = until
        self._others: list[Row] = []
        self._best: dict[str, Any] = {}
        self.scores: list[float] = []
        self._index = 0
        self._training = begin(0)

    @property
    def rows(self) -> list[Row]:
        """The rows of all restarts so far, each with the index of its ``restart``."""
        rows = self._others + self._numbered(self._training.rows)
        return sorted(rows, key=lambda row: row["restart"])

    @property
    def policy(self) -> Policy:
        """The current restart's; after :meth:`run` the best."""
        return self._training.policy

    @property
    def steps(self) -> int:
        """Environment steps taken so far."""
        others = min(len(self.scores), self._count - 1)
        return others * self._training.steps_until(self._until) + self._training.steps

    @property
    def planned_steps(self) -> int:
        """Environment steps of all restarts."""
        others = self._count - 1
        return others * self._training.steps_until(self._until) + self._training.planned_steps

    def run(
        self,
        after_round: Callable[[Restarts, list[Row]], None],
        warn: Callable[[str], None],
    ) -> list[Row]:
        """Train and compare all restarts, then train the best one to its end.

        Returns:
            All rows; ``kept`` says whether they are of the best restart.
        """

        def report(_: Training, rows: list[Row]) -> None:
            after_round(self, self._numbered(rows))

        while len(self.scores) < self._count:
            self._training.run(report, warn, self._until)
            score = self._score(self.policy)
            rows = self.rows
            if not self.scores or score > max(self.scores):
                self._best = copy.deepcopy(self._training.state_dict())
            self.scores.append(score)
            if len(self.scores) < self._count:
                self._start(len(self.scores), rows)
            else:
                self._start(self.scores.index(max(self.scores)), rows, self._best)
                self._best = {}
        self._training.run(report, warn)
        return [row | {"kept": row["restart"] == self._index} for row in self.rows]

    def _start(self, index: int, rows: Sequence[Row], state: State | None = None) -> None:
        """Begin restart ``index``, or continue it from ``state`` and its own of ``rows``."""
        self._index = index
        # Before the next one takes its memory.
        del self._training
        self._training = self._begin(index)
        self._others = [row for row in rows if row["restart"] != index]
        if state is not None:
            own = [row for row in rows if row["restart"] == index]
            self._training.load_state_dict(state, [_without_restart(row) for row in own])

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
        compared = len(self.scores) == self._count
        index = self.scores.index(max(self.scores)) if compared else len(self.scores)
        self._start(index, rows, state["training"])


def _without_restart(row: Row) -> Row:
    return {name: value for name, value in row.items() if name != "restart"}
