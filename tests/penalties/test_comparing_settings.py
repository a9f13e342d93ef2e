"""V-REx, group DRO, IGA and the controls L2 and input gradient, computed by hand and by autograd."""

import math

import pytest
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from irlcli.penalties import (
    PenaltyOptions,
    Samples,
    discriminator_penalty,
    group_dro,
    iga,
    l2,
    vrex,
)
from irlcli.penalties.risk import cross_entropy

E, B, D = 3, 8, 4
PLAIN = PenaltyOptions(unbiased=False)
UNIFORM = torch.full((E,), 1 / E, dtype=torch.float64)


def of_risks(risks, weights=None):
    """Samples of which only the risks matter."""
    risks = torch.as_tensor(risks, dtype=torch.float64)
    weights = (
        torch.full_like(risks, 1 / len(risks)) if weights is None else torch.as_tensor(weights)
    )
    return Samples(torch.zeros(len(risks), 2, 2), torch.zeros(len(risks), 2, 2), risks, weights)


@pytest.fixture
def linear():
    """Inputs x [E, 2, B, D] and weights theta [D] of logits x theta."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(E, 2, B, D, generator=generator, dtype=torch.float64)
    theta = torch.randn(D, generator=generator, dtype=torch.float64)
    return x, theta.requires_grad_()


def samples_of(x, theta):
    logits = x @ theta
    return Samples(logits, logits, cross_entropy(logits), UNIFORM, (theta,))


def test_vrex_is_the_variance_of_the_risks():
    # Mean 3: (4 + 1 + 9) / 3.
    assert vrex.discriminator(of_risks([1, 2, 6]), PLAIN).item() == pytest.approx(14 / 3)


def test_group_dro_turns_the_mean_into_shares_that_grow_with_the_risk():
    # exp(2 R) = 1, 2, 5: shares 1/8, 2/8, 5/8.
    risks = [0.0, math.log(2) / 2, math.log(5) / 2]
    seen = of_risks(torch.tensor(risks, dtype=torch.float64).requires_grad_())
    total = seen.risks.mean() + 2.0 * group_dro.discriminator(seen, PenaltyOptions(weight=2.0))
    assert total.item() == pytest.approx((2 * risks[1] + 5 * risks[2]) / 8)
    (gradient,) = torch.autograd.grad(total, seen.risks)
    assert gradient.tolist() == pytest.approx([1 / 8, 2 / 8, 5 / 8])


def test_the_gradient_of_group_dro_is_that_of_a_soft_maximum():
    weights = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    seen = of_risks(torch.tensor([0.3, 0.1, 0.9], dtype=torch.float64).requires_grad_(), weights)
    penalty = group_dro.discriminator(seen, PenaltyOptions(weight=7.0))
    total = (weights * seen.risks).sum() + 7.0 * penalty
    (actual,) = torch.autograd.grad(total, seen.risks)
    soft = torch.log((weights * torch.exp(7.0 * seen.risks)).sum()) / 7.0
    (expected,) = torch.autograd.grad(soft, seen.risks)
    torch.testing.assert_close(actual, expected)


def test_group_dro_at_a_large_lambda_is_the_worst_risk_and_at_none_the_mean():
    seen = of_risks([0.3, 0.1, 0.9])
    worst = seen.risks.mean() + 1e6 * group_dro.discriminator(seen, PenaltyOptions(weight=1e6))
    assert worst.item() == pytest.approx(0.9)
    assert group_dro.discriminator(seen, PenaltyOptions(weight=0.0)) == 0.0


def test_group_dro_keeps_the_share_that_challengers_leave_to_the_risks():
    seen = of_risks([0.3, 0.1, 0.9], UNIFORM / 2)
    total = 0.5 * seen.risks.mean() + 50.0 * group_dro.discriminator(
        seen, PenaltyOptions(weight=50.0)
    )
    assert total.item() == pytest.approx(0.45)
    # Challengers may leave nothing.
    assert (
        group_dro.discriminator(of_risks([0.3, 0.1], [0.0, 0.0]), PenaltyOptions(weight=50.0)) == 0
    )


def test_iga_of_a_linear_model_is_the_variance_of_its_gradients(linear):
    """The gradient of a cross-entropy is the mean of (sigmoid(l) - y) x."""
    x, theta = linear
    with torch.no_grad():
        error = (x @ theta).sigmoid()
        error[:, 1] -= 1.0
        gradients = 0.5 * (error[..., None] * x).mean(2).sum(1)  # [E, D]
        expected = gradients.var(0, unbiased=False).sum()
    torch.testing.assert_close(iga.discriminator(samples_of(x, theta), PLAIN), expected)


@pytest.mark.parametrize("unbiased", [False, True])
@pytest.mark.parametrize("name", ["vrex", "iga", "l2"])
def test_gradients_by_finite_differences(linear, name, unbiased):
    x, theta = linear
    penalty, options = discriminator_penalty(name), PenaltyOptions(unbiased=unbiased)
    assert torch.autograd.gradcheck(lambda weights: penalty(samples_of(x, weights), options), theta)


@pytest.mark.parametrize("unbiased", [False, True])
@pytest.mark.parametrize("name", ["vrex", "iga", "group-dro"])
def test_equal_settings_are_not_penalised(linear, name, unbiased):
    x, theta = linear
    equal = samples_of(x[:1].expand(E, -1, -1, -1), theta)
    found = discriminator_penalty(name)(equal, PenaltyOptions(unbiased=unbiased))
    assert found.item() == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("name", ["vrex", "iga"])
def test_the_unbiased_estimate_has_the_right_mean_and_the_plain_one_is_biased(linear, name):
    x, theta = linear
    penalty = discriminator_penalty(name)
    truth = penalty(samples_of(x, theta), PLAIN).item()
    generator = torch.Generator().manual_seed(1)
    found = {True: [], False: []}
    for _ in range(800):
        picks = torch.randint(B, (E, 2, 4), generator=generator)
        drawn = torch.gather(x, 2, picks[..., None].expand(-1, -1, -1, D))
        for unbiased, values in found.items():
            one = penalty(samples_of(drawn, theta), PenaltyOptions(unbiased=unbiased))
            values.append(one.item())
    means = {unbiased: torch.tensor(values) for unbiased, values in found.items()}
    errors = {unbiased: 4 * v.std().item() / len(v) ** 0.5 for unbiased, v in means.items()}
    assert means[True].mean().item() == pytest.approx(truth, abs=errors[True])
    assert means[False].mean().item() > truth + errors[False]


def test_the_risk_of_parts_of_a_batch_is_torchs(linear):
    x, theta = linear
    logits = x @ theta
    labels = torch.zeros_like(logits)
    labels[:, 1] = 1.0
    each = binary_cross_entropy_with_logits(logits, labels, reduction="none")
    torch.testing.assert_close(cross_entropy(logits[..., ::2]), each[..., ::2].mean((1, 2)))


def test_l2_is_half_the_squared_size_of_all_weights():
    parameters = (torch.tensor([3.0]), torch.tensor([[4.0, 0.0]]))
    seen = of_risks([1.0])._replace(parameters=parameters)
    assert l2.discriminator(seen, PLAIN).item() == pytest.approx(12.5)


def test_input_gradient_is_the_slope_it_is_given():
    seen = of_risks([1.0])._replace(input_gradient=lambda: torch.tensor(2.5))
    assert discriminator_penalty("input-gradient")(seen, PLAIN).item() == 2.5
