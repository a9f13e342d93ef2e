"""Tables that compare variants of the config: their plan, their report, and what is refused."""

import json
from types import SimpleNamespace

import pandas as pd
import pytest

from irlcli.configs import load_config
from irlcli.errors import UsageError
from irlcli.experiments.facts import left_out
from irlcli.experiments.tables import load_table, load_tables
from irlcli.store import KeyRecord, Store

TABLES = """
[parts]
title = "Which part matters"
rows = ["lunar-lander.engine-power"]
methods = ["erm"]
seeds = [0, 1]
measures = ["transfer-id", "id"]
base = "full"
[parts.variants]
"gradient penalty" = ["airl.gradient_penalty=1"]
"full" = []
"low ceiling" = ["transfer.ceiling=0.5"]
"no ceiling" = ["transfer.ceiling=none"]
"""
ROW = "smoke.lunar-lander.engine-power"
VALUES = ("1x", "1.25x")


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    path = tmp_path_factory.mktemp("variants") / "tables.toml"
    path.write_text(TABLES)
    return path


@pytest.fixture
def plan(irl, tables, tmp_path):
    """``plan(...)``: the steps of the table as JSON, by name without tag and row."""

    def run(*more, file=tables):
        line = ["plan", "parts", "--experiments", file, "--profile", "smoke", "--tag", "smoke"]
        done = irl(*line, "--store", tmp_path / "none", *more, "--json")
        assert done.code == 0, done.err
        steps = json.loads(done.out)["steps"]
        return {step["name"].removeprefix(f"{ROW}."): step for step in steps}

    return run


def test_variants_share_what_they_do_not_change(plan):
    steps = plan("--seeds", "0")
    rewards = {name for name, step in steps.items() if step["request"].startswith("train-airl")}
    assert rewards == {"full.erm.0", "gradient-penalty.erm.0"}
    retrained = {name for name, step in steps.items() if step["request"].startswith("transfer")}
    assert retrained == {
        f"{variant}.erm.0.transfer-id.{value}"
        for variant in ("full", "gradient-penalty", "low-ceiling")
        for value in VALUES
    }
    for value in VALUES:
        assert f"{ROW}.full.erm.0" in steps[f"low-ceiling.erm.0.transfer-id.{value}"]["needs"]
    assert not any(name.startswith("no-ceiling.") for name in steps)
    # Experts and demonstrations are the same for all.
    assert {"demos", "expert.1x", "expert.1.25x"} <= set(steps)
    # No measure of the table is taken in the held-out setting.
    held_out = {"expert.1.5x", "expert-returns", "random-returns", "expert.1x.reused-returns"}
    assert held_out.isdisjoint(steps)


def test_a_space_before_a_field_changes_nothing(plan, tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace('"airl.', '" airl.'))
    assert plan("--seeds", "0", file=path).keys() == plan("--seeds", "0").keys()


def test_retraining_options_leave_rewards_that_know_challengers_alone(irl, tmp_path):
    """Challengers learn as retrained policies do; a variant's options are not theirs."""
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace("transfer.ceiling=0.5", "transfer.ppo.learning_rate=0.01"))
    line = ["plan", "parts", "--experiments", path, "--profile", "smoke", "--seeds", "0", "--json"]
    line += ["--set", "airl.challenger.life=2", "--set", "airl.logit=f"]
    line += ["--set", "airl.policy_reward=f", "--tag", "x", "--store", tmp_path / "none"]
    steps = {s["name"].removeprefix("x."): s for s in json.loads(irl(*line).out)["steps"]}
    rewards = [name for name, step in steps.items() if step["request"].startswith("train-airl")]
    assert [name.split(".")[2] for name in rewards] == ["full", "gradient-penalty"]
    assert any(".low-ceiling.erm.0.transfer-id." in name for name in steps)


@pytest.mark.parametrize("row", ["ant.friction", "ant.leg-length"])
def test_nor_where_a_knob_has_its_own_retraining(irl, tmp_path, row):
    path = tmp_path / "tables.toml"
    text = TABLES.replace("lunar-lander.engine-power", row)
    path.write_text(text.replace("transfer.ceiling=0.5", "transfer.ppo.learning_rate=0.01"))
    line = ["plan", "parts", "--experiments", path, "--profile", "smoke", "--seeds", "0", "--json"]
    line += ["--set", "airl.challenger.life=2", "--set", "airl.logit=f"]
    line += ["--tag", "x", "--store", tmp_path / "none"]
    steps = json.loads(irl(*line).out)["steps"]
    rewards = [step["name"] for step in steps if step["request"].startswith("train-airl")]
    assert [name.split(".")[3] for name in rewards] == ["full", "gradient-penalty"]


def test_a_variant_wins_over_set(plan):
    shared = plan("--seeds", "0", "--set", "transfer.ceiling=0.9")
    # Now `no ceiling` differs from the base.
    assert "no-ceiling.erm.0.transfer-id.1x" in shared
    assert "no-ceiling.erm.0" not in shared


@pytest.mark.parametrize("measures", ['"id"', '"id", "assess"'])
def test_every_step_can_be_selected(plan, tmp_path, measures):
    """With what it needs, under the names of the whole plan: `irl run` names what each step needs."""
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace('"id"', measures))
    every = plan("--seeds", "0", file=path)
    for name in every:
        selected = plan("--seeds", "0", "--only", f"{ROW}.{name}", file=path)
        assert name in selected and selected.keys() <= every.keys()


@pytest.mark.parametrize("knob_has_its_own", [True, False])
def test_none_removes_the_ceiling(tmp_path, knob_has_its_own):
    file = tmp_path / "mine.toml"
    table = "interventions.engine-power.transfer" if knob_has_its_own else "transfer"
    file.write_text(f"[{table}]\nceiling = 0.9\n")

    def ceiling(*overrides):
        config = load_config("lunar-lander", "smoke", [file], overrides)
        own = config.interventions["engine-power"].transfer
        return (own or config.transfer).ceiling

    assert ceiling() == 0.9 and ceiling("transfer.ceiling=none") is None


def test_the_shipped_ablation():
    table = load_table("retraining")
    full, *others = table.variants
    assert full.name == "full" and full.overrides == ("transfer.restarts=1",)
    assert all(set(full.overrides) < set(variant.overrides) for variant in others)
    assert table.methods == ("erm",) and len(table.seeds) == 3


@pytest.mark.parametrize(
    ("old", "new", "message", "hint"),
    [
        ("airl.gradient_penalty=1", "airl.gradient_penalti=1", "unknown field", "gradient_penalty"),
        ("airl.gradient_penalty=1", "expert.total_steps=9", "expert.total_steps", "airl, transfer"),
        ("airl.gradient_penalty=1", "airl.gradient_penalty=x", "gradient_penalty=x: exp", "0.0"),
        ("airl.gradient_penalty=1", "airl.gradient_penalty", "has no '='", "write"),
        ("airl.gradient_penalty=1", "airl.penalty=irmv1", "which the method sets", "method"),
        ("airl.gradient_penalty=1", "transfer.algorithm=pppo", "transfer.algorithm 'pppo'", "ppo"),
        ("airl.gradient_penalty=1", "transfer.ceiling=0.5", "have the same overrides", "omit"),
        ('=1"]', '=1", "airl.gradient_penalty=2"]', "gradient_penalty appears twice", "once"),
        (
            '["airl.gradient_penalty=1"]',
            '"airl.gradient_penalty=1"',
            "parts.variants.gradient penalty: expected a list",
            "see",
        ),
        ('"gradient penalty"', '"no-ceiling"', "are one name in steps", "rename"),
        ('"gradient penalty"', '"random"', "'random' cannot be the name of a variant", "idle"),
        ('"gradient penalty"', '"Mine"', "'Mine' cannot be the name of a variant", "lowercase"),
        ('base = "full"', 'base = "ful"', "parts.base: 'ful' is not a variant", "'full'"),
        ('base = "full"', "", "parts.base is missing", "full"),
        ('["erm"]', '["erm", "irm"]', "parts.methods: variants", "one method"),
        ('"transfer-id", "id"', '"id"', "parts.measures: variants", "transfer-id"),
        ("[parts.variants]", "[other]", "base: parts has no variants", "omit base"),
    ],
)
def test_a_mistake_in_a_variant_is_one_clear_line(tmp_path, old, new, message, hint):
    assert old in TABLES
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace(old, new, 1))
    with pytest.raises(UsageError) as caught:
        load_tables(path)
    assert str(path) in caught.value.message and "parts" in caught.value.message
    assert message in caught.value.message and "\n" not in caught.value.message
    assert "--set" not in caught.value.message and hint in caught.value.hint


def test_contradictory_options_name_the_variant(irl, tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace("airl.gradient_penalty=1", "airl.challenger.life=2"))
    line = ["--experiments", path, "--profile", "smoke", "--store", tmp_path / "none"]
    refused = irl("plan", "parts", *line)
    assert refused.code == 2 and ", gradient penalty: airl.challenger.life" in refused.err
    assert len(refused.err.splitlines()) == 2 and "own values win over --set" in refused.err
    several = irl("plan", "parts", *line, "--methods", "erm,irm")
    assert several.code == 2 and "--methods: variants" in several.err
    chosen = irl("plan", "parts", *line, "--choose-penalty", "1,2")
    assert chosen.code == 2 and "takes no --choose-penalty" in chosen.err
    assert "set airl.penalty_weight in [parts.variants]" in chosen.err


@pytest.fixture(scope="module")
def made(tables, smoke_store, run_irl):
    """A store in which every step of one seed exists, and the directory of the report on it."""
    store, out = tables.parent / "runs", tables.parent / "out"
    common = ["parts", "--experiments", str(tables), "--profile", "smoke", "--quiet"]
    common += ["--seeds", "0", "--store", str(store)]
    line = ["run", *common, "--from", str(smoke_store.path), "--only"]
    for step in json.loads(run_irl(["plan", *common, "--json"]).out)["steps"]:
        done = run_irl([*line, step["name"]])
        assert done.code == 0, done.err
    done = run_irl(["report", *common, "--out", str(out)])
    assert done.code == 0, done.err
    return store, out, done


def test_the_report_holds_shares_of_the_experts(made):
    store, out, _ = made
    seeds = pd.read_csv(out / "seeds.csv")
    shares = pd.read_csv(out / "shares.csv").set_index(["agent", "measure", "setting"])
    assert set(shares.index.get_level_values("agent")) == {
        *("full", "gradient penalty", "low ceiling", "no ceiling")
    }
    points = seeds.set_index(["agent", "measure", "setting"])["true_return"]
    for value in VALUES:
        setting = f"engine-power={value}"
        expert = points["expert", "id", setting]
        earned = points["low ceiling", "transfer-id", setting]
        share = shares.loc[("low ceiling", "transfer-id", setting), "share"]
        # An expert that earns nothing has no share.
        assert share == pytest.approx(earned / expert, rel=1e-4) if expert > 0 else pd.isna(share)
        name = f"{ROW}.low-ceiling.erm.0.transfer-id.{value}-returns"
        artefact = Store(store).resolve(name).artefact
        (place,) = json.loads((artefact.directory / "summary.json").read_text())["settings"]
        assert earned == pytest.approx(place["mean_return"], rel=1e-5)
    variants = pd.read_csv(out / "variants.csv")
    assert variants["agent"].iloc[0] == "full" and len(variants) == 4


def test_budgets_are_those_of_the_base(made, irl, tmp_path):
    store, _, _ = made
    file = tmp_path / "tables.toml"
    file.write_text(TABLES.replace('"full" = []', '"full" = ["transfer.restarts=3"]'))
    line = ["report", "parts", "--experiments", file, "--profile", "smoke", "--seeds", "0"]
    done = irl(*line, "--store", store, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    rows = (tmp_path / "out" / "README.md").read_text().splitlines()
    (header,) = (row for row in rows if "transfer steps" in row)
    steps = rows[rows.index(header) + 2].split("|")[header.split("|").index(" transfer steps ")]
    # Three policies of 2,048 steps.
    assert steps.strip() == "6,144"


def test_variants_that_change_nothing_are_named(made):
    _, out, done = made
    text = (out / "README.md").read_text()
    assert "full, no ceiling share every run" in text and "share every run" in done.err
    # Sharing a run is no coincidence that a reader must be warned of.
    assert "no ceiling seed 0" not in text
    assert "| transfer.ceiling=0.5 |" in text and "AIRL-ERM." in text
    assert (out / "parts.png").stat().st_size > 0
    page = (out / "parts.html").read_text()
    assert "student, mean over settings" in page and ">90%<" in page
    assert "reward learning: the student" in page


def test_what_is_left_out_is_compared_with_the_most_similar_variant():
    def reward(**options):
        learner = {"learner": "airl", "grouping": "pooled", "penalty": "none"}
        return KeyRecord("train-airl", 1, {"airl": learner | options, "seed": 0}, {})

    wanted = [reward(shaping=True, hidden=32), reward(shaping=False, hidden=64)]
    other = SimpleNamespace(
        id="x", manifest=SimpleNamespace(record=reward(shaping=False, hidden=8))
    )
    for order in (wanted, wanted[::-1]):
        (found,) = left_out([other], order, set())
        assert found.why == "airl.hidden 8 instead of 64"
