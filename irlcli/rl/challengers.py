"""Policies that start again and again from random weights while a reward is learned.

Each is trained on the reward of that moment, as a retrained policy will be on the final one. What
they do becomes negatives of the discriminator. So the reward rises from where a new policy begins,
and poses that it would overpay are corrected before it is frozen.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from irlcli.configs import ChallengerConfig
from irlcli.rl.policy import Policy
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.worlds import Worlds
from irlcli.seeds import derive
from irlcli.trajectories import Rollout


class Challenged(Protocol):
    """The learner whose reward is challenged."""

    def challenger_rewards(self, rollout: Rollout) -> np.ndarray:
        """The rewards [T, N] of a challenger for its own ``rollout``."""


class Challengers:
    """One challenger at a time; the next begins after ``config.life`` rounds.

    Args:
        worlds: those of the student. Every round starts fresh episodes in them.
        config: how they learn.
        learner: whose reward they are trained on.
        seed, purpose: everything random of a challenger derives from them and its number.
    """

    def __init__(
        self,
        worlds: Worlds,
        config: ChallengerConfig,
        learner: Challenged,
        seed: int,
        purpose: str,
    ):
        self._worlds = worlds
        self._config = config
        self._learner = learner
        self._seed = seed
        self._purpose = purpose
        self._life = 0
        self._trainer = self._born(0)

    def _born(self, life: int) -> PPOTrainer:
        ppo = self._config.ppo
        steps = self._config.life * ppo.rollouts_per_round * ppo.n_steps * ppo.n_envs
        seed = derive(f"{self._purpose} challenger", self._seed, life)[0]
        return PPOTrainer(self._worlds, ppo, steps, seed, f"{self._purpose} challenger")

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rewards [T, N] of a rollout, by the reward as it is now."""
        return self._learner.challenger_rewards(rollout)

    def train_round(self, index: int) -> list[Rollout]:
        """The rollouts of the challenger of round ``index``, updated on each of them."""
        life, age = divmod(index, self._config.life)
        if life != self._life:
            self._life, self._trainer = life, self._born(life)
        return self._trainer.train_round(age, self)

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs from the end of the last round."""
        return {"life": self._life, "trainer": self._trainer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict()`` of equally configured challengers."""
        self._life = int(state["life"])
        self._trainer = self._born(self._life)
        self._trainer.load_state_dict(state["trainer"])
