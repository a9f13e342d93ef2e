"""Maximum causal entropy IRL: its risks by hand, its gradients, and where its fits end."""

import io

import numpy as np
import pytest
import torch
from tabular_demos import expert_demonstrations, mazes

from irlcli.envs.gridworld.env import gridworld, observations
from irlcli.errors import StageFailed
from irlcli.learners.maxent import MaxEnt, RewardNetworks, Risks, group_risks
from irlcli.learners.occupancy import mean_occupancy
from irlcli.learners.soft_values import solve
from irlcli.penalties import Occupancies, occupancy_penalty
from irlcli.tabular import stack

COUNTS = np.array([40, 7, 3])


def soft_experts(settings, seed, horizon):
    """rho_E [E, S] of experts that a finite reward explains exactly."""
    reward = np.random.default_rng(seed).normal(size=(1, settings.shape[1]))
    return solve(settings, reward, horizon).occupancy[0]


def own_risks(expert, weights=None):
    """A risk for each setting, of occupancies ``expert`` [E, S]; equal weights by default."""
    e, n = expert.shape
    occupancy = np.zeros((e, e, n))
    occupancy[np.arange(e), np.arange(e)] = expert
    return Risks(occupancy, np.eye(e), np.full(e, 1 / e) if weights is None else weights)


def maxent(settings, features, risks, penalty_weight=0.0, l2=0.0, seed=0, **changes):
    """A learner of one run."""
    options = {"penalty": "irmv1", "horizon": 16, "learning_rate": 1e-2, **changes}
    return MaxEnt(
        settings, features, [risks], np.array([penalty_weight]), np.array([l2]), [seed], **options
    )


def risk(settings, risks, k, phi, horizon=16):
    """L_k: the mean negative log-likelihood of a risk's demonstrations, by its definition."""
    partition = solve(settings, phi[None], horizon).log_partition[0]
    return sum(
        risks.shares[k, e] * (partition[e] - risks.occupancy[k, e] @ phi)
        for e in range(len(partition))
    )


def seen(settings, phi, gaps, risks, weight):
    """What a penalty with a fixed gap sees."""
    each = np.array([[risk(settings, risks, k, phi) for k in range(len(gaps))]])
    weights = risks.weights[None]
    return Occupancies(phi[None], gaps[None], weights, each, lambda: None, np.array([weight]))


# Risks


def test_pooled_demonstrations_are_one_risk_that_weighs_by_count():
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, "pooled", 16, seed=0)
    assert risks.weights.tolist() == [1.0]
    assert np.allclose(risks.shares, COUNTS / COUNTS.sum())


def test_balanced_demonstrations_are_one_risk_of_equal_settings():
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, "balanced", 16, seed=0)
    assert risks.weights.tolist() == [1.0]
    assert np.allclose(risks.shares, 1 / 3)


def test_per_setting_risks_have_the_setting_they_are_of():
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, "per-setting", 16, seed=0)
    assert np.array_equal(risks.shares, np.eye(3))
    assert np.allclose(risks.weights, 1 / 3)
    for e, mdp in enumerate(settings.mdps):
        assert np.array_equal(risks.occupancy[e, e], mean_occupancy(mdp, demos.states[e], 16))


@pytest.mark.parametrize("seed", range(5))
def test_shuffling_keeps_each_settings_weight_and_its_mean_occupancy(seed):
    """The control: 40, 7 and 3 episodes weigh 1/3 each, as with the true labels."""
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, "shuffled", 16, seed)
    parts = risks.weights[:, None] * risks.shares
    assert risks.weights.sum() == pytest.approx(1.0)
    assert np.allclose(parts.sum(0), 1 / 3)
    for e, mdp in enumerate(settings.mdps):
        whole = mean_occupancy(mdp, demos.states[e], 16) / 3
        assert np.allclose(parts[:, e] @ risks.occupancy[:, e], whole, atol=1e-14)


def test_shuffled_risks_hold_several_settings_and_depend_on_the_seed():
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    one, other = (group_risks(settings, demos, "shuffled", 16, seed) for seed in (0, 1))
    assert (one.shares > 0.2).all()  # three episodes deal one to each risk
    assert not np.array_equal(one.occupancy, other.occupancy)


def test_without_penalty_shuffled_is_balanced():
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    found = [
        maxent(settings, np.eye(25), group_risks(settings, demos, grouping, 16, 0)).fit(60)
        for grouping in ("balanced", "shuffled", "per-setting", "pooled")
    ]
    assert np.allclose(found[0], found[1], atol=1e-9)
    assert np.allclose(found[0], found[2], atol=1e-9)
    assert np.abs(found[0] - found[3]).max() > 0.1


# Gradients


@pytest.mark.parametrize("grouping", ["pooled", "balanced", "per-setting", "shuffled"])
@pytest.mark.parametrize("penalty", ["none", "irmv1", "closed-form", "vrex", "group-dro"])
def test_a_step_follows_the_gradient_of_the_penalised_risk(grouping, penalty):
    """By finite differences in phi; the penalty's gap, which is held fixed, in closed form."""
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, grouping, 16, seed=0)
    learner = maxent(settings, np.eye(25), risks, 0.3, penalty=penalty, hidden=0)
    phi = np.random.default_rng(0).normal(size=25)
    with torch.no_grad():
        learner.networks.psi[0, :, 0] = torch.as_tensor(phi)
    learner.step(record=True)
    policy = solve(settings, phi[None], 16).occupancy[0]
    gaps = np.stack(
        [
            sum(risks.shares[k, e] * (risks.occupancy[k, e] - policy[e]) for e in range(3))
            for k in range(len(risks.weights))
        ]
    )

    def objective(phi):
        at = seen(settings, phi, gaps, risks, 0.3)
        if penalty == "group-dro":
            # Its shares are held fixed: the gradient is that of a soft maximum.
            return np.log(risks.weights @ np.exp(0.3 * at.risks[0])) / 0.3
        value, _ = occupancy_penalty(penalty)(at)
        return risks.weights @ (at.risks[0] + 0.3 * value[0])

    step = 1e-5 * np.eye(25)
    numeric = [(objective(phi + d) - objective(phi - d)) / 2e-5 for d in step]
    assert np.allclose(learner.networks.psi.grad[0, :, 0], numeric, atol=1e-6)
    value, _ = occupancy_penalty(penalty)(seen(settings, phi, gaps, risks, 0.3))
    assert learner.records[0].penalty[0] == pytest.approx(risks.weights @ value[0])


@pytest.mark.parametrize("grouping", ["per-setting", "shuffled"])
def test_irmv1_is_the_squared_derivative_of_a_risk_by_the_scale_psi(grouping):
    """Paper Eq. 9 with psi = 1: d/dpsi L_k(psi phi), the dynamics of each episode its own."""
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, grouping, 16, seed=0)
    phi = np.random.default_rng(4).normal(size=25)
    learner = maxent(settings, np.eye(25), risks, hidden=0)
    with torch.no_grad():
        learner.networks.psi[0, :, 0] = torch.as_tensor(phi)
    learner.step(record=True)
    slopes = [
        (risk(settings, risks, k, phi * 1.00001) - risk(settings, risks, k, phi * 0.99999)) / 2e-5
        for k in range(3)
    ]
    expected = risks.weights @ np.square(slopes)
    assert expected > 0.01
    assert learner.records[0].penalty[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("grouping", ["pooled", "per-setting", "shuffled"])
def test_irmv1_full_is_differentiated_through_the_policy(grouping):
    """By finite differences of the whole objective: the gap follows phi."""
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, grouping, 16, seed=0)
    phi = np.random.default_rng(0).normal(size=25)
    learner = maxent(settings, np.eye(25), risks, 0.3, penalty="irmv1-full", hidden=0)
    with torch.no_grad():
        learner.networks.psi[0, :, 0] = torch.as_tensor(phi)
    learner.step(record=True)

    def objective(phi):
        policy = solve(settings, phi[None], 16).occupancy[0]
        slopes = np.einsum("ke,kes,s->k", risks.shares, risks.occupancy - policy, phi)
        each = [risk(settings, risks, k, phi) for k in range(len(slopes))]
        return risks.weights @ (each + 0.3 * slopes**2)

    step = 1e-5 * np.eye(25)
    numeric = [(objective(phi + d) - objective(phi - d)) / 2e-5 for d in step]
    assert np.allclose(learner.networks.psi.grad[0, :, 0], numeric, rtol=1e-4, atol=1e-4)


def test_a_step_follows_the_gradient_of_the_risk():
    """By finite differences in phi."""
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    risks = group_risks(settings, demos, "pooled", 16, seed=0)
    learner = maxent(settings, np.eye(25), risks, hidden=0)
    phi = np.random.default_rng(0).normal(size=25)
    with torch.no_grad():
        learner.networks.psi[0, :, 0] = torch.as_tensor(phi)
    learner.step(record=False)
    numeric = [
        (risk(settings, risks, 0, phi + d) - risk(settings, risks, 0, phi - d)) / 2e-5
        for d in 1e-5 * np.eye(25)
    ]
    assert np.allclose(learner.networks.psi.grad[0, :, 0], numeric, atol=1e-6)


@pytest.mark.parametrize(("warmup", "divisor"), [(0, 1.0), (2, 50.0)])
def test_l2_adds_a_multiple_of_the_weights_to_the_gradient(warmup, divisor):
    """After a warm-up it is divided by lambda = 50, as the rest of the objective is."""
    settings = mazes()
    risks = own_risks(soft_experts(settings, 1, 16))
    plain, decayed = (
        maxent(settings, np.eye(25), risks, 50.0, l2, hidden=0, penalty_warmup=warmup)
        for l2 in (0.0, 0.3)
    )
    psi = torch.as_tensor(np.random.default_rng(0).normal(size=(1, 25, 1)))
    for learner in (plain, decayed):
        with torch.no_grad():
            learner.networks.psi[:] = psi
        learner.iterations = warmup
        learner.step(record=False)
    added = decayed.networks.psi.grad - plain.networks.psi.grad
    assert torch.allclose(added, 0.3 * psi / divisor, rtol=1e-9, atol=1e-12)


def test_a_penalty_sees_the_risks_and_their_response_to_the_scale(monkeypatch):
    settings = mazes()
    risks = group_risks(settings, expert_demonstrations(settings, COUNTS), "shuffled", 16, seed=0)
    found = []

    def penalty(at):
        found.append(at._replace(response=at.response()))
        return np.zeros(at.gap.shape[:2]), np.zeros(at.gap.shape)

    monkeypatch.setattr("irlcli.learners.maxent.occupancy_penalty", lambda name: penalty)
    learner = maxent(settings, np.eye(25), risks)
    phi = learner.rewards()[0]
    learner.step(record=False)
    expected = [risk(settings, risks, k, phi) for k in range(3)]
    assert np.allclose(found[0].risks[0], expected)
    assert np.array_equal(found[0].weights[0], risks.weights)
    one, other = (solve(settings, w * phi[None], 16).occupancy[0] for w in (1.0001, 0.9999))
    by_scale = -np.einsum("ke,es->ks", risks.shares, (one - other) / 2e-4)
    assert np.allclose(found[0].response[0], by_scale, atol=1e-3)


def test_kinds_of_states_share_their_reward():
    """As states with equal features do, in worlds that look different to each run."""
    settings = mazes()
    risks = own_risks(soft_experts(settings, 1, 16))
    of_kinds = np.random.default_rng(2).normal(size=(4, 3))
    kinds = np.random.default_rng(3).integers(4, size=(2, 1, 25)).repeat(3, axis=1)
    options = {"penalty": "irmv1", "horizon": 16, "learning_rate": 1e-2}
    weights = np.array([0.1, 0.1])
    both = MaxEnt(
        settings, of_kinds, [risks] * 2, weights, np.zeros(2), [0, 1], kinds=kinds, **options
    )  # fmt: skip
    found = both.fit(30)
    for r in range(2):
        alone = maxent(settings, of_kinds[kinds[r, 0]], risks, 0.1, seed=r)
        reward = alone.fit(30)[0]
        assert np.allclose(found[r][kinds[r, 0]], reward, atol=1e-9)
        for one, other in zip(both.records, alone.records, strict=True):
            assert np.allclose(one.log_likelihood[r], other.log_likelihood[0])
            assert np.allclose(one.penalty[r], other.penalty[0])


def test_lambda_is_zero_in_the_warm_up_and_scales_the_objective_after_it():
    settings = mazes()
    risks = own_risks(soft_experts(settings, 1, 16))
    plain = maxent(settings, np.eye(25), risks)
    warm = maxent(settings, np.eye(25), risks, 50.0, penalty_warmup=5)
    assert np.array_equal(warm.fit(5), plain.fit(5))
    cold = maxent(settings, np.eye(25), risks, 50.0)
    cold.networks.load_state_dict(warm.networks.state_dict())
    warm.step(record=False), cold.step(record=False)
    for one, other in zip(warm.networks.parameters(), cold.networks.parameters(), strict=True):
        assert torch.allclose(50.0 * one.grad, other.grad, rtol=1e-9)


# Fits


def test_a_linear_fit_matches_features_at_the_optimum():
    settings = mazes()
    features = np.random.default_rng(6).normal(size=(25, 3))
    expert = soft_experts(settings, 7, 12)
    weights = np.array([0.5, 0.3, 0.2])
    learner = maxent(settings, features, own_risks(expert, weights), hidden=0, horizon=12)
    reward = learner.fit(300)
    gap = weights @ (expert - solve(settings, reward, 12).occupancy[0])
    uniform = weights @ (expert - solve(settings, np.zeros((1, 25)), 12).occupancy[0])
    assert np.abs(features.T @ uniform).max() > 1.0
    assert np.abs(features.T @ gap).max() < 1e-6
    assert np.allclose(reward[0], features @ learner.networks.psi.detach().numpy()[0, :, 0])


@pytest.mark.parametrize("penalty", ["irmv1", "closed-form"])
def test_identical_settings_have_no_penalty_at_the_optimum(penalty):
    settings = stack([gridworld(4, goal="absorbing")] * 2)
    risks = own_risks(soft_experts(settings, 8, 12))
    learner = MaxEnt(
        settings, np.eye(16), [risks] * 2, np.array([0.0, 0.05]), np.zeros(2), [0, 0],
        penalty=penalty, horizon=12, hidden=0, learning_rate=1e-2,
    )  # fmt: skip
    reward = learner.fit(300)
    penalties = np.stack([record.penalty for record in learner.records])
    assert penalties.max() > 0.1
    assert penalties[-1].max() < 0.03
    assert np.ptp(reward[0]) > 0.5
    first, last = learner.records[0].occupancy_gap, learner.records[-1].occupancy_gap
    assert last.max() < 0.15 < 1.0 < first.min()


def test_a_fit_improves_the_likelihood_and_runs_do_not_affect_each_other():
    settings = mazes()
    demos = expert_demonstrations(settings, COUNTS)
    # Risks of different numbers are fitted side by side.
    risks = [group_risks(settings, demos, g, 16, 0) for g in ("pooled", "shuffled")]
    weights, l2, seeds = (0.0, 1e-3), (1e-3, 0.0), (3, 4)
    shared = {"penalty": "irmv1", "horizon": 16, "learning_rate": 1e-2}
    both = MaxEnt(
        settings, np.eye(25), risks, np.array(weights), np.array(l2), seeds, **shared
    )  # fmt: skip
    reward = both.fit(60)
    first, last = both.records[0].log_likelihood, both.records[-1].log_likelihood
    assert (last.mean(-1) > first.mean(-1) + 1.0).all()
    for r in range(2):
        alone = maxent(settings, np.eye(25), risks[r], weights[r], l2[r], seeds[r])
        assert np.allclose(alone.fit(60)[0], reward[r], atol=1e-9)


def test_a_fit_continued_from_a_state_ends_with_the_same_bits():
    settings = mazes()
    risks = own_risks(soft_experts(settings, 6, 16))

    def fresh():
        return maxent(settings, np.eye(25), risks, 0.01, penalty="closed-form")

    states = []

    def keep():
        buffer = io.BytesIO()
        torch.save(whole.state_dict(), buffer)
        states.append((whole.iterations, buffer.getvalue()))

    whole = fresh()
    reward = whole.fit(25, record_every=10, after_record=keep)
    assert [done for done, _ in states] == [1, 11, 21, 25]
    for _, data in states:
        again = fresh()
        again.load_state_dict(torch.load(io.BytesIO(data), weights_only=True))
        assert np.array_equal(again.fit(25, record_every=10), reward)
        for one, other in zip(again.records, whole.records, strict=True):
            assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_l2_and_the_penalty_change_the_fit():
    settings = mazes()
    risks = own_risks(soft_experts(settings, 1, 16))
    learner = MaxEnt(
        settings, observations(5), [risks] * 3, np.array([0.0, 0.0, 0.1]),
        np.array([0.0, 5.0, 0.0]), [0, 0, 0], penalty="closed-form", horizon=16,
        learning_rate=1e-2,
    )  # fmt: skip
    plain, decayed, invariant = np.ptp(learner.fit(200), axis=1)
    assert decayed < 0.5 * plain and invariant < 0.9 * plain


def test_networks_start_from_their_seed_only():
    three = RewardNetworks(2, 8, [5, 6, 5])
    one = RewardNetworks(2, 8, [6])
    reward = three(torch.as_tensor(observations(4)).double())
    assert torch.equal(reward[0], reward[2]) and not torch.equal(reward[0], reward[1])
    assert torch.allclose(one(torch.as_tensor(observations(4)).double())[0], reward[1])


def test_a_fit_that_diverges_is_no_reward():
    """Its next step would be to infinity, or, by RMSProp's infinite mean of squares, zero."""
    settings, risks = stack([gridworld(3), gridworld(3)]), own_risks(np.ones((2, 9)))
    for weight, rate in ((1.0, 1e300), (0.0, 1e308), (1e300, 1e-3)):
        learner = maxent(settings, np.eye(9), risks, weight, learning_rate=rate)
        with pytest.raises(StageFailed, match="not finite in iteration"):
            learner.fit(5)


# Bad arguments


@pytest.mark.parametrize(
    ("change", "message"),
    [({"learning_rate": float("nan")}, "learning rate"), ({"horizon": 0}, "horizon must be")],
)
def test_bad_arguments_are_refused(change, message):
    settings, risks = stack([gridworld(3), gridworld(3)]), own_risks(np.ones((2, 9)))
    maxent(settings, np.eye(9), risks).fit(1)
    with pytest.raises(ValueError, match=message):
        maxent(settings, np.eye(9), risks, **change).fit(1)
