"""How a reward model scores the steps of a policy in training, and whole episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from irlcli.learners.pools import Pool, make_pool
from irlcli.learners.reward_model import RewardModel, RewardModule, absorbed
from irlcli.trajectories import Transitions

# Of g: a constant reward has no scale.
SMALLEST_SCALE = 1e-6


def policy_reward(
    model: RewardModel,
    data: Transitions,
    log_probs: torch.Tensor,
    form: str,
    absorbing: bool,
    gamma: float,
) -> torch.Tensor:
    """The reward of each transition [B] float32, without gradient.

    ``form`` is ``f-log-pi`` (log D - log(1 - D), Algorithm 1), ``f`` or ``g``. With ``absorbing``,
    a terminated transition also earns the discounted sum of its absorbing state's rewards for a
    policy that discounts by ``gamma``: gamma / (1 - gamma) times the reward there, where log pi is
    zero.
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
            # absorbing_value() multiplies in another order: rewards under existing keys would differ in the
            # last bit.
            series = gamma / (1.0 - gamma)
            reward = reward + terminated * series * (g if form == "g" else f)
        return reward


def transformed_reward(
    model: RewardModule,
    data: Transitions,
    transform: Callable[[torch.Tensor], torch.Tensor],
    absorbing: bool,
    gamma: float,
) -> torch.Tensor:
    """``transform`` of g [B], for each transition [B] float32, without gradient.

    With ``absorbing``, a terminated transition also earns the discounted sum of its absorbing
    state's rewards, gamma / (1 - gamma) times the transformed g there: without it a reward that is
    never negative favours staying alive.
    """
    with torch.no_grad():
        actions = model.encode(torch.as_tensor(data.actions))
        reward = transform(model.reward(torch.as_tensor(data.observations), actions))
        terminated = torch.as_tensor(data.terminated, dtype=torch.float32)
        if absorbing and bool(terminated.any()):
            g = absorbed(model, torch.as_tensor(data.next_observations))
            reward = reward + absorbing_value(transform(g), terminated, gamma)
        return reward


def absorbing_value(reward: torch.Tensor, terminated: torch.Tensor, gamma: float) -> torch.Tensor:
    """Discounted sum [B] of the absorbing state's ``reward`` [B] from the next step on.

    Zero where ``terminated`` [B], float, is zero.
    """
    return terminated * gamma / (1.0 - gamma) * reward


def reward_scale(model: RewardModule, pools: Sequence[Pool]) -> float:
    """Standard deviation of g over the samples of ``pools``, each row as often as drawn.

    Fixed on training data, it makes frozen rewards of different runs comparable. Nothing is
    centred, which would change what the reward asks for. At least :data:`SMALLEST_SCALE`.
    """
    with torch.no_grad():
        g = torch.cat([model.reward(pool.observations, pool.actions)[pool.draw] for pool in pools])
    return max(float(g.double().std()), SMALLEST_SCALE)


def reward_quantiles(model: RewardModule, demonstrations: Sequence[Pool]) -> tuple[float, ...]:
    """The 0, 1, ... 100 % quantiles of g over the settings' pools of ``demonstrations``.

    Each row counts as often as drawn; all settings weigh the same.
    """
    with torch.no_grad():
        g = [model.reward(pool.observations, pool.actions)[pool.draw] for pool in demonstrations]
    weights = np.concatenate([np.full(len(values), 1.0 / len(values)) for values in g])
    found = np.quantile(
        torch.cat(g).double().numpy(),
        np.linspace(0.0, 1.0, 101),
        weights=weights,
        method="inverted_cdf",
    )
    return tuple(float(value) for value in found)


def level_of(quantiles: Sequence[float], share: float) -> float:
    """The reward that a ``share`` of the demonstrations' steps does not exceed."""
    return float(np.interp(100.0 * share, range(101), quantiles))


def episode_reward(
    model: RewardModule, data: Transitions, absorbing: bool, ceiling: float
) -> float:
    """Undiscounted sum of min(g, ``ceiling``) over ``data``; with ``absorbing``, up to the horizon."""
    with torch.no_grad():
        pool = make_pool(model, data, torch.zeros(len(data)), absorbing)
        g = model.reward(pool.observations, pool.actions)
    return float(g.double().clamp(max=ceiling)[pool.draw].sum())
