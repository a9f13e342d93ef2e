"""Retraining through the real command line: SAC, a ceiling, the student as a start."""

import json
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from retraining import common, interrupt, made

from irlcli.configs import load_config
from irlcli.data.tensors import load_policy_file, load_reward_file
from irlcli.errors import UsageError
from irlcli.experiments.runner import Silent
from irlcli.interventions import parse_setting
from irlcli.learners.frozen import FrozenReward
from irlcli.requests.arguments import warn_of_seen, where
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.rollout import roll_out
from irlcli.rl.sac import SACTrainer
from irlcli.stages.base import Job, environment_key
from irlcli.stages.running import deciding_score, frozen_reward
from irlcli.store import Store
from irlcli.trajectories import Trajectory

RELU = ["--set", "airl.ppo.activation=relu"]


@pytest.fixture(scope="module")
def cheetah(tmp_path_factory, run_irl):
    """A store with a reward ``airl`` of HalfCheetah, whose student has other layers than the default."""
    store = tmp_path_factory.mktemp("cheetah") / "runs"
    common = ["--store", str(store), "--profile", "smoke", "--quiet", "--name"]
    intervention = ["--env", "half-cheetah", "--intervention", "friction"]
    for arguments in (
        ["collect-experts", *intervention, *common, "demos"],
        ["train-airl", "--demos", "demos", "--method", "erm", *common, "airl", *RELU],
    ):
        done = run_irl(arguments)
        assert done.code == 0, done.err
    return store


@pytest.fixture
def runs(cheetah, tmp_path):
    """A copy of that store."""
    return shutil.copytree(cheetah, tmp_path / "cheetah", symlinks=True)


SAC = ["transfer", "--reward", "airl", "--ood", "friction", "--algorithm", "sac"]


def test_sac_end_to_end(runs, irl):
    artefact = made(runs, irl(*SAC, *common(runs), "--name", "moved"))
    parameters = artefact.manifest.record.parameters["transfer"]
    assert parameters["algorithm"] == "sac"
    about = json.loads((artefact.directory / "policy.json").read_text())
    assert about["agent"] == "transfer" and about["network"]["squashed"]
    policy, _ = load_policy_file(artefact.directory / "policy.pt")
    observations = np.random.default_rng(0).normal(0, 5, (50, 17)).astype(np.float32)
    assert np.abs(policy.act(observations)).max() <= 1.0
    score = irl("evaluate", "--policy", "moved", "--reward", "airl", *common(runs))
    assert score.code == 0 and "AIRL-ERM retrained policy" in score.err
    again = irl(*SAC, *common(runs), "--dry-run")
    assert again.out.startswith("HIT")


def test_sac_interrupted_and_run_again_gives_the_same_bytes(runs, irl, tmp_path, monkeypatch):
    """By SIGINT. The checkpoint from which it resumes has the replay buffer, too."""
    line = [*SAC, "--set", "transfer.total_steps=3072"]
    whole = shutil.copytree(runs, tmp_path / "whole", symlinks=True)
    expected = made(whole, irl(*line, *common(whole)))
    rounds = interrupt(SACTrainer, 2, monkeypatch)
    assert irl(*line, *common(runs)).code == 130
    resumed = made(runs, irl(*line, *common(runs)))
    assert rounds == [0, 1, 2]
    assert resumed.provenance()["resumed"] == 1
    assert resumed.id == expected.id


@pytest.mark.parametrize("words", [["--start", "student"], ["--start", "student", "--seed", "3"]])
def test_the_retrained_policy_begins_as_the_student(runs, irl, words, monkeypatch):
    """Its first actions are the student's, before any update; its moments stay."""
    first = {}
    original = PPOTrainer.train_round

    def spied(self, index, source):
        if index == 0:
            first.update({name: t.clone() for name, t in self.policy.state_dict().items()})
        return original(self, index, source)

    student, about = load_policy_file(Store(runs).resolve("airl").artefact.directory / "policy.pt")
    monkeypatch.setattr(PPOTrainer, "train_round", spied)
    command = ["transfer", "--reward", "airl", "--ood", "friction", *words]
    artefact = made(runs, irl(*command, *common(runs)))
    expected = student.state_dict()
    assert first.keys() == expected.keys()
    assert all(torch.equal(first[name], expected[name]) for name in expected)
    parameters = artefact.manifest.record.parameters["transfer"]
    assert parameters["total_steps"] == 2048
    assert parameters["ppo"]["learning_rate"] == 1e-4
    assert parameters["ppo"]["learning_rate_schedule"] == "linear"
    moved, description = load_policy_file(artefact.directory / "policy.pt")
    assert description.from_student and description.network == about.network
    count = "features_extractor.normaliser.count"
    assert moved.state_dict()[count] == expected[count]
    inputs = artefact.manifest.record.inputs
    assert set(inputs) == {"reward", "start"}
    scratch = made(runs, irl(*command[:5], *common(runs)))
    assert scratch.id != artefact.id
    # Outside the store the student is found beside the reward, with the same key.
    outside = runs.parent / "copied"
    shutil.copytree(Store(runs).resolve("airl").artefact.directory, outside)
    command[2] = str(outside / "reward.pt")
    assert made(runs, irl(*command, *common(runs))).id == artefact.id
    os.chmod(outside, 0o755)
    (outside / "policy.pt").unlink()
    missing = irl(*command, *common(runs))
    assert missing.code == 3 and "there is no student beside" in missing.err
    shutil.copy(scratch.directory / "policy.pt", outside)
    foreign = irl(*command, *common(runs))
    assert foreign.code == 3 and "is not the student of the reward" in foreign.err


def test_the_absorbing_series_is_discounted_by_the_retrained_policys_gamma(
    store_copy, irl, monkeypatch
):
    """With gamma 0.5, that of the reward being 0.99, the final state counts 0.5 / (1 - 0.5) = 1."""
    seen = []
    original = FrozenReward.rewards

    def spied(self, rollout, policy):
        paid = original(self, rollout, policy)
        seen.append((rollout.transitions(slice(None), 1000), paid.ravel()))
        return paid

    monkeypatch.setattr(FrozenReward, "rewards", spied)
    line = ["transfer", "--reward", "airl", "--ood", "1.5x", *common(store_copy.path)]
    one_round = ["--set", "transfer.ppo.gamma=0.5", "--set", "transfer.total_steps=1024"]
    made(store_copy.path, irl(*line, *one_round))
    model, about = load_reward_file(store_copy.path / store_copy.airl / "reward.pt")
    ((steps, paid),) = seen
    ended = steps.terminated
    actions = torch.eye(4)[torch.as_tensor(steps.actions[ended])]
    states, final = (
        torch.as_tensor(s[ended]) for s in (steps.observations, steps.next_observations)
    )
    with torch.no_grad():
        g = model.reward(states, actions) + 1.0 * model.reward(final, torch.zeros_like(actions))
    assert about.network.gamma == 0.99 and ended.any()
    assert paid[ended] == pytest.approx(g.numpy() / about.scale, rel=1e-4, abs=1e-6)


def test_a_ceiling_changes_the_policy_and_evaluations_stay_unbounded(runs, irl):
    command = ["transfer", "--reward", "airl", "--ood", "friction"]
    plain = made(runs, irl(*command, *common(runs)))
    low = made(runs, irl(*command, "--set", "transfer.ceiling=0.1", *common(runs), "--name", "low"))
    (free, _), (policy, about) = (load_policy_file(a.directory / "policy.pt") for a in (plain, low))
    ours, theirs = (p.state_dict() for p in (policy, free))
    assert any(not torch.equal(ours[name], theirs[name]) for name in ours)
    score = made(runs, irl("evaluate", "--policy", "low", "--reward", "airl", *common(runs)))
    paid = pq.read_table(score.directory / "episodes.parquet")["learned_return"].to_pylist()
    modal = score.manifest.record.parameters["evaluation"]["deterministic"]
    (setting,) = about.settings
    parsed = parse_setting("half-cheetah", setting)
    acted = roll_out("half-cheetah", parsed, policy, len(paid), 0, "evaluate", modal)
    model, origin = load_reward_file(Store(runs).resolve("airl").artefact.directory / "reward.pt")
    where = environment_key("half-cheetah"), setting, model, origin
    unbounded, bounded = (
        [frozen_reward(*where, ceiling).of_episode(episode) for episode in acted]
        for ceiling in (None, 0.1)
    )
    assert paid == pytest.approx(unbounded) and paid != pytest.approx(bounded)


def test_a_training_setting_is_named_as_for_evaluations(runs, irl):
    own = ["transfer", "--reward", "airl", *common(runs), "--dry-run"]
    by_value = irl(*own, "--intervention", "2:0.6:0.6")
    assert by_value.code == 0, by_value.err
    assert "half-cheetah friction=2:0.6:0.6" in by_value.out
    assert "warning" not in by_value.err
    as_unseen = irl(*own, "--ood", "friction=2:0.6:0.6")
    assert as_unseen.out == by_value.out
    warned = "warning: friction=2:0.6:0.6 is not held out: 'airl' was trained in it"
    assert warned in as_unseen.err
    assert "warning" not in irl(*own, "--ood", "friction").err
    score = ["evaluate", "--policy", "airl", *common(runs), "--dry-run"]
    assert warned in irl(*score, "--ood", "2:0.6:0.6").err
    assert "warning" not in irl(*score).err


@pytest.mark.parametrize(
    ("trained", "shared", "apart"),
    [
        ("direction=-10..0", "direction=-5,0,-10..0,-5..5", "direction=1,0.5..3"),
        ("leg-length=1.5", "leg-length=1.5x", "leg-length=1x,2"),
    ],
)
def test_a_held_out_setting_that_shares_worlds_with_a_trained_one_is_named(trained, shared, apart):
    origin = SimpleNamespace(env="half-cheetah", settings=(trained,), selected_in=None)

    def named(text):
        said = []
        settings = [parse_setting("half-cheetah", part) for part in texts(text)]
        warn_of_seen(SimpleNamespace(warn=said.append), settings, origin, "irm")
        return [line.partition(" is not held out")[0] for line in said]

    def texts(text):
        knob, _, values = text.partition("=")
        return [f"{knob}={value}" for value in values.split(",")]

    assert named(shared) == texts(shared) and named(apart) == []


def test_a_setting_that_selected_the_round_is_not_held_out():
    one = SimpleNamespace(env="ant", settings=("mass=1x",), selected_in="mass=2x")
    said = []
    settings = [parse_setting("ant", text) for text in ("mass=2x", "mass=3x")]
    warn_of_seen(SimpleNamespace(warn=said.append), settings, one, "irm")
    assert said == ["mass=2x is not held out: it selected the round of 'irm'"]


def test_a_knob_that_the_reward_has_not_seen_changed_is_named(runs, irl):
    line = ["transfer", "--reward", "airl", *common(runs), "--dry-run", "--ood"]
    assert "do not change mass" in irl(*line, "mass=2x").err
    assert "do not change" not in irl(*line, "friction").err


@pytest.mark.parametrize("settings", [("default", "mass=2x"), ("mass=2x", "default")])
def test_values_alone_belong_to_the_only_knob_of_all_training_settings(settings):
    origin = SimpleNamespace(env="ant", settings=settings)
    (found,) = where("3x", None, ()).settings("ant", load_config("ant", "smoke"), origin)
    assert str(found) == "mass=3x"


def test_values_alone_are_refused_where_the_training_settings_have_several_knobs():
    origin = SimpleNamespace(env="ant", settings=("mass=2x", "friction=1:1:1"))
    with pytest.raises(UsageError, match="names no intervention"):
        where("3x", None, ()).settings("ant", load_config("ant", "smoke"), origin)


def test_bad_input_is_one_line_and_a_hint(runs, irl, store_copy):
    lander = ["transfer", "--reward", "airl", "--ood", "1.5x", *common(store_copy.path)]
    own = ["transfer", "--reward", "airl", "--ood", "friction", *common(runs)]
    for arguments, message, hint in (
        ([*lander, "--algorithm", "sac"], "SAC needs continuous actions", "use --algorithm ppo"),
        ([*own, "--algorithm", "sca"], "unknown transfer.algorithm 'sca'", "did you mean 'sac'"),
        ([*own, "--start", "studnet"], "unknown --start 'studnet'", "did you mean 'student'"),
        (
            [*own, "--start", "student", "--algorithm", "sac"],
            "--start student needs PPO",
            "use --algorithm ppo",
        ),
        ([*own, "--set", "transfer.ceiling=1.5"], "transfer.ceiling", "none"),
        ([*own, "--intervention", "friction"], "--ood and --intervention both", "give one of"),
        ([*own[:3], *common(runs)], "no setting is named", "give one of --ood"),
        (
            [*own[:3], "--intervention", "friction", *common(runs)],
            "names 2 settings: friction=1.5:0.1:0.1, friction=2:0.6:0.6",
            "one at a time",
        ),
    ):
        done = irl(*arguments)
        assert done.code == 2 and done.out == ""
        error, told = done.err.strip().splitlines()
        assert message in error and hint in told


class Heard(Silent):
    """A console that remembers the warnings."""

    def __init__(self):
        self.warned = []

    def warn(self, message):
        self.warned.append(message)


@pytest.mark.parametrize(
    ("errors", "expected"),
    [((None, None, None), -20.0), ((None, "burst", None), -15.0), (("burst",) * 3, -20.0)],
)
def test_an_episode_that_an_error_stopped_decides_nothing(tmp_path, errors, expected):
    episodes = [
        Trajectory(
            np.zeros((length + 1, 1), np.float32),
            np.zeros(length, np.int64),
            np.full(length, -1.0),
            *(False, True),
            seed=k,
            error=error,
        )
        for k, (length, error) in enumerate(zip((10, 30, 20), errors, strict=True))
    ]
    console = Heard()
    job = Job(None, {}, tmp_path, None, console)
    score = deciding_score(job, "gravity=1x", episodes, lambda t: t.episode_return)
    assert score == expected
    assert len(console.warned) == sum(error is not None for error in errors)


def test_sac_restarts(runs, irl):
    artefact = made(runs, irl(*SAC, "--set", "transfer.restarts=2", *common(runs)))
    about = json.loads((artefact.directory / "policy.json").read_text())
    assert about["network"]["squashed"] and len(about["restarts"]) == 2
