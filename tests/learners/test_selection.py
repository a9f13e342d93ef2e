"""Which round, and which lambda, is selected by held-out data in distribution."""

import json
import math
from dataclasses import replace

import fsspec
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from airl_runs import CONFIG, LANDER, SETTINGS, make, random_episodes

from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.descriptions import PenaltyChoice, convert
from irlcli.data.streaming import write_demonstrations
from irlcli.data.tensors import load_policy_file, load_reward_file
from irlcli.errors import IntegrityError, StageFailed
from irlcli.experiments.runner import Silent
from irlcli.learners.discriminator import full_weight_from, penalty_weight_at
from irlcli.learners.selection import BestRound, hold_out, log_likelihood
from irlcli.requests.arguments import weights
from irlcli.rl.rollout import roll_out
from irlcli.stages import choose_penalty
from irlcli.stages.base import Job, environment_key
from irlcli.store import Store, read_json

FIRST, SECOND = (str(s) for s in SETTINGS)


@pytest.fixture(scope="module")
def demos():
    return random_episodes(6)


@pytest.fixture(scope="module")
def networks(demos):
    return make(demos, CONFIG)


def test_the_first_of_the_best_rounds_is_kept_and_put_back(networks):
    trainer, learner = networks
    scores = {1: 2.0, 3: 5.0, 5: 5.0, 6: 4.0}
    given = iter(scores.values())
    best = BestRound(lambda policy: next(given), learner, every=2, rounds=7)
    states = []
    for index in range(7):
        learner.update(index, trainer.train_round(index, learner), trainer.policy)
        policy = {k: v.clone() for k, v in trainer.policy.state_dict().items()}
        states.append((policy, learner.snapshot()))
        score = best.consider(index, trainer.policy)["score"]
        assert score == scores[index] if index in scores else math.isnan(score)
    assert (best.best["round"], best.best["score"]) == (3, 5.0)
    best.restore(trainer.policy)
    policy, reward = states[3]
    for name, tensor in trainer.policy.state_dict().items():
        assert torch.equal(tensor, policy[name])
    for name, tensor in learner.model.state_dict().items():
        assert torch.equal(tensor, reward["model"][name])
    assert learner.scale == reward["scale"]
    assert not all(torch.equal(policy[k], states[6][0][k]) for k in policy)


def test_no_round_before_the_full_penalty_is_kept(networks):
    """A clone scores best at once, when the reward is still that of ERM."""
    trainer, learner = networks
    assert [full_weight_from(warmup, ramp) for warmup, ramp in ((0, 0), (2, 1), (2, 3))] == [
        0,
        2,
        4,
    ]
    for warmup, ramp in ((0, 0), (2, 1), (2, 3)):
        first = full_weight_from(warmup, ramp)
        weights = [penalty_weight_at(index, 8.0, warmup, ramp) for index in range(first + 1)]
        assert weights[-1] == 8.0 and 8.0 not in weights[:-1]
    given = iter([3.0, 2.0])
    best = BestRound(lambda policy: next(given), learner, every=1, rounds=5, first=3)
    scores = [best.consider(index, trainer.policy)["score"] for index in range(5)]
    assert all(map(math.isnan, scores[:3])) and scores[3:] == [3.0, 2.0]
    assert best.best["round"] == 3
    # The last round is always scored.
    short = BestRound(lambda policy: 1.0, learner, every=1, rounds=2, first=3)
    for index in range(2):
        short.consider(index, trainer.policy)
    assert short.best["round"] == 1


def test_the_penalty_of_a_selected_round_is_the_whole_one(store_copy, irl):
    done = irl(
        *("train-airl", "--demos", "demos", "--store", store_copy.path, "--profile", "smoke"),
        *("--select", "episodes", "--set", "airl.select_every=1", "--method", "irm", "--json"),
        *("--set", "airl.penalty_warmup_rounds=1", "--set", "airl.penalty_ramp_rounds=2"),
    )
    assert done.code == 0, done.err
    made = store_copy.path / json.loads(done.out)["id"]
    rows = pq.read_table(made / "metrics.parquet").to_pylist()
    weights = {row["round"]: row["penalty_weight"] for row in rows}
    scored = {row["round"] for row in rows if not math.isnan(row["score"])}
    assert scored == {index for index, w in weights.items() if w == max(weights.values())}
    assert 0 < len(scored) < len(weights)


@pytest.mark.parametrize("score", [math.nan, math.inf])
def test_a_score_that_is_not_finite_ends_training(networks, score):
    """NaN is above nothing and below nothing, so the first round would be kept for ever."""
    trainer, learner = networks
    with pytest.raises(StageFailed, match=f"round 0 is {score}"):
        BestRound(lambda policy: score, learner, every=1, rounds=2).consider(0, trainer.policy)


def test_log_likelihood_weighs_settings_not_steps(networks, demos):
    """Against SB3's own evaluation of actions, and with one setting's data repeated."""
    trainer, learner = networks
    means = []
    for trajectories in demos:
        log_probs = [
            trainer.policy.network.evaluate_actions(
                torch.as_tensor(t.observations[:-1]), torch.as_tensor(t.actions)
            )[1].detach()
            for t in trajectories
        ]
        means.append(float(torch.cat(log_probs).mean()))
    expected = pytest.approx(np.mean(means), rel=1e-5)
    assert log_likelihood(trainer.policy, learner.view, demos) == expected
    repeated = [list(demos[0]) * 5, demos[1]]
    assert log_likelihood(trainer.policy, learner.view, repeated) == expected


def test_one_episode_in_five_is_held_out_and_at_least_one(demos):
    for count, expected in ((6, 1), (2, 1), (5, 1)):
        kept, held_out = hold_out(demos[0][:count])
        assert (len(kept), len(held_out)) == (count - expected, expected)
        assert [*kept, *held_out] == list(demos[0][:count])
    assert [len(part) for part in hold_out(list(demos[0]) * 2)] == [10, 2]
    with pytest.raises(ValueError, match="none can be held out"):
        hold_out(demos[0][:1])


@pytest.fixture(scope="module")
def chosen(smoke_store, copied, tmp_path_factory, run_irl):
    """A reward whose lambda was chosen, and its store."""
    path = copied(smoke_store.path, tmp_path_factory.mktemp("choice") / "runs")
    arguments = ["train-airl", "--demos", "demos", "--method", "irm", "--profile", "smoke"]
    arguments += ["--store", str(path), "--choose-penalty", "1,0.1", "--name", "chosen"]
    plan = run_irl([*arguments, "--dry-run"]).out
    # Two candidates in two folds; their evaluations, the choice and the reward wait.
    assert plan.count("RUN ") == 4 and plan.count("BLOCKED") == 6
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
    parents = chosen.index().parents(choice)
    students = {
        output.sha256: artefact.manifest.record
        for artefact in chosen.artefacts()
        for output in artefact.manifest.outputs
    }
    for weight in (0.1, 1.0):
        for setting, other in ((FIRST, SECOND), (SECOND, FIRST)):
            # Students that earn the same have equal summaries, so a role may have two parents.
            measured = parents[f"lambda {weight} without {setting}"]
            found = [students[e.manifest.record.inputs["policy"]] for e in measured]
            (student,) = (s for s in found if s.parameters["airl"]["penalty_weight"] == weight)
            # The round that is deployed is the one that was scored: same rule as the reward's.
            assert student.parameters["settings"] == [other]
            assert student.parameters["airl"]["select"] == record.parameters["airl"]["select"]
            summary = read_json(chosen.open(measured[0], "summary.json"))
            row = made["scores"][made["weights"].index(weight)]
            assert [s["setting"] for s in summary["settings"]] == [setting]
            assert summary["settings"][0]["mean_return"] == row[setting]


def test_ls_shows_the_method_and_the_candidates_of_a_choice(chosen, run_irl):
    listed = run_irl(["ls", "--store", str(chosen.root)]).out
    (choice,) = (row for row in listed.splitlines() if "choose-penalty" in row)
    assert f"{FIRST} {SECOND} lambda among 0.1, 1 seed 0 for irm" in " ".join(choice.split())


def test_a_choice_behind_a_url_is_planned_with(chosen, smoke_store, run_irl, tmp_path):
    place = f"memory://{tmp_path.name}"
    assert run_irl(["push", "chosen", "--to", place, "--store", str(chosen.root)]).code == 0
    demos = str(smoke_store.path / smoke_store.demos)
    arguments = ["train-airl", "--demos", demos, "--method", "irm", "--choose-penalty", "1,0.1"]
    arguments += ["--profile", "smoke", "--store", str(tmp_path / "none"), "--from", place]
    done = run_irl([*arguments, "--dry-run"])
    fsspec.filesystem("memory").rm(f"/{tmp_path.name}", recursive=True)
    assert done.code == 0, done.err
    assert done.out.startswith("FOUND") and not (tmp_path / "none").exists()


def test_the_selected_round_is_on_record(chosen, run_irl):
    arguments = ["train-airl", "--demos", "demos", "--profile", "smoke", "--json"]
    arguments += ["--store", str(chosen.root), "--select", "episodes"]
    done = run_irl([*arguments, "--set", "airl.select_every=1"])
    assert done.code == 0, done.err
    artefact = chosen.resolve(json.loads(done.out)["id"]).artefact
    selected = read_json(chosen.open(artefact, "reward.json"))["selected"]
    rows = pq.read_table(chosen.open(artefact, "metrics.parquet")).to_pylist()
    scores = {row["round"]: row["score"] for row in rows}
    assert selected["score"] == max(scores.values()) == scores[selected["round"]]
    last = run_irl([*arguments[:-1], "last", "--dry-run"]).out
    plain = run_irl([*arguments[:-2], "--dry-run"]).out
    assert last == plain


@pytest.mark.parametrize(
    ("first", "second", "chosen", "ties"),
    [
        ((9.0, 0.0), (5.0, 5.0), 1.0, 1),  # means 4.5 and 5
        ((9.0, 2.0), (5.0, 5.0), 0.1, 1),  # means 5.5 and 5
        ((9.0, 1.0), (5.0, 5.0), 0.1, 2),  # of equal means, the smaller lambda
    ],
)
def test_the_largest_mean_is_chosen(tmp_path, first, second, chosen, ties):
    inputs = {}
    for weight, means in ((0.1, first), (1.0, second)):
        for setting, mean in zip((FIRST, SECOND), means, strict=True):
            path = tmp_path / f"{weight} {setting}.json"
            returns = {"setting": setting, "episodes": 1, "stopped": 0, "mean_return": mean}
            policy = {"agent": "student", "env": LANDER}
            path.write_text(json.dumps({"policy": policy, "settings": [returns]}))
            inputs[f"lambda {weight} without {setting}"] = path
    parameters = choose_penalty.Parameters(
        environment=environment_key(LANDER), settings=(FIRST, SECOND), weights=(0.1, 1.0), seed=0
    )
    choose_penalty.run(Job(parameters, inputs, tmp_path, None, Silent()))
    made = read_json(tmp_path / "choice.json")
    assert (made["chosen"], made["ties"]) == (chosen, ties)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"chosen": 3.0}, "3"),
        ({"scores": [{FIRST: 1.0}]}, "1 of 2"),
        ({"weights": "all"}, "weights"),
    ],
)
def test_a_choice_of_another_form_is_refused(changes, named):
    choice = {"env": LANDER, "weights": [0.1, 1.0], "scores": [{FIRST: 1.0}, {FIRST: 2.0}]}
    choice |= {"chosen": 1.0, "ties": 1}
    assert convert(choice, PenaltyChoice, "choice.json").chosen == 1.0
    with pytest.raises(IntegrityError, match=rf"choice\.json.*{named}"):
        convert(choice | changes, PenaltyChoice, "choice.json")


def test_held_out_episodes_are_not_trained_on(store_copy, tmp_path, irl):
    """Two episodes of each setting: the second is held out, and scores the only round."""
    demos = read_demonstrations(store_copy.path / store_copy.demos)
    altered = tmp_path / "altered"
    altered.mkdir()
    groups = [
        (setting, [kept, replace(held_out, observations=-held_out.observations)])
        for setting in SETTINGS
        for kept, held_out in [demos.trajectories[str(setting)]]
    ]
    write_demonstrations(altered, LANDER, groups, demos.metadata)
    found = []
    for source in ("demos", altered):
        done = irl(
            *("train-airl", "--demos", source, "--store", store_copy.path, "--profile", "smoke"),
            *("--select", "episodes", "--set", "airl.total_steps=2048", "--json"),
        )
        assert done.code == 0, done.err
        made = store_copy.path / json.loads(done.out)["id"]
        found.append((load_reward_file(made / "reward.pt"), read_json(made / "reward.json")))
    (one, _), (other, _) = (reward for reward, _ in found)
    assert all(map(torch.equal, one.state_dict().values(), other.state_dict().values()))
    # The scores differ: the altered episodes were read.
    assert found[0][1]["selected"]["score"] != found[1][1]["selected"]["score"]


def test_the_setting_that_selects_scores_by_true_return_and_is_not_trained_on(store_copy, irl):
    done = irl(
        *("train-airl", "--demos", "demos", "--store", store_copy.path, "--profile", "smoke"),
        *("--select", FIRST, "--set", "airl.select_every=1", "--set", "airl.select_episodes=4"),
        *("--set", "airl.total_steps=4096", "--seed", "3", "--json"),
    )
    assert done.code == 0, done.err
    made = store_copy.path / json.loads(done.out)["id"]
    reward = read_json(made / "reward.json")
    assert reward["settings"] == [SECOND]
    rows = pq.read_table(made / "metrics.parquet").to_pylist()
    assert {row["setting"] for row in rows} == {SECOND}
    scores = [row["score"] for row in rows]
    assert reward["selected"]["score"] == max(scores) > min(scores)
    policy, _ = load_policy_file(made / "policy.pt")
    episodes = roll_out(LANDER, SETTINGS[0], policy, 4, 3, "selection")
    assert max(scores) == pytest.approx(np.mean([t.episode_return for t in episodes]))


def test_candidates_for_lambda_may_have_spaces_between_them():
    assert weights(" 0.1, 1 ") == [0.1, 1]


@pytest.mark.parametrize(
    ("arguments", "named", "hint"),
    [
        (["--select", "engine-power=3x"], "engine-power=3x", "last, episodes, engine-power=1x"),
        (["--select", "rounds"], "rounds", "episodes"),
        (["--select", "gravity=1x"], "gravity", "engine-power"),
        (["--choose-penalty", "1"], "two different candidates", "0.1,1,10"),
        (["--choose-penalty", "1,1.0"], "two different candidates", "0.1,1,10"),
        (["--choose-penalty", "1,nan"], "1,nan", "0.1,1,10"),
        (["--choose-penalty", "1,x"], "1,x", "0.1,1,10"),
        (["--choose-penalty", "-1,1"], "-1,1", "0.1,1,10"),
        (["--choose-penalty", "1,2", "--penalty-weight", "3"], "--penalty-weight", "give one"),
        (["--choose-penalty", "1,2", "--method", "erm"], "no penalty", "irm"),
        (["--choose-penalty", "1,2", "--select", "engine-power=1x"], "engine-power=1x", "episodes"),
    ],
)
def test_bad_input(smoke_store, run_irl, arguments, named, hint):
    common = ["train-airl", "--demos", "demos", "--profile", "smoke"]
    common += [] if "--method" in arguments else ["--method", "irm"]
    done = run_irl([*common, "--store", str(smoke_store.path), *arguments])
    assert done.code == 2
    assert done.out == ""
    message, hinted = done.err.strip().splitlines()[-2:]
    assert named in message
    assert hint in hinted
