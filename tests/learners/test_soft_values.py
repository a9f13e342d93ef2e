"""The soft solver against enumeration, a dense reference and autograd."""

import numpy as np
import pytest
import torch
from tabular_demos import GOALS

from irlcli.envs.gridworld.env import PATH_GROUPS, gridworld
from irlcli.learners.soft_values import SAFE_SPAN, solve
from irlcli.tabular import dense_transitions, stack


def dense_log_partition(mdp, reward: torch.Tensor, horizon: int) -> torch.Tensor:
    """E[V_0] by a dense soft backward pass that autograd can follow. ``reward`` [S]."""
    dense = torch.as_tensor(dense_transitions(mdp))
    ended = torch.as_tensor(mdp.terminal)
    value = reward
    for _ in range(horizon):
        soft = torch.logsumexp(dense @ value, 0)
        value = reward + torch.where(ended, torch.zeros_like(soft), soft)
    return torch.as_tensor(mdp.start) @ value


def paths(mdp, dense, horizon):
    """Every (states, actions) of an MDP from its fixed start, ended episodes cut there."""
    unfinished = [([int(mdp.start.argmax())], [])]
    while unfinished:
        states, actions = unfinished.pop()
        if len(actions) == horizon or mdp.terminal[states[-1]]:
            yield states, actions
            continue
        for a in range(mdp.n_actions):
            for s in np.flatnonzero(dense[a, states[-1]]):
                unfinished.append(([*states, int(s)], [*actions, a]))


@pytest.mark.parametrize("goal", GOALS)
def test_without_chance_the_occupancy_is_the_gibbs_distributions(goal):
    """Paper Eq. 1: p(tau) = exp(r(tau)) / Z, by enumerating every trajectory."""
    mdp = gridworld(3, goal=goal, p_slip=0.0)
    reward = np.random.default_rng(0).normal(size=9)
    horizon = 6
    total, visits = 0.0, np.zeros(9)
    for states, _ in paths(mdp, dense_transitions(mdp), horizon):
        weight = np.exp(reward[states].sum())
        total += weight
        np.add.at(visits, states, weight)
    solution = solve(stack([mdp]), reward[None], horizon)
    assert solution.log_partition[0, 0] == pytest.approx(np.log(total), abs=1e-10)
    assert np.allclose(solution.occupancy[0, 0], visits / total, atol=1e-10)


@pytest.mark.parametrize("goal", GOALS)
def test_occupancy_equals_the_enumeration_of_all_trajectories(goal):
    mdp = gridworld(2, goal=goal)
    reward = np.random.default_rng(1).normal(size=4)
    horizon = 4
    dense = dense_transitions(mdp)
    solution = solve(stack([mdp]), reward[None], horizon)
    policy = solution.policy[:, :, 0, :, 0]
    expected, mass = np.zeros(4), 0.0
    for states, actions in paths(mdp, dense, horizon):
        chance = 1.0
        for t, a in enumerate(actions):
            chance *= policy[t, a, states[t]] * dense[a, states[t], states[t + 1]]
        mass += chance
        np.add.at(expected, states, chance)
    assert mass == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(solution.occupancy[0, 0], expected, atol=1e-12)


@pytest.mark.parametrize("goal", GOALS)
def test_solver_equals_a_dense_one_and_its_gradient_by_autograd(goal):
    settings = stack([gridworld(6, path_group=g, goal=goal) for g in PATH_GROUPS])
    reward = torch.randn(2, 36, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    solution = solve(settings, reward.numpy(), 20)
    for e, mdp in enumerate(settings.mdps):
        for r in range(2):
            leaf = reward[r].clone().requires_grad_(True)
            partition = dense_log_partition(mdp, leaf, 20)
            partition.backward()
            assert solution.log_partition[r, e] == pytest.approx(partition.item(), abs=1e-11)
            assert np.allclose(solution.occupancy[r, e], leaf.grad.numpy(), atol=1e-11)


@pytest.mark.parametrize("goal", GOALS)
def test_values_that_span_too_much_for_one_scale_are_solved_too(goal):
    settings = stack([gridworld(6, path_group=g, goal=goal) for g in PATH_GROUPS])
    reward = 40.0 * np.random.default_rng(9).normal(size=(2, 36))
    solution = solve(settings, reward, 20)
    span = np.ptp(solution.log_weight, axis=1)
    assert (span > SAFE_SPAN).any() and (span < SAFE_SPAN).any()  # either way in one solution
    assert np.isfinite(solution.policy).all()
    for e, mdp in enumerate(settings.mdps):
        for r in range(2):
            leaf = torch.tensor(reward[r], requires_grad=True)
            partition = dense_log_partition(mdp, leaf, 20)
            partition.backward()
            assert solution.log_partition[r, e] == pytest.approx(partition.item(), rel=1e-13)
            assert np.allclose(solution.occupancy[r, e], leaf.grad.numpy(), atol=1e-9)


@pytest.mark.parametrize("runs", [1, 3])
def test_a_solution_in_used_memory_is_the_same(runs):
    settings = stack([gridworld(4), gridworld(4)])
    rng = np.random.default_rng(10)
    fresh = solve(settings, second := rng.normal(size=(runs, 16)), 9)
    used = solve(settings, rng.normal(size=(runs, 16)), 9)
    again = solve(settings, second, 9, reuse=used)
    assert np.shares_memory(again.log_weight, used.log_weight)
    assert np.array_equal(again.policy, fresh.policy)
    assert np.array_equal(again.occupancy, fresh.occupancy)
    with pytest.raises(ValueError, match="reshape"):
        solve(settings, second, 8, reuse=used)


@pytest.mark.parametrize("goal", GOALS)
def test_likelihoods_gradient_by_finite_differences(goal):
    """d/dphi(s) sum_e w_e (rho_E . phi - log Z) = sum_e w_e (rho_E - rho_pi)(s)."""
    settings = stack([gridworld(5, path_group=g, goal=goal) for g in PATH_GROUPS])
    rng = np.random.default_rng(2)
    phi, expert = rng.normal(size=25), rng.random((3, 25))
    weights = np.array([0.7, 0.2, 0.1])

    def likelihood(phi):
        return weights @ (expert @ phi - solve(settings, phi[None], 12).log_partition[0])

    gradient = weights @ (expert - solve(settings, phi[None], 12).occupancy[0])
    step = 1e-5 * np.eye(25)
    numeric = [(likelihood(phi + d) - likelihood(phi - d)) / 2e-5 for d in step]
    assert np.allclose(gradient, numeric, atol=1e-7)
