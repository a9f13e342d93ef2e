"""The penalties against autograd, closed forms and their own expectation."""

import math

import pytest
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from irlcli.penalties import irmv1 as penalties

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


def test_cross_entropy_is_torchs(samples):
    f, log_pi = samples
    torch.testing.assert_close(penalties.binary_cross_entropy(f - log_pi), torch_loss(f - log_pi))


@pytest.mark.parametrize("scaling", ["logit", "reward"])
def test_scale_gradient_is_the_derivative_by_w(samples, scaling):
    f, log_pi = samples
    w = torch.ones(SHAPE[0], 1, 1, dtype=torch.float64, requires_grad=True)
    logits = w * (f - log_pi) if scaling == "logit" else w * f - log_pi
    (expected,) = torch.autograd.grad(torch_loss(logits).sum(), w)
    scaled = f - log_pi if scaling == "logit" else f
    actual = penalties.scale_gradient(f - log_pi, scaled)
    torch.testing.assert_close(actual, expected.flatten())


@pytest.mark.parametrize("scaling", ["logit", "reward"])
def test_penalty_gradient_is_the_double_backward(samples, scaling):
    f, log_pi = samples
    f1, f2 = f.clone().requires_grad_(), f.clone().requires_grad_()
    w = torch.ones(SHAPE[0], 1, 1, dtype=torch.float64, requires_grad=True)
    logits = w * (f1 - log_pi) if scaling == "logit" else w * f1 - log_pi
    (by_w,) = torch.autograd.grad(torch_loss(logits).sum(), w, create_graph=True)
    (expected,) = torch.autograd.grad((by_w**2).sum(), f1)
    scaled = f2 - log_pi if scaling == "logit" else f2
    penalty = penalties.gradient_norm(f2 - log_pi, scaled)
    (actual,) = torch.autograd.grad(penalty.sum(), f2)
    torch.testing.assert_close(actual, expected)


def test_penalty_gradient_by_finite_differences(samples):
    f, log_pi = samples
    torch.autograd.gradcheck(
        lambda x: penalties.gradient_norm(x - log_pi, x), f.clone().requires_grad_()
    )


def test_equal_logits_have_the_closed_form():
    c = 1.7
    logits = torch.full(SHAPE, c, dtype=torch.float64)
    sigmoid = 1 / (1 + math.exp(-c))
    expected = (0.5 * c * (2 * sigmoid - 1)) ** 2
    torch.testing.assert_close(
        penalties.gradient_norm(logits, logits), torch.full((3,), expected, dtype=torch.float64)
    )


def test_penalty_vanishes_where_w_is_optimal():
    # Symmetric logits +-c in shares sigmoid(c) : 1 - sigmoid(c): calibrated, so w = 1 is optimal.
    c = math.log(3.0)  # sigmoid(c) = 3/4
    right = torch.tensor([c, c, c, -c], dtype=torch.float64)
    logits = torch.stack([-right, right])[None]
    assert penalties.gradient_norm(logits, logits).item() == pytest.approx(0.0, abs=1e-15)


def test_unbiased_estimate_has_the_right_mean_and_the_square_is_biased(samples):
    f, log_pi = samples
    population = (f - log_pi)[:1]
    truth = penalties.scale_gradient(population, population).item() ** 2
    generator = torch.Generator().manual_seed(1)
    repeats, size = 40_000, 4
    picks = torch.randint(SHAPE[2], (repeats, 2, size), generator=generator)
    drawn = torch.gather(population.expand(repeats, 2, SHAPE[2]), 2, picks)
    unbiased = penalties.gradient_norm_unbiased(drawn, drawn)
    square = penalties.gradient_norm(drawn, drawn)
    error = unbiased.std().item() / repeats**0.5
    assert unbiased.mean().item() == pytest.approx(truth, abs=4 * error)
    assert square.mean().item() > truth + 4 * square.std().item() / repeats**0.5


def test_identical_settings_have_identical_penalties(samples):
    f, log_pi = samples
    same = (f - log_pi)[:1].expand(SHAPE)
    penalty = penalties.gradient_norm(same, same)
    torch.testing.assert_close(penalty, penalty[:1].expand(3))
