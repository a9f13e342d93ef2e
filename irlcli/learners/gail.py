"""GAIL: imitation by a discriminator of state-action pairs (Ho and Ermon 2016).

Algorithm 1 of :mod:`irlcli.learners.airl` with another discriminator and another reward. The
discriminator is D = sigmoid(g(s, a)), without log pi and without shaping. The policy earns
-log(1 - D), which is never negative, where AIRL's earns log D - log(1 - D).

Imitation is GAIL's aim: at its optimum D is 1/2 everywhere, so g is zero and carries no
information. What is frozen and retrained on is the last g, as for every learner.
"""

from __future__ import annotations

import numpy as np
from torch.nn.functional import softplus

from irlcli.learners.actions import Policy
from irlcli.learners.airl import AIRL
from irlcli.trajectories import Rollout


class GAIL(AIRL):
    """AIRL's discriminator and updates with GAIL's logit and reward.

    Its config has ``logit = "f"`` and no shaping (``irlcli.learners.LEARNERS``).
    """

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rewards [T, N] of ``policy`` for its rollout, by the current discriminator."""
        # -log(1 - D) = softplus(g).
        return self._of_g(rollout, softplus, self.config.ppo.gamma)
