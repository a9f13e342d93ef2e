"""Tables with the measure ``assess``: their plan, and their report."""

import json

import pytest

from irlcli.store import Store

TABLES = """
[tiny]
title = "Engine power"
rows = ["lunar-lander.engine-power"]
methods = ["erm"]
seeds = [0]
measures = ["transfer", "assess"]
"""
ROW = "smoke.lunar-lander.engine-power"
SETTINGS = ("1x", "1.25x", "1.5x")
BOUNDED = ["--set", "transfer.ceiling=0.3"]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "tables.toml"
    path.write_text(TABLES)
    return path


@pytest.fixture(scope="module")
def made(tables, smoke_store, run_irl):
    """A store in which every step of the row exists; policies are retrained under a ceiling."""
    store = tables.parent / "runs"
    line = ["run", "tiny", "--experiments", str(tables), "--profile", "smoke", "--quiet"]
    line += [*BOUNDED, "--tag", "smoke"]
    line += ["--store", str(store), "--from", str(smoke_store.path), "--only"]
    names = ("assess", "transfer-returns", "expert-by-reward")
    for step in (*(f"erm.0.{n}" for n in names), "random-returns", "idle-returns"):
        done = run_irl([*line, f"{ROW}.{step}"])
        assert done.code == 0, done.err
    return store


def test_the_plan_names_the_bank(irl, tables, tmp_path):
    line = ["plan", "tiny", "--experiments", tables, "--profile", "smoke", "--store", tmp_path]
    # The shipped tables have this reward's assessment on a bank of other policies.
    named = irl(*line)
    assert named.code == 2 and "bank of other policies" in named.err and "--tag" in named.err
    line += ["--tag", "smoke"]
    steps = {s["name"] for s in json.loads(irl(*line, "--json").out)["steps"]}
    for value in SETTINGS:
        bank = [f"{ROW}.bank.{who}.{value}" for who in ("idle", "random", "clone-noise-0.25")]
        bank += [f"{ROW}.bank.expert-of-1x.{value}", f"{ROW}.erm.0.bank.student.{value}"]
        assert set(bank) <= steps
    assert f"{ROW}.erm.0.bank.retrained.1.5x" in steps and f"{ROW}.erm.0.assess" in steps
    assert f"{ROW}.erm.0.bank.retrained.1x" not in steps


def test_gates_do_not_act_in_the_unseen_settings_with_anything_learned(irl, tmp_path):
    line = ["plan", "gates", "--profile", "smoke", "--rows", "lunar-lander", "--store", tmp_path]
    steps = {s["name"] for s in json.loads(irl(*line, "--json").out)["steps"]}
    row = {name for name in steps if name.startswith(ROW)}
    learned = {name for name in row if "erm" in name or "bank" in name}
    assert f"{ROW}.erm.0.bank.retrained.1.25x" in learned and f"{ROW}.erm.0.assess" in learned
    assert not {name for name in learned if name.endswith(".1.5x")}


def test_the_report_rates_the_reward(irl, made, tables, tmp_path):
    line = ["report", "tiny", "--experiments", tables, "--profile", "smoke", "--store", made]
    done = irl(*line, *BOUNDED, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "out" / "tiny.json").read_text())["reward_quality"]
    assert [(q["setting"], q["agent"], q["seed"]) for q in found] == [
        (f"engine-power={value}", "erm", 0) for value in SETTINGS
    ]
    artefact = Store(made).resolve(f"{ROW}.erm.0.assess").artefact
    written = json.loads((artefact.directory / "assessment.json").read_text())
    unseen = {
        e["kind"]: e["true"]["mean"]
        for e in written["bank"]
        if e["setting"] == found[-1]["setting"]
    }
    # An expert of the smoke profile may earn no more than the random agent. Verdicts then mean nothing.
    verdicts = int(unseen["expert"] > unseen["random"])
    assert [len(q["verdicts"]) for q in found] == [0, 0, verdicts]
    for q, s in zip(found, written["settings"], strict=True):
        assert q["spearman"] == s["overall"]["spearman"]["value"]
        assert q["expert_minus_idle"] == s["expert_minus_idle"]["mean"]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert "bank-lunar-lander-engine-power.png" in names
    text = (tmp_path / "out" / "README.md").read_text()
    assert "## Reward quality" in text and "(bank-lunar-lander-engine-power.png)" in text
    page = (tmp_path / "out" / "tiny.html").read_text()
    assert "Learned against true return" in page
    # No student is evaluated in this table, but its reward has a discriminator.
    assert "## The discriminator at the end of training" in text
    assert "No learning curves exist yet" not in page
    assert ("Weak expert" in text) == (not verdicts) and ("1/1" in text or not verdicts)


def test_reports_and_assessments_score_by_the_same_reward(irl, made, tables):
    """A policy retrained under a ceiling, and the expert it is compared with, are scored under it."""
    line = ["report", "tiny", "--experiments", tables, "--profile", "smoke", "--store", made]
    (row,) = json.loads(irl(*line, *BOUNDED, "--json").out)["report"]["learned_returns"]
    artefact = Store(made).resolve(f"{ROW}.erm.0.assess").artefact
    *_, unseen = json.loads((artefact.directory / "assessment.json").read_text())["settings"]
    (split,) = unseen["retrained"]
    assert split["ceiling"] == 0.3
    assert row["expert"] - row["retrained"] == pytest.approx(split["learned_gap"]["mean"], abs=1e-3)
    (expert,) = (
        e["learned"]["mean"]
        for e in json.loads((artefact.directory / "assessment.json").read_text())["bank"]
        if e["kind"] == "expert" and e["setting"] == unseen["setting"]
    )
    assert row["expert"] < expert  # As it was learned, without the ceiling.


def test_assess_alone_is_no_table(irl, tmp_path):
    path = tmp_path / "tables.toml"
    path.write_text(TABLES.replace('"transfer", "assess"', '"assess"'))
    done = irl("plan", "tiny", "--experiments", path, "--store", tmp_path / "runs")
    assert done.code == 2 and "tiny.measures: assess alone" in done.err and "hint:" in done.err
