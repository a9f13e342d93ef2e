"""Adversarial training that ends at a plateau of the discriminator's cross-entropy."""

import json
import math

import pyarrow.parquet as pq
import pytest
from airl_runs import make, random_episodes

from irlcli.labels import describe
from irlcli.learners.stopping import cross_entropies, plateaued
from irlcli.rl.loop import Training
from irlcli.store import Store, read_json

COIN = math.log(2.0)


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([COIN] * 4, True),
        ([COIN] * 3, False),
        ([0.66, 0.67, 0.68, 0.69], False),
        ([0.69, 0.69, 0.70, 0.68], True),
        # Only the last rounds count, and those before them.
        ([0.1, 0.2, 0.69, 0.69, 0.69, 0.69], True),
        # A student that fails: nothing rises, but the discriminator tells the two apart.
        ([0.6] * 4, False),
        # Near chance begins at 95 % of a coin's.
        ([0.951 * COIN] * 4, True),
        ([0.949 * COIN] * 4, False),
    ],
)
def test_a_plateau_is_near_chance_and_no_higher_than_before(values, ends):
    assert plateaued(values, 2) is ends


def test_settings_count_alike_and_rounds_before_the_first_do_not():
    rows = [
        {"round": index, "setting": setting, "cross_entropy": index + value}
        for index in range(4)
        for setting, value in (("one", 0.2), ("other", 0.4))
    ]
    assert cross_entropies(rows, 2) == pytest.approx([2.3, 3.3])
    assert cross_entropies([], 0) == []


def test_a_run_killed_after_its_last_round_trains_no_further():
    def training():
        trainer, learner = make(random_episodes(1), total_steps=3 * 8 * 64)
        ends = lambda rows: len(rows) >= 4  # noqa: E731
        return Training(trainer, learner, ["one", "other"], learner, ends=ends)

    saved = []
    rows = training().run(lambda t, _: saved.append((t.state_dict(), list(t.rows))), pytest.fail)
    assert len(saved) == 2 and len(rows) == 4
    resumed = training()
    resumed.load_state_dict(*saved[-1])
    assert resumed.run(lambda t, _: pytest.fail("trained on"), pytest.fail) == rows


@pytest.fixture(scope="module")
def line(smoke_store, copied, tmp_path_factory):
    """A training whose cross-entropy falls from above chance, so that two rounds are a plateau."""
    path = copied(smoke_store.path, tmp_path_factory.mktemp("plateau") / "runs")
    return ["train-airl", "--demos", "demos", "--profile", "smoke", "--store", str(path), "--json"]


def test_training_ends_at_the_plateau_and_says_so(line, run_irl):
    done = run_irl([*line, "--set", "airl.plateau_rounds=1"])
    assert done.code == 0, done.err
    assert "4,096 of 6,144 steps" in done.err
    store = Store(line[line.index("--store") + 1])
    artefact = store.resolve(json.loads(done.out)["id"]).artefact
    reward = read_json(store.open(artefact, "reward.json"))
    assert reward["stopped_after"] == 2
    rows = pq.read_table(store.open(artefact, "metrics.parquet")).to_pylist()
    assert {row["round"] for row in rows} == {0, 1}
    losses = cross_entropies(rows, 0)
    assert 0.95 * COIN <= losses[1] <= losses[0]
    assert "to a plateau" in describe(artefact.manifest.record)


def test_rounds_of_the_penaltys_ramp_do_not_count(line, run_irl):
    """The ramp is the first round. After three others, nothing would be left to save."""
    penalty = ["--method", "irm", "--penalty-weight", "0.01", "--set", "airl.plateau_rounds=1"]
    refused = run_irl([*line, *penalty])
    assert refused.code == 2 and "omit airl.plateau_rounds" in refused.err
    done = run_irl([*line, *penalty, "--set", "airl.total_steps=8192"])
    assert done.code == 0, done.err
    store = Store(line[line.index("--store") + 1])
    artefact = store.resolve(json.loads(done.out)["id"]).artefact
    rows = pq.read_table(store.open(artefact, "metrics.parquet")).to_pylist()
    assert {row["round"] for row in rows} >= {0, 1, 2}


def test_a_plateau_longer_than_the_budget_is_refused(line, run_irl):
    done = run_irl([*line, "--set", "airl.plateau_rounds=2"])
    assert done.code == 2
    message, hint = done.err.strip().splitlines()[-2:]
    assert "airl.plateau_rounds = 2" in message and "training has 2" in message
    assert "airl.plateau_rounds=1" in hint


@pytest.mark.parametrize("other", ["airl.select=episodes", "airl.averaged_rounds=2"])
def test_what_takes_the_whole_budget_is_refused(line, run_irl, other):
    done = run_irl([*line, "--set", "airl.plateau_rounds=1", "--set", other])
    assert done.code == 2
    message, hint = done.err.strip().splitlines()[-2:]
    assert "airl.plateau_rounds = 1" in message and other.split("=")[0] in message
    assert other.split("=")[0] in hint
