"""The maximum-causal-entropy policy of a finite MDP, solved exactly (Ziebart et al. 2010).

A soft backward pass gives the policy and log Z, a forward pass gives the state occupancy. Both use
the same finite horizon, without discount, in float64. A trajectory has H actions and H + 1 states,
and each state is rewarded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from irlcli.tabular import StackedMDPs, check_size, columns, runs_first

SAFE_SPAN = 600.0  # nats: exp of this neither overflows nor underflows


@dataclass(frozen=True, eq=False)
class Solution:
    """The maximum-causal-entropy policies of R rewards in E settings.

    log pi_t(a|s) = log_weight[t, afterstate(a, s)] - log_total[t, s]. Weights per afterstate take
    less memory than a policy per action.
    """

    settings: StackedMDPs
    log_weight: np.ndarray  # [H, E * X, R], E[V_{t+1}] from each afterstate
    log_total: np.ndarray  # [H, E * S, R], log sum_a exp of it
    log_partition: np.ndarray  # [R, E], log Z = E[V_0] over the start distribution
    occupancy: np.ndarray  # [R, E, S], d log Z / d r(s) = sum_{t=0..H} P(s_t = s)

    @property
    def policy(self) -> np.ndarray:
        """pi_t(a|s) as [H, A, E, S, R], the form that :func:`irlcli.tabular.evaluate` takes."""
        e, n, a = self.settings.shape
        weight = self.log_weight[:, self.settings.afterstate]
        return np.exp(weight - self.log_total[:, None]).reshape(-1, a, e, n, weight.shape[-1])


def solve(
    settings: StackedMDPs,
    reward: np.ndarray,
    horizon: int,
    reuse: Solution | None = None,
) -> Solution:
    """Soft backward pass, then forward pass.

    V_H = r, Q_t(s, a) = E[V_{t+1}], V_t = r + log sum_a exp Q_t, pi_t = exp(Q_t - log sum).
    V_t = r where the episode has ended, because nothing is chosen there. An absorbing state's
    actions are choices like any other's.

    Args:
        reward: [R, S], the same reward in every setting, or [R, E, S].
        horizon: H [steps].
        reuse: a solution of the same shape that is no longer needed. Its memory is overwritten:
            allocating memory may cost as much as solving.

    Raises:
        ValueError: as :func:`irlcli.tabular.backward`; or ``reuse`` has another shape.
    """
    e, n, a = settings.shape
    flat = columns(settings, reward)
    afterstates = len(settings.mdps[0].successor) * e
    check_size(horizon, (afterstates + e * n) * (flat.size // (e * n)))
    ended = np.flatnonzero(settings.terminal)
    if reuse is None:
        log_weight = np.empty((horizon, afterstates, *flat.shape[1:]))
        log_total = np.empty((horizon, *flat.shape))
    else:
        log_weight = reuse.log_weight.reshape(horizon, afterstates, *flat.shape[1:])
        log_total = reuse.log_total.reshape(horizon, *flat.shape)
    # Each step's weights are scaled by their largest, so that exp is taken once per afterstate
    # instead of once per action. Where they span too much for one scale (None), each state's
    # largest is used.
    scales: list[np.ndarray | None] = [None] * horizon
    each = np.empty((a, *flat.shape))
    value = flat
    for t in reversed(range(horizon)):
        weight = log_weight[t]
        weight[...] = settings.spread @ value
        largest = weight.max(0)
        if (largest - weight.min(0)).max() <= SAFE_SPAN:
            scales[t] = largest
            np.exp(weight - largest).take(settings.afterstate, axis=0, out=each, mode="clip")
        else:
            weight.take(settings.afterstate, axis=0, out=each, mode="clip")
            largest = each.max(0)
            np.exp(each - largest, out=each)
        total = np.log(each.sum(0), out=log_total[t])
        total += largest
        value = total + flat
        value[ended] = flat[ended]
    occupancy = _occupancy(settings, log_weight, log_total, scales, each)
    return Solution(
        settings=settings,
        log_weight=log_weight.reshape(horizon, afterstates, -1),
        log_total=log_total.reshape(horizon, e * n, -1),
        log_partition=(runs_first(settings, value) * settings.start).sum(-1),
        occupancy=runs_first(settings, occupancy),
    )


def _occupancy(
    settings: StackedMDPs,
    log_weight: np.ndarray,
    log_total: np.ndarray,
    scales: list[np.ndarray | None],
    each: np.ndarray,
) -> np.ndarray:
    """The forward pass of :func:`solve`; ``each`` [A, E * S, ...] is overwritten."""
    e, n, a = settings.shape
    runs = log_total[0].size // (e * n)
    state = columns(settings, np.broadcast_to(settings.start, (runs, e, n)))
    occupancy = state.copy()
    for t, scale in enumerate(scales):
        if scale is not None:
            arriving = settings.arrivals @ (state * np.exp(scale - log_total[t]))
            arriving *= np.exp(log_weight[t] - scale)
        else:
            log_weight[t].take(settings.afterstate, axis=0, out=each, mode="clip")
            np.exp(each - log_total[t], out=each)
            each *= state
            arriving = settings.collect @ each.reshape(a * e * n, *state.shape[1:])
        state = settings.spread_transposed @ arriving
        occupancy += state
    return occupancy
