"""``irl plan``: names, statuses and reasons; nothing is written."""

from __future__ import annotations

import json

import pytest

from irlcli.configs import load_config
from irlcli.experiments.rows import Chosen, RewardRun, comparison
from irlcli.experiments.tables import Row, Table
from irlcli.methods import fields
from irlcli.store import Store

TABLES = """
[tiny]
title = "Engine power"
rows = ["lunar-lander.engine-power"]
methods = ["irm"]
seeds = [0]
measures = ["transfer"]
"""
ROW = "smoke.lunar-lander.engine-power"


@pytest.fixture
def tables(tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(TABLES)
    return path


@pytest.fixture
def plan(irl, tables):
    """``plan(store, ...)``: the steps of the tiny table as JSON, by name."""

    def run(store, *more):
        words = ["plan", "tiny", "--experiments", tables, "--profile", "smoke", "--store", store]
        done = irl(*words, *more, "--json")
        assert done.code == 0, done.err
        document = json.loads(done.out)
        assert document["kind"] == "plan" and document["version"] == 1
        assert sum(document["counts"].values()) == len(document["steps"])
        return {step["name"]: step for step in document["steps"]}

    return run


def tree(root):
    """Every path below ``root`` with its size and times."""
    return {
        path: (status.st_size, status.st_mtime_ns, status.st_mode)
        for path in sorted(root.rglob("*"))
        if (status := path.lstat())
    }


def test_an_empty_store_needs_everything_and_stays_absent(plan, irl, tables, tmp_path):
    store = tmp_path / "none"
    steps = plan(store)
    assert {name.removeprefix(f"{ROW}.") for name in steps} == {
        *("expert.1x", "expert.1.25x", "expert.1.5x", "demos", "irm.0", "irm.0.transfer"),
        *("random-returns", "idle-returns", "expert-returns"),
        *("expert.1x.reused-returns", "expert.1.25x.reused-returns"),
        *("irm.0.transfer-returns", "irm.0.expert-by-reward"),
    }
    ready = {name for name, step in steps.items() if step["status"] == "RUN"}
    assert {name.removeprefix(f"{ROW}.") for name in ready} == {
        *("expert.1x", "expert.1.25x", "expert.1.5x", "random-returns", "idle-returns"),
    }
    assert all(steps[name]["key"] for name in ready)
    demos = steps[f"{ROW}.demos"]
    assert (demos["status"], demos["key"]) == ("BLOCKED", None)
    assert demos["needs"] == [f"{ROW}.expert.1x", f"{ROW}.expert.1.25x"]
    assert demos["why"] == f"waits for {ROW}.expert.1x, {ROW}.expert.1.25x"
    scored = steps[f"{ROW}.irm.0.transfer-returns"]
    assert scored["needs"] == [f"{ROW}.irm.0.transfer", f"{ROW}.irm.0"]
    text = irl("plan", "tiny", "--experiments", tables, "--profile", "smoke", "--store", store)
    assert f"BLOCKED {ROW}.demos: waits for " in text.out
    assert "13 steps: 5 RUN, 8 BLOCKED" in text.err
    assert not store.exists()


def test_every_step_stands_after_what_it_needs(irl, tmp_path):
    for table in ("table1", "figure2", "experts"):
        done = irl("plan", table, "--json", "--store", tmp_path / "none")
        steps = json.loads(done.out)["steps"]
        seen = set()
        for step in steps:
            assert seen.issuperset(step["needs"]), step["name"]
            seen.add(step["name"])
        assert len(seen) == len(steps)


def test_phases_end_a_plan(plan, tmp_path):
    phases = ("experts", "demos", "rewards", "transfers", "returns")
    sizes = [len(plan(tmp_path / "none", "--until", phase)) for phase in phases]
    assert sizes == [3, 4, 5, 6, 13]


def test_lambda_is_chosen_by_a_step_for_every_candidate_and_setting(plan, tmp_path):
    steps = plan(
        tmp_path / "none", "--tag", "smoke", "--choose-penalty", "1,10", "--until", "rewards"
    )
    trials = {name.removeprefix(f"{ROW}.irm.0.choice") for name in steps if ".choice" in name}
    left_out = {f".{weight}.without-{value}" for weight in (1, 10) for value in ("1x", "1.25x")}
    assert trials == {""} | left_out | {f"{trial}.returns" for trial in left_out}
    assert f"{ROW}.irm.0.choice" in steps[f"{ROW}.irm.0"]["needs"]


def test_every_candidate_has_a_name(plan, tmp_path):
    close = "0.1234567,0.1234568,1000000,1e20"
    steps = plan(
        tmp_path / "none", "--tag", "smoke", "--choose-penalty", close, "--until", "rewards"
    )
    for weight in ("0.1234567", "0.1234568", "1000000", "1e20"):
        assert f"{ROW}.irm.0.choice.{weight}.without-1x" in steps


def test_profiles_of_a_table_with_settings_of_its_own_share_no_name(irl, tmp_path):
    named = []
    for profile in ("smoke", "standard"):
        done = irl("plan", "demo", "--profile", profile, "--store", tmp_path / "none", "--json")
        named.append({step["name"] for step in json.loads(done.out)["steps"]})
    assert len(named[0]) == len(named[1]) and not named[0] & named[1]
    assert all(name.startswith("demo.") for name in named[1])


@pytest.mark.parametrize(
    ("text", "experts"),
    [
        ("[airl]\nbc_epochs = 3", ["0.1", "0.2", "0.3", "0.4", "0.5", "0.9"]),
        ('[interventions.bounce]\nid = ["0.1", "0.3"]\nood = ["0.8"]', ["0.1", "0.3", "0.8"]),
    ],
)
def test_a_settings_file_is_laid_over_that_of_the_table(irl, tmp_path, text, experts):
    (tmp_path / "own.toml").write_text(text)
    line = ["plan", "table1-5", "--rows", "lunar-lander.bounce", "--until", "experts", "--tag", "x"]
    done = irl(*line, "--settings", tmp_path / "own.toml", "--store", tmp_path / "none", "--json")
    names = [step["name"] for step in json.loads(done.out)["steps"]]
    assert names == [f"x.lunar-lander.bounce.expert.{value}" for value in experts]


def test_what_exists_is_a_hit_whoever_made_it(plan, smoke_store):
    """The chain of plain commands gives the artefacts that the table asks for."""
    steps = plan(smoke_store.path)
    found = {name: step["why"] for name, step in steps.items() if step["status"] == "HIT"}
    assert {
        name.removeprefix(f"{ROW}."): why.rpartition("/")[2] for name, why in found.items()
    } == {
        "expert.1x": smoke_store.expert,
        "expert.1.25x": found[f"{ROW}.expert.1.25x"].rpartition("/")[2],
        "demos": smoke_store.demos,
        "irm.0": smoke_store.airl,
        "irm.0.transfer": smoke_store.transfer,
    }
    waiting = steps[f"{ROW}.expert-returns"]
    assert (waiting["status"], waiting["why"]) == ("BLOCKED", f"waits for {ROW}.expert.1.5x")
    assert steps[f"{ROW}.irm.0.transfer-returns"]["status"] == "RUN"


def test_what_another_store_holds_is_found_there(plan, smoke_store, tmp_path):
    before = tree(smoke_store.path)
    steps = plan(tmp_path / "none", "--from", smoke_store.path)
    demos = steps[f"{ROW}.demos"]
    assert (demos["status"], demos["why"]) == ("FOUND", f"in {smoke_store.path}")
    assert sum(step["status"] == "FOUND" for step in steps.values()) == 5
    assert tree(smoke_store.path) == before and not (tmp_path / "none").exists()


@pytest.mark.parametrize("read_only", [True, False])
def test_planning_writes_nothing_even_where_an_artefact_is_damaged(plan, store_copy, read_only):
    directory = store_copy.path / store_copy.demos
    for path in (directory, directory / "summary.json"):
        path.chmod(0o755)
    (directory / "summary.json").write_text("{}")
    paths = [store_copy.path, *store_copy.path.rglob("*")]
    modes = {path: path.stat().st_mode for path in paths}
    for path in paths if read_only else []:
        path.chmod(modes[path] & ~0o222)
    before = tree(store_copy.path)
    try:
        steps = plan(store_copy.path)
        assert tree(store_copy.path) == before
    finally:
        for path in paths:
            path.chmod(modes[path])
    demos = steps[f"{ROW}.demos"]
    assert demos["status"] == "RUN" and "summary.json" in demos["why"]
    assert "quarantine" in demos["why"]
    assert steps[f"{ROW}.irm.0"]["status"] == "BLOCKED"


def test_other_library_versions_are_named(plan, smoke_store, monkeypatch):
    from irlcli.experiments import provenance

    assert plan(smoke_store.path)[f"{ROW}.demos"]["other_versions"] == []
    present = provenance.libraries()
    monkeypatch.setattr(provenance, "libraries", lambda: {**present, "torch": "99.0"})
    found = plan(smoke_store.path)[f"{ROW}.demos"]["other_versions"]
    assert found == [f"torch {present['torch']} (now 99.0)"]


def test_the_command_of_a_step_makes_it(plan, irl, tmp_path):
    """The command line that provenance records, and that a damaged artefact prints, is complete."""
    store = tmp_path / "runs"
    name = f"{ROW}.idle-returns"
    command = plan(store)[name]["command"]
    made = irl(*command[1:], "--quiet")
    assert made.code == 0, made.err
    artefact = Store(store).resolve(name).artefact
    assert made.out.split() == [str(artefact.directory)]
    assert len(Store(store).ids()) == 1
    recorded = artefact.provenance()["command"]
    assert recorded[: len(command)] == command
    assert plan(store)[name]["status"] == "HIT"


def test_each_measure_of_a_retrained_policy_has_its_own_steps(irl, tmp_path):
    tables = tmp_path / "tables.toml"
    measures = 'measures = ["transfer", "from-student", "transfer-id"]\nretrainings = 2'
    tables.write_text(TABLES.replace('measures = ["transfer"]', measures))
    words = ["plan", "tiny", "--experiments", tables, "--profile", "smoke", "--json"]
    done = irl(*words, "--store", tmp_path / "none")
    assert done.code == 0, done.err
    steps = {s["name"].removeprefix(f"{ROW}."): s for s in json.loads(done.out)["steps"]}
    policies = [
        f"irm.0.{what}{again}"
        for what in ("transfer", "from-student", "transfer-id.1x", "transfer-id.1.25x")
        for again in ("", "-1")
    ]
    for name in policies:
        assert steps[name]["needs"] == [f"{ROW}.irm.0"]
        assert steps[f"{name}-returns"]["needs"] == [f"{ROW}.{name}", f"{ROW}.irm.0"]
    assert {"expert.1x.returns", "expert.1.25x.returns"} <= set(steps)
    assert sum(".transfer" in name or ".from-student" in name for name in steps) == 16


def test_a_value_and_a_retraining_of_another_value_are_two_names(irl, tmp_path):
    tables, own = tmp_path / "tables.toml", tmp_path / "own.toml"
    own.write_text('[interventions.bounce]\nid = ["0", "0.1"]\nood = ["0.9"]\n')
    text = TABLES.replace('["transfer"]', '["transfer-id"]\nretrainings = 2\nsettings = "own.toml"')
    tables.write_text(text.replace("engine-power", "bounce"))
    done = irl("plan", "tiny", "--experiments", tables, "--store", tmp_path / "none", "--json")
    assert done.code == 0, done.err
    names = [step["name"] for step in json.loads(done.out)["steps"]]
    row = "tiny.lunar-lander.bounce.irm.0.transfer-id"
    assert [name for name in names if name.startswith(row) and "returns" not in name] == [
        *(f"{row}.0", f"{row}.0.1", f"{row}.0-1", f"{row}.0.1-1")
    ]


def test_a_bank_tells_opposite_values_apart(irl, tmp_path):
    """The experts of goal-y=-900 and of goal-y=900 are two steps in the setting 900."""
    tables = tmp_path / "tables.toml"
    tables.write_text(
        TABLES.replace("lunar-lander.engine-power", "half-cheetah.goal-y").replace(
            'measures = ["transfer"]', 'measures = ["zero-shot", "assess"]'
        )
    )
    words = ["plan", "tiny", "--experiments", tables, "--profile", "smoke", "--json"]
    done = irl(*words, "--store", tmp_path / "none")
    assert done.code == 0, done.err
    steps = {s["name"]: s for s in json.loads(done.out)["steps"]}
    row = "smoke.half-cheetah.goal-y"
    for value in ("-900", "900"):
        recorded = f"{row}.bank.expert-of-{value}.900"
        assert steps[recorded]["needs"] == [f"{row}.expert.{value}"]
        assert recorded in steps[f"{row}.irm.0.assess"]["needs"]


def test_further_retrainings_have_seeds_of_their_own():
    """Retraining 0 keeps the reward's seed; no two policies share one."""
    table = Table(
        name="t",
        title="t",
        rows=(Row("reacher", "gravity"),),
        methods=("erm",),
        seeds=(0, 1),
        measures=("transfer",),
        retrainings=3,
    )
    row = table.rows[0]

    def configs(env, method):
        return load_config(env, "smoke", flags=method and fields(method, "airl"))

    runs = [RewardRun("erm", "erm", seed, str(row), configs) for seed in table.seeds]
    tasks = comparison(row, table.measures, table.retrainings, runs, configs, Chosen((), None))
    found = {t.name: t.request.parameters.seed for t in tasks if t.phase == "transfers"}
    assert found["reacher.gravity.erm.0.transfer"] == 0
    assert found["reacher.gravity.erm.1.transfer"] == 1
    assert len(found) == len(set(found.values())) == 6


def test_a_bank_holds_every_retrained_policy(irl, tmp_path):
    tables = tmp_path / "tables.toml"
    measures = 'measures = ["transfer", "from-student", "transfer-id", "assess"]\nretrainings = 2'
    tables.write_text(TABLES.replace('measures = ["transfer"]', measures))
    words = ["plan", "tiny", "--experiments", tables, "--profile", "smoke", "--json"]
    done = irl(*words, "--store", tmp_path / "none")
    assert done.code == 0, done.err
    steps = {s["name"].removeprefix(f"{ROW}."): s for s in json.loads(done.out)["steps"]}
    needs = {n.removeprefix(f"{ROW}.") for n in steps["irm.0.assess"]["needs"]}
    assert {n for n in needs if ".bank.retrained" in n} == {
        *("irm.0.bank.retrained.1.5x", "irm.0.bank.retrained-2.1.5x"),
        "irm.0.bank.retrained-from-the-student.1.5x",
        "irm.0.bank.retrained-from-the-student-2.1.5x",
        *("irm.0.bank.retrained.1x", "irm.0.bank.retrained-2.1x"),
        *("irm.0.bank.retrained.1.25x", "irm.0.bank.retrained-2.1.25x"),
    }
