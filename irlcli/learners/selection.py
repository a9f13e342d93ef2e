"""Which round of adversarial training to keep, by in-distribution data that was held out.

Adversarial training has no loss that falls, so the last round need not be the best one. A round may
be selected by data of the settings trained on, never by the setting that a method is judged in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from irlcli.errors import StageFailed
from irlcli.learners.actions import ActionView, Policy
from irlcli.trajectories import Trajectory, transitions

# One episode in so many is held out, at least one.
HOLD_OUT_ONE_IN = 5


class BestRound:
    """Keeps the policy and the reward of the round with the highest score so far.

    Args:
        score: of a policy; higher is better.
        learner: its reward is kept with the policy (``snapshot``, ``load_snapshot``).
        every: rounds between two scores; the last of ``rounds`` is always scored.
        first: round, before which none is scored: a reward learned without the penalty is not the
            method's.
    """

    def __init__(
        self,
        score: Callable[[Any], float],
        learner: Any,
        every: int,
        rounds: int,
        first: int = 0,
    ):
        self._score = score
        self._learner = learner
        self._every = every
        self._rounds = rounds
        self._first = first
        self.best: dict[str, Any] = {}

    def consider(self, index: int, policy: Any) -> dict[str, float]:
        """The score of round ``index``, NaN where none is due. Of equal rounds the first is kept.

        Raises:
            StageFailed: the score is not a finite number.
        """
        due = index >= self._first and (index + 1) % self._every == 0
        if not due and index + 1 != self._rounds:
            return {"score": float("nan")}
        score = self._score(policy)
        if not math.isfinite(score):
            raise StageFailed(
                f"the score of round {index} is {score}, so no round can be selected",
                "airl.select = last needs no score",
            )
        if not self.best or score > self.best["score"]:
            self.best = {
                "round": index,
                "score": score,
                "policy": {name: t.clone() for name, t in policy.state_dict().items()},
                "reward": self._learner.snapshot(),
            }
        return {"score": score}

    def restore(self, policy: Any) -> None:
        """Put the best round's policy and reward back in place."""
        policy.load_state_dict(self.best["policy"])
        self._learner.load_snapshot(self.best["reward"])

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return self.best

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict()``."""
        self.best = dict(state)


def hold_out(
    episodes: Sequence[Trajectory],
) -> tuple[Sequence[Trajectory], Sequence[Trajectory]]:
    """One setting's episodes to train on, and those that score.

    Raises:
        ValueError: there is a single episode.
    """
    count = max(1, len(episodes) // HOLD_OUT_ONE_IN)
    if len(episodes) <= count:
        raise ValueError("one demonstration: none can be held out")
    return episodes[:-count], episodes[-count:]


def log_likelihood(
    policy: Policy, view: ActionView, held_out: Sequence[Sequence[Trajectory]]
) -> float:
    """Mean log pi(a|s) over the steps of ``held_out``, every setting weighted equally."""
    means = []
    for trajectories in held_out:
        data = view.of(transitions(trajectories, max(len(t) for t in trajectories)))
        means.append(float(view.log_prob(policy, data).double().mean()))
    return float(np.mean(means))
