"""With ``shared_absorbing`` every episode that ends early continues in the same absorbing state."""

import numpy as np
import pytest
import torch

from irlcli.learners.discriminator import discriminator_logits
from irlcli.learners.images import Images
from irlcli.learners.pools import Minibatch, make_pool
from irlcli.learners.reward_model import AveragedReward, RewardModel, absorbed
from irlcli.learners.scoring import episode_reward
from irlcli.learners.standalone import StandaloneReward
from irlcli.penalties.risk import cross_entropy
from irlcli.symmetries import Symmetries
from irlcli.trajectories import Transitions

D, A = 3, 2


def model(shared=True, state_only=False, hidden=(8,), **options):
    torch.manual_seed(0)
    return RewardModel(
        D, A, False, state_only, hidden, "tanh", 0.9, False, shared_absorbing=shared, **options
    )


@pytest.mark.parametrize("options", [{}, {"state_only": True}, {"columns": (1,)}])
def test_absorbing_states_differ_only_without_it(options):
    finals = torch.randn(20, D)
    shared, kept = (absorbed(model(shared, **options), finals) for shared in (True, False))
    assert torch.equal(shared, shared[:1].expand(20))
    assert len(kept.unique()) == 20


def test_a_mean_of_rewards_shares_it_too():
    finals = torch.randn(20, D)
    parts = [model(), model()]
    torch.testing.assert_close(absorbed(AveragedReward(parts), finals), absorbed(parts[0], finals))


def test_other_states_are_told_apart_as_before():
    """A linear g = w s + v a + c e: e is 1 in absorbing states, in which s and a count as zero."""
    reward = model(hidden=())
    w, v, c = reward.g[0].weight[0].detach().split([D, A, 1])
    states, actions = torch.randn(5, D), torch.randn(5, A)
    bias = reward.g[0].bias.detach()
    torch.testing.assert_close(
        reward.reward(states, reward.encode(actions)),
        states @ w + actions @ v + bias,
        atol=1e-4,
        rtol=0,
    )
    torch.testing.assert_close(absorbed(reward, states), (c + bias).expand(5))


def an_episode(length, remaining, final):
    """It ends in ``final`` with so many steps left; at 0 it lasts until the time limit."""
    ended = np.arange(length) == length - 1
    return Transitions(
        observations=np.zeros((length, D), np.float32),
        actions=np.zeros((length, A), np.float32),
        next_observations=np.full((length, D), final, np.float32),
        terminated=ended & (remaining > 0),
        remaining=np.where(ended, remaining, 0),
    )


def test_the_return_of_an_episode_that_ends_early_does_not_depend_on_its_final_state():
    reward = model()
    one, other = (episode_reward(reward, an_episode(4, 6, x), True, np.inf) for x in (-1.0, 2.0))
    step, end = (
        float(reward.reward(torch.zeros(D), v)) for v in (torch.zeros(A + 1), torch.eye(A + 1)[A])
    )
    assert one == other == pytest.approx(4 * step + 6 * end, rel=1e-5)
    with torch.no_grad():
        alone = StandaloneReward(reward, 1.0, True, 0.9, np.inf, None, None)
        zeros = torch.zeros(1, D), torch.zeros(1, A), torch.full((1, D), 2.0)
        assert float(alone(*zeros, torch.tensor([True]))) == pytest.approx(step + 9 * end, rel=1e-5)


def test_images_of_absorbing_states_are_absorbing():
    maps = np.array([np.eye(D), -np.eye(D)], np.float32)
    swap = np.array([np.eye(A), np.eye(A)[::-1]], np.float32)
    vectors = torch.tensor([2.0, 3.0, 1.0]).expand(1, 2, 50, 3)
    states, none = torch.ones(1, 2, 50, D), torch.zeros(1, 2, 50)
    batch = Minibatch(states, vectors, states, none, none)
    found = Images(Symmetries(maps, swap)).of(batch, torch.Generator().manual_seed(0))
    assert found.actions.reshape(-1, 3).unique(dim=0).tolist() == [[2.0, 3.0, 1.0], [3.0, 2.0, 1.0]]


def learned(shared):
    """g of absorbing states at x = 3, after policies fell at x = 1 and experts stayed at x = 2."""
    torch.manual_seed(0)
    reward = RewardModel(1, 1, False, False, (16,), "tanh", 0.9, False, shared_absorbing=shared)

    def pool(x, remaining):
        data = Transitions(
            observations=np.full((8, 1), x, np.float32),
            actions=np.zeros((8, 1), np.float32),
            next_observations=np.full((8, 1), x, np.float32),
            terminated=np.full(8, remaining > 0),
            remaining=np.full(8, remaining),
        )
        return make_pool(reward, data, torch.zeros(8), absorbing=True)

    optimizer = torch.optim.Adam(reward.parameters(), lr=1e-2)
    for _ in range(200):
        rows = [(p, torch.arange(64) % len(p.observations)) for p in (pool(1.0, 5), pool(2.0, 0))]
        parts = [
            torch.stack([getattr(p, name)[i] for p, i in rows])[None]
            for name in ("observations", "actions", "next_observations", "terminated", "log_probs")
        ]
        logits, _ = discriminator_logits(reward, Minibatch(*parts), "f")
        optimizer.zero_grad()
        cross_entropy(logits).mean().backward()
        optimizer.step()
    with torch.no_grad():
        expert = float(reward.reward(torch.tensor([2.0]), reward.encode(torch.zeros(1))))
        return float(absorbed(reward, torch.tensor([[3.0]]))) - expert


def test_a_fall_that_nobody_took_is_worth_less_than_the_expert_only_if_falls_are_shared():
    assert learned(shared=True) < -2.0
    assert learned(shared=False) > -0.5
