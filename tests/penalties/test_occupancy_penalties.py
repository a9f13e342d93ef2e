"""The penalties of MaxEnt IRL against autograd, finite differences and hand-computed values."""

import numpy as np
import pytest
import torch

from irlcli.errors import UsageError
from irlcli.penalties import PENALTIES, Occupancies, check_penalty, check_risks, occupancy_penalty

MAXENT = [name for name, penalty in PENALTIES.items() if "maxent" in penalty.learners]


def at(phi, gap, risks=None, weights=None, weight=1.0):
    """What a penalty sees, for equal risks of equal weights that respond to w by one."""
    runs, count, _ = gap.shape
    return Occupancies(
        phi,
        gap,
        np.full((runs, count), 1 / count) if weights is None else weights,
        np.ones((runs, count)) if risks is None else np.asarray(risks, dtype=float),
        lambda: np.ones(gap.shape),
        np.full(runs, weight),
    )


@pytest.mark.parametrize("name", ["irmv1", "closed-form"])
def test_penalty_gradients_by_finite_differences_and_autograd(name):
    rng = np.random.default_rng(3)
    phi, gap = rng.normal(size=(2, 5)), rng.normal(size=(2, 3, 5))
    penalty = occupancy_penalty(name)
    found, gradient = penalty(at(phi, gap))
    leaf, fixed = torch.tensor(phi, requires_grad=True), torch.tensor(gap)
    if name == "irmv1":
        value = (leaf[:, None] * fixed).sum(-1) ** 2
    else:
        value = (fixed**2).sum(-1) * (leaf**2).sum(-1)[:, None]
    assert np.allclose(found, value.detach().numpy())
    value.sum().backward()
    assert np.allclose(gradient.sum(1), leaf.grad.numpy(), atol=1e-12)
    for s in range(5):
        step = np.zeros((2, 5))
        step[:, s] = 1e-5
        numeric = (penalty(at(phi + step, gap))[0] - penalty(at(phi - step, gap))[0]) / 2e-5
        assert np.allclose(gradient[..., s], numeric, atol=1e-6)


def test_closed_form_bounds_irmv1():
    rng = np.random.default_rng(5)
    both = at(rng.normal(size=(4, 6)), rng.normal(size=(4, 3, 6)))
    irmv1, closed_form = (occupancy_penalty(name)(both)[0] for name in ("irmv1", "closed-form"))
    assert (irmv1 <= closed_form).all()


def test_vrex_is_the_variance_of_the_likelihoods_and_its_gradient():
    # Risks 1, 2 and 6 of equal weight: mean 3, variance (4 + 1 + 9) / 3. Risk k pulls phi by -gap_k.
    gap = np.eye(3)[None]
    value, gradient = occupancy_penalty("vrex")(at(np.zeros((1, 3)), gap, [[1, 2, 6]]))
    assert value.mean() == pytest.approx(14 / 3)
    assert gradient.mean(1)[0] == pytest.approx(-2 / 3 * np.array([1 - 3, 2 - 3, 6 - 3]))


def test_a_risk_without_weight_changes_nothing():
    """Runs side by side are filled up with such risks."""
    rng = np.random.default_rng(7)
    phi, gap, risks = rng.normal(size=(1, 4)), rng.normal(size=(1, 3, 4)), [[1.0, 4.0, 0.0]]
    weights = np.array([[0.5, 0.5, 0.0]])
    filled = at(phi, gap, risks, weights, weight=2.0)
    alone = at(phi, gap[:, :2], [risks[0][:2]], weights[:, :2], weight=2.0)
    for name in MAXENT:
        sums = [
            (m.weights[0] @ value[0], m.weights[0] @ gradient[0])
            for m in (filled, alone)
            for value, gradient in [occupancy_penalty(name)(m)]
        ]
        assert sums[0][0] == pytest.approx(sums[1][0]), name
        assert sums[0][1] == pytest.approx(sums[1][1]), name


@pytest.mark.parametrize("weight", [0.5, 2.0])
def test_group_dro_weighs_a_likelihood_by_its_exponential(weight):
    # exp(lambda L) of L = 0 and log(3) / lambda: shares 1/4 and 3/4.
    gap = np.eye(2)[None]
    both = at(np.zeros((1, 2)), gap, [[0.0, np.log(3) / weight]], weight=weight)
    _, gradient = occupancy_penalty("group-dro")(both)
    pulled = 0.5 * (-gap[0] + weight * gradient[0]).sum(0)
    assert pulled == pytest.approx([-1 / 4, -3 / 4])


def test_group_dro_without_lambda_is_the_mean():
    value, gradient = occupancy_penalty("group-dro")(
        at(np.ones((1, 2)), np.eye(2)[None], [[1.0, 5.0]], weight=0.0)
    )
    assert not value.any() and not gradient.any()


def test_no_penalty_is_zero_and_pulls_nowhere():
    value, gradient = occupancy_penalty("none")(at(np.ones((4, 6)), np.ones((4, 3, 6))))
    assert value.shape == (4, 3) and gradient.shape == (4, 3, 6)
    assert not value.any() and not gradient.any()


@pytest.mark.parametrize("name", MAXENT)
def test_a_matched_occupancy_of_equal_risks_is_not_penalised(name):
    value, gradient = occupancy_penalty(name)(at(np.ones((4, 6)), np.zeros((4, 3, 6))))
    assert np.allclose(value, 0.0, atol=1e-14) and np.allclose(gradient, 0.0)


def test_unknown_penalties_and_those_of_other_learners_are_refused():
    with pytest.raises(UsageError, match="unknown penalty 'irmv2'"):
        check_penalty("irmv2", "maxent")
    with pytest.raises(UsageError, match="airl has no penalty 'closed-form'"):
        check_penalty("closed-form", "airl")


@pytest.mark.parametrize("name", ["vrex", "iga", "group-dro"])
def test_a_penalty_that_compares_settings_refuses_a_single_risk(name):
    with pytest.raises(UsageError, match="at least two"):
        check_risks(name, "per-setting", 1)
    with pytest.raises(UsageError, match="one of all settings"):
        check_risks(name, "balanced", 2)
    check_risks(name, "shuffled", 2)
    check_risks("irmv1", "per-setting", 1)


@pytest.mark.parametrize("name", ["irmv1", "vrex"])
def test_labels_of_one_setting_cannot_be_shuffled(name):
    with pytest.raises(UsageError, match="no labels to shuffle"):
        check_risks(name, "shuffled", 1)
