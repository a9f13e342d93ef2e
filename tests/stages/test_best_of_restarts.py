"""Restarts of retraining through the real command line."""

import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from retraining import common, interrupt, made

from irlcli.data.tensors import load_policy_file, load_reward_file
from irlcli.interventions import parse_setting
from irlcli.learners.frozen import FrozenReward
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.rollout import roll_out
from irlcli.stages.base import environment_key
from irlcli.stages.running import frozen_reward
from irlcli.store import Store


@pytest.fixture
def runs(store_copy):
    """A copy of the smoke store, with LunarLander's reward ``airl``."""
    return store_copy.path


RESTARTS = ["transfer", "--reward", "airl", "--ood", "1.5x", "--set", "transfer.restarts=3"]


def test_the_restart_with_the_highest_learned_return_is_kept(runs, irl, monkeypatch):
    """Two episodes measure each restart; only the learned return of an episode is looked at."""
    paid = iter([1.0, 1.0, 5.0, 7.0, 3.0, 3.0])
    with monkeypatch.context() as patch:
        patch.setattr(FrozenReward, "of_episode", lambda *_: next(paid))
        artefact = made(runs, irl(*RESTARTS, *common(runs), "--name", "best"))
    about = json.loads((artefact.directory / "policy.json").read_text())
    assert about["restarts"] == [1.0, 6.0, 3.0]
    rows = pq.read_table(artefact.directory / "metrics.parquet").to_pylist()
    assert {(row["restart"], row["kept"]) for row in rows} == {(0, False), (1, True), (2, False)}
    score = irl("evaluate", "--policy", "best", "--reward", "airl", *common(runs))
    assert score.code == 0 and "best of 3" in score.err
    assert "6,144 steps" in irl("ls", "--store", runs).out


def test_restarts_are_measured_under_the_ceiling(runs, irl, monkeypatch):
    """On the same episodes, other than those that evaluations measure."""
    seen, original = [], FrozenReward.of_episode

    def spied(self, trajectory):
        seen.append(trajectory)
        return original(self, trajectory)

    monkeypatch.setattr(FrozenReward, "of_episode", spied)
    low = ["--set", "transfer.ceiling=0.1", "--set", "transfer.total_steps=1024"]
    artefact = made(runs, irl(*RESTARTS[:-1], "transfer.restarts=2", *low, *common(runs)))
    model, origin = load_reward_file(Store(runs).resolve("airl").artefact.directory / "reward.pt")
    about = json.loads((artefact.directory / "policy.json").read_text())
    where = environment_key("lunar-lander"), about["settings"][0], model, origin
    bounded, unbounded = (
        [original(frozen_reward(*where, ceiling), trajectory) for trajectory in seen]
        for ceiling in (0.1, None)
    )
    assert about["restarts"] == pytest.approx(np.reshape(bounded, (2, -1)).mean(1))
    assert (np.array(unbounded) > bounded).all()
    first, second = np.reshape([trajectory.seed for trajectory in seen], (2, -1)).tolist()
    assert first == second
    (setting,) = (parse_setting("lunar-lander", text) for text in about["settings"])
    evaluated = roll_out("lunar-lander", setting, "idle", len(first), 0, "evaluate")
    assert {t.seed for t in evaluated}.isdisjoint(first)


def test_one_restart_is_the_policy_without(runs, irl):
    plain = made(runs, irl(*RESTARTS[:-2], *common(runs)))
    once = irl(*RESTARTS[:-1], "transfer.restarts=1", *common(runs), "--dry-run")
    assert once.out.startswith("HIT")
    with_two = made(runs, irl(*RESTARTS[:-1], "transfer.restarts=2", *common(runs)))
    policies = [
        load_policy_file(one.directory / "policy.pt")[0].state_dict() for one in (plain, with_two)
    ]
    paid = json.loads((with_two.directory / "policy.json").read_text())["restarts"]
    same = all(torch.equal(policies[0][name], policies[1][name]) for name in policies[0])
    assert paid[0] != paid[1] and same == (paid[0] > paid[1])


def test_the_best_restart_alone_has_the_whole_budget(runs, irl):
    """Three restarts of one round; the best has a second, as if it had been alone from the start."""
    line = [*RESTARTS[:-2], "--set", "transfer.restart_episodes=1"]
    each = ["--set", "transfer.restart_steps=1024"]
    artefact = made(runs, irl(*line, *RESTARTS[-2:], *each, *common(runs)))
    rows = pq.read_table(artefact.directory / "metrics.parquet").to_pylist()
    kept = [row["round"] for row in rows if row["kept"]]
    assert kept == [0, 1] and len(rows) == 4
    assert "4,096 steps" in irl("ls", "--store", runs).out
    whole = made(runs, irl(*line, *RESTARTS[-2:], *common(runs)))
    best = next(row["restart"] for row in rows if row["kept"])
    both = [
        [row["true_return"] for row in found if row["restart"] == best]
        for found in (rows, pq.read_table(whole.directory / "metrics.parquet").to_pylist())
    ]
    assert both[0] == both[1] and len(both[0]) == 2


def test_restarts_as_long_as_the_whole_budget_are_refused(runs, irl):
    done = irl(*RESTARTS, "--set", "transfer.restart_steps=2048", *common(runs))
    assert done.code == 2 and "transfer.restart_steps" in done.err and "omit" in done.err


@pytest.mark.parametrize(
    ("each", "done"), [([], [0, 1, 0, 1]), (["--set", "transfer.restart_steps=1024"], [0, 0, 1])]
)
def test_restarts_interrupted_and_run_again_give_the_same_bytes(
    runs, irl, tmp_path, monkeypatch, each, done
):
    """Interrupted in its third round, it resumes there."""
    line = [*RESTARTS[:-1], "transfer.restarts=2", "--set", "transfer.total_steps=2048"]
    line += ["--set", "transfer.ppo.rollouts_per_round=1", *each]
    whole = shutil.copytree(runs, tmp_path / "whole", symlinks=True)
    expected = made(whole, irl(*line, *common(whole)))
    rounds = interrupt(PPOTrainer, 3, monkeypatch)
    assert irl(*line, *common(runs)).code == 130
    resumed = made(runs, irl(*line, *common(runs)))
    assert rounds == done
    assert resumed.provenance()["resumed"] == 1
    assert resumed.id == expected.id


def test_a_policy_that_begins_as_the_student_has_no_restarts(runs, irl):
    student = ["transfer", "--reward", "airl", "--ood", "1.5x", "--start", "student"]
    made(runs, irl(*student, *common(runs)))
    again = irl(*student, *RESTARTS[-2:], *common(runs), "--dry-run")
    assert again.out.startswith("HIT")


@pytest.mark.parametrize("count", ["0", "-1", "two", "1.5"])
def test_a_bad_count_of_restarts_is_refused(runs, irl, count):
    done = irl(*RESTARTS[:-1], f"transfer.restarts={count}", *common(runs))
    assert done.code == 2 and "transfer.restarts" in done.err
