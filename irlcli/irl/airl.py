"""Adversarial IRL with the invariance penalty (paper Sec. 3, 4.3; Fu et al. 2017).

Tensors in, tensors out. A discriminator minibatch is laid out [E, 2, B]: E settings (one if
pooled), label 0 = policy and 1 = expert, B samples of each.

Absorbing states. Where episodes may end early, the sign of a learned reward alone can solve
the task (Kostrikov et al. 2019). With an absorbing state after termination and the time limit
bootstrapped through, as a truncation is, the value of the state that ended the episode is the
geometric series f_abs / (1 - gamma): it is added in closed form instead of being stepped
through, and the discriminator sees each absorbing state as often as stepping on to the horizon
would show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from irlcli.irl.networks import RewardModel
from irlcli.irl.penalties import (
    binary_cross_entropy,
    gradient_norm,
    gradient_norm_unbiased,
)
from irlcli.trajectories import Transitions


@dataclass(frozen=True)
class Pool:
    """Transitions to draw discriminator samples from, all of one label and one group.

    Rows are transitions followed by one absorbing row per terminated transition; ``draw``
    indexes rows, an absorbing one as often as the horizon had steps left. All tensors have
    length R but ``draw``.
    """

    observations: torch.Tensor  # [R, D] float32
    actions: torch.Tensor  # [R, A] float32, encoded; zero in absorbing rows
    next_observations: torch.Tensor  # [R, D] float32
    terminated: torch.Tensor  # [R] float32
    log_probs: torch.Tensor  # [R] float32, log pi(a|s); zero in absorbing rows
    draw: torch.Tensor  # [W] int64


def make_pool(
    model: RewardModel, data: Transitions, log_probs: torch.Tensor, absorbing: bool
) -> Pool:
    """The pool of ``data`` with log pi(a|s) = ``log_probs`` [B] of its transitions.

    With ``absorbing``, a terminated transition leads to an absorbing state that the pool
    holds too; otherwise its successor is worth nothing and nothing follows.
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
        actions = torch.cat([actions, torch.zeros(len(ends), model.action_size)])
        log_probs = torch.cat([log_probs, torch.zeros(len(ends))])
        terminated = torch.zeros(len(observations))
        absorbed = len(data) + np.arange(len(ends))
        draw = np.concatenate([draw, np.repeat(absorbed, data.remaining[ends])])
    return Pool(observations, actions, successors, terminated, log_probs, torch.as_tensor(draw))


def join_pools(pools: Sequence[Pool]) -> Pool:
    """One pool of several, each row drawn as often as before."""
    offsets = np.cumsum([0] + [len(pool.observations) for pool in pools[:-1]])
    draw = torch.cat([pool.draw + int(o) for pool, o in zip(pools, offsets, strict=True)])
    rows = (torch.cat([getattr(pool, f.name) for pool in pools]) for f in fields(Pool)[:-1])
    return Pool(*rows, draw)


def reward_scale(model: RewardModel, pools: Sequence[Pool]) -> float:
    """Standard deviation of g over the samples of ``pools``, each row as often as drawn.

    Fixed on training data, it makes frozen rewards of different runs comparable to a policy
    trained on them; nothing is centred, as that would change what the reward asks for.
    """
    with torch.no_grad():
        g = torch.cat([model.reward(pool.observations, pool.actions)[pool.draw] for pool in pools])
    return max(float(g.double().std()), 1e-6)


def episode_reward(model: RewardModel, data: Transitions, absorbing: bool) -> float:
    """Undiscounted sum of g over ``data``, with ``absorbing`` up to the horizon."""
    with torch.no_grad():
        pool = make_pool(model, data, torch.zeros(len(data)), absorbing)
        g = model.reward(pool.observations, pool.actions)
    return float(g.double()[pool.draw].sum())


@dataclass(frozen=True)
class Minibatch:
    """Discriminator samples, every tensor [E, 2, B] or [E, 2, B, .]."""

    observations: torch.Tensor
    actions: torch.Tensor
    next_observations: torch.Tensor
    terminated: torch.Tensor
    log_probs: torch.Tensor


def sample_minibatch(
    policy: Sequence[Pool],
    expert: Sequence[Pool],
    size: int,
    generator: torch.Generator,
    past: Sequence[Pool] = (),
    past_share: float = 0.0,
) -> Minibatch:
    """``size`` samples of either label for each of the E groups, with replacement.

    Of the policy's samples a share of ``past_share`` comes from ``past``, pools of earlier
    rounds: without them the discriminator forgets what the policy no longer does.
    """

    def fields(pool: Pool, count: int) -> tuple[torch.Tensor, ...]:
        rows = pool.draw[torch.randint(len(pool.draw), (count,), generator=generator)]
        return (
            pool.observations[rows],
            pool.actions[rows],
            pool.next_observations[rows],
            pool.terminated[rows],
            pool.log_probs[rows],
        )

    old = round(size * past_share) if past else 0
    groups = []
    for e in range(len(expert)):
        generated = fields(policy[e], size - old)
        if old:
            both = zip(generated, fields(past[e], old), strict=True)
            generated = tuple(torch.cat(pair) for pair in both)
        pairs = zip(generated, fields(expert[e], size), strict=True)
        groups.append([torch.stack(pair) for pair in pairs])
    return Minibatch(*(torch.stack(column) for column in zip(*groups, strict=True)))


def logits(model: RewardModel, batch: Minibatch) -> tuple[torch.Tensor, torch.Tensor]:
    """(f - log pi, f), each [E, 2, B]; sigmoid of the first is D (paper Eq. 2)."""
    f = model(batch.observations, batch.actions, batch.next_observations, batch.terminated)
    return f - batch.log_probs, f


@dataclass(frozen=True)
class Losses:
    """Losses and diagnostics of one minibatch, per setting [E] unless said otherwise."""

    total: torch.Tensor  # scalar to minimise
    cross_entropy: torch.Tensor
    penalty: torch.Tensor
    accuracy: torch.Tensor
    mean_abs_logit: torch.Tensor


def discriminator_losses(
    logit: torch.Tensor,
    f: torch.Tensor,
    penalty_weight: float,
    scaling: str = "logit",
    unbiased: bool = True,
) -> Losses:
    """mean_e [BCE_e + lambda penalty_e] / max(1, lambda) (paper Eq. 5, Algorithm 1).

    The paper sums over settings; the mean differs by the constant E, which Adam does not see.
    Dividing by lambda keeps the gradient's size when the penalty dominates.

    Args:
        logit: f - log pi [E, 2, B].
        f: the learned part [E, 2, B].
        penalty_weight: lambda, at least 0.
        scaling: ``logit`` scales the whole logit by w, ``reward`` only f: log pi is not learned.
        unbiased: product of two half-batches' gradients instead of the plain square.
    """
    cross_entropy = binary_cross_entropy(logit)
    estimate = gradient_norm_unbiased if unbiased else gradient_norm
    penalty = estimate(logit, logit if scaling == "logit" else f)
    total = cross_entropy.mean()
    if penalty_weight > 0.0:
        total = (total + penalty_weight * penalty.mean()) / max(1.0, penalty_weight)
    with torch.no_grad():
        correct = torch.stack([logit[:, 0] < 0, logit[:, 1] > 0], 1).float()
    return Losses(
        total=total,
        cross_entropy=cross_entropy.detach(),
        penalty=penalty.detach(),
        accuracy=correct.mean((-1, -2)),
        mean_abs_logit=logit.detach().abs().mean((-1, -2)),
    )


def penalty_weight_at(round_index: int, weight: float, warmup: int, ramp: int) -> float:
    """lambda of a round: 0 for ``warmup`` rounds, then linear over ``ramp`` to ``weight``."""
    if round_index < warmup:
        return 0.0
    return weight * min(1.0, (round_index - warmup + 1) / max(1, ramp))


def clipped_log_prob(
    mean: torch.Tensor,
    std: torch.Tensor,
    actions: torch.Tensor,
    low: torch.Tensor,
    high: torch.Tensor,
) -> torch.Tensor:
    """log pi [B] of a diagonal Gaussian's samples after clipping to [low, high].

    Inside the bounds it is the Gaussian's density, at a bound the mass beyond it. Without that,
    how far an action lies beyond a bound tells the expert from the policy, though it does nothing.

    Args:
        mean, std: of the samples, [B, A].
        actions: clipped, [B, A].
        low, high: the bounds, [A].
    """
    inside = torch.distributions.Normal(mean, std).log_prob(actions)
    below = torch.special.log_ndtr((low - mean) / std)
    above = torch.special.log_ndtr((mean - high) / std)
    at_bounds = torch.where(actions <= low, below, above)
    return torch.where((low < actions) & (actions < high), inside, at_bounds).sum(-1)


def policy_reward(
    model: RewardModel,
    data: Transitions,
    log_probs: torch.Tensor,
    form: str,
    absorbing: bool,
    gamma: float,
) -> torch.Tensor:
    """What the policy is paid for each transition, [B] float32, without gradient.

    ``form`` is ``f-log-pi`` (log D - log(1 - D), Algorithm 1), ``f`` or ``g``. With
    ``absorbing``, a terminated transition also earns the discounted sum of everything its
    absorbing state pays to a policy that discounts by ``gamma``: gamma / (1 - gamma) times the
    reward there, where log pi is zero.
    """
    with torch.no_grad():
        observations = torch.as_tensor(data.observations)
        actions = model.encode(torch.as_tensor(data.actions))
        successors = torch.as_tensor(data.next_observations)
        terminated = torch.as_tensor(data.terminated, dtype=torch.float32)
        if form == "g":
            reward = model.reward(observations, actions)
        else:
            ends = torch.zeros_like(terminated) if absorbing else terminated
            reward = model(observations, actions, successors, ends)
        if form == "f-log-pi":
            reward = reward - log_probs
        if absorbing and bool(terminated.any()):
            g, f = model.absorbing_reward(successors)
            series = gamma / (1.0 - gamma)
            reward = reward + terminated * series * (g if form == "g" else f)
        return reward
