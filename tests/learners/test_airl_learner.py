"""The learner as a whole: groupings, diagnostics, cloning, resuming."""

from dataclasses import replace as replaced

import numpy as np
import pytest
import torch
from airl_runs import (
    CONFIG,
    SETTINGS,
    make,
    moved,
    random_episodes,
    record_losses,
    worlds_of,
)
from msgspec.structs import replace

from irlcli.configs import ChallengerConfig, PPOConfig
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.learners import airl
from irlcli.learners.discriminator import measured
from irlcli.learners.pools import Pool
from irlcli.learners.replay import whole_episodes
from irlcli.rl.challengers import Challengers
from irlcli.rl.loop import Training
from irlcli.symmetries import Symmetries
from irlcli.trajectories import join, transitions

# A round holds whole episodes at this time limit.
HORIZON = 200
LONG = PPOConfig(n_envs=8, n_steps=220, batch_size=512, n_epochs=1)
IRM = {"grouping": "per-setting", "penalty": "irmv1", "penalty_weight": 10.0}


@pytest.fixture(scope="module")
def demos():
    return random_episodes(4)


def shown(demos):
    """All transitions of ``demos``."""
    return transitions([episode for episodes in demos for episode in episodes], HORIZON)


def updated(demos, rounds=1, **changes):
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, **changes)
    for index in range(rounds):
        rollouts = trainer.train_round(index, learner)
        rows = learner.update(index, rollouts, trainer.policy)
    return trainer, learner, rows


def test_the_logged_objective_is_the_one_that_was_optimised(demos, monkeypatch):
    """With replay: mean over the round's minibatches of what the optimiser minimised."""
    seen = record_losses(monkeypatch)
    changes = {**IRM, "penalty_warmup_rounds": 0, "penalty_ramp_rounds": 1, "updates_per_round": 3}
    _, _, rows = updated(demos, rounds=2, **changes)
    last = [loss for _, _, loss in seen[-3:]]
    for row in rows:
        assert row["penalty_weight"] == 10.0
        for name, values in (
            ("optimised_cross_entropy", [float(loss.cross_entropy) for loss in last]),
            ("optimised_penalty", [float(loss.penalty) for loss in last]),
        ):
            assert row[name] == pytest.approx(np.mean(values))
    for loss in last:
        total = (loss.cross_entropy + 10.0 * loss.penalty) / 10.0
        assert float(loss.total) == pytest.approx(float(total), rel=1e-5)
    # Replay makes them differ from the diagnostics, which are of the current policy alone.
    assert rows[0]["cross_entropy"] != rows[0]["optimised_cross_entropy"]


@pytest.mark.parametrize("grouping", ["pooled", "balanced", "per-setting", "shuffled"])
def test_diagnostics_are_per_true_setting_for_every_grouping(demos, grouping):
    """The policy is told from the expert where its observations are unlike all others."""
    penalty = "irmv1" if grouping in ("per-setting", "shuffled") else "none"
    changes = {"updates_per_round": 60, "learning_rate": 1e-2, "batch_size": 128}
    trainer, learner = make(
        demos, ppo=LONG, horizon=HORIZON, grouping=grouping, penalty=penalty, **changes
    )
    rollouts = [moved(r, 5.0, slice(4, 8)) for r in trainer.train_round(0, learner)]
    rows = learner.update(0, rollouts, trainer.policy)
    names = {"cross_entropy", "accuracy", "mean_abs_logit", "penalty", "penalty_weight"}
    optimised = {"optimised_cross_entropy", "optimised_penalty"}
    assert [set(row) for row in rows] == 2 * [names | optimised]
    assert rows[0]["accuracy"] < 0.95 < rows[1]["accuracy"]
    assert rows[0]["cross_entropy"] > rows[1]["cross_entropy"]


def test_diagnostics_measure_the_logits():
    """f is -2 for every policy's sample, 2 for two of three of the expert's and -2 for the third."""

    def model(observations, *_):
        return observations[..., 0]

    def pool(values):
        rows = torch.tensor(values).reshape(-1, 1)
        zeros = torch.zeros(len(rows))
        return Pool(rows, rows, rows, zeros, zeros, torch.arange(len(rows)))

    pools = [pool([-2.0])], [pool([2.0, 2.0, -2.0])]
    (row,) = measured(model, *pools, "f", torch.Generator().manual_seed(0))
    right, wrong = np.log1p(np.exp([-2.0, 2.0]))
    # The expert's share of 2 is that of 1024 draws.
    share = 2.0 * row["accuracy"] - 1.0
    assert share == pytest.approx(2.0 / 3.0, abs=0.05)
    assert row["mean_abs_logit"] == 2.0
    expected = 0.5 * right + 0.5 * (share * right + (1.0 - share) * wrong)
    assert row["cross_entropy"] == pytest.approx(expected, rel=1e-5)
    # d BCE / dw at w = 1 is (sigmoid(f) - y) f, for the policy's samples and the expert's.
    high = 1.0 / (1.0 + np.exp(-2.0))
    slope = 0.5 * -2.0 * (1.0 - high) + 0.5 * (
        share * -2.0 * (1.0 - high) + (1.0 - share) * 2.0 * high
    )
    assert row["penalty"] == pytest.approx(slope**2, abs=0.02)


def observed(demos):
    """All observations of ``demos`` and of the round that a learner of them was updated on."""
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, fixed_horizon=False)
    rollouts = [moved(r, 5.0) for r in trainer.train_round(0, learner)]
    learner.update(0, rollouts, trainer.policy)
    generated, _ = whole_episodes(rollouts, np.ones(8, bool), HORIZON)
    return learner, join([generated, shown(demos)])


def test_observations_are_normalised_by_demonstrations_and_rollouts(demos):
    learner, data = observed(demos)
    seen = data.observations.astype(float)
    np.testing.assert_allclose(learner.model.normaliser.mean, seen.mean(0), rtol=1e-6)


def test_samples_have_log_pi_of_the_present_policy_replayed_ones_too(demos, monkeypatch):
    """Paper Eq. 2. An absorbing state offers no choice: its action vector and log pi are zero."""
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, replay_share=0.5)
    drawn = record_losses(monkeypatch)
    absorbed = 0
    for index in range(3):
        rollouts = trainer.train_round(index, learner)
        learner.update(index, rollouts, trainer.policy)
        while drawn:
            batch, _, _ = drawn.pop()
            chosen = batch.actions.sum(-1) > 0
            absorbed += int((~chosen).sum())
            expected = trainer.policy.log_prob(
                batch.observations[chosen], batch.actions[chosen].argmax(-1)
            )
            torch.testing.assert_close(batch.log_probs[chosen], expected, atol=1e-5, rtol=1e-5)
            assert (batch.log_probs[~chosen] == 0.0).all()
    assert absorbed > 0


def test_the_student_earns_f_minus_log_pi(demos):
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, fixed_horizon=False)
    (rollout,) = trainer.train_round(0, learner)
    data = rollout.transitions(slice(None), HORIZON)
    with torch.no_grad():
        f = learner.model(
            torch.as_tensor(data.observations),
            learner.model.encode(torch.as_tensor(data.actions)),
            torch.as_tensor(data.next_observations),
            torch.as_tensor(data.terminated, dtype=torch.float32),
        )
    expected = f.numpy() - rollout.log_probs.ravel()
    earned = learner.rewards(rollout, trainer.policy).ravel()
    np.testing.assert_allclose(earned, expected, rtol=1e-5, atol=1e-5)


def test_the_scale_is_the_deviation_of_g_over_demonstrations_and_rollouts(demos):
    learner, data = observed(demos)
    with torch.no_grad():
        actions = learner.model.encode(torch.as_tensor(data.actions))
        g = learner.model.reward(torch.as_tensor(data.observations), actions)
    assert learner.scale == pytest.approx(float(g.double().std()), rel=1e-4)


def test_every_round_draws_other_samples(demos, monkeypatch):
    drawn = record_losses(monkeypatch)
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, updates_per_round=1, replay_share=0.0)
    rollouts = trainer.train_round(0, learner)
    for index in range(2):
        learner.update(index, rollouts, trainer.policy)
    first, second = (batch.observations for batch, _, _ in drawn)
    assert first.shape == second.shape and not torch.equal(first, second)


def test_a_step_is_as_long_as_the_clipped_gradient_allows(demos):
    """The gradient is so short that Adam divides it by its epsilon, 1e-8."""
    clipped = {"max_grad_norm": 1e-12, "weight_decay": 0.0, "learning_rate": 0.1}
    trainer, learner = make(demos, **clipped)
    before = [p.detach().clone() for p in learner.model.parameters()]
    learner.update(0, trainer.train_round(0, learner), trainer.policy)
    for now, then in zip(learner.model.parameters(), before, strict=True):
        assert torch.allclose(now, then, rtol=0.0, atol=1e-3)


def test_erm_measures_the_penalty_that_it_does_not_optimise(demos):
    _, _, rows = updated(demos)
    assert all(row["optimised_penalty"] == 0.0 and row["penalty"] != 0.0 for row in rows)


def test_without_penalty_own_and_shared_risks_learn_the_same(demos):
    rewards = [
        to_bytes(updated(demos, grouping=grouping)[1].snapshot())
        for grouping in ("balanced", "per-setting")
    ]
    assert rewards[0] == rewards[1]


def test_shuffled_labels_learn_another_reward(demos):
    plain = updated(demos, **IRM)[1]
    shuffled = updated(demos, **{**IRM, "grouping": "shuffled"})[1]
    assert to_bytes(plain.snapshot()) != to_bytes(shuffled.snapshot())


def test_the_learners_seed_deals_the_episodes_out(demos, monkeypatch):
    dealt, original = [], airl.risk_strata

    def record(groups, *arguments):
        dealt.append(str([[part.episodes for part in group.parts] for group in groups]))
        return original(groups, *arguments)

    monkeypatch.setattr(airl, "risk_strata", record)
    for seed in (0, 1, 1):
        updated(demos, grouping="shuffled", seed=seed)
    assert dealt[0] != dealt[1] == dealt[2]


@pytest.mark.parametrize(
    ("pairing", "met"), [("matched", [{5.0}, {6.0}]), ("pooled", [{5.0, 6.0}, {5.0, 6.0}])]
)
def test_a_minibatch_is_as_large_and_paired_as_the_config_says(demos, monkeypatch, pairing, met):
    drawn = record_losses(monkeypatch)
    changes = {**IRM, "pairing": pairing, "batch_size": 96, "replay_share": 0.0}
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, fixed_horizon=False, **changes)
    rollouts = [
        moved(moved(rollout, 5.0, slice(4)), 6.0, slice(4, 8))
        for rollout in trainer.train_round(0, learner)
    ]
    learner.update(0, rollouts, trainer.policy)
    batch = drawn[0][0]
    assert batch.log_probs.shape == (2, 2, 96)
    assert [set(part[0].unique().tolist()) for part in batch.observations] == met


def test_a_student_begins_as_a_clone_of_all_experts(demos):
    """Whatever the method, and only if asked for."""
    found = {}
    for grouping, epochs in (("pooled", 0), ("pooled", 5), ("shuffled", 5)):
        trainer, learner = make(demos, grouping=grouping, bc_epochs=epochs)
        learner.begin(trainer)
        data = learner.view.of(shown(demos))
        likelihood = float(learner.view.log_prob(trainer.policy, data).mean())
        found[grouping, epochs] = likelihood, to_bytes(trainer.state_dict())
    untouched, _ = make(demos)
    assert found["pooled", 0][1] == to_bytes(untouched.state_dict())
    assert found["pooled", 5][0] > found["pooled", 0][0]
    assert found["pooled", 5] == found["shuffled", 5]


def test_a_clone_keeps_the_moments_of_its_demonstrations(demos):
    ppo = replace(CONFIG.ppo, normalise_observations=True)
    trainer, learner = make(demos, ppo=ppo, bc_epochs=1)
    learner.begin(trainer)
    normaliser = trainer.model.policy.features_extractor.normaliser
    before = normaliser.mean.clone()
    np.testing.assert_allclose(before, shown(demos).observations.astype(float).mean(0), rtol=1e-6)
    trainer.train_round(0, learner)
    assert torch.equal(normaliser.mean, before)
    plain, other = make(demos, ppo=ppo)
    plain.train_round(0, other)
    assert float(plain.model.policy.features_extractor.normaliser.count) == 8 * 64


def leaves(state, path=""):
    """Every number and tensor of a nested state, by its path, as bytes."""
    if isinstance(state, dict | list | tuple):
        parts = state.items() if isinstance(state, dict) else enumerate(state)
        return {k: v for name, part in parts for k, v in leaves(part, f"{path}/{name}").items()}
    if isinstance(state, torch.Tensor):
        return {path: (state.dtype, tuple(state.shape), state.numpy().tobytes())}
    return {path: state}


# Saved in the middle of a challenger's life, and at its end.
CHALLENGED = [
    {
        "logit": "f",
        "policy_reward": "f",
        "gradient_penalty": 1.0,
        "learning_rate_schedule": "linear",
    }
    | {"challenger": ChallengerConfig(life=life, per_setting=own, ppo=LONG)}
    for life, own in ((1, False), (2, False), (2, True))
]


@pytest.mark.parametrize("changes", [{}, {"bc_epochs": 2}, {"averaged_rounds": 3}, *CHALLENGED])
def test_a_resumed_run_equals_an_uninterrupted_one(demos, changes):
    """To the byte, the replay, a clone and challengers included."""

    def training():
        trainer, learner = make(
            demos,
            ppo=LONG,
            horizon=HORIZON,
            total_steps=3 * LONG.n_envs * LONG.n_steps,
            **(IRM | changes),
        )
        challengers = None
        if learner.config.challenger.life > 0:
            worlds = [worlds_of(SETTINGS, LONG.n_envs, HORIZON)]
            if learner.config.challenger.per_setting:
                worlds = [worlds_of([setting], 4, HORIZON) for setting in SETTINGS]
            challengers = Challengers(worlds, learner.config.challenger, learner, 0, "test")
        return Training(trainer, learner, ["one", "other"], learner, challengers=challengers)

    saved = []
    through = training()
    through.run(lambda t, rows: saved.append((to_bytes(t.state_dict()), list(t.rows))), pytest.fail)
    assert len(saved) == 3
    resumed = training()
    state, rows = saved[0]
    resumed.load_state_dict(from_bytes(state), rows)
    resumed.run(lambda t, rows: None, pytest.fail)
    assert leaves(resumed.state_dict()) == leaves(from_bytes(saved[-1][0]))
    assert str(resumed.rows) == str(saved[-1][1])


def test_observations_of_another_size_are_refused(demos):
    from irlcli.interventions import parse_settings

    with pytest.raises(ValueError, match="observations of size 8"):
        make(demos, env="reacher", settings=parse_settings("reacher", "gravity=0.5x,2x"))


def test_the_reward_is_the_network_that_the_config_describes(demos):
    _, learner = make(demos, state_only=True, columns=(2,), hidden=(5, 6), activation="relu")
    layers = list(learner.model.g)
    widths = [layer.out_features for layer in layers if isinstance(layer, torch.nn.Linear)]
    assert widths == [5, 6, 1] and any(isinstance(layer, torch.nn.ReLU) for layer in layers)
    observations, actions = torch.zeros(2, 8), torch.eye(4)[:2]
    here = learner.model.reward(observations, actions)
    assert here[0] == here[1]
    observations[:, 3] = 9.0
    assert torch.equal(learner.model.reward(observations, actions), here)
    observations[:, 2] = 9.0
    assert not torch.equal(learner.model.reward(observations, actions), here)


def challenged(demos, symmetries=None, **changes):
    """A trainer, a learner and its challengers."""
    parts = {"ppo": LONG, "logit": "f", "policy_reward": "f", **changes}
    parts.setdefault("challenger", ChallengerConfig(life=9, ppo=LONG))
    trainer, learner = make(demos, horizon=HORIZON, symmetries=symmetries, **parts)
    worlds = worlds_of(SETTINGS, LONG.n_envs, HORIZON)
    return trainer, learner, Challengers([worlds], parts["challenger"], learner, 0, "test")


def test_observations_of_challengers_are_normalised_too(demos):
    trainer, learner, challengers = challenged(demos, fixed_horizon=False)
    rollouts = trainer.train_round(0, learner)
    theirs = [moved(r, 5.0) for r in challengers.train_round(0)]
    learner.update(0, rollouts, trainer.policy, theirs)
    generated, challenge = (
        whole_episodes(r, np.ones(8, bool), HORIZON)[0] for r in (rollouts, theirs)
    )
    seen = join([generated, challenge, shown(demos)]).observations.astype(float)
    np.testing.assert_allclose(learner.model.normaliser.mean, seen.mean(0), rtol=1e-5)


def test_each_replay_has_its_own_sizes(demos):
    challenger = ChallengerConfig(life=9, ppo=LONG, replay_episodes_per_round=3, replay_capacity=5)
    changes = {"replay_episodes_per_round": 1, "replay_capacity": 2, "challenger": challenger}
    trainer, learner, challengers = challenged(demos, **changes)
    for index in range(3):
        rollouts, theirs = trainer.train_round(index, learner), challengers.train_round(index)
        learner.update(index, rollouts, trainer.policy, theirs)
        for replay, most, kept in (("replay", 1, 2), ("challenger_replay", 3, 5)):
            held = [len(own["lengths"]) for own in learner.state_dict()[replay]["settings"]]
            assert held == [min(most * (index + 1), kept)] * 2


def test_the_discriminator_sees_images_of_students_challengers_and_experts(demos, monkeypatch):
    """All are at 5; the environment is the same with the other sign."""
    signs = np.array([np.eye(8), -np.eye(8)], np.float32)
    symmetries = Symmetries(signs, np.array([np.eye(4)] * 2, np.float32))
    at_five = [
        [replaced(t, observations=np.full_like(t.observations, 5.0)) for t in g] for g in demos
    ]
    trainer, learner, challengers = challenged(at_five, symmetries)
    seen = record_losses(monkeypatch)
    rollouts = [moved(r, 5.0) for r in trainer.train_round(0, learner)]
    theirs = [moved(r, 5.0) for r in challengers.train_round(0)]
    learner.update(0, rollouts, trainer.policy, theirs)
    # The student's minibatches and the challengers', each with its policy's and the experts' samples.
    assert len(seen) == CONFIG.updates_per_round
    for student, challenger, _ in seen:
        for batch in (student, challenger):
            for label in (0, 1):
                assert set(batch.observations[:, label].unique().tolist()) == {-5.0, 5.0}
    assert learner.model.normaliser.mean.abs().max() < 1.0
