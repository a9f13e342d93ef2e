"""Training in rounds: a policy learns from a reward source, and a learner from its rollouts.

Experts, retrained policies and adversarial students differ only in what they pass here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np

from irlcli.rl.challengers import Challengers
from irlcli.rl.policy import Policy
from irlcli.rl.ppo import RewardSource
from irlcli.trajectories import Rollout, world_settings

Row = dict[str, Any]
State = dict[str, Any]


class Resumable(Protocol):
    """A part of a training that a checkpoint holds."""

    def state_dict(self) -> State:
        """What a resumed run needs from the end of the last round."""

    def load_state_dict(self, state: State) -> None:
        """Continue from ``state_dict()``."""


class Trainer(Resumable, Protocol):
    """A policy and the algorithm that trains it, one seeded round at a time."""

    @property
    def steps(self) -> int:
        """Environment steps taken so far."""

    @property
    def steps_per_round(self) -> int:
        """Environment steps of one round."""

    @property
    def rounds(self) -> int:
        """Rounds of the whole run."""

    @property
    def policy(self) -> Policy:
        """The current policy; it keeps learning with the trainer."""

    def train_round(self, index: int, source: RewardSource) -> list[Rollout]:
        """Run round ``index`` on the rewards of ``source``, from fresh episodes."""


class Learner(Resumable, Protocol):
    """What learns from the policy's rollouts while the policy learns."""

    def begin(self, trainer: Trainer) -> None:
        """Called once, before the first round."""

    def update(
        self,
        index: int,
        rollouts: Sequence[Rollout],
        policy: Policy,
        challenger_rollouts: Sequence[Rollout],
    ) -> list[dict[str, float]]:
        """Learn from the rollouts of round ``index``; diagnostics, one dict per setting.

        ``challenger_rollouts`` are the rollouts of a challenger, if there is one.
        """


class Selector(Resumable, Protocol):
    """Which round's networks are kept."""

    def consider(self, index: int, policy: Policy) -> dict[str, float]:
        """Note round ``index``; diagnostics that are the same for all settings."""

    def restore(self, policy: Policy) -> None:
        """Put the networks of the chosen round back in place."""


class Training:
    """A training run: its parts, the rounds done, and one row of metrics per round and setting.

    Args:
        trainer: the policy and its algorithm.
        source: the policy's rewards.
        settings: of the worlds, in their order.
        learner: learns from every round's rollouts; none if the reward is fixed.
        selector: chooses the round that is kept; without one it is the last.
        challengers: whose rollouts the learner learns from, too.
        ends: whether training ends before the trainer's last round, by the rows so far.
    """

    def __init__(
        self,
        trainer: Trainer,
        source: RewardSource,
        settings: Sequence[str],
        learner: Learner | None = None,
        selector: Selector | None = None,
        challengers: Challengers | None = None,
        ends: Callable[[Sequence[Row]], bool] = lambda rows: False,
    ):
        self.trainer = trainer
        self.source = source
        self.settings = list(settings)
        self.learner = learner
        self.selector = selector
        self.challengers = challengers
        self._ends = ends
        self.rounds_done = 0
        self.rows: list[Row] = []

    @property
    def policy(self) -> Policy:
        """The current policy; after :meth:`run` the chosen round's."""
        return self.trainer.policy

    @property
    def steps(self) -> int:
        """Environment steps of the policy so far, without those of challengers."""
        return self.trainer.steps

    @property
    def planned_steps(self) -> int:
        """Environment steps of all rounds."""
        return self.steps_until(None)

    def steps_until(self, until: int | None) -> int:
        """Environment steps of the rounds that :meth:`run` needs to reach ``until``."""
        size = self.trainer.steps_per_round
        rounds = self.trainer.rounds if until is None else -(-until // size)
        return min(rounds, self.trainer.rounds) * size

    def run(
        self,
        after_round: Callable[[Training, list[Row]], None],
        warn: Callable[[str], None],
        until: int | None = None,
    ) -> list[Row]:
        """Train to the last round, or to where ``ends`` says so, and return all rows.

        ``after_round`` gets each round's rows. After the round that reaches ``until`` environment
        steps training stops, with the networks of that round; another call continues it.
        """
        if self.learner is not None and self.rounds_done == 0:
            self.learner.begin(self.trainer)
        for index in range(self.rounds_done, self.trainer.rounds):
            # Here, not at the end: a resumed run may have been killed after its last round.
            if self._ends(self.rows):
                break
            if until is not None and self.steps >= until:
                return self.rows
            rollouts = self.trainer.train_round(index, self.source)
            challenger_rollouts = (
                [] if self.challengers is None else self.challengers.train_round(index)
            )
            policy = self.trainer.policy
            diagnostics: list[dict[str, float]] = [{}] * len(self.settings)
            if self.learner is not None:
                diagnostics = self.learner.update(index, rollouts, policy, challenger_rollouts)
            score = {} if self.selector is None else self.selector.consider(index, policy)
            rows = [
                row | of_setting | of_challenger | score
                for row, of_setting, of_challenger in zip(
                    episode_rows(index, self.trainer.steps, rollouts, self.settings),
                    diagnostics,
                    self._of_challenger(index, challenger_rollouts),
                    strict=True,
                )
            ]
            self.rows += rows
            self.rounds_done = index + 1
            for message in (
                *self._errors(index, rollouts, "world"),
                *self._errors(index, challenger_rollouts, "the challenger's world"),
            ):
                warn(message)
            after_round(self, rows)
        if self.selector is not None:
            self.selector.restore(self.trainer.policy)
        return self.rows

    def _of_challenger(self, index: int, challenger_rollouts: Sequence[Rollout]) -> list[Row]:
        """What the challenger of round ``index`` earned in each setting, by the true reward."""
        if not challenger_rollouts:
            return [{} for _ in self.settings]
        return [
            {
                "challenger_return": row["true_return"],
                "challenger_progress": row["progress"],
            }
            for row in episode_rows(index, self.trainer.steps, challenger_rollouts, self.settings)
        ]

    def _errors(self, index: int, rollouts: Sequence[Rollout], whose: str) -> Iterator[str]:
        """The worlds whose episode stopped on an error."""
        for rollout in rollouts:
            settings = world_settings(rollout.terminated.shape[1], len(self.settings))
            for world, error in rollout.errors:
                yield (
                    f"{self.settings[settings[world]]}, {whose} {world}, round {index}: {error}; the "
                    "episode ended there and training continues"
                )

    @property
    def _parts(self) -> dict[str, Resumable]:
        """What a checkpoint holds, by name."""
        parts = {
            "trainer": self.trainer,
            "learner": self.learner,
            "selector": self.selector,
            "challengers": self.challengers,
        }
        return {name: part for name, part in parts.items() if part is not None}

    def state_dict(self) -> State:
        """What a resumed run needs, besides the rows."""
        states = {name: part.state_dict() for name, part in self._parts.items()}
        return states | {"rounds_done": self.rounds_done}

    def load_state_dict(self, state: State, rows: Sequence[Row]) -> None:
        """Continue from ``state_dict()`` and the ``rows`` of that moment."""
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.rounds_done = int(state["rounds_done"])
        self.rows = list(rows)


def episode_rows(
    index: int, steps: int, rollouts: Sequence[Rollout], settings: Sequence[str]
) -> list[Row]:
    """One row per setting: true return and length of the episodes that ended in this round.

    Rounds that are not many times as long as an episode show more short episodes than the policy
    has: long ones are cut at the end. Evaluations do not have this bias. Where no episode ended the
    values are NaN, not zero; so is the progress of an environment that reports none.
    """
    of_world = world_settings(rollouts[0].terminated.shape[1], len(settings))
    rows = []
    for number, setting in enumerate(settings):
        worlds = of_world == number
        ended = np.concatenate([(r.lengths[:, worlds] > 0).ravel() for r in rollouts])

        def mean(field: str, worlds=worlds, ended=ended) -> float:
            values = np.concatenate([getattr(r, field)[:, worlds].ravel() for r in rollouts])[ended]
            return float(values.mean()) if len(values) else float("nan")

        rows.append(
            {
                "round": index,
                "steps": steps,
                "setting": setting,
                "episodes": int(ended.sum()),
                "true_return": mean("returns"),
                "progress": mean("progress"),
                "episode_length": mean("lengths"),
                "terminated": mean("terminated"),
            }
        )
    return rows
