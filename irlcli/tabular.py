"""Finite Markov decision processes as exact arrays, and dynamic programming over many of them.

Transitions are factored through *afterstates* (Sutton and Barto 2018, Sec. 6.8): an action leads
from s to an afterstate deterministically, and chance leads from there to s',

    P(s' | s, a) = sum_k probability[afterstate[a, s], k] * [successor[afterstate[a, s], k] = s'].

In a gridworld the afterstate is the intended cell, so all actions share the sparse part. Any finite
MDP has this form with one afterstate per (s, a). Time and memory are linear in the states.

Everything is batched over E settings (MDPs of one shape, stacked as one block-diagonal MDP) and
over R rewards. Internal arrays keep R last, so that a sparse row acts on all R at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

MEMORY_LIMIT = 8 * 2**30  # bytes
TIE_TOLERANCE = 1e-9  # relative: actions whose values differ by less are equally good


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """One finite MDP with S states, A actions, X afterstates of at most K successors.

    Attributes:
        afterstate: [A, S] int64, where action a leads from state s before chance acts.
        successor: [X, K] int64, the intended one first.
        probability: [X, K] float64; a row sums to one, or is all zero: the episode has ended.
        start: [S] float64, distribution of the first state.
        reward: [S] float64, the true reward of acting in a state.
        goal: the goal's state index.
    """

    afterstate: np.ndarray
    successor: np.ndarray
    probability: np.ndarray
    start: np.ndarray
    reward: np.ndarray
    goal: int

    @property
    def n_states(self) -> int:
        """S."""
        return self.afterstate.shape[1]

    @property
    def n_actions(self) -> int:
        """A."""
        return self.afterstate.shape[0]

    @property
    def terminal(self) -> np.ndarray:
        """[S] bool: the states in which the episode has ended and nothing is chosen."""
        return (self.probability == 0.0).all(1)[self.afterstate].all(0)


def dense_transitions(mdp: TabularMDP) -> np.ndarray:
    """P(s'|s, a) as [A, S, S] float64: a reference for tests and benchmarks of small cases."""
    spread = np.zeros((len(mdp.successor), mdp.n_states))
    rows = np.broadcast_to(np.arange(len(spread))[:, None], mdp.successor.shape)
    np.add.at(spread, (rows, mdp.successor), mdp.probability)
    return spread[mdp.afterstate]


def shortest_path_length(mdp: TabularMDP) -> int:
    """The fewest steps from any possible first state to the goal if every move succeeds.

    Raises:
        ValueError: the goal cannot be reached.
    """
    possible = mdp.probability[:, 0] > 0.0
    reached = mdp.start > 0.0
    steps = 0
    while not reached[mdp.goal]:
        after = mdp.afterstate[:, reached].ravel()
        grown = reached.copy()
        grown[mdp.successor[after[possible[after]], 0]] = True
        if (grown == reached).all():
            raise ValueError("the goal cannot be reached from the start")
        reached = grown
        steps += 1
    return steps


@dataclass(frozen=True, eq=False)
class StackedMDPs:
    """E MDPs of one shape, as one block-diagonal sparse MDP over E * S states; see :func:`stack`.

    Attributes:
        mdps: the E MDPs.
        afterstate: [A, E*S] int64.
        spread: [E*X, E*S], maps values of states to values of afterstates.
        spread_transposed: [E*S, E*X].
        collect: [E*X, A*E*S], sums the probability that the actions send to each afterstate.
        arrivals: [E*X, E*S], counts the actions that lead from a state to an afterstate.
        terminal: [E*S] bool.
        start: [E, S], distribution of the first state.
    """

    mdps: tuple[TabularMDP, ...]
    afterstate: np.ndarray
    spread: sparse.csr_array
    spread_transposed: sparse.csr_array
    collect: sparse.csr_array
    arrivals: sparse.csr_array
    terminal: np.ndarray
    start: np.ndarray

    @property
    def shape(self) -> tuple[int, int, int]:
        """(E, S, A)."""
        return len(self.mdps), self.mdps[0].n_states, self.mdps[0].n_actions


def stack(mdps: Sequence[TabularMDP]) -> StackedMDPs:
    """Stack ``mdps``, at least one and all of one shape, into one."""
    (a, n), (x, k) = mdps[0].afterstate.shape, mdps[0].successor.shape
    afterstate = np.concatenate([m.afterstate + e * x for e, m in enumerate(mdps)], axis=1)
    successor = np.concatenate([m.successor + e * n for e, m in enumerate(mdps)])
    probability = np.concatenate([m.probability for m in mdps])
    rows = np.repeat(np.arange(len(mdps) * x), k)
    spread = sparse.csr_array(
        (probability.ravel(), (rows, successor.ravel())), shape=(len(mdps) * x, len(mdps) * n)
    )
    spread.eliminate_zeros()
    collect = sparse.csr_array(
        (np.ones(afterstate.size), (afterstate.ravel(), np.arange(afterstate.size))),
        shape=(len(mdps) * x, afterstate.size),
    )
    return StackedMDPs(
        mdps=tuple(mdps),
        afterstate=afterstate,
        spread=spread,
        spread_transposed=spread.T.tocsr(),
        collect=collect,
        arrivals=collect @ sparse.vstack([sparse.eye_array(len(mdps) * n, format="csr")] * a),
        terminal=np.concatenate([m.terminal for m in mdps]),
        start=np.stack([m.start for m in mdps]),
    )


def _greedy(action_values: np.ndarray) -> np.ndarray:
    """max_a Q [E*S, ...] of action values [A, E*S, ...], which become the policy in place.

    It is greedy, uniform over ties.
    """
    best = action_values.max(0)
    slack = TIE_TOLERANCE * np.maximum(1.0, np.abs(best))
    np.greater_equal(action_values, best - slack, out=action_values)
    action_values /= action_values.sum(0)
    return best


def backward(
    settings: StackedMDPs, reward: np.ndarray, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """Value iteration over a finite horizon: V_H = r, Q_t = E[V_{t+1}], V_t = r + max_a Q_t.

    A trajectory is s_0, a_0, ..., s_H: H actions, and a reward for each of its H + 1 states.
    ``Evaluation.true_return`` leaves out the last reward, so near a tight horizon another policy may
    have a slightly higher true return.

    Args:
        reward: [R, S], the same reward in every setting, or [R, E, S].
        horizon: H, at least 1 [steps].

    Returns:
        The policy pi_t(a|s) [H, A, E, S, R], uniform over ties, and V_0 [E, S, R].

    Raises:
        ValueError: a reward of another shape or not finite; or as :func:`check_size`.
    """
    e, n, a = settings.shape
    flat = columns(settings, reward)
    check_size(horizon, a * flat.size)
    policy = np.empty((horizon, a, *flat.shape))
    value = flat
    for t in reversed(range(horizon)):
        after = settings.spread @ value
        # All indices are in range; with "clip", take writes to ``out`` without a buffer.
        after.take(settings.afterstate, axis=0, out=policy[t], mode="clip")
        value = _greedy(policy[t])
        value += flat
    return policy.reshape(horizon, a, e, n, -1), value.reshape(e, n, -1)


def forward(settings: StackedMDPs, policy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State distributions under ``policy`` [H, A, E, S, R], as :func:`backward` returns it.

    Returns:
        The occupancy sum_{t=0..H} P(s_t = s) [R, E, S], and P(s_H = s) [R, E, S]. An episode
        that has ended is in no state, so P(s_H) may sum to less than one.
    """
    horizon, a, e, n, runs = policy.shape
    state = columns(settings, np.broadcast_to(settings.start, (runs, e, n)))
    steps = policy.reshape(horizon, a, *state.shape)
    occupancy = state.copy()
    flow = np.empty((a, *state.shape))
    outflow = flow.reshape(a * e * n, *state.shape[1:])
    for t in range(horizon):
        np.multiply(steps[t], state, out=flow)
        state = settings.spread_transposed @ (settings.collect @ outflow)
        occupancy += state
    return runs_first(settings, occupancy), runs_first(settings, state)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """How a policy performs at the true task, [R, E]."""

    goal_probability: np.ndarray  # of having reached the goal within the horizon
    true_return: np.ndarray  # over s_0 .. s_{H-1} as the environment computes it


def evaluate(settings: StackedMDPs, policy: np.ndarray) -> Evaluation:
    """Exact evaluation of ``policy`` [H, A, E, S, R] by the true reward of each setting.

    The goal must be absorbing or terminal.
    """
    occupancy, last = forward(settings, policy)
    goals = np.array([m.goal for m in settings.mdps])
    e = np.arange(len(goals))
    reached = 1.0 - last.sum(-1) + last[:, e, goals]
    reward = np.stack([m.reward for m in settings.mdps])
    true_return = ((occupancy - last) * reward).sum(-1)
    return Evaluation(np.clip(reached, 0.0, 1.0), true_return)


def intended_path(mdp: TabularMDP, policy: np.ndarray) -> np.ndarray:
    """The states [H + 1] that ``policy`` [H, A, S] visits if every move succeeds.

    It begins in the first possible state. Among equally likely actions it takes the first.
    """
    states = [int(mdp.start.argmax())]
    for step in policy:
        after = mdp.afterstate[step[:, states[-1]].argmax(), states[-1]]
        states.append(int(mdp.successor[after, 0]))
    return np.array(states)


def true_reward(settings: StackedMDPs) -> np.ndarray:
    """[1, E, S]: the true rewards, as :func:`backward` takes them."""
    return np.stack([m.reward for m in settings.mdps])[None]


def columns(settings: StackedMDPs, array: np.ndarray) -> np.ndarray:
    """[R, S] or [R, E, S] as [E * S, R]; as [E * S] if R = 1, which takes half the time.

    Raises:
        ValueError: another shape, or values that are not finite.
    """
    e, n, _ = settings.shape
    array = np.asarray(array, dtype=np.float64)
    if array.shape[1:] not in ((n,), (e, n)):
        raise ValueError(f"reward must be [R, {n}] or [R, {e}, {n}], not {list(array.shape)}")
    if not np.isfinite(array).all():
        raise ValueError("the reward is not finite")
    if array.ndim == 2:
        array = np.broadcast_to(array[:, None], (len(array), e, n))
    if len(array) == 1:
        return array.reshape(e * n)
    return np.ascontiguousarray(array.reshape(-1, e * n).T)


def runs_first(settings: StackedMDPs, array: np.ndarray) -> np.ndarray:
    """[E * S, R] or [E * S] as [R, E, S]."""
    e, n, _ = settings.shape
    return np.ascontiguousarray(array.reshape(e * n, -1).T).reshape(-1, e, n)


def check_size(horizon: int, numbers: int) -> None:
    """Refuse what the solvers cannot do, or cannot hold: they keep ``numbers`` for every step.

    Raises:
        ValueError: a horizon below 1, or more than ``MEMORY_LIMIT``.
    """
    if horizon < 1:
        raise ValueError(f"the horizon must be at least 1 step, not {horizon}")
    size = 8 * horizon * numbers
    if size > MEMORY_LIMIT:
        raise ValueError(
            f"too many states, steps or runs for the exact solver: it would keep "
            f"{size / 2**30:.0f} GiB, the limit is {MEMORY_LIMIT / 2**30:.0f}"
        )
