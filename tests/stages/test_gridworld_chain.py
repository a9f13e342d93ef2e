"""The gridworld end to end, through the real command line at the smoke profile."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from test_architecture import loaded_by

from irlcli.configs import load_config
from irlcli.data import tensors as checkpoints
from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.descriptions import TabularReward
from irlcli.envs.gridworld import tasks
from irlcli.envs.gridworld.env import gridworld
from irlcli.envs.gridworld.tasks import usable_input
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.errors import UsageError
from irlcli.experiments.runner import Runner
from irlcli.interventions import parse_settings
from irlcli.learners import tabular_quality
from irlcli.stages import collect_experts, figure2, sweep_maxent, train_maxent
from irlcli.stages.base import From
from irlcli.stages.sweep_maxent import variants
from irlcli.store import Store

GROUPS = ["path-group=1", "path-group=2", "path-group=3"]
UNSEEN = ["blocked=1", "blocked=2"]
WARMUP = "maxent.penalty_warmup_iterations"
METHODS = (
    ["--method", "erm"],
    ["--method", "erm", "--l2", "1e-3"],
    ["--method", "erm-balanced"],
    ["--method", "irm", "--penalty-weight", "0.05"],
    ["--method", "irm", "--penalty", "closed-form"],
    ["--method", "irm-shuffled"],
    ["--grouping", "balanced", "--penalty", "irmv1"],
    ["--method", "irm", "--features", "linear", "--seed", "3"],
)
# Other ways to ask for the same computation.
EQUAL = (
    (["--method", "erm"], []),
    (["--method", "erm"], ["--set", "maxent.penalty_weight=7"]),
    (["--method", "erm-balanced"], ["--method", "irm", "--penalty-weight", "0"]),
    (["--method", "erm-balanced"], ["--method", "irm-shuffled", "--penalty", "none"]),
    (["--method", "irm"], ["--grouping", "per-setting", "--penalty", "irmv1"]),
    (
        ["--features", "linear", "--method", "irm"],
        ["--features", "linear", "--method", "irm", "--set", "maxent.hidden=5"],
    ),
)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return tmp_path_factory.mktemp("gridworld") / "runs"


@pytest.fixture
def run(irl, store):
    """A command at the smoke profile in the module's store."""
    return lambda *arguments: irl(*arguments, "--profile", "smoke", "--store", store)


@pytest.fixture
def demos(run):
    arguments = ["--intervention", "path-group=1,2,3", "--episodes", "20,5,2", "--name", "demos"]
    done = run("collect-experts", "--env", "gridworld", *arguments)
    assert done.code == 0, done.err
    return Path(done.out.strip())


def test_demonstrations_have_the_common_form_and_record_their_grid(demos):
    dataset = read_demonstrations(demos)
    assert {s: len(t) for s, t in dataset.trajectories.items()} == dict(
        zip(GROUPS, (20, 5, 2), strict=True)
    )
    assert dataset.metadata["gridworld"] == {
        **{"size": 5, "horizon": 16, "goal": "absorbing", "p_slip": 0.2}
    }
    summary = json.loads((demos / "summary.json").read_text())["settings"]
    assert all(-16 < s["mean_return"] <= -8 + 2 for s in summary)


def test_grid_and_seed_are_part_of_the_identity(run, demos):
    base = ["collect-experts", "--env", "gridworld", "--intervention", "path-group=1,2,3"]
    base += ["--episodes", "20,5,2"]
    ids = {run(*base, *more).out for more in ([], ["--seed", "1"])}
    for change in ("size=6", "horizon=17", "goal=terminal", "p_slip=0.1"):
        ids.add(run(*base, "--set", f"gridworld.{change}").out)
    assert len(ids) == 6
    assert f"{demos}\n" in ids


@pytest.mark.parametrize(("bar", "missed"), [("-1", True), ("-100", False)])
def test_an_expert_below_its_bar_is_named(run, bar, missed):
    line = ["--env", "gridworld", "--intervention", "path-group=2", "--set", f"expert.bar={bar}"]
    done = run("collect-experts", *line)
    warned = [text for text in done.err.splitlines() if text.startswith("warning")]
    assert done.code == 0 and len(warned) == missed
    assert all("path-group=2" in text and f"bar {bar}" in text for text in warned)


@pytest.mark.parametrize("method", METHODS, ids=" ".join)
def test_every_method_trains_and_is_found_again(run, demos, method):
    command = ["train-maxent", "--demos", "demos", *method]
    first = run(*command)
    assert first.code == 0, first.err
    assert "blocked=1 (unseen)" in first.err
    again = run(*command)
    assert again.out == first.out
    assert re.search(rf"HIT train-maxent .*path-group=1.*: {first.out.strip()}\n", again.err)
    assert run(*command, "--dry-run").out.startswith("HIT")
    artefact = Path(first.out.strip())
    description, tensors = checkpoints.load(artefact / "reward.pt", "tabular-reward")
    written = msgspec.convert(json.loads((artefact / "reward.json").read_text()), TabularReward)
    assert description == written
    assert description.gridworld.size == 5 and list(description.settings) == GROUPS
    assert tensors["reward"].shape == (25,) and tensors["reward"].isfinite().all()
    assert ("psi" in tensors) == ("linear" in method)
    metrics = pq.read_table(artefact / "metrics.parquet").to_pydict()
    assert metrics["setting"][:3] == GROUPS and metrics["iteration"][-1] == 59
    penalised = description.maxent.penalty != "none"
    assert any(metrics["optimised_penalty"]) == penalised
    quality = json.loads((artefact / "quality.json").read_text())["settings"]
    assert [row["setting"] for row in quality] == GROUPS + UNSEEN
    assert [row["seen"] for row in quality] == [True] * 3 + [False] * 2
    assert all(0.0 <= row["goal_probability"] <= 1.0 for row in quality)


@pytest.mark.parametrize(("episodes", "reveals"), [("3", False), ("20,5,2", True)])
def test_shuffled_labels_that_reveal_the_settings_are_named(run, episodes, reveals):
    """Two episodes cannot be dealt out to three groups."""
    line = ["--env", "gridworld", "--intervention", "path-group=1,2,3", "--episodes", episodes]
    demos = Path(run("collect-experts", *line).out.strip()).name
    done = run("train-maxent", "--demos", demos, "--method", "irm-shuffled", "--seed", "5")
    assert done.code == 0 and "RUN" in done.err
    assert ("warning: shuffled labels" in done.err) == reveals


def test_figure_2_names_shuffled_labels_that_reveal_the_settings(run):
    few = ["--tag", "few", "--set", "figure2.episodes=[20,5,2]"]
    done = run("run", "figure2", *few, "--only", "few.figure2.sweep")
    assert done.code == 0, done.err
    assert done.err.count("shuffled labels still reveal") == 1


def test_methods_learn_different_rewards(run, demos):
    rewards = set()
    for method in METHODS:
        made = Path(run("train-maxent", "--demos", "demos", *method).out.strip())
        _, tensors = checkpoints.load(made / "reward.pt", "tabular-reward")
        rewards.add(tensors["reward"].numpy().tobytes())
    assert len(rewards) == len(METHODS)


def test_rewards_are_judged_by_episodes_of_no_dataset(monkeypatch):
    judged, original = [], tabular_quality.assess
    monkeypatch.setattr(
        tabular_quality, "assess", lambda *given: judged.append(given[3]) or original(*given)
    )
    grid = load_config("gridworld", "smoke").gridworld
    list(train_maxent.judge(GROUPS, [], grid, np.zeros((1, 25)), 10))
    for seed in range(5):
        for e, text in enumerate(GROUPS):
            trained = tasks.sample(text, grid, 10, (seed, e))
            held_out = judged[0].actions[e]
            assert not all(
                np.array_equal(actions, episode.actions[: len(actions)])
                for actions, episode in zip(held_out, trained, strict=True)
            )


def test_a_sweep_holds_the_rewards_that_train_maxent_learns(store):
    config, runner = load_config("gridworld", "smoke"), Runner(store)
    groups, unseen = (
        parse_settings("gridworld", text) for text in ("path-group=1,2,3", "blocked=1,2")
    )
    sweep = runner.run(sweep_maxent.request("gridworld", groups, unseen, config))
    rows = pq.read_table(sweep.directory / "rewards.parquet").to_pylist()
    penalised = next(row for row in rows if row["penalty"] == "irmv1")
    for row in (rows[1], penalised, rows[-1]):
        how = {name: row[name] for name in ("grouping", "penalty", "penalty_weight", "l2")}
        demos = collect_experts.request(
            "gridworld", groups, config, row["seed"], config.figure2.episodes
        )
        maxent = msgspec.structs.replace(config.maxent, **how)
        learned = runner.run(
            train_maxent.request(From(demos), "gridworld", groups, unseen, maxent, row["seed"])
        )
        _, tensors = checkpoints.load(learned.directory / "reward.pt", "tabular-reward")
        assert row["reward"] == pytest.approx(tensors["reward"].tolist(), abs=1e-6)


def test_a_warm_up_changes_the_reward_only_through_the_penalty(run, demos):
    def penalties(*changes):
        line = [*("train-maxent", "--demos", "demos", "--method", "irm"), *changes]
        artefact = Path(run(*line, "--penalty-weight", "100").out.strip())
        metrics = pq.read_table(artefact / "metrics.parquet").to_pydict()
        return metrics["iteration"], metrics["optimised_penalty"]

    iterations, cold = penalties()
    (*_, last), warm = penalties("--set", f"{WARMUP}={iterations[-1]}")
    assert last > 0 and warm[0] == cold[0] and warm[-1] != cold[-1]


@pytest.mark.parametrize("one, other", EQUAL, ids=str)
def test_equal_computations_are_one_artefact(run, demos, one, other):
    first, second = (run("train-maxent", "--demos", "demos", *m) for m in (one, other))
    assert first.code == 0 and first.out == second.out
    assert re.search("^HIT", second.err, re.MULTILINE)


@pytest.mark.parametrize("field", ["physics", "max_episode_steps"])
def test_a_changed_maze_or_horizon_is_no_stale_hit(monkeypatch, field):
    """As the version of the gridworld's physics is raised, every key of it changes."""
    config = load_config("gridworld", "smoke")
    groups = parse_settings("gridworld", "path-group=1,2,3")
    unseen = parse_settings("gridworld", "blocked=1,2")

    def parameters():
        demos = collect_experts.request("gridworld", groups, config, episodes=[9, 3, 2])
        trained = train_maxent.request(From(demos), "gridworld", groups, unseen, config.maxent)
        sweep = sweep_maxent.request("gridworld", groups, unseen, config)
        figure = figure2.request("gridworld", groups, unseen, config)
        return [request.parameters for request in (demos, trained, sweep, figure)]

    before = parameters()
    assert parameters() == before
    spec = ENVIRONMENTS["gridworld"]
    changed = spec._replace(**{field: getattr(spec, field) + 1})
    monkeypatch.setitem(ENVIRONMENTS, "gridworld", changed)
    assert all(old != new for old, new in zip(before, parameters(), strict=True))


def test_figure_and_table(run, store):
    made = run("run", "figure2")
    assert made.code == 0, made.err
    first = run("report", "figure2", "--name", "fig")
    assert first.code == 0, first.err
    assert first.out == made.out
    artefact = Path(first.out.strip())
    assert (artefact / "figure2.png").read_bytes()[:4] == b"\x89PNG"
    pdf = (artefact / "figure2.pdf").read_bytes()
    assert pdf[:5] == b"%PDF-" and b"CreationDate" not in pdf
    with open(artefact / "figure2.csv") as file:
        rows = list(csv.DictReader(file))
    names = {str(v) for v in variants([], [])}
    assert {r["variant"] for r in rows} == names
    assert {r["setting"] for r in rows} == {*GROUPS, *UNSEEN, "worst"}
    assert all(float(r["low"]) <= float(r["mean"]) <= float(r["high"]) for r in rows)
    page = (artefact / "README.md").read_text()
    table, _, paired = page.partition("## Paired differences")
    assert sum(line.startswith("| ") for line in table.splitlines()) == 2 + len(names)
    assert "| irm irmv1 0.01 | irm-shuffled irmv1 0.01 | " in paired
    assert "20 episodes in path-group=1" in page
    # Of three episodes each group gets one.
    assert "3 episodes in path-group=3" in page and "shuffled labels still reveal" not in made.err
    assert "![" not in first.err and "|" not in first.err
    shown = [line for line in page.splitlines() if line and not line.startswith(("|", "!["))]
    assert all(line in first.err for line in shown)
    assert "irm irmv1 0.01  irm-shuffled irmv1 0.01  " in re.sub(" {2,}", "  ", first.err)
    plan = run("report", "figure2", "--dry-run").out.splitlines()
    assert len(plan) == 4 and all(line.startswith("HIT") for line in plan)
    warned = run("report", "figure2", "--set", "maxent.penalty_weight=3", "--dry-run").err
    assert warned.count("--set maxent.penalty_weight=3 counts as 0.0") == 1
    lineage = run_light("lineage", "fig", "--store", store)
    assert "sweep-maxent" in lineage and lineage.count("collect-experts") == 3


def run_light(*arguments):
    done = subprocess.run(
        [sys.executable, "-m", "irlcli", *map(str, arguments)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_hits_load_nothing_heavy(run, demos, store):
    common = ["--profile", "smoke", "--store", str(store)]
    assert run("train-maxent", "--demos", "demos").code == 0
    assert loaded_by("train-maxent", "--demos", "demos", *common) == "LOADED []"
    assert run("run", "figure2").code == 0
    assert loaded_by("report", "figure2", *common) == "LOADED []"


COLLECT = ["collect-experts", "--env", "gridworld", "--intervention"]
TRAIN = ["train-maxent", "--demos", "demos"]
SIZE = ["--set", "gridworld.size=1024"]


@pytest.mark.parametrize(
    "command, named",
    [
        ([*COLLECT, "path-group=1.5"], "not a whole number"),
        ([*COLLECT, "path-group=4"], "out of range"),
        ([*COLLECT, "path-group=-1"], "out of range"),
        ([*COLLECT, "blocked=2x"], "blocked as absolute"),
        ([*COLLECT, "path-group=1,2", "--episodes", "3,0"], "--episodes 0"),
        ([*COLLECT, "path-group=1", "--set", "gridworld.horizon=5"], "8 steps away"),
        ([*COLLECT, "path-group=1", "--set", "gridworld.size=4"], "at least 5"),
        ([*COLLECT, "path-group=1", "--set", "gridworld.p_slip=1"], "below 1"),
        ([*COLLECT, "path-group=1", "--set", "gridworld.goal=open"], "open"),
        ([*COLLECT, "path-group=1", *SIZE, "--set", "gridworld.horizon=3000"], "too many states"),
        ([*COLLECT, "path-group=1", *SIZE, "--set", "gridworld.horizon=99"], "2046 steps away"),
        ([*TRAIN, "--penalty-weight", "-1"], "at least 0"),
        ([*TRAIN, "--penalty-weight", "nan"], "at least 0"),
        ([*TRAIN, "--method", "irm", "--set", f"{WARMUP}=1000"], "leaves none"),
        ([*TRAIN, "--l2", "inf"], "l2"),
        ([*TRAIN, "--method", "airl"], "airl"),
        ([*TRAIN, "--penalty", "ridge"], "ridge"),
        ([*TRAIN, "--features", "deep"], "deep"),
        (["train-airl", "--demos", "demos"], "does not work on gridworld"),
        (["evaluate", "--random", "--env", "gridworld", "--intervention", "blocked=1"], "does not"),
        (["evaluate", "--expert", "--env", "gridworld", "--intervention", "blocked=1"], "does not"),
        (["transfer", "--reward", "learned", "--ood", "blocked=1"], "is a reward of MaxEnt IRL"),
        (["report", "figure5"], "unknown table"),
        (["report", "figure2", "demos"], "no references"),
        (["report", "returns"], "name at least one evaluation"),
        (["report", "figure2", "--set", "figure2.episodes=[1,2]"], "2 episode counts"),
    ],
)
def test_bad_input_is_one_line_with_a_hint(run, demos, command, named):
    if "learned" in command:
        assert run(*TRAIN, "--name", "learned").code == 0
    done = run(*command)
    assert (done.code, done.out) == (2, ""), done
    error, hint = done.err.splitlines()[-2:]
    assert error.startswith("error: ") and named in error
    assert hint.startswith("hint: ")


def test_a_dataset_of_another_environment_is_refused(irl, smoke_store):
    done = irl("train-maxent", "--demos", "demos", "--store", smoke_store.path)
    assert done.code == 2
    assert "train-maxent does not work on lunar-lander" in done.err
    assert "train-airl" in done.err


def test_a_missing_dataset(run, demos):
    assert run("train-maxent", "--demos", "nothing").code == 3


def test_a_goal_behind_walls_is_a_usage_error():
    with pytest.raises(UsageError, match="cannot be reached"), usable_input():
        gridworld(8, path_group=1, blocked=1)


REQUEST = """
from irlcli.interventions import parse_settings
from irlcli.configs import load_config
from irlcli.stages.base import From
from irlcli.stages import collect_experts, sweep_maxent, train_maxent

def request(stage):
    # A sweep trains several rewards; one round at least is left after the first checkpoint.
    iterations = {"train-maxent": 800, "sweep-maxent": 100}[stage]
    config = load_config("gridworld", "smoke", overrides=[f"maxent.iterations={iterations}"])
    groups = parse_settings("gridworld", "path-group=1,2,3")
    unseen = parse_settings("gridworld", "blocked=1")
    if stage == "sweep-maxent":
        return sweep_maxent.request("gridworld", groups, unseen, config)
    demos = From(collect_experts.request("gridworld", groups, config, episodes=[9, 3, 2]))
    return train_maxent.request(demos, "gridworld", groups, unseen, config.maxent)
"""
RUN = """
import sys
from irlcli.experiments.runner import Runner
Runner(sys.argv[1], command=["irl", "test"], checkpoint_seconds=0.0).run(request(sys.argv[2]))
"""


@pytest.mark.parametrize("stage", ["train-maxent", "sweep-maxent"])
def test_killed_and_run_again_it_is_the_same(tmp_path, stage):
    command = [sys.executable, "-c", REQUEST + RUN, str(tmp_path / "killed"), stage]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not list(tmp_path.glob("killed/.work/*/checkpoint")):
        time.sleep(0.001)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    namespace = {}
    exec(REQUEST, namespace)
    request = namespace["request"](stage)
    resumed = Runner(tmp_path / "killed").run(request)
    undisturbed = Runner(tmp_path / "undisturbed").run(request)
    assert resumed.manifest.id == undisturbed.manifest.id
    assert [a.provenance()["resumed"] for a in (resumed, undisturbed)] == [1, 0]
    store = Store(tmp_path / "killed")
    assert not store.verify(store.ids()).damaged
