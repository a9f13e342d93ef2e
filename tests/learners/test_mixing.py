"""Samples that mix a challenger's numbers with an expert's."""

import math

import pytest
import torch

from irlcli.learners.discriminator import discriminator_logits
from irlcli.learners.mixing import mixed
from irlcli.learners.pools import Minibatch
from irlcli.learners.reward_model import RewardModel
from irlcli.penalties.risk import cross_entropy


def a_batch(size: int, width: int) -> Minibatch:
    """The policy's numbers are 0, the expert's 1; successors are 10 and 11."""
    label = torch.arange(2.0).reshape(1, 2, 1, 1)
    return Minibatch(
        observations=label.expand(2, 2, size, width),
        actions=label.expand(2, 2, size, 3),
        next_observations=label.expand(2, 2, size, width) + 10.0,
        terminated=torch.arange(2.0).reshape(1, 2, 1).expand(2, 2, size),
        log_probs=torch.randn(2, 2, size),
    )


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_without_a_share_nothing_is_mixed():
    batch = a_batch(8, 5)
    for name, values in vars(mixed(batch, 0.0, generator())).items():
        assert torch.equal(values, getattr(batch, name))


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_each_number_is_the_policys_or_the_experts(share):
    batch = a_batch(4000, 6)
    found = mixed(batch, share, generator())
    policy = found.observations[:, 0]
    assert set(policy.unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(found.next_observations[:, 0], policy + 10.0)
    # The action is one or the other as a whole.
    assert torch.equal(found.actions[:, 0].amin(-1), found.actions[:, 0].amax(-1))
    assert torch.equal(found.actions[:, 0, :, 0], found.terminated[:, 0])
    for name in ("observations", "actions", "next_observations"):
        assert torch.equal(getattr(found, name)[:, 1], getattr(batch, name)[:, 1])
    # With a uniform probability of each number, their count is uniform on 0 to 6.
    counts = torch.bincount(policy.sum(-1).long().ravel(), minlength=7) / 8000
    expected = torch.full((7,), share / 7)
    expected[0] += 1.0 - share
    torch.testing.assert_close(counts, expected, atol=0.02, rtol=0.0)


def paid(share: float) -> torch.Tensor:
    """g where none, one, the other, and both of an expert's two numbers are there.

    Experts have (1, 1), challengers (0, 0): nothing tells which of the two numbers matters.
    """
    torch.manual_seed(0)
    model = RewardModel(2, 3, False, True, [16], "tanh", 0.9, shaping=False)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    draws = generator()
    for _ in range(200):
        batch = mixed(a_batch(64, 2), share, draws)
        logits, _ = discriminator_logits(model, batch, "f")
        optimizer.zero_grad()
        cross_entropy(logits).mean().backward()
        optimizer.step()
    corners = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    with torch.no_grad():
        return model.reward(corners, torch.zeros(4, 3)).ravel()


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_reward_learned_from_mixed_samples_pays_for_all_numbers_together(share):
    """The best g is the log of the ratio of densities: a third of mixed samples has both numbers."""
    _, first, second, both = paid(share).tolist()
    assert max(first, second) < -2.0
    assert both == pytest.approx(math.log(3.0 / share), abs=0.15)


def test_without_mixed_samples_one_number_is_enough():
    _, first, second, both = paid(0.0).tolist()
    assert both > max(first, second) > 0.0
