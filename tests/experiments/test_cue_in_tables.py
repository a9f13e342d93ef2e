"""The control with a cue: who demonstrates, the measure, the report, and what is refused."""

import json
from dataclasses import replace

import pytest

from irlcli.configs import load_config
from irlcli.data.demonstrations import read_demonstrations
from irlcli.envs.cue import with_hints
from irlcli.experiments.bank import Finder, bank
from irlcli.experiments.references import tensor_file
from irlcli.experiments.status import Lookup
from irlcli.interventions import cue_in, parse_setting
from irlcli.store import Store

TABLES = """
[control]
title = "Control"
rows = ["lunar-lander.cue-strength"]
methods = ["erm", "irm"]
seeds = [0]
measures = ["transfer", "zero-shot", "id", "cue"]
[control.penalty_weights]
irm = 7
"""
ROW = "smoke.lunar-lander.cue-strength"


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "tables.toml"
    path.write_text(TABLES)
    return path


@pytest.fixture(scope="module")
def made(tables, smoke_store, run_irl):
    store = tables.parent / "runs"
    line = ["control", "--experiments", str(tables), "--profile", "smoke", "--store", str(store)]
    # The shipped control has another lambda in this row.
    line += ["--from", str(smoke_store.path), "--tag", "smoke"]
    # Without --only, each step would be a process.
    for step in json.loads(run_irl(["plan", *line, "--json"]).out)["steps"]:
        done = run_irl(["run", *line, "--quiet", "--only", step["name"]])
        assert done.code == 0, done.err
    return store


def artefact(store, step):
    return Store(store).resolve(f"{ROW}.{step}").artefact


def test_the_expert_of_the_base_setting_demonstrates(made, smoke_store):
    """No expert is trained for the cue: it changes nothing that an expert needs to know."""
    demos = artefact(made, "demos")
    parents = Store(made).index().parents(demos)
    assert set(parents) == {"expert cue-strength=0.95", "expert cue-strength=0.8"}
    assert {e.id for found in parents.values() for e in found} == {smoke_store.expert}
    recorded = read_demonstrations(demos.directory).trajectories
    for text in ("cue-strength=0.95", "cue-strength=0.8"):
        for t in recorded[text]:
            plain = replace(t, observations=t.observations[:, :-2])
            again = with_hints(plain, *cue_in("lunar-lander", parse_setting("lunar-lander", text)))
            assert t.observations.shape[1] == 10
            assert (again.observations == t.observations).all()


def test_the_expert_earns_in_the_unseen_setting_what_it_earns_without_a_cue(made, irl):
    written = artefact(made, "expert-returns").directory / "summary.json"
    line = ["evaluate", "--expert", "--env", "lunar-lander", "--profile", "smoke", "--quiet"]
    done = irl(*line, "--intervention", "engine-power=1x", "--store", made, "--json")
    assert done.code == 0, done.err
    (plain,) = json.loads(done.out)["returns"]
    (with_cue,) = json.loads(written.read_text())["settings"]
    assert with_cue["mean_return"] == plain["mean"]


def test_the_report_tells_what_each_reward_pays_for_the_cue(made, tables, irl, tmp_path):
    line = ["report", "control", "--experiments", tables, "--profile", "smoke", "--store", made]
    done = irl(*line, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "out" / "control.json").read_text())["cue_contrasts"]
    assert [(r["agent"], r["seed"]) for r in found] == [("erm", 0), ("irm", 0)]
    written = artefact(made, "irm.0.cue").directory / "cue.json"
    measured = json.loads(written.read_text())
    settings = measured["settings"]
    assert [s["setting"] for s in settings] == ["cue-strength=0.95", "cue-strength=0.8"]
    for name in ("cue", "texture"):
        assert found[1][name] == pytest.approx(sum(s[name] for s in settings) / 2)
    described = json.loads((artefact(made, "irm.0").directory / "reward.json").read_text())
    assert found[1]["scale"] == measured["scale"] == described["scale"] > 0.0
    assert "## How the reward depends on the cue" in (tmp_path / "out" / "README.md").read_text()


def test_a_table_may_have_a_lambda_for_a_method(made, tables, irl, tmp_path):
    described = json.loads((artefact(made, "irm.0").directory / "reward.json").read_text())
    assert described["airl"]["penalty_weight"] == 7.0
    line = ["report", "control", "--experiments", tables, "--profile", "smoke", "--store", made]
    assert irl(*line, "--out", tmp_path / "out").code == 0
    assert "irm: 7" in (tmp_path / "out" / "README.md").read_text()


def test_a_bank_has_one_expert_in_each_setting(made):
    """Whether it is the one behind the demonstrations, or found by the config as in 0.5."""
    store, config = Store(made), load_config("lunar-lander", "smoke")
    reward, origin = tensor_file(store, f"{ROW}.irm.0", "reward")
    texts = [f"cue-strength={value}" for value in ("0.95", "0.8", "0.5")]
    settings = [parse_setting("lunar-lander", text) for text in texts]
    policies = Finder(store, Lookup(store), config).policies(reward, origin, settings, None, (), 0)
    entries = bank("lunar-lander", settings, config, policies)
    experts = [(e.kind, e.setting) for e in entries if e.kind in ("expert", "reused")]
    assert experts == [("expert", text) for text in texts]


def test_a_bank_of_a_table_has_one_expert_in_each_setting(irl, tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace('"cue"]', '"cue", "assess"]'))
    line = ["plan", "control", "--experiments", path, "--profile", "smoke", "--tag", "smoke"]
    planned = irl(*line, "--store", tmp_path / "runs", "--json")
    names = [step["name"] for step in json.loads(planned.out)["steps"]]
    experts = [name for name in names if "bank.expert" in name]
    assert experts == [f"{ROW}.bank.expert-of-{v}.{v}" for v in ("0.95", "0.8", "0.1")]


def test_a_second_run_finds_everything(made, tables, irl):
    line = ["plan", "control", "--experiments", tables, "--profile", "smoke", "--store", made]
    line += ["--tag", "smoke"]
    steps = json.loads(irl(*line, "--json").out)["steps"]
    assert {s["status"] for s in steps} == {"HIT"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("lunar-lander.cue-strength", "lunar-lander.bounce"), "has no cue to measure"),
        (('"transfer", "zero-shot", "id", "cue"', '"cue"'), "cue alone fills no cell"),
    ],
)
def test_a_table_that_cannot_measure_a_cue_is_refused(irl, tmp_path, change, message):
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace(*change))
    done = irl("plan", "control", "--experiments", path, "--store", tmp_path / "runs")
    assert done.code == 2 and message in done.err and "hint:" in done.err


@pytest.mark.parametrize("strength", ["1.2", "-0.1", "nan"])
def test_a_strength_outside_zero_to_one_is_named(irl, tmp_path, strength):
    line = ["collect-experts", "--env", "lunar-lander", "--store", tmp_path / "runs"]
    done = irl(*line, "--intervention", f"cue-strength={strength}")
    assert done.code == 2 and f"cue-strength='{strength}'" in done.err
    assert "Traceback" not in done.err and not (tmp_path / "runs").exists()


def test_a_policy_that_does_not_see_the_cue_is_refused_by_name(irl, smoke_store):
    line = ["evaluate", "--policy", smoke_store.airl, "--store", smoke_store.path]
    done = irl(*line, "--ood", "cue-strength=0.1")
    assert done.code == 2 and "a cue" in done.err and "hint:" in done.err
