"""The learner as a whole: groupings, diagnostics, cloning, resuming."""

import numpy as np
import pytest
import torch
from airl_runs import CONFIG, make, random_episodes
from msgspec.structs import replace

from irlcli.configs import ChallengerConfig, PPOConfig
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.learners import airl
from irlcli.rl.challengers import Challengers
from irlcli.rl.loop import LastRound, Training
from irlcli.trajectories import join

# A round holds whole episodes at this time limit.
HORIZON = 200
LONG = PPOConfig(n_envs=8, n_steps=220, batch_size=512, n_epochs=1)
IRM = {"grouping": "per-setting", "penalty": "irmv1", "penalty_weight": 10.0}


@pytest.fixture(scope="module")
def demos():
    return random_episodes(4)


def updated(demos, rounds=1, **changes):
    trainer, learner = make(demos, ppo=LONG, horizon=HORIZON, **changes)
    for index in range(rounds):
        rollouts = trainer.train_round(index, learner)
        rows = learner.update(index, rollouts, trainer.policy)
    return trainer, learner, rows


def test_the_logged_objective_is_the_one_that_was_optimised(demos, monkeypatch):
    """With replay: mean over the round's minibatches of what the optimiser minimised."""
    seen = []
    original = airl.discriminator_loss

    def spy(*arguments):
        loss = original(*arguments)
        seen.append(loss)
        return loss

    monkeypatch.setattr(airl, "discriminator_loss", spy)
    changes = {**IRM, "penalty_warmup_rounds": 0, "penalty_ramp_rounds": 1, "updates_per_round": 3}
    _, _, rows = updated(demos, rounds=2, **changes)
    last = seen[-3:]
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


def test_diagnostics_are_per_true_setting_for_every_grouping(demos):
    for grouping in ("pooled", "balanced", "per-setting", "shuffled"):
        penalty = "irmv1" if grouping in ("per-setting", "shuffled") else "none"
        _, _, rows = updated(demos, grouping=grouping, penalty=penalty)
        assert len(rows) == 2
        names = {"cross_entropy", "accuracy", "mean_abs_logit", "penalty", "penalty_weight"}
        assert all(
            set(row) == names | {"optimised_cross_entropy", "optimised_penalty"} for row in rows
        )
        assert all(0 <= row["accuracy"] <= 1 for row in rows)
        assert rows[0]["cross_entropy"] != rows[1]["cross_entropy"]


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


def test_every_grouping_draws_as_many_samples(demos, monkeypatch):
    sizes = {}
    original = airl.discriminator_logits
    for grouping in ("pooled", "balanced", "per-setting", "shuffled"):

        def spy(model, batch, grouping=grouping):
            if batch.log_probs.shape[-1] < 1000:
                sizes.setdefault(grouping, batch.log_probs.numel())
            return original(model, batch)

        monkeypatch.setattr(airl, "discriminator_logits", spy)
        updated(demos, grouping=grouping)
    assert len(set(sizes.values())) == 1


def test_unequal_counts_weigh_as_the_grouping_says(demos):
    """One episode against three: pooled by count, otherwise equally."""
    few = [demos[0][:1], demos[1][:3]]
    for grouping, weights in (("pooled", [1.0]), ("balanced", [0.5, 0.5])):
        _, learner = make(few, ppo=LONG, horizon=HORIZON, grouping=grouping)
        assert learner._weights.tolist() == weights


def test_the_policys_samples_are_shared_out_as_the_demonstrations_are(demos):
    """Otherwise the discriminator could learn how often a setting was demonstrated."""
    few = [demos[0][:1], demos[1][:3]]
    trainer, learner = make(few, ppo=LONG, horizon=HORIZON, batch_size=64)
    pools = [
        learner._pool(data, None) for data, _ in learner._generated(trainer.train_round(0, learner))
    ]
    ((first, second),) = learner._risks(pools, learner._replay, pools, None)
    assert (first.count, second.count) == (32, 96)
    for setting, stratum in enumerate((first, second)):
        assert torch.equal(stratum.policy.observations, pools[setting].observations)


def test_a_student_begins_as_a_clone_of_all_experts(demos):
    """Whatever the method, and only if asked for."""
    found = {}
    for grouping, epochs in (("pooled", 0), ("pooled", 5), ("shuffled", 5)):
        trainer, learner = make(demos, grouping=grouping, bc_epochs=epochs)
        learner.begin(trainer)
        data = join([episode for group in learner._demonstrations for episode in group])
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
    data = join([episode for group in learner._demonstrations for episode in group])
    np.testing.assert_allclose(before, data.observations.astype(float).mean(0), rtol=1e-6)
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
    | {"challenger": ChallengerConfig(life=life, mixed_share=mixed, ppo=LONG)}
    for life, mixed in ((1, 0.0), (2, 0.5))
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
            worlds = trainer._venv.worlds
            challengers = Challengers(worlds, learner.config.challenger, learner, 0, "test")
        return Training(trainer, learner, learner, LastRound(), ["one", "other"], challengers)

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
