"""Maximum causal entropy IRL on finite MDPs, with the invariance penalty (paper Sec. 4.2, App. A).

The finite-horizon model of Ziebart et al. (2010), solved exactly in float64; the reward is
phi_theta(s), a scalar feature of the state (DeepMaxEnt, Wulfmeier et al. 2015; psi = 1), or
psi^T features(s). A fit is one call for any number of independent *runs* R (seeds, penalty
weights, datasets), each over the same E settings.

Arrays in, arrays out. A trajectory has H actions and H + 1 states, each of which is rewarded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

from irlcli.errors import UsageError, suggest
from irlcli.penalties.closed_form import penalty, penalty_gradient
from irlcli.tabular import (
    StackedMDPs,
    check_size,
    columns,
    evaluate,
    forward,
    optimal_policy,
    runs_first,
    true_reward,
)

METHODS = ("erm", "erm-balanced", "irm")


SAFE_SPAN = 600.0  # nats: exp of no more than this neither over- nor underflows


@dataclass(frozen=True, eq=False)
class Solution:
    """The maximum-causal-entropy policy of R rewards in E settings.

    log pi_t(a|s) = log_weight[t, afterstate(a, s)] - log_total[t, s]: with afterstates the policy
    need not be kept for each action.
    """

    settings: StackedMDPs
    log_weight: np.ndarray  # [H, E * X, R], gamma E[V_{t+1}] from each afterstate
    log_total: np.ndarray  # [H, E * S, R], log sum_a exp of it
    log_partition: np.ndarray  # [R, E], E[V_0] over the start distribution; its gradient is ...
    occupancy: np.ndarray  # ... [R, E, S], sum_{t=0..H} gamma^t P(s_t = s)

    @property
    def policy(self) -> np.ndarray:
        """pi_t(a|s) as [H, A, E, S, R], as :func:`irlcli.tabular.evaluate` takes it."""
        e, n, a = self.settings.shape
        weight = self.log_weight[:, self.settings.afterstate]
        return np.exp(weight - self.log_total[:, None]).reshape(-1, a, e, n, weight.shape[-1])


def solve(
    settings: StackedMDPs,
    reward: np.ndarray,
    horizon: int,
    discount: float = 1.0,
    reuse: Solution | None = None,
) -> Solution:
    """Soft backward pass and forward pass with the same horizon and discount.

    V_H = r, Q_t(s, a) = gamma E[V_{t+1}], V_t = r + log sum_a exp Q_t, pi_t = exp(Q_t - log sum).
    Where the episode has ended nothing is chosen, so that V_t = r; an absorbing state's actions
    are choices like any other's.

    Args:
        reward: [R, S], or [R, E, S].
        horizon: H [steps].
        reuse: a solution of the same shape that is needed no more: its memory is overwritten.
            Fresh memory may cost as much as the solution itself.

    Raises:
        ValueError: as :func:`irlcli.tabular.backward`; or ``reuse`` is of another shape.
    """
    e, n, a = settings.shape
    flat = columns(settings, reward)
    afterstates = len(settings.mdps[0].successor) * e
    check_size(horizon, discount, (afterstates + e * n) * (flat.size // (e * n)))
    ended = np.flatnonzero(settings.terminal)
    if reuse is None:
        log_weight = np.empty((horizon, afterstates, *flat.shape[1:]))
        log_total = np.empty((horizon, *flat.shape))
    else:
        log_weight = reuse.log_weight.reshape(horizon, afterstates, *flat.shape[1:])
        log_total = reuse.log_total.reshape(horizon, *flat.shape)
    # What each step's weights are scaled by to take exp once per afterstate, not per action. Where
    # they span too much for that, None: each state's own largest takes the place.
    scales: list[np.ndarray | None] = [None] * horizon
    each = np.empty((a, *flat.shape))
    value = flat
    for t in reversed(range(horizon)):
        weight = np.multiply(settings.spread @ value, discount, out=log_weight[t])
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
    state = columns(settings, np.broadcast_to(settings.start, (value.size // (e * n), e, n)))
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
        occupancy += state if discount == 1.0 else discount ** (t + 1) * state
    return Solution(
        settings=settings,
        log_weight=log_weight.reshape(horizon, afterstates, -1),
        log_total=log_total.reshape(horizon, e * n, -1),
        log_partition=(runs_first(settings, value) * settings.start).sum(-1),
        occupancy=runs_first(settings, occupancy),
    )


class UnfitState(ValueError):
    """A state to go on from that no such fit was in."""


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """The demonstrations of one run in E settings, as state and action indices.

    Attributes:
        states: for each setting its trajectories, each [T + 1] int64.
        actions: the same, each [T] int64.
    """

    states: tuple[tuple[np.ndarray, ...], ...]
    actions: tuple[tuple[np.ndarray, ...], ...]

    @property
    def counts(self) -> np.ndarray:
        """[E], trajectories per setting."""
        return np.array([len(group) for group in self.states])


def demonstrations(
    settings: StackedMDPs,
    states: Sequence[Sequence[np.ndarray]],
    actions: Sequence[Sequence[np.ndarray]],
    horizon: int,
) -> Demonstrations:
    """Check demonstrations, and cut each where it first reaches the goal.

    What follows the goal is the MDP's business (an absorbing goal is occupied to the horizon, a
    terminal one once), whatever environment recorded it.

    Args:
        states: E groups of trajectories of state indices, each [T + 1].
        actions: the same of action indices, each [T].
        horizon: H [steps].

    Raises:
        ValueError: a number of groups other than E, an empty group, indices out of range, a
            trajectory longer than the horizon, or one that stops early without the goal.
    """
    e, n, a = settings.shape
    if len(states) != e or len(actions) != e:
        raise ValueError(f"{e} settings need {e} groups of demonstrations, not {len(states)}")
    cut_states, cut_actions = [], []
    for i, (mdp, group, choices) in enumerate(zip(settings.mdps, states, actions, strict=True)):
        if len(group) == 0:
            raise ValueError(f"setting {i} has no demonstrations")
        paths, moves = [], []
        for path, chosen in zip(group, choices, strict=True):
            if len(path) != len(chosen) + 1:
                raise ValueError(f"setting {i}: {len(chosen)} actions but {len(path)} states")
            if path.min() < 0 or path.max() >= n or chosen.min() < 0 or chosen.max() >= a:
                raise ValueError(f"setting {i}: demonstrations of another state or action space")
            at_goal = np.flatnonzero(path == mdp.goal)
            length = int(at_goal[0]) if len(at_goal) else len(chosen)
            if length > horizon:
                raise ValueError(
                    f"setting {i}: a demonstration takes {length} steps, the horizon is {horizon}"
                )
            if not len(at_goal) and length < horizon:
                raise ValueError(
                    f"setting {i}: a demonstration stops after {length} steps, "
                    f"before the goal and before the horizon of {horizon}"
                )
            paths.append(np.asarray(path[: length + 1], dtype=np.int64))
            moves.append(np.asarray(chosen[:length], dtype=np.int64))
        cut_states.append(tuple(paths))
        cut_actions.append(tuple(moves))
    return Demonstrations(tuple(cut_states), tuple(cut_actions))


def shuffle_settings(demos: Demonstrations, seed: int) -> Demonstrations:
    """The same trajectories dealt out to the settings at random, as many to each as before.

    The control for invariance: a method that gains as much from labels that mean nothing gains
    from regularisation.
    """
    counts = demos.counts
    order = np.random.default_rng(seed).permutation(counts.sum())
    states = [path for group in demos.states for path in group]
    actions = [moves for group in demos.actions for moves in group]
    parts = np.split(order, np.cumsum(counts)[:-1])
    return Demonstrations(
        tuple(tuple(states[i] for i in part) for part in parts),
        tuple(tuple(actions[i] for i in part) for part in parts),
    )


def expert_occupancy(
    settings: StackedMDPs, demos: Demonstrations, horizon: int, discount: float = 1.0
) -> np.ndarray:
    """rho_E [E, S]: discounted state counts per trajectory, on average over each setting."""
    e, n, _ = settings.shape
    occupancy = np.zeros((e, n))
    powers = discount ** np.arange(horizon + 1)
    for i, (mdp, group) in enumerate(zip(settings.mdps, demos.states, strict=True)):
        for path in group:
            np.add.at(occupancy[i], path, powers[: len(path)])
            if path[-1] == mdp.goal and not mdp.terminal[mdp.goal]:
                occupancy[i, mdp.goal] += powers[len(path) :].sum()
        occupancy[i] /= len(group)
    return occupancy


def log_likelihood(solution: Solution, run: int, demos: Demonstrations) -> np.ndarray:
    """sum_t log pi_t(a_t|s_t) per trajectory, on average over each setting [E], in nats."""
    _, n, _ = solution.settings.shape
    result = np.empty(len(demos.states))
    for e, (paths, moves) in enumerate(zip(demos.states, demos.actions, strict=True)):
        t = np.concatenate([np.arange(len(m)) for m in moves])
        s = np.concatenate([p[:-1] for p in paths]) + e * n
        after = solution.settings.afterstate[np.concatenate(moves), s]
        log_policy = solution.log_weight[t, after, run] - solution.log_total[t, s, run]
        result[e] = log_policy.sum() / len(paths)
    return result


def setting_weights(method: str, counts: np.ndarray) -> np.ndarray:
    """How much each setting's likelihood weighs [E], in sum one.

    ``erm`` pools all demonstrations, so settings weigh by count; ``erm-balanced`` and ``irm``
    weigh settings equally.

    Raises:
        UsageError: an unknown method.
        ValueError: a setting without demonstrations.
    """
    if method not in METHODS:
        raise UsageError(f"unknown method {method!r}", suggest(method, METHODS))
    counts = np.asarray(counts)
    if not (counts > 0).all():
        raise ValueError("a setting has no demonstrations")
    if method == "erm":
        return counts / counts.sum()
    return np.full(len(counts), 1.0 / len(counts))


class RewardNetworks(torch.nn.Module):
    """R independent rewards phi(s) = v^T tanh(W features(s) + b) + c, or psi^T features(s).

    Args:
        n_features: F.
        hidden: width of the hidden layer; 0 for the linear reward.
        seeds: one per run. A run's first weights depend on its seed only.
    """

    def __init__(self, n_features: int, hidden: int, seeds: Sequence[int]):
        super().__init__()

        def draw(*shape: int, fan_in: int) -> torch.nn.Parameter:
            bound = fan_in**-0.5
            values = [
                torch.empty(shape, dtype=torch.float64).uniform_(-bound, bound, generator=g)
                for g in generators
            ]
            return torch.nn.Parameter(torch.stack(values))

        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        self.hidden = hidden
        if hidden == 0:
            self.psi = torch.nn.Parameter(torch.zeros(len(seeds), n_features, 1).double())
        else:
            self.weight = draw(n_features, hidden, fan_in=n_features)
            self.bias = draw(1, hidden, fan_in=n_features)
            self.output = draw(hidden, 1, fan_in=hidden)
            self.offset = torch.nn.Parameter(torch.zeros(len(seeds), 1, 1).double())

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """[R, S] float64 of ``features`` [S, F] float64."""
        if self.hidden == 0:
            return (features @ self.psi).squeeze(-1)
        layer = torch.tanh(features @ self.weight + self.bias)
        return (layer @ self.output + self.offset).squeeze(-1)


@dataclass(frozen=True, eq=False)
class Fit:
    """R fitted rewards and how the fit went."""

    networks: RewardNetworks
    reward: np.ndarray  # [R, S]
    solution: Solution  # of that reward
    iterations: np.ndarray  # [L], when the following were recorded, before that iteration's step
    objective: np.ndarray  # [L, R, E], rho_E . r - log Z: the log-likelihood, see fit
    penalty: np.ndarray  # [L, R, E]
    gap: np.ndarray  # [L, R, E], sum_s |rho_E - rho_pi|


def fit(
    settings: StackedMDPs,
    features: np.ndarray,
    occupancy: np.ndarray,
    weights: np.ndarray,
    penalty_weight: np.ndarray,
    l2: np.ndarray,
    seeds: Sequence[int],
    *,
    penalty_kind: str,
    horizon: int,
    discount: float = 1.0,
    hidden: int = 32,
    iterations: int = 2000,
    learning_rate: float = 1e-3,
    record_every: int = 50,
    state: Mapping[str, Any] | None = None,
    after_record: Callable[[int, Callable[[], dict[str, Any]]], None] | None = None,
) -> Fit:
    """Fit R rewards at once (paper Eq. 8), each minimising

        sum_e w_e [ -(rho_E^e . phi - log Z^e) + lambda D^e ] + l2 / 2 ||theta||^2

    by RMSProp (App. C). The first term's gradient by phi(s) is rho_pi - rho_E. It is the causal
    log-likelihood of the demonstrations in expectation over their dynamics (Ziebart et al. 2010).

    Args:
        settings: the dynamics the learner assumes for each of the E settings.
        features: [S, F], of each state.
        occupancy: rho_E [R, E, S], see :func:`expert_occupancy`.
        weights: w [R, E], see :func:`setting_weights`.
        penalty_weight: lambda [R].
        l2: [R].
        seeds: R, of the networks' first weights.
        penalty_kind: ``irmv1`` or ``closed-form``.
        hidden: width of the hidden layer; 0 learns psi of r = psi^T features.
        record_every: iterations between two records of the fit's progress.
        state: where an equal call was when ``after_record`` got it, to go on from there.
        after_record: called with the iterations done, and what gives the state then.

    Raises:
        ValueError: shapes that do not fit; weights, penalty weights or l2 negative or NaN; a
            horizon, discount, width, rate or number of iterations out of range; a ``state`` of
            another fit (:class:`UnfitState`).
        UsageError: an unknown penalty.
    """
    e, n, _ = settings.shape
    runs = len(seeds)
    features = np.asarray(features, dtype=np.float64)
    if features.ndim != 2 or len(features) != n or not np.isfinite(features).all():
        raise ValueError(f"features must be [{n}, F] and finite, not {list(features.shape)}")
    if occupancy.shape != (runs, e, n):
        raise ValueError(f"occupancy must be {[runs, e, n]}, not {list(occupancy.shape)}")
    for name, array, shape in (
        ("occupancy", occupancy, (runs, e, n)),
        ("weights", weights, (runs, e)),
        ("penalty_weight", penalty_weight, (runs,)),
        ("l2", l2, (runs,)),
    ):
        if np.shape(array) != shape:
            raise ValueError(f"{name} must be {list(shape)}, not {list(np.shape(array))}")
        if not (np.isfinite(array).all() and (np.asarray(array) >= 0.0).all()):
            raise ValueError(f"{name} must be finite and not negative")
    if iterations < 1:
        raise ValueError(f"at least one iteration is needed, not {iterations}")
    if hidden < 0:
        raise ValueError(f"hidden must be a width, or 0 for a linear reward, not {hidden}")
    networks = RewardNetworks(features.shape[1], hidden, seeds)
    inputs = torch.as_tensor(features)
    decay = torch.as_tensor(np.asarray(l2, dtype=np.float64)).reshape(runs, 1, 1)
    strength = np.asarray(penalty_weight)[:, None, None]
    optimizer = torch.optim.RMSprop(networks.parameters(), lr=learning_rate)
    records = []
    solution = None
    done = 0
    if state is not None:
        try:
            done = int(state["iterations"])
            networks.load_state_dict(state["networks"])
            optimizer.load_state_dict(state["optimizer"])
            steps, objective, penalties, gaps = (column.numpy() for column in state["records"])
            records = list(zip(steps.tolist(), objective, penalties, gaps, strict=True))
        except Exception as error:
            # Whatever a crafted state makes torch and Python raise.
            raise UnfitState(f"no such fit was in this state ({type(error).__name__})") from error

    def snapshot() -> dict[str, Any]:
        # A tensor a column: their number does not grow with the iterations.
        columns = [torch.as_tensor(np.stack(column)) for column in zip(*records, strict=True)]
        return {
            "iterations": done,
            "networks": networks.state_dict(),
            "optimizer": optimizer.state_dict(),
            "records": columns,
        }

    for i in range(done, iterations):
        reward = networks(inputs)
        phi = reward.detach().numpy()
        solution = solve(settings, phi, horizon, discount, reuse=solution)
        gap = occupancy - solution.occupancy
        if i % record_every == 0 or i == iterations - 1:
            objective = np.einsum("res,rs->re", occupancy, phi) - solution.log_partition
            records.append((i, objective, penalty(penalty_kind, phi, gap), np.abs(gap).sum(-1)))
        slope = strength * penalty_gradient(penalty_kind, phi, gap) - gap
        optimizer.zero_grad()
        reward.backward(torch.as_tensor(np.einsum("re,res->rs", weights, slope)))
        for parameter in networks.parameters():
            parameter.grad += decay * parameter.detach()
        optimizer.step()
        done = i + 1
        if after_record is not None and records[-1][0] == i:
            after_record(done, snapshot)
    with torch.no_grad():
        phi = networks(inputs).numpy()
    steps, objectives, penalties, gaps = zip(*records, strict=True)
    return Fit(
        networks=networks,
        reward=phi,
        solution=solve(settings, phi, horizon, discount, reuse=solution),
        iterations=np.array(steps),
        objective=np.stack(objectives),
        penalty=np.stack(penalties),
        gap=np.stack(gaps),
    )


@dataclass(frozen=True, eq=False)
class Quality:
    """How the policy that is optimal for a recovered reward fares at the true task, [R, E]."""

    goal_probability: np.ndarray
    true_return: np.ndarray
    value_difference: np.ndarray  # the optimal true return less true_return, at least 0
    rank_correlation: np.ndarray  # Spearman, of its optimal value with the true one over states


def assess(settings: StackedMDPs, reward: np.ndarray, horizon: int) -> Quality:
    """Solve each setting for ``reward`` [R, S] by value iteration and judge by the true reward.

    The rank correlation is over the states that the start leads to, walls left out, and NaN
    where the recovered value is constant.

    Raises:
        ValueError: as :func:`irlcli.tabular.optimal_policy`.
    """
    best_policy, best_value = optimal_policy(settings, true_reward(settings), horizon)
    best = evaluate(settings, best_policy)
    policy, value = optimal_policy(settings, reward, horizon)
    found = evaluate(settings, policy)
    uniform = np.full((horizon, *policy.shape[1:4], 1), 1.0 / policy.shape[1])
    reachable = forward(settings, uniform)[0][0] > 0.0
    correlation = np.full((len(reward), len(settings.mdps)), np.nan)
    for e, here in enumerate(reachable):
        for r in range(len(reward)):
            if np.ptp(value[e, here, r]) > 0.0:
                correlation[r, e] = spearmanr(value[e, here, r], best_value[e, here, 0]).statistic
    return Quality(
        goal_probability=found.goal_probability,
        true_return=found.true_return,
        value_difference=best.true_return - found.true_return,
        rank_correlation=correlation,
    )
