"""Negatives that mix a challenger's numbers with an expert's.

What experts do comes together: a walking ant has certain poses and a certain velocity. From experts
and policies alone a reward may learn to value the poses, and a new policy takes the poses without
the velocity. In a mixed sample each number is the expert's or the challenger's. To distinguish
it from an expert's, a reward has to depend on all of them.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from irlcli.learners.pools import Minibatch


def mixed(batch: Minibatch, share: float, generator: torch.Generator) -> Minibatch:
    """``batch`` with about ``share`` of its policy samples mixed with the expert samples beside them.

    Each mixed sample draws a probability, uniform on [0, 1]. With it, each number of the
    observation is the expert's, and so are the action as a whole and whether the episode ended.
    The successor takes the same numbers from the expert's successor. Absorbing rows are mixed, too.
    Experts' samples and log pi stay as they are.

    Args:
        batch: samples [E, 2, B].
        share: in [0, 1].
        generator: draws what is mixed.
    """
    size = batch.log_probs[:, 0].shape
    chosen = (torch.rand(size, generator=generator) < share).float()
    probability = (chosen * torch.rand(size, generator=generator)).unsqueeze(-1)
    width = batch.observations.shape[-1]
    columns = torch.rand(*size, width, generator=generator) < probability
    action = torch.rand(*size, 1, generator=generator) < probability

    def taking(values: torch.Tensor, experts: torch.Tensor) -> torch.Tensor:
        policy, expert = values.unbind(1)
        return torch.stack([torch.where(experts, expert, policy), expert], 1)

    return replace(
        batch,
        observations=taking(batch.observations, columns),
        next_observations=taking(batch.next_observations, columns),
        actions=taking(batch.actions, action),
        terminated=taking(batch.terminated.unsqueeze(-1), action).squeeze(-1),
    )
