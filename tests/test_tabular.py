"""Finite MDPs against dense references, and the errors of bad arguments."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from irlcli.envs.gridworld.env import gridworld
from irlcli.tabular import (
    TabularMDP,
    backward,
    dense_transitions,
    evaluate,
    forward,
    intended_path,
    shortest_path_length,
    stack,
    true_reward,
)


def random_mdp(seed: int, n: int = 7, a: int = 3, k: int = 4) -> TabularMDP:
    """An MDP without structure: one afterstate per (s, a), some with repeated successors."""
    rng = np.random.default_rng(seed)
    return TabularMDP(
        afterstate=np.arange(a * n).reshape(a, n),
        successor=rng.integers(n, size=(a * n, k)),
        probability=rng.dirichlet(np.ones(k), size=a * n),
        start=rng.dirichlet(np.ones(n)),
        reward=rng.normal(size=n),
        goal=n - 1,
    )


def test_hard_backward_and_forward_equal_a_dense_reference():
    mdps = [random_mdp(0), random_mdp(1)]
    reward = np.random.default_rng(2).normal(size=(3, 7))
    policy, value = backward(stack(mdps), reward, 6)
    occupancy, last = forward(stack(mdps), policy)
    for e, mdp in enumerate(mdps):
        dense = dense_transitions(mdp)
        for r in range(3):
            v, steps = reward[r], []
            for _ in range(6):
                q = dense @ v
                steps.append(np.eye(3)[q.argmax(0)].T)
                v = reward[r] + q.max(0)
            assert np.allclose(policy[:, :, e, :, r], steps[::-1], atol=1e-12)
            assert np.allclose(value[e, :, r], v, atol=1e-12)
            state, total = mdp.start, mdp.start.copy()
            for step in steps[::-1]:
                state = np.einsum("s,as,ast->t", state, step, dense)
                total += state
            assert np.allclose(occupancy[r, e], total, atol=1e-12)
            assert np.allclose(last[r, e], state, atol=1e-12)


def test_a_reward_per_setting_and_runs_together_equal_each_alone():
    mdps = [random_mdp(0), random_mdp(1)]
    reward = np.random.default_rng(2).normal(size=(3, 2, 7))
    policy, value = backward(stack(mdps), reward, 5)
    for e in range(2):
        for r in range(3):
            alone, v = backward(stack([mdps[e]]), reward[r : r + 1, e], 5)
            assert np.array_equal(policy[:, :, e, :, r], alone[:, :, 0, :, 0])
            assert np.allclose(value[e, :, r], v[0, :, 0], atol=1e-13)


@pytest.mark.parametrize("goal", ["terminal", "absorbing"])
def test_evaluation_is_the_same_whether_the_goal_ends_or_absorbs(goal):
    settings = stack([gridworld(4, goal=goal)])
    policy, _ = backward(settings, true_reward(settings), 7)
    result = evaluate(settings, policy)
    dense = dense_transitions(gridworld(4, goal="absorbing"))
    state, paid = settings.start[0], 0.0
    for t in range(7):
        paid -= 1.0 - state[-1]
        state = np.einsum("s,as,ast->t", state, policy[t, :, 0, :, 0], dense)
    assert result.goal_probability[0, 0] == pytest.approx(state[-1], abs=1e-12)
    assert result.true_return[0, 0] == pytest.approx(paid, abs=1e-12)


def test_value_iteration_is_optimal_among_all_policies_of_a_tiny_mdp():
    mdp = random_mdp(3, n=3, a=2, k=2)
    settings = stack([mdp])
    reward = true_reward(settings)
    best = -np.inf
    for code in range(2 ** (2 * 3)):  # every deterministic policy of 2 steps and 3 states
        choice = np.array([code >> i & 1 for i in range(6)]).reshape(2, 3)
        policy = np.eye(2)[choice].transpose(0, 2, 1)[:, :, None, :, None]
        occupancy = forward(settings, policy)[0]
        best = max(best, float((occupancy[0, 0] * mdp.reward).sum()))
    _, value = backward(settings, reward, 2)
    assert float(mdp.start @ value[0, :, 0]) == pytest.approx(best, abs=1e-12)


def test_the_intended_path_ignores_slips_and_stays_at_the_goal():
    mdp = gridworld(3, goal="absorbing", p_slip=0.5)
    up, right = np.eye(4)[0], np.eye(4)[1]
    policy = np.stack([right, up, right, up, up])[:, :, None].repeat(9, axis=2)
    assert intended_path(mdp, policy).tolist() == [0, 1, 4, 5, 8, 8]


def test_a_grid_too_large_for_the_exact_solver_is_refused():
    settings = stack([gridworld(256)])
    with pytest.raises(ValueError, match="it would keep 100 GiB"):
        backward(settings, np.zeros((100, 256**2)), 512)


def test_an_unreachable_goal_is_refused():
    mdp = random_mdp(0)
    stuck = dataclasses.replace(mdp, successor=np.zeros_like(mdp.successor), start=np.eye(7)[0])
    with pytest.raises(ValueError, match="cannot be reached"):
        shortest_path_length(stuck)


def test_bad_arguments_of_the_solver_are_refused():
    settings = stack([random_mdp(0)])
    good = np.zeros((1, 7))
    with pytest.raises(ValueError, match="horizon must be"):
        backward(settings, good, 0)
    with pytest.raises(ValueError, match="reward must be"):
        backward(settings, np.zeros((1, 8)), 3)
    with pytest.raises(ValueError, match="not finite"):
        backward(settings, np.full((1, 7), np.nan), 3)
