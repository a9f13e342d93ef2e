"""``--method`` on the command line: behavioural cloning, and methods that a learner does not offer."""

import json

import pytest

from irlcli.methods import METHODS
from irlcli.store import Store

SMOKE = ["--profile", "smoke", "--quiet"]
BC_TABLE = """
[imitation]
rows = ["lunar-lander.engine-power"]
methods = ["bc", "gail"]
seeds = [0]
measures = ["zero-shot", "id"]
"""


def made(irl, store, *words):
    done = irl(*words, "--store", store, *SMOKE)
    assert done.code == 0, done.err
    return Store(store).resolve(done.out.split()[-1].rpartition("/")[2]).artefact


def test_behavioural_cloning_leaves_a_policy_and_no_reward(irl, store_copy):
    cloned = made(irl, store_copy.path, "train-airl", "--demos", "demos", "--method", "bc")
    assert cloned.manifest.record.stage == "clone"
    assert {output.path for output in cloned.manifest.outputs} == {"policy.pt", "policy.json"}
    score = made(irl, store_copy.path, "evaluate", "--policy", cloned.id, "--ood", "1.5x")
    summary = json.loads((score.directory / "summary.json").read_text())
    assert summary["policy"]["agent"] == "clone"


@pytest.mark.parametrize("command", ["transfer", "evaluate"])
def test_a_clone_is_no_reward(irl, store_copy, command):
    cloned = made(irl, store_copy.path, "train-airl", "--demos", "demos", "--method", "bc")
    words = ["--reward", cloned.id, "--ood", "1.5x", "--store", store_copy.path, *SMOKE]
    if command == "evaluate":
        words += ["--policy", cloned.id]
    done = irl(command, *words)
    assert done.code == 2 and "learned no reward" in done.err.splitlines()[0]


@pytest.mark.parametrize(
    ("option", "value"),
    [("--penalty", "irmv1"), ("--penalty-weight", "1"), ("--choose-penalty", "1,2")],
)
def test_behavioural_cloning_takes_no_option_about_a_reward(irl, store_copy, option, value):
    words = ["train-airl", "--demos", "demos", "--method", "bc", option, value]
    done = irl(*words, "--store", store_copy.path, *SMOKE)
    assert done.code == 2 and f"--method bc takes no {option}" in done.err


def test_a_penalty_that_lambda_turns_off_is_named(irl, smoke_store):
    line = ["train-airl", "--demos", "demos", "--method", "irm", "--profile", "smoke", "--dry-run"]
    for weight, warned in (("0", True), ("1", False)):
        done = irl(*line, "--penalty-weight", weight, "--store", smoke_store.path)
        assert done.code == 0
        assert ("lambda is 0: irm learns without its penalty" in done.err) == warned


def test_gail_leaves_a_reward_that_transfers(irl, store_copy):
    path = store_copy.path
    learned = made(irl, path, "train-airl", "--demos", "demos", "--method", "gail")
    about = json.loads((learned.directory / "reward.json").read_text())
    assert (about["method"], about["network"]["shaping"]) == ("gail", False)
    moved = made(irl, path, "transfer", "--reward", learned.id, "--ood", "1.5x")
    assert json.loads((moved.directory / "policy.json").read_text())["method"] == "gail"


def test_maxent_names_what_it_offers(irl, tmp_path):
    common = ["--store", tmp_path / "runs", *SMOKE]
    grid = ["--env", "gridworld", "--intervention", "path-group=1,2,3"]
    assert irl("collect-experts", *grid, *common, "--name", "grid").code == 0
    for method in ("gail", "bc", "dropout", "iga", "l2"):
        done = irl("train-maxent", "--demos", "grid", "--method", method, *common)
        assert done.code == 2, method
        assert f"MaxEnt IRL has no method '{method}'" in done.err
        assert "it has: erm, irm, erm-balanced, irm-shuffled, vrex, group-dro" in done.err
    wrong = irl("train-maxent", "--demos", "grid", "--method", "vrexx", *common)
    assert wrong.code == 2 and "did you mean 'vrex'?" in wrong.err and "bc" not in wrong.err


def test_a_setting_that_maxent_trained_in_is_not_measured_as_unseen(irl, tmp_path):
    path = tmp_path / "runs"
    # blocked=1 is held out in the settings file.
    grid = ["--env", "gridworld", "--setting", "blocked=1", "--setting", "path-group=1"]
    demos = made(irl, path, "collect-experts", *grid, "--episodes", "2")
    learned = made(irl, path, "train-maxent", "--demos", demos.id)
    quality = json.loads((learned.directory / "quality.json").read_text())
    found = [row["setting"] for row in quality["settings"]]
    assert "blocked=1" in found and len(found) == len(set(found))


def test_help_lists_the_methods(irl):
    shown = "".join(irl("train-airl", "--help").out.split())
    assert ",".join(METHODS) in shown


def test_a_table_of_imitation_has_behavioural_cloning(irl, tmp_path):
    file = tmp_path / "tables.toml"
    file.write_text(BC_TABLE)
    words = ["plan", "imitation", "--experiments", file, "--store", tmp_path / "none", "--json"]
    steps = [step["name"] for step in json.loads(irl(*words, *SMOKE[:2]).out)["steps"]]
    own = [name.partition(".engine-power.")[2] for name in steps if ".bc." in name]
    assert own == ["bc.0", "bc.0.zero-shot-returns", "bc.0.id-returns"]


@pytest.mark.parametrize("measure", ["transfer", "from-student", "transfer-id", "assess"])
def test_a_table_asks_no_reward_of_behavioural_cloning(irl, tmp_path, measure):
    file = tmp_path / "tables.toml"
    file.write_text(BC_TABLE.replace('"zero-shot"', f'"{measure}", "zero-shot"'))
    done = irl("plan", "imitation", "--experiments", file, "--store", tmp_path / "none")
    assert done.code == 2
    assert f"bc learns no reward, so it has no {measure}" in done.err
    assert "bc has: zero-shot, id" in done.err
    chosen = irl("plan", "table1", "--methods", "erm,bc", "--store", tmp_path / "none")
    assert chosen.code == 2 and "--methods: bc learns no reward" in chosen.err
