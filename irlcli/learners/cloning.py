"""Behavioural cloning: maximum likelihood of the demonstrations."""

from __future__ import annotations

from typing import Any

import torch

from irlcli.learners.actions import ActionView
from irlcli.seeds import derive
from irlcli.trajectories import Transitions

# Adam's learning rate, and demonstrated steps a minibatch.
LEARNING_RATE = 1e-3
BATCH_SIZE = 256


def clone(trainer: Any, data: Transitions, view: ActionView, epochs: int, seed: int) -> None:
    """Fit the policy of ``trainer`` to the demonstrated ``data`` [B].

    The policy normalises observations by the demonstrations' moments. The trainer must keep them
    (``keep_moments``): other moments would turn the fitted policy into another one.

    Args:
        trainer: a :class:`irlcli.rl.ppo.PPOTrainer` before its first round.
        data: as ``view`` shows it.
        view: the actions that likelihoods are of.
        epochs: how often each demonstration is seen.
        seed: of the order of the demonstrations.
    """
    trainer.observe(data.observations)
    generator = torch.Generator().manual_seed(derive("cloning", seed, 0)[0])
    optimizer = torch.optim.Adam(trainer.policy.network.parameters(), lr=LEARNING_RATE)
    for _ in range(epochs):
        order = torch.randperm(len(data), generator=generator)
        for rows in order.split(BATCH_SIZE):
            batch = data.take(rows.numpy())
            loss = -view.log_prob(trainer.policy, batch, gradient=True).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    trainer.cap_noise()
