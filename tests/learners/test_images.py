"""Discriminator samples and their images under symmetries."""

import numpy as np
import torch

from irlcli.learners.discriminator import discriminator_logits
from irlcli.learners.images import Images
from irlcli.learners.pools import Minibatch
from irlcli.learners.reward_model import RewardModel
from irlcli.penalties.risk import cross_entropy
from irlcli.symmetries import Symmetries

# A reflection of the first number, which swaps two actions; and a half turn of an orientation.
FLIP = np.array([np.diag([1.0, 1.0]), np.diag([-1.0, 1.0])], np.float32)
SWAP = np.array([[[1, 0], [0, 1]], [[0, 1], [1, 0]]], np.float32)
TURN = np.array([np.eye(2), [[0.0, 1.0], [-1.0, 0.0]]], np.float32)


def a_batch(observations: torch.Tensor) -> Minibatch:
    """Samples at ``observations`` [E, 2, B, D], each followed by the state one further."""
    shape = observations.shape[:-1]
    actions = torch.stack([torch.full(shape, 2.0), torch.full(shape, 3.0)], -1)
    return Minibatch(
        observations, actions, observations + 1.0, torch.zeros(shape), torch.ones(shape)
    )


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_state_action_and_successor_have_the_same_image_and_each_is_as_frequent():
    batch = a_batch(torch.tensor([5.0, 7.0]).expand(2, 2, 2000, 2))
    found = Images(Symmetries(FLIP, SWAP)).of(batch, generator())
    images = torch.cat([found.observations, found.actions, found.next_observations], -1)
    kinds, counts = images.reshape(-1, 6).unique(dim=0, return_counts=True)
    assert kinds.tolist() == [
        [-5.0, 7.0, 3.0, 2.0, -6.0, 8.0],
        [5.0, 7.0, 2.0, 3.0, 6.0, 8.0],
    ]
    assert (counts / 8000 - 0.5).abs().max() < 0.03
    for name in ("terminated", "log_probs"):
        assert torch.equal(getattr(found, name), getattr(batch, name))


def test_an_orientation_has_the_sign_that_a_small_turn_would_give_it():
    images = Images(Symmetries(TURN, SWAP, quaternion=slice(0, 2)))
    observations = torch.tensor([[0.6, 0.8], [-0.6, 0.8], [0.6, -0.8]]).repeat(500, 1)
    found = images.of_observations(observations, generator())
    other = (found - observations).abs().sum(-1) > 1e-6
    # The image of (0.6, 0.8) is (0.8, -0.6), the same orientation as (-0.8, 0.6).
    torch.testing.assert_close(found[0::3][other[0::3]].unique(dim=0), torch.tensor([[-0.8, 0.6]]))
    torch.testing.assert_close(found[1::3][other[1::3]].unique(dim=0), torch.tensor([[0.8, 0.6]]))
    # The state itself keeps its sign.
    torch.testing.assert_close(found[2::3][~other[2::3]].unique(dim=0), torch.tensor([[0.6, -0.8]]))


def rewards(images: Images | None) -> list[float]:
    """g at -1, 0 and 1, learned from experts at 1 and policies at 0."""
    torch.manual_seed(0)
    model = RewardModel(1, 2, False, True, [16], "tanh", 0.9, shaping=False)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    label = torch.arange(2.0).reshape(1, 2, 1, 1).expand(1, 2, 64, 1)
    draws = generator()
    for _ in range(200):
        batch = a_batch(label) if images is None else images.of(a_batch(label), draws)
        logits, _ = discriminator_logits(model, batch, "f")
        optimizer.zero_grad()
        cross_entropy(logits).mean().backward()
        optimizer.step()
    with torch.no_grad():
        places = torch.tensor([[-1.0], [0.0], [1.0]])
        return model.reward(places, torch.zeros(3, 2)).ravel().tolist()


def test_a_reward_learned_from_images_pays_as_much_where_no_expert_was_seen():
    here = Symmetries(np.array([[[1.0]], [[-1.0]]], np.float32), SWAP)
    image, policy, expert = rewards(Images(here))
    assert min(image, expert) > policy + 2.0
    assert abs(image - expert) < 1.0
    image, policy, expert = rewards(None)
    assert expert > policy + 2.0
    assert image < policy
