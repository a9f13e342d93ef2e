"""Which round, and which lambda, held-out data in distribution chooses."""

import json
import math
from functools import partial

import numpy as np
import pytest
import torch

from irlcli.configs import AIRLConfig, PPOConfig
from irlcli.data.demonstrations import Demonstrations
from irlcli.errors import UsageError
from irlcli.interventions import parse_settings
from irlcli.learners import selection
from irlcli.learners.adversary import Adversary
from irlcli.rl import ppo as rl
from irlcli.store import Store, read_json

SETTINGS = parse_settings("lunar-lander", "engine-power=1x,1.25x")
FIRST, SECOND = (str(s) for s in SETTINGS)
PPO = PPOConfig(n_envs=4, n_steps=64, batch_size=64)


@pytest.fixture(scope="module")
def demos():
    groups = {
        str(s): tuple(rl.roll_out("lunar-lander", s, "random", 6, 0, f"test {s}")) for s in SETTINGS
    }
    return Demonstrations("lunar-lander", groups, {})


@pytest.fixture(scope="module")
def networks(demos):
    worlds = rl.make_worlds("lunar-lander", SETTINGS, PPO.n_envs)
    trainer = rl.PPOTrainer(worlds, PPO, 10_000, 0, "test")
    return trainer, Adversary(demos, AIRLConfig(updates_per_round=2, ppo=PPO), worlds, 0)


def test_the_first_of_the_best_rounds_is_kept_and_put_back(networks):
    trainer, adversary = networks
    scores = {1: 2.0, 3: 5.0, 5: 5.0, 6: 4.0}
    given = iter(scores.values())
    chosen = selection.Selection(lambda policy, actions: next(given), every=2, rounds=7)
    states = []
    for index in range(7):
        rollouts = trainer.train_round(index, partial(adversary.reward, policy=trainer.policy))
        adversary.train_round(index, rollouts, trainer.policy)
        states.append(
            (
                {k: v.clone() for k, v in trainer.policy.state_dict().items()},
                adversary.reward_state(),
            )
        )
        score = chosen.consider(index, trainer.policy, adversary)
        assert score == scores[index] if index in scores else math.isnan(score)
    assert (chosen.best["round"], chosen.best["score"]) == (3, 5.0)
    chosen.restore(trainer.policy, adversary)
    policy, reward = states[3]
    for name, tensor in trainer.policy.state_dict().items():
        assert torch.equal(tensor, policy[name])
    for name, tensor in adversary.model.state_dict().items():
        assert torch.equal(tensor, reward["model"][name])
    assert adversary.reward_state()["scale"] == reward["scale"]
    assert not all(torch.equal(policy[k], states[6][0][k]) for k in policy)


def test_log_likelihood_weighs_settings_not_steps(networks, demos):
    """Against SB3's own evaluation of actions, and with one setting's data repeated."""
    policy, actions = networks[0].policy, networks[1].actions
    means = []
    for trajectories in demos.trajectories.values():
        log_probs = [
            policy.network.evaluate_actions(
                torch.as_tensor(t.observations[:-1]), torch.as_tensor(t.actions)
            )[1].detach()
            for t in trajectories
        ]
        means.append(float(torch.cat(log_probs).mean()))
    expected = np.mean(means)
    assert selection.log_likelihood(policy, actions, demos.trajectories) == pytest.approx(
        expected, rel=1e-5
    )
    repeated = {FIRST: demos.trajectories[FIRST] * 5, SECOND: demos.trajectories[SECOND]}
    assert selection.log_likelihood(policy, actions, repeated) == pytest.approx(expected, rel=1e-5)


def test_held_out_episodes_are_not_trained_on(demos, networks):
    config = AIRLConfig(select="episodes", select_every=1, select_episodes=1)
    kept, chosen = selection.split(demos, config, rounds=1, seed=0)
    assert [len(group) for group in kept.trajectories.values()] == [5, 5]
    held_out = {text: group[-1:] for text, group in demos.trajectories.items()}
    score = chosen.consider(0, networks[0].policy, networks[1])
    assert score == selection.log_likelihood(networks[0].policy, networks[1].actions, held_out)


def test_a_selecting_setting_is_not_trained_on(demos, networks):
    config = AIRLConfig(select=FIRST, select_every=1, select_episodes=2)
    kept, chosen = selection.split(demos, config, rounds=1, seed=3)
    assert list(kept.trajectories) == [SECOND]
    first, again = (chosen.consider(0, networks[0].policy, networks[1]) for _ in range(2))
    assert first == again
    assert first == selection.true_return(
        networks[0].policy, networks[1].actions, "lunar-lander", FIRST, 2, 3
    )


def test_a_single_demonstration_cannot_be_held_out(demos):
    one = Demonstrations("lunar-lander", {FIRST: demos.trajectories[FIRST][:1]}, {})
    with pytest.raises(UsageError, match="none can be held out"):
        selection.split(one, AIRLConfig(select="episodes"), rounds=1, seed=0)


@pytest.fixture(scope="module")
def chosen(smoke_store, tmp_path_factory, run_irl):
    """A reward whose lambda was chosen, and its store."""
    import shutil

    path = tmp_path_factory.mktemp("choice") / "runs"
    shutil.copytree(smoke_store.path, path)
    arguments = ["train-airl", "--demos", "demos", "--method", "irm", "--profile", "smoke"]
    arguments += ["--store", str(path), "--choose-penalty", "1,0.1", "--name", "chosen"]
    plan = run_irl([*arguments, "--dry-run"]).out
    assert plan.count("RUN ") == 4 and plan.count("BLOCKED") == 2
    done = run_irl(arguments)
    assert done.code == 0, done.err
    assert run_irl([*arguments, "--dry-run"]).out.startswith("HIT")
    return Store(path)


def test_lambda_is_the_one_that_does_best_in_the_settings_left_out(chosen):
    reward = chosen.resolve("chosen").artefact
    record = reward.manifest.record
    (choice,) = (a for a in chosen.artefacts() if a.manifest.record.stage == "choose-penalty")
    made = read_json(chosen.open(choice, "choice.json"))
    assert made["weights"] == [0.1, 1.0]
    means = [np.mean([row[FIRST], row[SECOND]]) for row in made["scores"]]
    assert made["chosen"] == made["weights"][int(np.argmax(means))]
    assert record.parameters["airl"]["penalty_weight"] == made["chosen"]
    assert set(record.inputs) == {"demonstrations", "penalty choice"}
    sources = {
        role: found[0].manifest.record for role, found in chosen.index().parents(choice).items()
    }
    for weight in ("0.1", "1.0"):
        for setting, other in ((FIRST, SECOND), (SECOND, FIRST)):
            airl = sources[f"lambda {weight} without {setting}"].parameters["airl"]
            assert (airl["penalty_weight"], airl["select"]) == (float(weight), setting)
            (learned,) = (
                read_json(chosen.open(a, "reward.json"))
                for a in chosen.artefacts()
                if a.manifest.record.parameters.get("airl") == airl
            )
            assert learned["settings"] == [other]
            row = made["scores"][made["weights"].index(float(weight))]
            assert learned["selected"]["score"] == row[setting]


def test_the_selected_round_is_on_record(chosen, run_irl):
    arguments = ["train-airl", "--demos", "demos", "--profile", "smoke", "--json"]
    arguments += ["--store", str(chosen.root), "--select", "episodes"]
    done = run_irl([*arguments, "--set", "airl.select_every=1"])
    assert done.code == 0, done.err
    artefact = chosen.resolve(json.loads(done.out)["id"]).artefact
    selected = read_json(chosen.open(artefact, "reward.json"))["selected"]
    import pyarrow.parquet as pq

    rows = pq.read_table(chosen.open(artefact, "metrics.parquet")).to_pylist()
    scores = {row["round"]: row["score"] for row in rows}
    assert selected["score"] == max(scores.values()) == scores[selected["round"]]
    last = run_irl([*arguments[:-1], "last", "--dry-run"]).out
    plain = run_irl([*arguments[:-2], "--dry-run"]).out
    assert last == plain


@pytest.mark.parametrize(
    ("arguments", "named", "hint"),
    [
        (["--select", "engine-power=3x"], "engine-power=3x", "last, episodes, engine-power=1x"),
        (["--select", "rounds"], "rounds", "episodes"),
        (["--select", "gravity=1x"], "gravity", "engine-power"),
        (["--choose-penalty", "1"], "one lambda", "0.1,1,10"),
        (["--choose-penalty", "1,nan"], "1,nan", "0.1,1,10"),
        (["--choose-penalty", "1,x"], "1,x", "0.1,1,10"),
        (["--choose-penalty", "-1,1"], "-1,1", "0.1,1,10"),
        (["--choose-penalty", "1,2", "--penalty-weight", "3"], "--penalty-weight", "give one"),
        (["--choose-penalty", "1,2", "--method", "erm"], "'erm'", "irm-shuffled"),
    ],
)
def test_bad_input(smoke_store, run_irl, arguments, named, hint):
    common = ["train-airl", "--demos", "demos", "--method", "irm", "--profile", "smoke"]
    done = run_irl([*common, "--store", str(smoke_store.path), *arguments])
    assert done.code == 2
    assert done.out == ""
    message, hinted = done.err.strip().splitlines()[-2:]
    assert named in message
    assert hint in hinted
