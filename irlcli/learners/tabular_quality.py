"""How good a recovered tabular reward is, by the true reward and by held-out demonstrations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import spearmanr

from irlcli.learners.occupancy import IndexedDemonstrations
from irlcli.learners.soft_values import Solution, solve
from irlcli.tabular import StackedMDPs, backward, evaluate, forward, true_reward


@dataclass(frozen=True, eq=False)
class Quality:
    """Measures of R rewards in E settings, each [R, E].

    The first four concern the policy that is optimal for the recovered reward; the last one
    concerns the reward's maximum-entropy policy: sum log pi of the choices made. Demonstrations end at the
    goal, so it does not count the choices in the absorbing state.
    :class:`irlcli.learners.maxent.Record` has another likelihood.

    ``value_difference`` may be slightly negative near a tight horizon, see
    :func:`irlcli.tabular.backward`.
    """

    goal_probability: np.ndarray  # of reaching the goal within the horizon
    true_return: np.ndarray
    value_difference: np.ndarray  # true return of the optimal policy minus true_return
    rank_correlation: np.ndarray  # Spearman's, of its optimal value and the true one over states
    log_likelihood: np.ndarray  # of held-out episodes [nats per episode]


def assess(
    settings: StackedMDPs, reward: np.ndarray, horizon: int, held_out: IndexedDemonstrations
) -> Quality:
    """Judge ``reward`` [R, S] in each of E settings.

    The rank correlation covers the states that can be reached from the start, and is NaN where the
    recovered value is constant. ``held_out`` has episodes of each setting's own expert.

    Raises:
        ValueError: as :func:`irlcli.tabular.backward`.
    """
    best_policy, best_value = backward(settings, true_reward(settings), horizon)
    best = evaluate(settings, best_policy)
    policy, value = backward(settings, reward, horizon)
    found = evaluate(settings, policy)
    uniform = np.full((horizon, *policy.shape[1:4], 1), 1.0 / policy.shape[1])
    reachable = forward(settings, uniform)[0][0] > 0.0
    correlation = np.full((len(reward), len(settings.mdps)), np.nan)
    for e, here in enumerate(reachable):
        for r in range(len(reward)):
            if np.ptp(value[e, here, r]) > 0.0:
                correlation[r, e] = spearmanr(value[e, here, r], best_value[e, here, 0]).statistic
    soft = solve(settings, reward, horizon)
    return Quality(
        goal_probability=found.goal_probability,
        true_return=found.true_return,
        value_difference=best.true_return - found.true_return,
        rank_correlation=correlation,
        log_likelihood=np.stack([log_likelihood(soft, r, held_out) for r in range(len(reward))]),
    )


def log_likelihood(solution: Solution, run: int, demos: IndexedDemonstrations) -> np.ndarray:
    """sum_t log pi_t(a_t|s_t) per trajectory, averaged over each setting [E], in nats.

    ``run`` selects one of the solution's R rewards.
    """
    _, n, _ = solution.settings.shape
    result = np.empty(len(demos.states))
    for e, (paths, moves) in enumerate(zip(demos.states, demos.actions, strict=True)):
        t = np.concatenate([np.arange(len(m)) for m in moves])
        s = np.concatenate([p[:-1] for p in paths]) + e * n
        after = solution.settings.afterstate[np.concatenate(moves), s]
        log_policy = solution.log_weight[t, after, run] - solution.log_total[t, s, run]
        result[e] = log_policy.sum() / len(paths)
    return result
