"""IRMv1 against autograd, closed forms and its own expectation."""

import math

import pytest
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from irlcli.penalties import PenaltyOptions, Samples, irmv1
from irlcli.penalties.risk import cross_entropy

SHAPE = (3, 2, 8)


@pytest.fixture
def samples():
    generator = torch.Generator().manual_seed(0)
    f = torch.randn(SHAPE, generator=generator, dtype=torch.float64)
    log_pi = -torch.rand(SHAPE, generator=generator, dtype=torch.float64) * 3
    return f, log_pi


def torch_loss(logits):
    """BCE of each setting by torch's own function, labels weighted equally."""
    labels = torch.zeros_like(logits)
    labels[:, 1] = 1.0
    each = binary_cross_entropy_with_logits(logits, labels, reduction="none")
    return each.mean((-1, -2))


def penalty(logits, f, scaling="logit", unbiased=False):
    risks = cross_entropy(logits)
    seen = Samples(logits, f, risks, torch.full_like(risks, 1 / len(risks)))
    return irmv1.discriminator(seen, PenaltyOptions(scaling, unbiased))


def estimates(logits, unbiased):
    """The estimate of each risk alone [E]."""
    return torch.stack([penalty(one[None], one[None], unbiased=unbiased) for one in logits])


def test_cross_entropy_is_torchs(samples):
    f, log_pi = samples
    torch.testing.assert_close(cross_entropy(f - log_pi), torch_loss(f - log_pi))


@pytest.mark.parametrize("scaling", ["logit", "reward"])
def test_scale_gradient_is_the_derivative_by_w(samples, scaling):
    f, log_pi = samples
    w = torch.ones(SHAPE[0], 1, 1, dtype=torch.float64, requires_grad=True)
    logits = w * (f - log_pi) if scaling == "logit" else w * f - log_pi
    (expected,) = torch.autograd.grad(torch_loss(logits).sum(), w)
    scaled = f - log_pi if scaling == "logit" else f
    actual = irmv1.scale_gradient(f - log_pi, scaled)
    torch.testing.assert_close(actual, expected.flatten())


@pytest.mark.parametrize("scaling", ["logit", "reward"])
def test_penalty_gradient_is_the_double_backward(samples, scaling):
    f, log_pi = samples
    f1, f2 = f.clone().requires_grad_(), f.clone().requires_grad_()
    w = torch.ones(SHAPE[0], 1, 1, dtype=torch.float64, requires_grad=True)
    logits = w * (f1 - log_pi) if scaling == "logit" else w * f1 - log_pi
    (by_w,) = torch.autograd.grad(torch_loss(logits).sum(), w, create_graph=True)
    (expected,) = torch.autograd.grad((by_w**2).mean(), f1)
    (actual,) = torch.autograd.grad(penalty(f2 - log_pi, f2, scaling), f2)
    torch.testing.assert_close(actual, expected)


def test_penalty_gradient_by_finite_differences(samples):
    f, log_pi = samples
    torch.autograd.gradcheck(lambda x: penalty(x - log_pi, x, "reward"), f.clone().requires_grad_())


def test_equal_logits_have_the_closed_form():
    c = 1.7
    logits = torch.full(SHAPE, c, dtype=torch.float64)
    sigmoid = 1 / (1 + math.exp(-c))
    expected = (0.5 * c * (2 * sigmoid - 1)) ** 2
    assert penalty(logits, logits).item() == pytest.approx(expected)


def test_penalty_vanishes_where_w_is_optimal():
    # Symmetric logits +-c in shares sigmoid(c) : 1 - sigmoid(c): calibrated, so w = 1 is optimal.
    c = math.log(3.0)  # sigmoid(c) = 3/4
    right = torch.tensor([c, c, c, -c], dtype=torch.float64)
    logits = torch.stack([-right, right])[None]
    assert penalty(logits, logits).item() == pytest.approx(0.0, abs=1e-15)


def test_unbiased_estimate_has_the_right_mean_and_the_square_is_biased(samples):
    f, log_pi = samples
    population = (f - log_pi)[:1]
    truth = irmv1.scale_gradient(population, population).item() ** 2
    generator = torch.Generator().manual_seed(1)
    repeats, size = 5000, 4
    picks = torch.randint(SHAPE[2], (repeats, 2, size), generator=generator)
    drawn = torch.gather(population.expand(repeats, 2, SHAPE[2]), 2, picks)
    unbiased = estimates(drawn, unbiased=True)
    square = estimates(drawn, unbiased=False)
    error = unbiased.std().item() / repeats**0.5
    assert unbiased.mean().item() == pytest.approx(truth, abs=4 * error)
    assert square.mean().item() > truth + 4 * square.std().item() / repeats**0.5


def test_the_penalty_of_equal_risks_is_that_of_one(samples):
    f, log_pi = samples
    one = (f - log_pi)[:1]
    assert penalty(one.expand(SHAPE), one.expand(SHAPE)).item() == pytest.approx(
        penalty(one, one).item()
    )
