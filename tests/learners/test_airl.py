"""Adversarial IRL: definitions, absorbing states in closed form, the optimal discriminator."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import scipy.stats
import torch

from irlcli.configs import AIRLConfig
from irlcli.envs.lunar_lander.env import LunarLander
from irlcli.learners import airl, discriminator, scoring
from irlcli.learners.actions import clipped_log_prob
from irlcli.learners.pools import Pool, Stratum, join_pools, make_pool, sample_minibatch
from irlcli.learners.reward_model import RewardModel
from irlcli.networks import ObservationNormaliser
from irlcli.penalties.risk import cross_entropy
from irlcli.trajectories import ActionSpace, Trajectory, Transitions, join

GAMMA = 0.9
EPISODE = Trajectory(
    observations=np.arange(80, dtype=np.float32).reshape(10, 8),
    actions=np.arange(9) % 4,
    rewards=np.zeros(9),
    terminated=False,
    truncated=True,
    seed=0,
)


def make_model(state_only=False, discrete=True, seed=0):
    torch.manual_seed(seed)
    return RewardModel(8, 4, discrete, state_only, [16], "tanh", GAMMA)


def make_transitions(count, terminated=(), remaining=5, seed=0):
    rng = np.random.default_rng(seed)
    ends = np.zeros(count, dtype=bool)
    ends[list(terminated)] = True
    return Transitions(
        observations=rng.normal(size=(count, 8)).astype(np.float32),
        actions=rng.integers(4, size=count),
        next_observations=rng.normal(size=(count, 8)).astype(np.float32),
        terminated=ends,
        remaining=np.where(ends, remaining, 0),
    )


def as_tensors(model, data):
    return (
        torch.as_tensor(data.observations),
        model.encode(torch.as_tensor(data.actions)),
        torch.as_tensor(data.next_observations),
        torch.as_tensor(data.terminated, dtype=torch.float32),
    )


@pytest.mark.parametrize("state_only", [False, True])
def test_f_is_g_plus_shaping(state_only):
    model = make_model(state_only)
    data = make_transitions(6, terminated=[2])
    s, a, s_next, ends = as_tensors(model, data)
    g = model.g(s if state_only else torch.cat([s, a], -1))[:, 0]
    h, h_next = model.h(s)[:, 0], model.h(s_next)[:, 0]
    expected = g + GAMMA * h_next * torch.tensor([1.0, 1, 0, 1, 1, 1]) - h
    torch.testing.assert_close(model(s, a, s_next, ends), expected)


def test_state_only_reward_ignores_actions():
    model = make_model(state_only=True)
    s = torch.randn(5, 8)
    a = model.encode(torch.arange(5) % 4)
    torch.testing.assert_close(model.reward(s, a), model.reward(s, torch.zeros(5, 4)))


def test_variable_horizon_reward_forms():
    model = make_model()
    data = make_transitions(6, terminated=[1])
    log_probs = -torch.rand(6)
    f = model(*as_tensors(model, data))
    g = model.reward(*as_tensors(model, data)[:2])
    for form, expected in {"f": f, "g": g, "f-log-pi": f - log_probs}.items():
        reward = scoring.policy_reward(model, data, log_probs, form, False, GAMMA)
        torch.testing.assert_close(reward, expected)
        assert not reward.requires_grad


@pytest.mark.parametrize("form", ["f-log-pi", "f", "g"])
def test_absorbing_value_equals_stepping_the_environment(form):
    # Drop a lander to the ground, stay there for long, and add up what the absorbing steps pay; the
    # closed form must give as much at the step of the crash.
    horizon = 400
    env = LunarLander()
    observation, _ = env.reset(seed=1)
    observations, terminated = [observation], False
    while not terminated:
        observation, _, terminated, *_ = env.step(0)
        observations.append(observation)
    crash = len(observations) - 2
    stacked = np.array(observations + [observation] * (horizon - crash - 1))
    assert horizon - crash > 250  # 0.9 ** 250 is nothing: the horizon may count as infinite

    model = make_model()
    model.normaliser.update(torch.as_tensor(stacked))
    data = Transitions(
        stacked[crash : crash + 1],
        np.zeros(1, dtype=np.int64),
        stacked[crash + 1 : crash + 2],
        np.array([True]),
        np.array([horizon - crash - 1]),
    )
    log_probs = torch.tensor([-1.2])
    closed = scoring.policy_reward(model, data, log_probs, form, True, GAMMA).item()

    s = torch.as_tensor(stacked[crash:])
    actions = torch.zeros(len(s) - 1, 4)
    actions[0, 0] = 1.0  # the crash itself was an action; absorbing states have none
    with torch.no_grad():
        f = model(s[:-1], actions, s[1:], torch.zeros(len(s) - 1))
        paid = model.reward(s[:-1], actions) if form == "g" else f
    if form == "f-log-pi":
        paid[0] += 1.2
    discounts = GAMMA ** torch.arange(len(paid), dtype=torch.float64)
    assert closed == pytest.approx((discounts * paid).sum().item(), rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("absorbing", [False, True])
def test_an_episodes_reward_is_the_sum_over_its_horizon(absorbing):
    model = make_model()
    data = make_transitions(6, terminated=[5], remaining=7)
    s, a, s_next, _ = as_tensors(model, data)
    steps = [float(model.reward(s[t : t + 1], a[t : t + 1])) for t in range(6)]
    if absorbing:
        # No action is an action vector of zeros.
        steps += [float(model.reward(s_next[5:], torch.zeros(1, 4)))] * 7
    found = scoring.episode_reward(model, data, absorbing, math.inf)
    assert found == pytest.approx(sum(steps), rel=1e-5)


def test_pool_draws_absorbing_states_as_often_as_stepping_shows_them():
    model = make_model()
    data = make_transitions(10, terminated=[3, 7], remaining=6)
    log_probs = -torch.rand(10)
    pool = make_pool(model, data, log_probs, absorbing=True)
    counts = torch.bincount(pool.draw, minlength=12)
    assert counts.tolist() == [1] * 10 + [6, 6]
    assert pool.terminated.sum() == 0
    assert pool.actions[10:].abs().sum() == 0
    assert pool.log_probs[10:].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(pool.observations[10].numpy(), data.next_observations[3])

    plain = make_pool(model, data, log_probs, absorbing=False)
    assert plain.draw.tolist() == list(range(10))
    assert plain.terminated.sum() == 2


def test_join_pools_keeps_rows_and_weights():
    model = make_model()
    parts = [make_transitions(4, [1], 3, seed=s) for s in range(2)]
    pools = [make_pool(model, d, torch.zeros(4), True) for d in parts]
    joined = join_pools(pools)
    whole = torch.cat([p.observations[p.draw] for p in pools])
    torch.testing.assert_close(joined.observations[joined.draw], whole)


def test_minibatch_layout_and_share_of_the_past():
    model = make_model()

    def constant(value):
        data = make_transitions(20)
        observations = np.full_like(data.observations, value)
        data = Transitions(
            observations,
            *[
                getattr(data, n)
                for n in ("actions", "next_observations", "terminated", "remaining")
            ],
        )
        return make_pool(model, data, torch.zeros(20), False)

    risks = [
        [Stratum(constant(0), constant(2), constant(4), 8)],
        [Stratum(constant(1), constant(3), constant(5), 8)],
    ]
    batch = sample_minibatch(risks, torch.Generator().manual_seed(0), 0.25)
    assert batch.observations.shape == (2, 2, 8, 8)
    assert batch.observations[..., 0].int().tolist() == [
        [[0] * 6 + [4] * 2, [2] * 8],
        [[1] * 6 + [5] * 2, [3] * 8],
    ]


@pytest.mark.parametrize("count", [2, 6, 8, 78])
def test_even_and_odd_samples_hold_as_many_past_ones(count):
    """The unbiased penalty multiplies the gradients of the two halves."""
    model = make_model()

    def constant(value):
        data = make_transitions(5)
        observations = torch.full((5, 8), float(value))
        pool = make_pool(model, data, torch.zeros(5), False)
        return replace(pool, observations=observations)

    stratum = Stratum(constant(0), constant(1), constant(2), count)
    batch = sample_minibatch([[stratum, stratum]], torch.Generator().manual_seed(0), 0.5)
    past = batch.observations[0, 0, :, 0] == 2
    assert past[::2].sum() == past[1::2].sum()
    assert abs(int(past.sum()) - count) <= 2


@pytest.mark.parametrize("weight", [0.0, 0.5, 20.0])
def test_total_loss_is_the_papers_divided_by_lambda(weight):
    torch.manual_seed(0)
    logit, f = torch.randn(2, 2, 6), torch.randn(2, 2, 6)
    weights = torch.tensor([0.25, 0.75])
    config = AIRLConfig(
        grouping="per-setting",
        penalty="irmv1",
        penalty_scaling="reward",
        penalty_estimate="square",
    )
    loss = discriminator.discriminator_loss(logit, f, weights, config, weight)
    risks = cross_entropy(logit)
    assert loss.cross_entropy.item() == pytest.approx((0.25 * risks[0] + 0.75 * risks[1]).item())
    expected = loss.cross_entropy + weight * loss.penalty
    torch.testing.assert_close(loss.total, expected / max(1.0, weight))


def test_a_penalty_sees_balanced_settings_as_one_risk():
    torch.manual_seed(0)
    logit = torch.randn(3, 2, 6)
    config = AIRLConfig(grouping="balanced", penalty="irmv1", penalty_estimate="square")
    separate = msgspec.structs.replace(config, grouping="per-setting")
    weights = torch.full((3,), 1 / 3)
    merged = torch.stack([logit[:, label].flatten() for label in (0, 1)])[None]
    balanced = discriminator.discriminator_loss(logit, logit, weights, config, 1.0)
    one = discriminator.discriminator_loss(merged, merged, torch.ones(1), separate, 1.0)
    torch.testing.assert_close(balanced.penalty, one.penalty)
    torch.testing.assert_close(balanced.total, one.total)


@pytest.mark.parametrize("weight", [0.0, 1.0, 1000.0])
def test_weight_decay_does_not_depend_on_lambda(weight):
    """Where the loss has no gradient, a step shrinks every weight by learning rate times decay."""
    config = AIRLConfig(
        grouping="per-setting",
        penalty="irmv1",
        penalty_weight=weight,
        learning_rate=0.1,
        weight_decay=0.5,
        hidden=(4,),
    )
    learner = airl.AIRL([[EPISODE]], config, 1, 1, 9, 8, ActionSpace(True, 4, None, None), 0)
    before = {name: p.clone() for name, p in learner.model.named_parameters()}
    loss = sum(0.0 * p.sum() for p in learner.model.parameters())
    loss.backward()
    learner._optimizer.step()
    for name, parameter in learner.model.named_parameters():
        torch.testing.assert_close(parameter, before[name] * (1 - 0.1 * 0.5))


def test_penalty_weight_schedule():
    weights = [discriminator.penalty_weight_at(r, 8.0, warmup=2, ramp=4) for r in range(8)]
    assert weights == [0.0, 0.0, 2.0, 4.0, 6.0, 8.0, 8.0, 8.0]
    assert discriminator.penalty_weight_at(0, 8.0, warmup=0, ramp=0) == 8.0


def test_trained_discriminator_is_the_density_ratio():
    # Two states; the expert is in the first 4 of 5 times, the policy 1 of 2. At the optimum
    # f - log pi = log rho_E / rho_pi (Goodfellow et al. 2014, Prop. 1).
    torch.manual_seed(0)
    model = RewardModel(1, 2, True, False, [8], "tanh", GAMMA)

    def pool(states):
        observations = torch.tensor(states, dtype=torch.float32)[:, None]
        count = len(states)
        actions = torch.zeros(count, 2)
        actions[:, 0] = 1.0
        log_probs = torch.full((count,), math.log(0.5))
        return Pool(
            observations, actions, observations, torch.ones(count), log_probs, torch.arange(count)
        )

    policy, expert = pool([1, 1, 1, 1, 1, -1, -1, -1, -1, -1]), pool([1] * 8 + [-1] * 2)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.01)
    generator = torch.Generator().manual_seed(0)
    for _ in range(600):
        batch = sample_minibatch([[Stratum(policy, expert, None, 256)]], generator)
        logits, f = discriminator.discriminator_logits(model, batch)
        loss = discriminator.discriminator_loss(logits, f, torch.ones(1), AIRLConfig(), 0.0)
        optimizer.zero_grad()
        loss.total.backward()
        optimizer.step()
    f = model(policy.observations, policy.actions, policy.observations, policy.terminated)
    ratio = (f - policy.log_probs).detach()
    assert ratio[0].item() == pytest.approx(math.log(0.8 / 0.5), abs=0.15)
    assert ratio[-1].item() == pytest.approx(math.log(0.2 / 0.5), abs=0.15)


def test_reward_scale_is_the_deviation_over_draws():
    model = make_model()
    data = make_transitions(12, terminated=[4], remaining=7)
    pool = make_pool(model, data, torch.zeros(12), True)
    with torch.no_grad():
        g = model.reward(pool.observations, pool.actions).numpy().astype(float)
    repeated = np.concatenate([g[:12], np.repeat(g[12:], 7)])
    assert scoring.reward_scale(model, [pool]) == pytest.approx(repeated.std(ddof=1))


def test_normaliser_moments_do_not_depend_on_the_batching():
    data = torch.randn(100, 3) * torch.tensor([1.0, 5.0, 0.1]) + torch.tensor([3.0, 0.0, -7.0])
    whole, parts = ObservationNormaliser(3), ObservationNormaliser(3)
    whole.update(data)
    for part in data.split([1, 30, 69]):
        parts.update(part)
    torch.testing.assert_close(whole.mean, data.double().mean(0))
    torch.testing.assert_close(whole.variance, data.double().var(0, unbiased=False))
    torch.testing.assert_close(parts.variance, whole.variance)
    out = whole(data)
    assert out.dtype == torch.float32
    torch.testing.assert_close(out.mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(out.std(0, unbiased=False), torch.ones(3), atol=1e-4, rtol=0)


def test_a_constant_observation_stays_finite():
    normaliser = ObservationNormaliser(2)
    normaliser.update(torch.tensor([[1.0, 0.0], [2.0, 0.0]]))
    assert normaliser(torch.tensor([[1.5, 1.0]])).tolist() == [[0.0, 10.0]]


def test_join_is_concatenation():
    a, b = make_transitions(3, seed=1), make_transitions(2, seed=2)
    joined = join([a, b])
    np.testing.assert_array_equal(joined.actions, [*a.actions, *b.actions])
    np.testing.assert_array_equal(joined.take(np.array([3])).observations, b.observations[:1])


def test_clipped_log_prob_is_a_distribution_over_the_interval_and_its_ends():
    """scipy's tails at the bounds; the density inside and the two masses add up to one."""
    low, high = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 2.0])
    mean, std = torch.tensor([[0.3, 1.7]]), torch.tensor([[0.8, 0.4]])
    for k in range(2):
        normal = scipy.stats.norm(float(mean[0, k]), float(std[0, k]))
        ends = torch.stack([low[k], high[k]])[:, None]
        arguments = mean[:, k : k + 1], std[:, k : k + 1]
        bounds = low[k : k + 1], high[k : k + 1]
        tails = clipped_log_prob(*arguments, ends, *bounds)
        np.testing.assert_allclose(
            tails, [normal.logcdf(float(low[k])), normal.logsf(float(high[k]))], rtol=1e-5
        )
        grid = torch.linspace(float(low[k]), float(high[k]), 100_001)[1:-1, None]
        inside = clipped_log_prob(*arguments, grid, *bounds).double().exp()
        step = float(high[k] - low[k]) / 100_000
        assert float(inside.sum() * step + tails.double().exp().sum()) == pytest.approx(1, abs=1e-4)
    both = clipped_log_prob(mean, std, torch.tensor([[0.1, 2.0]]), low, high)
    first = clipped_log_prob(mean[:, :1], std[:, :1], torch.tensor([[0.1]]), low[:1], high[:1])
    last = clipped_log_prob(mean[:, 1:], std[:, 1:], torch.tensor([[2.0]]), low[1:], high[1:])
    torch.testing.assert_close(both, first + last)


def test_clipped_log_prob_stays_finite_far_from_the_bounds():
    far = clipped_log_prob(
        torch.tensor([[-8.0]]),
        torch.tensor([[0.05]]),
        torch.tensor([[1.0]]),
        torch.tensor([-1.0]),
        torch.tensor([1.0]),
    )
    assert float(far) == pytest.approx(scipy.stats.norm(-8, 0.05).logsf(1.0), rel=1e-5)


def test_the_entropy_of_clipped_actions_is_bounded():
    """Without bounds on log pi's actions, -log pi pays for noise without end."""
    torch.manual_seed(0)
    bounds = torch.tensor([-1.0]), torch.tensor([1.0])
    entropies = []
    for std in (1.0, 10.0, 1000.0):
        scale = torch.full((200_000, 1), std)
        actions = (torch.randn(200_000, 1) * std).clamp(-1, 1)
        log_probs = clipped_log_prob(torch.zeros_like(scale), scale, actions, *bounds)
        entropies.append(-float(log_probs.mean()))
    assert entropies[2] == pytest.approx(np.log(2), abs=0.01)
    # The interval and its two ends weigh four: no distribution over them has more.
    assert max(entropies) < math.log(4)
