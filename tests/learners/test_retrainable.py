"""What makes a reward retrainable: a slope everywhere, challengers, and a ceiling on their reward."""

from copy import deepcopy

import numpy as np
import pytest
import torch
from airl_runs import (
    CONFIG,
    LANDER,
    SETTINGS,
    make,
    moved,
    random_episodes,
    worlds_of,
)
from msgspec.structs import replace

from irlcli.configs import AIRLConfig, ChallengerConfig, PPOConfig
from irlcli.configs.relevance import relevant_airl
from irlcli.data.outputs import write_reward
from irlcli.data.tensors import load_reward_file
from irlcli.errors import StageFailed, UsageError
from irlcli.learners import airl, discriminator
from irlcli.learners.pools import Minibatch
from irlcli.learners.replay import whole_episodes
from irlcli.learners.reward_model import RewardModel
from irlcli.penalties.risk import cross_entropy
from irlcli.rl import worlds as worlds_module
from irlcli.rl.challengers import Challengers
from irlcli.rl.worlds import make_worlds
from irlcli.trajectories import join, transitions

LONG = PPOConfig(n_envs=8, n_steps=220, batch_size=512, n_epochs=1)
HORIZON = 200
CHALLENGED = {
    "logit": "f",
    "policy_reward": "f",
    "challenger": ChallengerConfig(life=2, ppo=LONG, share=0.5),
    "ppo": LONG,
}


@pytest.fixture(scope="module")
def demos():
    return random_episodes(4)


def a_batch(size=6, observations=3, actions=2):
    torch.manual_seed(0)
    return Minibatch(
        observations=torch.randn(2, 2, size, observations),
        actions=torch.randn(2, 2, size, actions),
        next_observations=torch.randn(2, 2, size, observations),
        terminated=torch.zeros(2, 2, size),
        log_probs=torch.randn(2, 2, size),
    )


# The discriminator


def test_the_gradient_penalty_of_a_linear_reward_is_its_squared_slope():
    model = RewardModel(3, 2, False, False, [], "tanh", 0.9)
    (weight,) = (p for name, p in model.g.named_parameters() if "weight" in name)
    for share in (0.0, 0.3, 1.0):
        found = discriminator.gradient_penalty(model, a_batch(), torch.full((2, 6, 1), share))
        torch.testing.assert_close(found, weight.square().sum())
    found.backward()
    torch.testing.assert_close(weight.grad, 2 * weight.detach())


def test_the_gradient_is_penalised_between_policy_and_expert():
    """At the ends of the lines it is the gradient at the policy's or at the expert's samples."""
    torch.manual_seed(1)
    model, batch = RewardModel(3, 2, False, True, [8], "tanh", 0.9), a_batch()
    for label, share in ((0, 0.0), (1, 1.0)):
        x = batch.observations[:, label].clone().requires_grad_()
        (slope,) = torch.autograd.grad(model.reward(x, batch.actions[:, label]).sum(), x)
        # Without observations, the normaliser divides by a deviation of one.
        expected = slope.square().sum(-1).mean()
        found = discriminator.gradient_penalty(model, batch, torch.full((2, 6, 1), share))
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0)


def test_the_points_of_the_gradient_penalty_are_drawn_anew_along_the_lines():
    """From the policy's sample at share 0 to the expert's at 1, by the round's generator."""
    torch.manual_seed(1)
    model, batch = RewardModel(3, 2, False, False, [8], "tanh", 0.9), a_batch(size=64)
    config = AIRLConfig(gradient_penalty=1.0)
    found = [
        discriminator.minibatch_loss(
            model, batch, None, torch.tensor([0.5, 0.5]), config, 0.0, generator(seed)
        ).total
        for seed in (0, 0, 1)
    ]
    ends = [
        discriminator.gradient_penalty(model, batch, torch.full((2, 64, 1), share))
        for share in (0.0, 1.0)
    ]
    plain = replace(config, gradient_penalty=0.0)
    without = discriminator.minibatch_loss(
        model, batch, None, torch.tensor([0.5, 0.5]), plain, 0.0, generator(0)
    ).total
    assert found[0] == found[1] != found[2]
    mix = torch.rand(2, 64, 1, generator=generator(0))
    torch.testing.assert_close(
        found[0] - without, discriminator.gradient_penalty(model, batch, mix)
    )
    assert not any(torch.isclose(found[0] - without, end, rtol=1e-4) for end in ends)


def generator(seed):
    return torch.Generator().manual_seed(seed)


def test_logits_may_leave_log_pi_out():
    model, batch = RewardModel(3, 2, False, False, [8], "tanh", 0.9), a_batch()
    logits, f = discriminator.discriminator_logits(model, batch, "f")
    torch.testing.assert_close(logits, f)
    logits, f = discriminator.discriminator_logits(model, batch)
    torch.testing.assert_close(logits, f - batch.log_probs)


def test_without_shaping_f_is_g():
    batch = a_batch()
    model = RewardModel(3, 2, False, False, [8], "tanh", 0.9, shaping=False)
    g = model.reward(batch.observations, batch.actions)
    torch.testing.assert_close(discriminator.discriminator_logits(model, batch, "f")[1], g)
    absorbing_g, absorbing_f = model.absorbing_reward(batch.observations)
    torch.testing.assert_close(absorbing_g, absorbing_f)
    assert not any(name.startswith("h") for name in model.state_dict())


@pytest.mark.parametrize("weight", [0.0, 0.5, 20.0])
def test_what_else_is_minimised_is_not_part_of_the_penalty(weight):
    torch.manual_seed(0)
    logit, weights = torch.randn(2, 2, 6), torch.tensor([0.25, 0.75])
    config = AIRLConfig(
        grouping="per-setting",
        penalty="irmv1",
        penalty_estimate="square",
        gradient_penalty=2.0,
        challenger=ChallengerConfig(share=0.7),
    )
    arguments = (logit, logit, weights, config, weight)
    alone = discriminator.discriminator_loss(*arguments)
    challenger = torch.randn(2, 2, 6)
    both = discriminator.discriminator_loss(
        *arguments,
        challenger_logits=challenger,
        input_gradient=lambda: torch.tensor(7.0),
    )
    assert both.penalty == alone.penalty and both.cross_entropy == alone.cross_entropy
    theirs = discriminator.discriminator_loss(challenger, challenger, *arguments[2:]).cross_entropy
    expected = 0.3 * alone.cross_entropy + 0.7 * theirs + 14.0 + weight * alone.penalty
    torch.testing.assert_close(both.total, expected / max(1.0, weight))


def test_the_gradients_of_student_and_challenger_are_penalised_alike(demos, monkeypatch):
    """0.5 times the mean of 3 and 5 joins the loss."""
    risk = Minibatch(*(t[:1] for t in vars(a_batch(observations=8, actions=4)).values()))
    totals = []
    for weight in (0.0, 0.5):
        _, learner = make(demos, logit="f", gradient_penalty=weight)
        slopes = iter((torch.tensor(3.0), torch.tensor(5.0)))
        monkeypatch.setattr(
            discriminator, "gradient_penalty", lambda *_, slopes=slopes: next(slopes)
        )
        loss = discriminator.minibatch_loss(
            learner.model, risk, risk, torch.ones(1), learner.config, 0.0, torch.Generator()
        )
        totals.append(loss.total.detach())
    torch.testing.assert_close(totals[1] - totals[0], torch.tensor(0.5 * 4.0))


@pytest.mark.parametrize(("grouping", "merged"), [("balanced", True), ("per-setting", False)])
def test_balanced_settings_share_the_risk_that_is_penalised(demos, grouping, merged):
    _, learner = make(demos, logit="f", grouping=grouping, penalty="irmv1")
    batch = a_batch(observations=8, actions=4)
    weights = torch.full((2,), 0.5)
    found = discriminator.minibatch_loss(
        learner.model, batch, None, weights, learner.config, 1.0, torch.Generator()
    )
    logits, f = discriminator.discriminator_logits(learner.model, batch, "f")
    joined = [torch.stack([x[:, label].flatten() for label in (0, 1)])[None] for x in (logits, f)]
    separate = AIRLConfig(grouping="per-setting", penalty="irmv1")
    one, other = (
        discriminator.discriminator_loss(*samples, separate, 1.0).penalty.item()
        for samples in ((*joined, torch.ones(1)), (logits, f, weights))[:: 1 if merged else -1]
    )
    assert found.penalty.item() == pytest.approx(one) != pytest.approx(other)


def test_a_linear_schedule_falls_towards_zero_and_the_last_round_still_learns(demos):
    def moved(index):
        trainer, learner = make(
            demos,
            ppo=LONG,
            horizon=HORIZON,
            learning_rate_schedule="linear",
            learning_rate=1e-6,
            updates_per_round=1,
        )
        (rollout,) = trainer.train_round(0, learner)
        before = [p.detach().clone() for p in learner.model.parameters()]
        learner.update(index, [rollout], trainer.policy)
        after = list(learner.model.parameters())
        return max(float((a - b).abs().max()) for a, b in zip(after, before, strict=True))

    rounds = make(demos, ppo=LONG, horizon=HORIZON)[0].rounds
    assert rounds > 2
    # Adam's first step is the learning rate.
    for index in (0, 1, rounds - 1):
        assert moved(index) == pytest.approx(1e-6 * (1 - index / rounds), rel=0.2)


# Challengers


def challenged(demos, **changes):
    changes = {**CHALLENGED, **changes}
    trainer, learner = make(demos, horizon=HORIZON, total_steps=5 * 220 * 8, **changes)
    config = learner.config.challenger
    worlds = worlds_of(SETTINGS, LONG.n_envs, HORIZON)
    return trainer, learner, Challengers([worlds], config, learner, 0, "test")


def test_a_challenger_that_diverges_is_named(demos, monkeypatch):
    """Each lives two rounds, so that of round 3 began in round 2."""
    _, learner, challengers = challenged(demos)
    for index in range(3):
        challengers.train_round(index)
    monkeypatch.setattr(
        learner, "challenger_rewards", lambda r: np.full(r.terminated.shape, np.nan)
    )
    with pytest.raises(StageFailed, match="challenger that began in round 2: ") as failed:
        challengers.train_round(3)
    assert "airl.challenger.ppo" in failed.value.hint


def test_a_challengers_learning_rate_falls_over_its_life(demos):
    ppo = replace(LONG, learning_rate=1e-3, learning_rate_schedule="linear")
    config = replace(CHALLENGED["challenger"], life=4, ppo=ppo)
    _, _, challengers = challenged(demos, challenger=config)
    rates = []
    for index in range(5):
        challengers.train_round(index)
        (state,) = challengers.state_dict()["trainers"]
        rates.append(state["optimizer"]["param_groups"][0]["lr"])
    # Set before each update, by the share of the steps that is left. The next life begins anew.
    assert rates == pytest.approx([0.75e-3, 0.5e-3, 0.25e-3, 0.0, 0.75e-3])


def weights_of(challengers):
    """A copy of one layer of each challenger."""
    trainers = challengers.state_dict()["trainers"]
    return [next(iter(each["policy"].values())).clone() for each in trainers]


def test_each_challenger_starts_from_other_random_weights(demos):
    _, _, challengers = challenged(demos)
    first = []
    for index in range(4):
        before = index % 2 == 0
        challengers.train_round(index)
        if before:
            first.append(weights_of(challengers)[0])
    assert not torch.equal(*first)


def test_a_resumed_challenger_goes_on_as_if_it_had_not_stopped(demos):
    """The second challenger, between its two rounds: its actions are drawn by its own seed."""
    _, _, whole = challenged(demos)
    for index in range(3):
        whole.train_round(index)
    _, _, resumed = challenged(demos)
    resumed.load_state_dict(deepcopy(whole.state_dict()))
    (expected,), (found,) = whole.train_round(3), resumed.train_round(3)
    for field in ("observations", "actions", "true_rewards", "returns"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    torch.testing.assert_close(weights_of(resumed), weights_of(whole), rtol=0, atol=0)


def test_each_settings_challenger_is_a_policy_of_its_own(demos):
    """The first acts as it would alone; the second starts from other weights, in its own worlds."""
    _, learner, _ = challenged(demos)

    def rollouts(settings):
        worlds = [make_worlds(LANDER, [setting], 4) for setting in settings]
        found = Challengers(worlds, learner.config.challenger, learner, 0, "test")
        return found, found.train_round(0)[0]

    both, beside = rollouts(SETTINGS)
    _, alone = rollouts(SETTINGS[:1])
    _, equal = rollouts(SETTINGS[:1] * 2)
    assert beside.observations.shape[1] == 8
    for field in ("observations", "actions", "true_rewards", "returns"):
        np.testing.assert_array_equal(getattr(beside, field)[:, :4], getattr(alone, field))
    assert not np.array_equal(beside.observations[:, 4:], equal.observations[:, 4:])
    assert not torch.equal(*weights_of(both))


def test_challengers_per_setting_share_the_worlds_in_the_order_of_the_settings(
    irl, smoke_store, tmp_path, monkeypatch
):
    made, original = [], worlds_module.make_worlds

    def record(env, settings, count, workers=1):
        made.append(([str(setting) for setting in settings], count))
        return original(env, settings, count, workers)

    monkeypatch.setattr(worlds_module, "make_worlds", record)
    line = ["train-airl", "--demos", smoke_store.path / smoke_store.demos]
    line += ["--profile", "smoke", "--store", tmp_path]
    for option in (
        "logit=f",
        "policy_reward=f",
        "challenger.life=1",
        "challenger.per_setting=true",
    ):
        line += ["--set", f"airl.{option}"]
    done = irl(*line)
    assert done.code == 0, done.err
    one, two = (str(setting) for setting in SETTINGS)
    assert made == [([one, two], 4), ([one], 2), ([two], 2)]
    assert "last challenger" not in done.err
    single = [*line, "--dry-run", "--set", "airl.challenger.ppo.n_steps=1"]
    assert irl(*single).code == 0
    refused = irl(*single, "--set", "airl.ppo.n_envs=2")
    assert refused.code == 2 and "airl.challenger.ppo: one world and one step" in refused.err


def numbers_of(demos):
    """All numbers in the observations of ``demos``."""
    return np.concatenate([t.observations.ravel() for group in demos for t in group])


def test_a_ceiling_is_a_quantile_over_the_demonstrations_of_all_settings(demos):
    _, learner, _ = challenged(demos, fixed_horizon=False)
    with torch.no_grad():
        g = [
            learner.model.reward(
                torch.as_tensor(t.observations[:-1]),
                learner.model.encode(torch.as_tensor(t.actions)),
            )
            for group in demos
            for t in group
        ]
    every = torch.cat(g)
    assert learner.quantiles[0] == pytest.approx(float(every.min()), rel=1e-5)
    assert learner.quantiles[-1] == pytest.approx(float(every.max()), rel=1e-5)


def test_a_challenger_is_paid_the_bounded_reward(demos):
    trainer, learner, _ = challenged(demos, fixed_horizon=False)
    (rollout,) = trainer.train_round(0, learner)
    data = rollout.transitions(slice(None), HORIZON)
    actions = learner.model.encode(torch.as_tensor(data.actions))
    with torch.no_grad():
        g = learner.model.reward(torch.as_tensor(data.observations), actions).numpy()
    for ceiling in (0.1, 0.9):
        challenger = replace(learner.config.challenger, ceiling=ceiling)
        learner.config = replace(learner.config, challenger=challenger)
        paid = learner.challenger_rewards(rollout).ravel()
        highest = np.quantile(learner.quantiles, ceiling)
        np.testing.assert_allclose(paid, np.minimum(g, highest), rtol=1e-5)
        assert (paid < g).any()


def test_a_challengers_ceiling_is_of_the_current_reward_not_of_a_mean_of_rounds(demos):
    """At the 0 quantile no step earns more than the least demonstrated one."""
    trainer, learner, _ = challenged(demos, averaged_rounds=3, fixed_horizon=False)
    challenger = replace(learner.config.challenger, ceiling=0.0)
    learner.config = replace(learner.config, challenger=challenger)
    for index in range(3):
        (rollout,) = trainer.train_round(index, learner)
        learner.update(index, [rollout], trainer.policy, [rollout])
    recorded = join([transitions([t], HORIZON) for group in demos for t in group])
    acted = rollout.transitions(slice(None), HORIZON)
    with torch.no_grad():
        least, g = (
            learner.model.reward(
                torch.as_tensor(data.observations),
                learner.model.encode(torch.as_tensor(data.actions)),
            ).numpy()
            for data in (recorded, acted)
        )
    paid = learner.challenger_rewards(rollout).ravel()
    np.testing.assert_allclose(paid, np.minimum(g, least.min()), rtol=1e-5, atol=1e-6)
    assert learner.quantiles[0] != pytest.approx(float(least.min()), rel=1e-3)


def test_a_challengers_absorbing_state_earns_a_series_in_its_own_discount(demos):
    """At gamma = 0.5, gamma / (1 - gamma) = 1 times the bounded reward; the student's is 0.99."""
    challenger = replace(CHALLENGED["challenger"], ppo=replace(LONG, gamma=0.5))
    trainer, learner, _ = challenged(demos, challenger=challenger)
    (rollout,) = trainer.train_round(0, learner)
    data = rollout.transitions(slice(None), HORIZON)
    with torch.no_grad():
        actions = learner.model.encode(torch.as_tensor(data.actions))
        g = learner.model.reward(torch.as_tensor(data.observations), actions).numpy()
        absorbing, _ = learner.model.absorbing_reward(torch.as_tensor(data.next_observations))
    highest = np.quantile(learner.quantiles, challenger.ceiling)
    series = np.where(data.terminated, np.minimum(absorbing.numpy(), highest), 0.0)
    paid = learner.challenger_rewards(rollout).ravel()
    assert data.terminated.any()
    np.testing.assert_allclose(paid, np.minimum(g, highest) + series, rtol=1e-4, atol=1e-5)


def test_past_challengers_are_replayed_beside_the_present_one(demos, monkeypatch):
    """The challengers of round k are made to be at 5 + k; the student's past stays apart.

    Both are told from the demonstrations.
    """
    trainer, learner, challengers = challenged(demos)
    drawn, original = [], airl.sample_minibatch

    def spied(risks, generator, past_share=None):
        if past_share is None:  # the diagnostics draw no past
            return original(risks, generator)
        drawn.append(risks)
        return original(risks, generator, past_share)

    monkeypatch.setattr(airl, "sample_minibatch", spied)
    for index in range(2):
        rollouts = trainer.train_round(index, learner)
        challenge = challengers.train_round(index)
        challenge = [moved(r, 5.0 + index) for r in challenge]
        learner.update(index, rollouts, trainer.policy, challenge)
    student, challenger = (
        [stratum for strata in risks for stratum in strata] for risks in drawn[-2:]
    )
    for stratum in challenger:
        assert (stratum.policy.observations == 6.0).all()
        assert (stratum.past.observations == 5.0).all()
    for stratum, other in zip(student, challenger, strict=True):
        assert not (stratum.past.observations == 5.0).all(-1).any()
        assert torch.equal(other.expert.observations, stratum.expert.observations)
        assert np.isin(other.expert.observations, numbers_of(demos)).all()


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_the_share_of_challengers_is_taken_from_the_student(demos, share):
    """With the whole weight on challengers, the student's own samples teach g nothing."""
    challenger = replace(CHALLENGED["challenger"], share=share)
    _, learner, _ = challenged(demos, grouping="per-setting", challenger=challenger)
    student, challengers = (a_batch(size, observations=8, actions=4) for size in (6, 10))
    # Both settings weigh the same.
    total = discriminator.minibatch_loss(
        learner.model,
        student,
        challengers,
        torch.full((2,), 0.5),
        learner.config,
        0.0,
        torch.Generator(),
    ).total
    own, other = (
        cross_entropy(discriminator.discriminator_logits(learner.model, batch, "f")[0]).mean()
        for batch in (student, challengers)
    )
    torch.testing.assert_close(total, (1.0 - share) * own + share * other)


@pytest.mark.parametrize("share", [0.3, 0.9, 1.0])
def test_group_dro_divides_what_challengers_leave_among_the_settings(demos, share):
    """The loss is (1 - share) sum q_e R_e, with q_e proportional to exp(50 R_e), and the challengers'."""
    challenger = replace(CHALLENGED["challenger"], share=share)
    changes = {"grouping": "per-setting", "penalty": "group-dro", "challenger": challenger}
    _, learner, _ = challenged(demos, **changes)
    batches = [a_batch(size, observations=8, actions=4) for size in (6, 10)]
    arguments = (torch.full((2,), 0.5), learner.config, 50.0, torch.Generator())
    total = discriminator.minibatch_loss(learner.model, *batches, *arguments).total
    risks, other = (
        cross_entropy(discriminator.discriminator_logits(learner.model, batch, "f")[0])
        for batch in batches
    )
    shares = (50.0 * risks).softmax(0)
    expected = (1.0 - share) * (shares * risks).sum() + share * other.mean()
    torch.testing.assert_close(total, expected)


def test_challengers_are_negatives(demos):
    """g falls where they are, and hardly where only the student's samples count."""
    lowered = {}
    for share in (0.0, 1.0):
        changes = {"challenger": replace(CHALLENGED["challenger"], share=share)}
        changes |= {"updates_per_round": 60, "learning_rate": 1e-2, "replay_share": 0.0}
        trainer, learner, challengers = challenged(demos, **changes)
        rollouts = trainer.train_round(0, learner)
        challenge = challengers.train_round(0)
        # Where the challengers were, made unlike all else.
        challenge = [moved(r, 5.0) for r in challenge]
        learner.update(0, rollouts, trainer.policy, challenge)
        data = challenge[0].transitions(slice(None), HORIZON)
        with torch.no_grad():
            actions = learner.model.encode(torch.as_tensor(data.actions))
            g = learner.model.reward(torch.as_tensor(data.observations), actions)
        lowered[share] = float(g.mean()) - np.median(learner.quantiles)
    assert lowered[1.0] < min(lowered[0.0], -1.0)


def test_challengers_need_logits_without_log_pi():
    airl = AIRLConfig(challenger=ChallengerConfig(life=3))
    with pytest.raises(UsageError, match=r"airl\.challenger\.life"):
        relevant_airl(airl, False)
    relevant_airl(replace(airl, logit="f"), False)


def test_challengers_live_in_the_students_worlds():
    airl = AIRLConfig(logit="f", challenger=ChallengerConfig(life=3, ppo=CONFIG.ppo))
    assert relevant_airl(airl, True).challenger.ppo.n_envs == airl.ppo.n_envs


def test_the_number_of_worlds_a_challenger_is_configured_with_does_not_matter():
    """Not for the largest minibatch either, which is a rollout in the student's worlds."""
    found = [
        relevant_airl(AIRLConfig(logit="f", challenger=ChallengerConfig(life=3, ppo=ppo)), True)
        for ppo in (PPOConfig(n_envs=n, n_steps=32, batch_size=128) for n in (1, 16))
    ]
    assert found[0] == found[1] and found[0].challenger.ppo.batch_size == 128


# The mean of several rounds


def test_the_deployed_reward_is_the_mean_over_equally_spaced_rounds(demos, tmp_path):
    trainer, learner = make(
        demos,
        ppo=LONG,
        horizon=HORIZON,
        total_steps=6 * 220 * 8,
        averaged_rounds=3,
        fixed_horizon=False,
    )
    assert trainer.rounds == 6
    after = []
    for index in range(6):
        (rollout,) = trainer.train_round(index, learner)
        learner.update(index, [rollout], trainer.policy)
        after.append(deepcopy(learner.model))
    states, actions = torch.randn(7, 8) * 3, torch.eye(4)[torch.randint(4, (7,))]
    expected = sum(after[index].reward(states, actions) for index in (1, 3, 5)) / 3
    torch.testing.assert_close(learner.deployed.reward(states, actions), expected)
    # The scale, and the level that a ceiling refers to, are those of the mean, too.
    generated, _ = whole_episodes([rollout], np.ones(8, bool), HORIZON)
    data = join([generated, transitions([*demos[0], *demos[1]], HORIZON)])
    with torch.no_grad():
        vectors = learner.model.encode(torch.as_tensor(data.actions))
        g = learner.deployed.reward(torch.as_tensor(data.observations), vectors)
    assert learner.scale == pytest.approx(float(g.double().std()), rel=1e-4)
    shown = torch.as_tensor(np.concatenate([t.observations[:-1] for t in demos[0] + demos[1]]))
    taken = torch.eye(4)[np.concatenate([t.actions for t in demos[0] + demos[1]])]
    assert learner.quantiles[-1] >= float(learner.deployed.reward(shown, taken).max()) - 1e-5

    write_reward(
        tmp_path,
        learner,
        env=LANDER,
        settings=("engine-power=1x",),
        method="erm",
        seed=0,
        airl=learner.config,
    )
    model, description = load_reward_file(tmp_path / "reward.pt")
    assert description.network.members == 3
    torch.testing.assert_close(model.reward(states, actions), expected)


@pytest.mark.parametrize(("members", "rounds"), [(3, [0, 1, 5]), (6, [0, 0, 0, 1, 2, 5])])
def test_rounds_can_be_averaged_by_the_learning_rate(demos, members, rounds):
    """The rates are as 6, 5, 4, 3, 2, 1, in sums 6, 11, 15, 18, 20, 21; members join at multiples of 7 or 3.5."""
    changes = {"averaged_rounds": members, "averaged_by": "learning-rate"}
    trainer, learner = make(
        demos,
        ppo=LONG,
        horizon=HORIZON,
        total_steps=6 * 220 * 8,
        learning_rate_schedule="linear",
        **changes,
    )
    after = []
    for index in range(6):
        (rollout,) = trainer.train_round(index, learner)
        learner.update(index, [rollout], trainer.policy)
        after.append(deepcopy(learner.model))
    states, actions = torch.randn(7, 8) * 3, torch.eye(4)[torch.randint(4, (7,))]
    expected = sum(after[index].reward(states, actions) for index in rounds) / members
    torch.testing.assert_close(learner.deployed.reward(states, actions), expected)


def test_a_mean_has_no_best_round():
    config = AIRLConfig(averaged_rounds=2, select="episodes")
    with pytest.raises(UsageError, match="averaged_rounds = 2 cannot be combined"):
        relevant_airl(config, True)


def test_a_mean_of_more_rounds_than_there_are_is_refused_before_anything_runs(irl, smoke_store):
    line = ["train-airl", "--demos", "demos", "--profile", "smoke", "--store", smoke_store.path]
    done = irl(*line, "--dry-run", "--set", "airl.averaged_rounds=1000")
    assert done.code == 2
    assert "airl.averaged_rounds = 1000, but training has" in done.err


def test_a_penalty_that_never_begins_is_refused_and_what_ends_too_early_is_named(irl, store_copy):
    line = ["train-airl", "--demos", "demos", "--profile", "smoke", "--store", store_copy.path]
    irm = [*line, "--method", "irm", "--penalty-weight", "10"]
    late = ["--set", "airl.penalty_warmup_rounds=1000"]
    refused = irl(*irm, *late, "--dry-run")
    assert refused.code == 2 and "airl.penalty_warmup_rounds = 1000 leaves no round" in refused.err
    assert irl(*line, "--method", "erm", *late, "--dry-run").code == 0
    irm += ["--set", "airl.logit=f", "--set", "airl.challenger.life=1000"]
    slow = irl(*irm, "--set", "airl.penalty_ramp_rounds=1000")
    assert slow.code == 0 and "lambda reaches 0.0" in slow.err and "of 10:" in slow.err
    assert "the last challenger has" in slow.err and "of 1000 rounds" in slow.err
