"""Maximum causal entropy IRL against enumeration, finite differences and autograd."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch

from irlcli.envs.gridworld.env import (
    PATH_GROUPS,
    expert_policy,
    gridworld,
    observations,
    sample_trajectories,
    state_indices,
)
from irlcli.errors import UsageError
from irlcli.learners.maxent import (
    SAFE_SPAN,
    RewardNetworks,
    assess,
    demonstrations,
    expert_occupancy,
    fit,
    log_likelihood,
    setting_weights,
    shuffle_settings,
    solve,
)
from irlcli.penalties.closed_form import PENALTIES, penalty, penalty_gradient
from irlcli.tabular import dense_transitions, forward, stack

GOALS = ("terminal", "absorbing")


def dense_log_partition(mdp, reward: torch.Tensor, horizon: int, discount: float) -> torch.Tensor:
    """E[V_0] by a dense soft backward pass that autograd can follow. ``reward`` [S]."""
    dense = torch.as_tensor(dense_transitions(mdp))
    ended = torch.as_tensor(mdp.terminal)
    value = reward
    for _ in range(horizon):
        soft = torch.logsumexp(discount * dense @ value, 0)
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


@pytest.mark.parametrize("discount", [1.0, 0.8])
@pytest.mark.parametrize("goal", GOALS)
def test_occupancy_equals_the_enumeration_of_all_trajectories(goal, discount):
    mdp = gridworld(2, goal=goal)
    reward = np.random.default_rng(1).normal(size=4)
    horizon = 4
    dense = dense_transitions(mdp)
    solution = solve(stack([mdp]), reward[None], horizon, discount)
    policy = solution.policy[:, :, 0, :, 0]
    expected, mass = np.zeros(4), 0.0
    for states, actions in paths(mdp, dense, horizon):
        chance = 1.0
        for t, a in enumerate(actions):
            chance *= policy[t, a, states[t]] * dense[a, states[t], states[t + 1]]
        mass += chance
        np.add.at(expected, states, chance * discount ** np.arange(len(states)))
    assert mass == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(solution.occupancy[0, 0], expected, atol=1e-12)


@pytest.mark.parametrize("discount", [1.0, 0.9])
@pytest.mark.parametrize("goal", GOALS)
def test_solver_equals_a_dense_one_and_its_gradient_by_autograd(goal, discount):
    settings = stack([gridworld(6, path_group=g, goal=goal) for g in PATH_GROUPS])
    reward = torch.randn(2, 36, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    solution = solve(settings, reward.numpy(), 20, discount)
    for e, mdp in enumerate(settings.mdps):
        for r in range(2):
            leaf = reward[r].clone().requires_grad_(True)
            partition = dense_log_partition(mdp, leaf, 20, discount)
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
    for r in range(2):
        leaf = torch.tensor(reward[r], requires_grad=True)
        partition = dense_log_partition(settings.mdps[1], leaf, 20, 1.0)
        partition.backward()
        assert solution.log_partition[r, 1] == pytest.approx(partition.item(), rel=1e-13)
        assert np.allclose(solution.occupancy[r, 1], leaf.grad.numpy(), atol=1e-9)


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


@pytest.mark.parametrize("kind", PENALTIES)
def test_penalty_gradients_by_finite_differences_and_autograd(kind):
    rng = np.random.default_rng(3)
    phi, gap = rng.normal(size=(2, 5)), rng.normal(size=(2, 3, 5))
    gradient = penalty_gradient(kind, phi, gap)
    leaf, fixed = torch.tensor(phi, requires_grad=True), torch.tensor(gap)
    if kind == "irmv1":
        value = (leaf[:, None] * fixed).sum(-1) ** 2
    else:
        value = (fixed**2).sum(-1) * (leaf**2).sum(-1)[:, None]
    assert np.allclose(penalty(kind, phi, gap), value.detach().numpy())
    value.sum().backward()
    assert np.allclose(gradient.sum(1), leaf.grad.numpy(), atol=1e-12)
    for s in range(5):
        step = np.zeros((2, 5))
        step[:, s] = 1e-5
        numeric = (penalty(kind, phi + step, gap) - penalty(kind, phi - step, gap)) / 2e-5
        assert np.allclose(gradient[..., s], numeric, atol=1e-6)


def test_irmv1_is_the_squared_derivative_of_the_likelihood_by_the_scale_psi():
    """Paper Eq. 9 with psi = 1: d/dpsi of rho_E . (psi phi) - log Z(psi phi)."""
    settings = stack([gridworld(5, path_group=g) for g in PATH_GROUPS])
    rng = np.random.default_rng(4)
    phi, expert = rng.normal(size=25), rng.random((3, 25))

    def likelihood(psi):
        return psi * expert @ phi - solve(settings, psi * phi[None], 12).log_partition[0]

    slope = (likelihood(1 + 1e-5) - likelihood(1 - 1e-5)) / 2e-5
    gap = expert - solve(settings, phi[None], 12).occupancy[0]
    assert np.allclose(penalty("irmv1", phi[None], gap[None])[0], slope**2, rtol=1e-6)


def test_closed_form_bounds_irmv1():
    rng = np.random.default_rng(5)
    phi, gap = rng.normal(size=(4, 6)), rng.normal(size=(4, 3, 6))
    assert (penalty("irmv1", phi, gap) <= penalty("closed-form", phi, gap)).all()


def soft_experts(settings, seed: int, horizon: int) -> np.ndarray:
    """rho_E [1, E, S] of experts that a finite reward explains exactly."""
    reward = np.random.default_rng(seed).normal(size=(1, settings.shape[1]))
    return solve(settings, reward, horizon).occupancy


FIT = {"penalty_kind": "irmv1", "horizon": 12, "iterations": 300, "learning_rate": 1e-2}


def test_linear_fit_matches_features_at_the_optimum():
    settings = stack([gridworld(5, path_group=g, goal="absorbing") for g in PATH_GROUPS])
    features = np.random.default_rng(6).normal(size=(25, 3))
    expert = soft_experts(settings, 7, 12)
    weights = np.array([[0.5, 0.3, 0.2]])
    result = fit(
        settings, features, expert, weights, np.zeros(1), np.zeros(1), [0], hidden=0, **FIT
    )
    gap = np.einsum("re,res->s", weights, expert - result.solution.occupancy)
    uniform = solve(settings, np.zeros((1, 25)), 12).occupancy
    start = np.einsum("re,res->s", weights, expert - uniform)
    assert np.abs(features.T @ start).max() > 1.0
    assert np.abs(features.T @ gap).max() < 1e-6
    assert np.allclose(result.reward[0], features @ result.networks.psi.detach().numpy()[0, :, 0])


@pytest.mark.parametrize("kind", PENALTIES)
def test_identical_settings_have_no_penalty_at_the_optimum(kind):
    settings = stack([gridworld(4, goal="absorbing")] * 2)
    expert = soft_experts(settings, 8, 12)
    both = np.repeat(expert, 2, axis=0)
    result = fit(
        settings, np.eye(16), both, np.full((2, 2), 0.5), np.array([0.0, 0.05]), np.zeros(2),
        [0, 0], hidden=0, **{**FIT, "penalty_kind": kind},
    )  # fmt: skip
    assert result.penalty.max() > 0.1
    assert result.penalty[-1].max() < 0.03
    assert np.abs(result.reward[0] - result.reward[0].mean()).max() > 0.5
    assert result.gap[-1].max() < 0.15 < 1.0 < result.gap[0].min()


def test_fit_improves_the_likelihood_and_runs_do_not_affect_each_other():
    settings = stack([gridworld(5, path_group=g) for g in PATH_GROUPS])
    expert = np.concatenate([soft_experts(settings, s, 16) for s in (1, 2)])
    shared = {"penalty_kind": "irmv1", "horizon": 16, "iterations": 60, "learning_rate": 1e-2}
    weights = np.full((2, 3), 1 / 3)
    strength, l2 = np.array([0.0, 1e-3]), np.array([1e-3, 0.0])
    both = fit(settings, np.eye(25), expert, weights, strength, l2, [3, 4], **shared)
    assert (both.objective[-1].mean(-1) > both.objective[0].mean(-1) + 1.0).all()
    for r, seed in enumerate((3, 4)):
        one = slice(r, r + 1)
        alone = fit(
            settings, np.eye(25), expert[one], weights[one], strength[one], l2[one], [seed],
            **shared,
        )  # fmt: skip
        assert np.allclose(alone.reward[0], both.reward[r], atol=1e-9)


def test_a_fit_that_goes_on_from_a_state_ends_the_same_to_the_bit():
    settings = stack([gridworld(5, path_group=g, goal="absorbing") for g in PATH_GROUPS])
    rest = (soft_experts(settings, 6, 12), np.full((1, 3), 1 / 3), np.array([0.01]), np.zeros(1))
    shared = {"penalty_kind": "closed-form", "horizon": 12, "iterations": 25, "record_every": 10}
    states = []

    def keep(done, state):
        buffer = io.BytesIO()
        torch.save(state(), buffer)
        states.append((done, buffer.getvalue()))

    whole = fit(settings, np.eye(25), *rest, [0], **shared, after_record=keep)
    assert [done for done, _ in states] == [1, 11, 21, 25]
    for _, data in states:
        state = torch.load(io.BytesIO(data), weights_only=True)
        again = fit(settings, np.eye(25), *rest, [0], **shared, state=state)
        assert np.array_equal(again.reward, whole.reward)
        for name in ("iterations", "objective", "penalty", "gap"):
            assert np.array_equal(getattr(again, name), getattr(whole, name))


def test_l2_and_the_penalty_change_the_fit():
    settings = stack([gridworld(5, path_group=g) for g in PATH_GROUPS])
    expert = np.repeat(soft_experts(settings, 1, 16), 3, axis=0)
    result = fit(
        settings, observations(5), expert, np.full((3, 3), 1 / 3), np.array([0.0, 0.0, 0.1]),
        np.array([0.0, 5.0, 0.0]), [0, 0, 0], penalty_kind="closed-form", horizon=16,
        iterations=200, learning_rate=1e-2,
    )  # fmt: skip
    plain, decayed, invariant = np.ptp(result.reward, axis=1)
    assert decayed < 0.5 * plain and invariant < 0.9 * plain


def test_networks_start_from_their_seed_only():
    three = RewardNetworks(2, 8, [5, 6, 5])
    one = RewardNetworks(2, 8, [6])
    reward = three(torch.as_tensor(observations(4)).double())
    assert torch.equal(reward[0], reward[2]) and not torch.equal(reward[0], reward[1])
    assert torch.allclose(one(torch.as_tensor(observations(4)).double())[0], reward[1])


PATH = np.array([0, 1, 2, 5, 8])
MOVES = np.array([1, 1, 0, 0])


@pytest.mark.parametrize("goal", GOALS)
def test_expert_occupancy_by_hand(goal):
    settings = stack([gridworld(3, goal=goal)])
    demos = demonstrations(settings, [[PATH, PATH]], [[MOVES, MOVES]], horizon=6)
    expected = np.zeros(9)
    expected[PATH] = 0.5 ** np.arange(5)
    if goal == "absorbing":
        expected[8] += 0.5**5 + 0.5**6
    assert np.allclose(expert_occupancy(settings, demos, 6, discount=0.5)[0], expected)


def test_a_recording_that_stays_in_the_goal_counts_like_one_that_ended():
    settings = stack([gridworld(3, goal="absorbing")])
    ended = demonstrations(settings, [[PATH]], [[MOVES]], horizon=6)
    stayed = demonstrations(
        settings, [[np.append(PATH, [8, 8])]], [[np.append(MOVES, [2, 3])]], horizon=6
    )
    assert np.array_equal(
        expert_occupancy(settings, ended, 6), expert_occupancy(settings, stayed, 6)
    )
    assert np.array_equal(ended.actions[0][0], stayed.actions[0][0])


def test_expert_occupancy_converges_to_the_exact_one():
    mdp = gridworld(5, path_group=3, goal="absorbing")
    settings = stack([mdp])
    policy = expert_policy(mdp, 24)
    episodes = sample_trajectories(mdp, 5, policy, 3000, seed=0)
    demos = demonstrations(
        settings,
        [[state_indices(t.observations, 5) for t in episodes]],
        [[t.actions for t in episodes]],
        horizon=24,
    )
    exact = forward(settings, policy[:, :, None, :, None])[0][0, 0]
    assert np.abs(expert_occupancy(settings, demos, 24)[0] - exact).max() < 0.15


def test_log_likelihood_by_hand():
    settings = stack([gridworld(3), gridworld(3)])
    demos = demonstrations(settings, [[PATH], [PATH, PATH[:5]]], [[MOVES], [MOVES, MOVES]], 6)
    solution = solve(settings, np.random.default_rng(0).normal(size=(2, 2, 9)), 6)
    steps = [solution.policy[t, MOVES[t], 1, PATH[t], 1] for t in range(4)]
    assert log_likelihood(solution, 1, demos)[1] == pytest.approx(np.log(steps).sum(), abs=1e-12)
    uniform = solve(settings, np.zeros((1, 9)), 6)
    assert log_likelihood(uniform, 0, demos).max() < 0.0


def test_an_impossible_action_has_a_finite_log_likelihood():
    settings = stack([gridworld(3)])
    demos = demonstrations(settings, [[PATH]], [[MOVES]], 6)
    reward = np.zeros((1, 9))
    reward[0, 3] = 1e5  # beside the path, so that leaving it is a certainty
    found = log_likelihood(solve(settings, reward, 6), 0, demos)[0]
    assert np.isfinite(found) and found < -1e4


def test_shuffled_settings_hold_the_same_trajectories():
    settings = stack([gridworld(3), gridworld(3)])
    short, long = PATH, np.array([0, 0, 1, 2, 5, 8])
    moves = np.array([3, 1, 1, 0, 0])
    demos = demonstrations(settings, [[short] * 4, [long]], [[MOVES] * 4, [moves]], 6)
    dealt = [shuffle_settings(demos, seed) for seed in range(20)]
    assert {len(d.states[1][0]) for d in dealt} == {5, 6}
    for d in dealt:
        assert d.counts.tolist() == [4, 1]
        assert sorted(len(p) for group in d.states for p in group) == [5, 5, 5, 5, 6]
        for group, choices in zip(d.states, d.actions, strict=True):
            assert all(len(p) == len(m) + 1 for p, m in zip(group, choices, strict=True))


def test_weights_pool_by_count_or_balance():
    assert np.allclose(setting_weights("erm", np.array([400, 25, 3])), np.array([400, 25, 3]) / 428)
    for method in ("erm-balanced", "irm"):
        assert np.allclose(setting_weights(method, np.array([400, 25, 3])), 1 / 3)


@pytest.mark.parametrize("goal", GOALS)
def test_the_true_reward_is_assessed_as_perfect_and_its_opposite_as_useless(goal):
    settings = stack([gridworld(6, goal=goal), gridworld(6, blocked=2, goal=goal)])
    true = settings.mdps[0].reward
    quality = assess(settings, np.stack([true, 3.0 * true, -true]), 40)
    assert np.allclose(quality.value_difference[:2], 0.0, atol=1e-9)
    assert (quality.goal_probability[:2] > 0.999).all()
    assert (quality.rank_correlation[:2] > 0.999).all()
    assert (quality.goal_probability[2] < 0.05).all() and (quality.value_difference[2] > 20).all()
    assert (quality.rank_correlation[2] < 0.0).all()


def test_bad_demonstrations_are_refused():
    settings = stack([gridworld(3)])

    def make(path, moves, horizon=6):
        demonstrations(settings, [[np.array(path)]], [[np.array(moves)]], horizon)

    with pytest.raises(ValueError, match="1 settings need 1 groups"):
        demonstrations(settings, [[PATH], [PATH]], [[MOVES], [MOVES]], 6)
    with pytest.raises(ValueError, match="setting 0 has no demonstrations"):
        demonstrations(settings, [[]], [[]], 6)
    with pytest.raises(ValueError, match="takes 4 steps, the horizon is 3"):
        make(PATH, MOVES, horizon=3)
    with pytest.raises(ValueError, match="stops after 3 steps"):
        make(PATH[:4], MOVES[:3])
    with pytest.raises(ValueError, match="another state or action space"):
        make([0, 1, 9], [1, 1])
    with pytest.raises(ValueError, match="another state or action space"):
        make(PATH, [1, 1, 0, 4])
    with pytest.raises(ValueError, match="4 actions but 4 states"):
        make(PATH[:4], MOVES)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": np.array([[-0.5, 1.5]])}, "weights must be finite and not negative"),
        ({"weights": np.array([[np.nan, 1.0]])}, "weights must be finite"),
        ({"weights": np.ones((1, 3))}, "weights must be"),
        ({"penalty_weight": np.array([-1.0])}, "penalty_weight must be finite"),
        ({"penalty_weight": np.array([np.nan])}, "penalty_weight must be finite"),
        ({"l2": np.array([np.inf])}, "l2 must be finite"),
        ({"occupancy": np.ones((1, 2, 8))}, "occupancy must be"),
        ({"features": np.ones((8, 2))}, "features must be"),
        ({"features": np.full((9, 2), np.nan)}, "features must be"),
        ({"iterations": 0}, "at least one iteration"),
        ({"hidden": -1}, "hidden must be"),
        ({"learning_rate": float("nan")}, "learning rate"),
        ({"horizon": 0}, "horizon must be"),
    ],
)
def test_bad_arguments_of_a_fit_are_refused(change, message):
    arguments = {
        "settings": stack([gridworld(3), gridworld(3)]),
        "features": np.eye(9),
        "occupancy": np.ones((1, 2, 9)),
        "weights": np.full((1, 2), 0.5),
        "penalty_weight": np.zeros(1),
        "l2": np.zeros(1),
        "seeds": [0],
        "penalty_kind": "irmv1",
        "horizon": 6,
        "iterations": 1,
    }
    fit(**arguments)
    with pytest.raises(ValueError, match=message):
        fit(**{**arguments, **change})


def test_unknown_names_are_refused():
    with pytest.raises(UsageError, match="unknown method"):
        setting_weights("mle", np.ones(2))
    with pytest.raises(UsageError, match="unknown penalty"):
        penalty("irmv2", np.zeros((1, 2)), np.zeros((1, 1, 2)))
    with pytest.raises(ValueError, match="no demonstrations"):
        setting_weights("erm", np.array([3, 0]))
