"""Policies that start again and again from random weights while a reward is learned.

Each is trained on the reward of that moment, as a retrained policy will be on the final one. The
discriminator sees their episodes as policy samples. The reward therefore rises from where a new
policy begins, and poses that the reward scores too high are corrected before it is frozen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from msgspec.structs import replace

from irlcli.configs import ChallengerConfig
from irlcli.errors import StageFailed
from irlcli.rl.policy import Policy
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.worlds import Worlds
from irlcli.seeds import derive
from irlcli.trajectories import Rollout, side_by_side


class Challenged(Protocol):
    """The learner whose reward is challenged."""

    def challenger_rewards(self, rollout: Rollout) -> np.ndarray:
        """The rewards [T, N] of a challenger for its own ``rollout``."""


class Challengers:
    """One challenger at a time, or one in each setting; the next begins after ``config.life`` rounds.

    Args:
        worlds: of each challenger that acts at a time, in the order of their settings. Every round
            starts fresh episodes in them.
        config: how they learn.
        learner: whose reward they are trained on.
        seed, purpose: everything random of a challenger derives from them, its number and its setting.
    """

    def __init__(
        self,
        worlds: Sequence[Worlds],
        config: ChallengerConfig,
        learner: Challenged,
        seed: int,
        purpose: str,
    ):
        self._worlds = worlds
        self._config = config
        self._learner = learner
        self._seed = seed
        self._purpose = f"{purpose} challenger"
        self._life = 0
        self._trainers = self._born(0)

    def _born(self, life: int) -> list[PPOTrainer]:
        seeds = derive(self._purpose, self._seed, life, len(self._worlds))
        return [
            self._trainer(worlds, seed) for worlds, seed in zip(self._worlds, seeds, strict=True)
        ]

    def _trainer(self, worlds: Worlds, seed: int) -> PPOTrainer:
        ppo = replace(self._config.ppo, n_envs=len(worlds))
        return PPOTrainer(worlds, ppo, self._config.life * ppo.steps_per_round, seed, self._purpose)

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rewards [T, N] of a rollout, by the reward as it is now."""
        return self._learner.challenger_rewards(rollout)

    def train_round(self, index: int) -> list[Rollout]:
        """The rollouts of the challengers of round ``index``, updated on each of them.

        Raises:
            StageFailed: a challenger's parameters stopped being finite.
        """
        life, age = divmod(index, self._config.life)
        if life != self._life:
            self._life, self._trainers = life, self._born(life)
        try:
            rollouts = [trainer.train_round(age, self) for trainer in self._trainers]
        except StageFailed as error:
            raise StageFailed(
                f"the challenger that began in round {index - age}: {error.message}",
                f"{error.hint}; it learns as airl.challenger.ppo says",
            ) from error
        return [side_by_side(parts) for parts in zip(*rollouts, strict=True)]

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs from the end of the last round."""
        return {"life": self._life, "trainers": [t.state_dict() for t in self._trainers]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict()`` of equally configured challengers."""
        self._life = int(state["life"])
        self._trainers = self._born(self._life)
        for trainer, saved in zip(self._trainers, state["trainers"], strict=True):
            trainer.load_state_dict(saved)
