"""What discriminator samples are drawn from, absorbing states included."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from irlcli.learners.reward_model import RewardModule
from irlcli.trajectories import Transitions


@dataclass(frozen=True, eq=False)
class Pool:
    """Transitions to draw samples from, all of one label.

    Rows are transitions, followed by one absorbing row per terminated transition. ``draw``
    indexes rows, an absorbing one as often as the horizon had steps left. All tensors but
    ``draw`` have length R.
    """

    observations: torch.Tensor  # [R, D] float32
    actions: torch.Tensor  # [R, A] float32, encoded, or the model's no_actions() in absorbing rows
    next_observations: torch.Tensor  # [R, D] float32
    terminated: torch.Tensor  # [R] float32
    log_probs: torch.Tensor  # [R] float32, log pi(a|s); zero in absorbing rows
    draw: torch.Tensor  # [W] int64


def make_pool(
    model: RewardModule, data: Transitions, log_probs: torch.Tensor, absorbing: bool
) -> Pool:
    """The pool of ``data`` with log pi(a|s) = ``log_probs`` [B] of its transitions.

    With ``absorbing``, a terminated transition leads to an absorbing state, which the pool holds
    too; otherwise its successor is worth nothing and nothing follows.
    """
    observations = torch.as_tensor(data.observations)
    actions = model.encode(torch.as_tensor(data.actions))
    successors = torch.as_tensor(data.next_observations)
    terminated = torch.as_tensor(data.terminated, dtype=torch.float32)
    draw = np.arange(len(data))
    if absorbing:
        ends = np.flatnonzero(data.terminated)
        final = successors[ends]
        observations = torch.cat([observations, final])
        successors = torch.cat([successors, final])
        actions = torch.cat([actions, model.no_actions(final)])
        log_probs = torch.cat([log_probs, torch.zeros(len(ends))])
        terminated = torch.zeros(len(observations))
        absorbed = len(data) + np.arange(len(ends))
        draw = np.concatenate([draw, np.repeat(absorbed, data.remaining[ends])])
    return Pool(observations, actions, successors, terminated, log_probs, torch.as_tensor(draw))


def join_pools(pools: Sequence[Pool]) -> Pool:
    """One pool of several, each row drawn as often as before."""
    if len(pools) == 1:
        return pools[0]
    offsets = np.cumsum([0] + [len(pool.observations) for pool in pools[:-1]])
    draw = torch.cat([pool.draw + int(o) for pool, o in zip(pools, offsets, strict=True)])
    names = [f.name for f in fields(Pool) if f.name != "draw"]
    rows = {name: torch.cat([getattr(pool, name) for pool in pools]) for name in names}
    return Pool(**rows, draw=draw)


@dataclass(frozen=True, eq=False)
class Minibatch:
    """Discriminator samples: every tensor is [E, 2, B] or [E, 2, B, .].

    E counts the risks; label 0 is the policy, label 1 the expert; B samples of each, those of a
    risk's strata one after the other.
    """

    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    terminated: torch.Tensor
    log_probs: torch.Tensor


@dataclass(frozen=True, eq=False)
class Stratum:
    """What one part of a risk is drawn from.

    ``past`` holds the policy's earlier rounds; None without replay. ``count`` is the number of
    samples of either label, at least 2 and even.
    """

    policy: Pool
    expert: Pool
    past: Pool | None
    count: int


def sample_minibatch(
    risks: Sequence[Sequence[Stratum]], generator: torch.Generator, past_share: float = 0.0
) -> Minibatch:
    """Samples of either label for each risk, with replacement.

    About ``past_share`` of the policy's samples, in each stratum an even number, come from earlier
    rounds: otherwise the discriminator forgets what the policy no longer does.
    """

    def draw(pool: Pool, count: int) -> list[torch.Tensor]:
        rows = pool.draw[torch.randint(len(pool.draw), (count,), generator=generator)]
        return [getattr(pool, f.name)[rows] for f in fields(Minibatch)]

    def stacked(stratum: Stratum) -> list[torch.Tensor]:
        # Even, so that the even and the odd samples hold as many past ones: the unbiased penalty
        # multiplies their gradients.
        earlier = 0 if stratum.past is None else 2 * round(stratum.count * past_share / 2)
        generated = draw(stratum.policy, stratum.count - earlier)
        if stratum.past is not None and earlier:
            both = zip(generated, draw(stratum.past, earlier), strict=True)
            generated = [torch.cat(pair) for pair in both]
        pairs = zip(generated, draw(stratum.expert, stratum.count), strict=True)
        return [torch.stack(pair) for pair in pairs]

    batches = []
    for strata in risks:
        parts = [stacked(stratum) for stratum in strata]
        batches.append([torch.cat(column, 1) for column in zip(*parts, strict=True)])
    return Minibatch(*(torch.stack(column) for column in zip(*batches, strict=True)))
