"""`irl report table1` and its kin, end to end through the command line, on small budgets."""

import errno
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
from test_architecture import loaded_by

from irlcli.configs import load_config
from irlcli.envs.registry import environment
from irlcli.experiments import provenance
from irlcli.store import Store
from irlcli.store.manifest import encode_provenance

ROOT = Path(__file__).parent.parent.parent
SMALL = ["--set", "airl.total_steps=2048", "--set", "transfer.total_steps=1024"]
SMALL += ["--set", "evaluation.episodes=2", "--set", "expert.total_steps=1024"]
ENV = ["--env", "lunar-lander"]
ROW = ["--rows", "lunar-lander"]
# Table 1 without the measures that need many more policies.
TABLES = """
[table1]
title = "Table 1"
rows = ["lunar-lander.bounce", "lunar-lander.engine-power"]
methods = ["erm", "irm"]
seeds = [0, 1]
measures = ["transfer", "zero-shot", "id"]
"""


@pytest.fixture(scope="module")
def table_store(tmp_path_factory, run_irl):
    """One row of Table 1 (engine power): ERM and IRM, seeds 0 and 1; seed 1 of IRM stops early."""
    store = tmp_path_factory.mktemp("table1") / "runs"

    def irl(*arguments):
        common = ["--store", str(store), "--profile", "smoke", "--quiet", *SMALL]
        done = run_irl([*arguments, *common])
        assert done.code == 0, done.err

    where = [*ENV, "--ood", "engine-power"]
    for agent in ("--expert", "--random", "--idle"):
        irl("evaluate", agent, *where)
    irl("collect-experts", *ENV, "--intervention", "engine-power", "--name", "demos")
    irl("evaluate", "--expert", *ENV, "--intervention", "engine-power")
    for use in ("--ood", "--intervention"):
        irl("evaluate", "--expert", "--trained-in", "engine-power", *ENV, use, "engine-power")
    for method in ("erm", "irm"):
        for seed in "01":
            name = f"{method}.{seed}"
            learn = ["train-airl", "--demos", "demos", "--method", method, "--seed", seed]
            irl(*learn, "--name", name)
            irl("evaluate", "--policy", name, "--ood", "engine-power", "--name", f"{name}.zero")
            irl("evaluate", "--policy", name, "--intervention", "engine-power")
            if name != "irm.1":
                moved = f"{name}.transfer"
                to = ["--ood", "engine-power", "--seed", seed, "--name", moved]
                irl("transfer", "--reward", name, *to)
                irl("evaluate", "--policy", moved, "--reward", name, "--name", f"{moved}-returns")
                there = ["--expert", "--ood", "engine-power", "--reward", name]
                irl("evaluate", *there, "--name", f"{name}.expert")
    return store


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    path = tmp_path_factory.mktemp("tables") / "tables.toml"
    path.write_text(TABLES)
    return path


@pytest.fixture
def report(irl, tables):
    """``report("table1", store, ...)``: ``irl report`` with the budgets of the store."""

    def run(kind, store, *more, methods="erm,irm", seeds="0,1", small=SMALL):
        chosen = ["--methods", methods, "--seeds", seeds]
        chosen += ["--experiments", tables] if kind == "table1" else []
        return irl("report", kind, "--store", store, "--profile", "smoke", *small, *chosen, *more)

    return run


def caveats(result):
    listed, _, _ = result.err.partition("In short:")
    return [line[2:] for line in listed.splitlines() if line.startswith("- ")]


def test_the_report_says_what_the_evaluations_say(report, table_store):
    done = report("table1", table_store, *ROW)
    assert done.code == 0, done.err
    directory = Path(done.out.strip())
    names = {p.name for p in directory.iterdir()} - {"manifest.json", "provenance.json"}
    kinds = {f"table1.{e}" for e in ("csv", "html", "json", "pdf", "png", "tex")}
    assert names == kinds | {"README.md", "seeds.csv", "comparisons.csv"}

    store = Store(table_store)
    points = pd.read_csv(directory / "seeds.csv")
    for name, agent, seed, measure in (
        ("erm.0.transfer-returns", "erm", 0, "transfer"),
        ("erm.1.zero", "erm", 1, "zero-shot"),
        ("irm.1.zero", "irm", 1, "zero-shot"),
    ):
        artefact = store.resolve(name).artefact
        summary = json.loads((artefact.directory / "summary.json").read_text())
        chosen = points[
            (points["agent"] == agent) & (points["seed"] == seed) & (points["measure"] == measure)
        ]
        assert list(chosen["evaluation"].astype(str)) == [artefact.id]
        (place,) = summary["settings"]
        assert chosen["true_return"].item() == pytest.approx(place["mean_return"], rel=1e-5)
        if measure == "transfer":
            own = pd.read_parquet(artefact.directory / "episodes.parquet")
            expert = store.resolve(f"{agent}.{seed}.expert").artefact
            theirs = pd.read_parquet(expert.directory / "episodes.parquet")
            assert own["seed"].tolist() == theirs["seed"].tolist()
            for kind, column in (("true", "regret_error"), ("learned", "gap_error")):
                gaps = theirs[f"{kind}_return"] - own[f"{kind}_return"]
                error = gaps.std() / len(gaps) ** 0.5
                assert chosen[column].item() == pytest.approx(error, rel=1e-4)
    learned = points["agent"].isin(["erm", "irm"])
    assert set(points.loc[learned, "demonstrations"]) == {store.resolve("demos").artefact.id}
    assert points.loc[~learned, "demonstrations"].isna().all()
    in_distribution = points[(points["measure"] == "id") & (points["agent"] == "irm")]
    assert sorted(set(in_distribution["setting"])) == ["engine-power=1.25x", "engine-power=1x"]

    cells = pd.read_csv(directory / "table1.csv").set_index(["row", "agent", "measure"])
    erm = cells.loc[("lunar-lander engine-power", "erm", "transfer")]
    assert erm["seeds"] == erm["seeds_wanted"] == 2
    mine = points[(points["agent"] == "erm") & (points["measure"] == "transfer")]["true_return"]
    assert erm["mean"] == pytest.approx(mine.mean(), rel=1e-5)
    assert erm["deviation"] == pytest.approx(mine.std(), rel=1e-4)
    assert cells.loc[("lunar-lander bounce", "erm", "transfer"), "seeds"] == 0


@pytest.mark.parametrize(("life", "shares"), [(0, {}), (1, {"erm": 0.25, "irm": 0.25})])
def test_challengers_take_their_share_of_the_loss(report, table_store, tmp_path, life, shares):
    store = shutil.copytree(table_store, tmp_path / "runs", symlinks=True)
    changes = ["airl.logit=f", f"airl.challenger.life={life}", "airl.challenger.share=0.75"]
    changes = [word for change in changes for word in ("--set", change)]
    done = report("table1", store, *ROW, *changes)
    assert done.code == 0, done.err
    made = Store(store).resolve(Path(done.out.strip()).name).artefact
    rows = made.manifest.record.parameters["rows"]
    assert [row["student_share"] for row in rows if row["knob"] == "engine-power"] == [shares]


def test_learned_returns_are_those_of_the_evaluations(report, table_store):
    directory = Path(report("table1", table_store, *ROW).out.strip())
    store = Store(table_store)
    scored = json.loads((directory / "table1.json").read_text())["learned_returns"]
    assert [(r["row"], r["agent"], r["seeds"]) for r in scored] == [
        ("lunar-lander engine-power", "erm", 2),
        ("lunar-lander engine-power", "irm", 1),
    ]

    def mean(name):
        artefact = store.resolve(name).artefact
        episodes = pd.read_parquet(artefact.directory / "episodes.parquet")
        return episodes["learned_return"].mean()

    policies, experts = (
        [mean(f"erm.{seed}.{x}") for seed in "01"] for x in ("transfer-returns", "expert")
    )
    assert scored[0]["retrained"] == pytest.approx(sum(policies) / 2)
    assert scored[0]["expert"] == pytest.approx(sum(experts) / 2)
    points = pd.read_csv(directory / "seeds.csv")
    by_reward = points[points["measure"] == "expert by reward"]
    assert set(by_reward["expert_of"]) == {"engine-power=1.5x"}
    assert sorted(by_reward["learned_return"]) == pytest.approx(
        sorted([*experts, mean("irm.0.expert")]), rel=1e-5
    )
    # The experts' true return is no sample of any method's.
    assert not any(
        "the same returns to the bit" in n and "by reward" in n
        for n in caveats(report("table1", table_store, *ROW))
    )


def test_experts_are_evaluated_in_the_other_settings_too(report, irl, table_store):
    directory = Path(report("table1", table_store, *ROW).out.strip())
    points = pd.read_csv(directory / "seeds.csv")
    points = points[points["row"] == "lunar-lander engine-power"]
    reused = points[points["agent"] == "reused"]
    trained = ["engine-power=1.25x", "engine-power=1x"]
    unseen = reused[reused["measure"] == "ood"]
    assert sorted(unseen["expert_of"]) == trained
    assert set(unseen["setting"]) == {"engine-power=1.5x"}
    inside = reused[reused["measure"] == "id"].set_index(["expert_of", "setting"])["true_return"]
    # The setting's own expert is what the reused one is compared with.
    assert sorted(inside.index) == [tuple(trained), tuple(trained[::-1])]
    experts = points[(points["agent"] == "expert") & (points["measure"] == "id")]
    assert (experts["expert_of"] == experts["setting"]).all()
    cells = pd.read_csv(directory / "table1.csv").set_index(["row", "agent", "measure"])
    for measure, values in (("ood", unseen["true_return"]), ("id", inside)):
        mean = cells.loc[("lunar-lander engine-power", "reused", measure), "mean"]
        assert mean == pytest.approx(values.mean(), rel=1e-5)
    # The command says whose expert it is where that is not the setting's own.
    where = [*ENV, "--intervention", "engine-power", "--trained-in", "engine-power=1x"]
    small = ["--store", table_store, "--profile", "smoke", *SMALL]
    said = irl("evaluate", "--expert", *where, *small).err
    assert re.search(r"^expert +lunar-lander engine-power=1x ", said, re.M)
    assert re.search(r"^expert of engine-power=1x +lunar-lander engine-power=1.25x ", said, re.M)


def test_the_learning_curve_of_a_retrained_policy_is_that_of_the_restart_kept(
    report, irl, table_store, tmp_path, monkeypatch
):
    copy = tmp_path / "runs"
    shutil.copytree(table_store, copy, symlinks=True)
    restarts = [*SMALL, "--set", "transfer.restarts=2"]
    common = ["--store", copy, "--profile", "smoke", "--quiet", *restarts]
    moved = irl("transfer", "--reward", "erm.0", "--ood", "1.5x", *common, "--name", "best")
    assert moved.code == 0, moved.err
    assert irl("evaluate", "--policy", "best", "--reward", "erm.0", *common).code == 0
    drawn = {}
    monkeypatch.setattr(
        "irlcli.report.plots.learning_curves", lambda p, found: drawn.update(found) or {}
    )
    done = report("table1", copy, *ROW, methods="erm", seeds="0", small=restarts)
    assert done.code == 0, done.err
    (curve,) = (curve for role, curve in drawn.items() if role.endswith("transfer-learning"))
    metrics = pd.read_parquet(Path(moved.out.strip()) / "metrics.parquet")
    assert set(metrics["restart"]) == {0, 1}
    pd.testing.assert_frame_equal(curve, metrics[metrics["kept"]])


def test_a_damaged_evaluation_is_named_and_not_called_missing_only(report, table_store, tmp_path):
    store = shutil.copytree(table_store, tmp_path / "runs", symlinks=True)
    path = Store(store).resolve("erm.1.zero").artefact.directory / "summary.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes() + b" ")
    done = report("table1", store, *ROW)
    assert done.code == 0 and "engine-power.erm.1.zero-shot-returns is damaged: " in done.err


def test_what_is_missing_is_said(report, table_store):
    done = report("table1", table_store, *ROW)
    said = caveats(done)
    assert any(n.startswith("Missing: lunar-lander bounce: 0 of ") for n in said)
    (mine,) = (n for n in said if n.startswith("Missing: lunar-lander engine-power"))
    assert "no result of transfer: AIRL-IRM 1." in mine
    assert any("one seed has no variance" in n for n in said if n.startswith("No p-value"))
    assert re.search(r"lunar-lander engine-power = 1.5x +return .*\(1/2\)", done.err)


def test_a_report_is_a_function_of_what_it_stands_on(report, irl, table_store, tmp_path):
    first, second = (report("table1", table_store, *ROW).out.strip() for _ in range(2))
    assert first == second
    copy = tmp_path / "runs"
    shutil.copytree(table_store, copy, symlinks=True)
    for path in (copy / ".keys").iterdir():
        if path.read_text().strip() == Path(first).name:
            path.unlink()
    remade = report("table1", copy, *ROW, "--name", "table")
    assert Path(remade.out.strip()).name == Path(first).name
    assert "differs from" not in remade.err
    # A name on the report keeps everything behind it.
    collected = irl("gc", "--store", copy, "--grace-days", "0", "--json")
    assert json.loads(collected.out)["artefacts"] == []
    lineage = irl("lineage", "table", "--store", copy).out
    assert "train-expert" in lineage and "train-airl" in lineage


def test_a_report_that_is_there_loads_nothing_heavy(report, table_store, tables):
    assert report("table1", table_store, *ROW).code == 0
    chosen = ["--methods", "erm,irm", "--seeds", "0,1", *ROW, "--profile", "smoke", *SMALL]
    chosen += ["--experiments", str(tables)]
    assert loaded_by("report", "table1", "--store", str(table_store), *chosen) == "LOADED []"
    assert loaded_by("report", "table2") == "LOADED []"


def test_json_holds_the_tables(report, table_store):
    done = report("table1", table_store, *ROW, "--json")
    value = json.loads(done.out)
    assert value["kind"] == "artefact" and "table1.html" in value["outputs"]
    printed = report("table1", table_store, *ROW)
    assert value["report"]["caveats"] == caveats(printed)
    (line,) = value["report"]["in_short"]
    assert printed.err.rstrip().endswith(f"In short:\n- {line}")
    agents = {(c["agent"], c["measure"]) for c in value["report"]["cells"]}
    assert {("erm", "transfer"), ("expert", "id"), ("random", "ood")} <= agents


def test_nothing_is_run(report, table_store):
    before = set(Store(table_store).ids())
    planned = report("table1", table_store, *ROW, "--dry-run", seeds="0,1,2")
    assert planned.out.startswith("RUN     report table1")
    assert set(Store(table_store).ids()) == before
    partly = report("table1", table_store, *ROW, seeds="0,1,2")
    assert any("no result of train-airl: AIRL-ERM 2; AIRL-IRM 2" in n for n in caveats(partly))
    made = set(Store(table_store).ids()) - before
    store = Store(table_store)
    assert {store.resolve(i).artefact.manifest.record.stage for i in made} == {"report"}


def test_a_damaged_provenance_is_named_and_can_be_repaired(report, irl, table_store, tmp_path):
    copy = tmp_path / "two words"
    shutil.copytree(table_store, copy, symlinks=True)
    victim = Store(copy).resolve("demos").artefact
    path = victim.directory / "provenance.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b'"seconds"', b'"secondz"'))
    common = ["--profile", "smoke", *SMALL, "--tag", "x"]
    planned = irl("plan", "table1", *ROW, "--store", copy, *common)
    assert planned.code == 0 and f"{victim.id}/provenance.json was altered" in planned.err
    # A store to copy from is only read.
    away = irl("plan", "table1", *ROW, "--store", tmp_path / "none", "--from", copy, *common)
    assert away.code == 0 and f"provenance of {victim.id} in {copy} is damaged" in away.err
    done = report("table1", copy, *ROW)
    error, hint = done.err.splitlines()[-2:]
    assert done.code == 4 and victim.id in error
    # `irl run` says so before it makes anything.
    line = ["run", "table1", "--rows", "lunar-lander.engine-power", "--store", copy, *common]
    told = irl(*line, "--until", "demos")
    assert told.code == 0 and "provenance.json was altered" in told.err
    repaired = irl(*shlex.split(hint.split("`")[1])[1:])
    assert repaired.code == 4 and "collect-experts" in repaired.err + repaired.out
    assert report("table1", copy, *ROW).code == 0


def test_one_seed_has_no_p_value(report, table_store):
    done = report("table1", table_store, *ROW, seeds="0")
    found = pd.read_csv(Path(done.out.strip()) / "comparisons.csv")
    assert found["p_welch"].isna().all() and found["p_welch_holm"].isna().all()
    there = found[found["row"] == "lunar-lander engine-power"]
    assert there["difference"].notna().all() and there["why"].str.contains("one seed").all()


def test_other_budgets_are_left_out_and_named(report, irl, table_store, tmp_path):
    copy = tmp_path / "runs"
    shutil.copytree(table_store, copy, symlinks=True)
    before = Path(report("table1", copy, *ROW).out.strip())
    other = [w.replace("airl.total_steps=2048", "airl.total_steps=1536") for w in SMALL]
    more = ["--store", copy, "--profile", "smoke", "--quiet", *other]
    made = irl("train-airl", "--demos", "demos", "--method", "irm", "--seed", "0", *more)
    assert made.code == 0, made.err
    done = report("table1", copy, *ROW)
    (left_out,) = (n for n in caveats(done) if n.startswith("Left out"))
    assert "1 run of train-airl, lunar-lander engine-power=1x engine-power=1.25x irm" in left_out
    assert f"({Path(made.out.strip()).name})" in left_out
    assert left_out.endswith("airl.total_steps 1536 instead of 2048.")
    after = Path(done.out.strip())
    assert (after / "table1.csv").read_bytes() == (before / "table1.csv").read_bytes()


def test_other_evaluations_are_left_out_too(report, irl, table_store, tmp_path):
    copy = tmp_path / "runs"
    shutil.copytree(table_store, copy, symlinks=True)
    three = [word.replace("episodes=2", "episodes=3") for word in SMALL]
    more = ["--store", copy, "--profile", "smoke", "--quiet", *three]
    assert irl("evaluate", "--policy", "irm.0", "--ood", "1.5x", *more).code == 0
    (left_out,) = (n for n in caveats(report("table1", copy, *ROW)) if n.startswith("Left out"))
    assert left_out.endswith("evaluation.episodes 3 instead of 2.")


def test_rewards_from_other_demonstrations_are_left_out_as_such(report, irl, table_store, tmp_path):
    copy = tmp_path / "runs"
    shutil.copytree(table_store, copy, symlinks=True)
    more = ["--store", copy, "--profile", "smoke", "--quiet"]
    # The demonstrations of the table have two episodes.
    again = ["collect-experts", "--env", "lunar-lander", "--intervention", "engine-power=1x,1.25x"]
    assert irl(*again, "--episodes", "3", *more, "--name", "others").code == 0
    learn = ["train-airl", "--demos", "others", "--method", "irm", "--seed", "0"]
    assert irl(*learn, *more, *SMALL).code == 0
    notes = [n for n in caveats(report("table1", copy, *ROW)) if n.startswith("Left out")]
    (reward,) = (note for note in notes if "train-airl" in note)
    assert "another input (demonstrations)" in reward


def test_a_lambda_that_was_chosen_is_followed(report, irl, table_store, tmp_path):
    copy = tmp_path / "runs"
    shutil.copytree(table_store, copy, symlinks=True)
    common = ["--store", copy, "--profile", "smoke", "--quiet", *SMALL]
    choice = ["--choose-penalty", "1,10"]
    learn = ["train-airl", "--demos", "demos", "--method", "irm", "--name", "chosen"]
    made = irl(*learn, *choice, *common)
    assert made.code == 0, made.err
    assert irl("evaluate", "--policy", "chosen", "--ood", "1.5x", *common).code == 0
    done = report("table1", copy, *ROW, *choice, "--json")
    said = json.loads(done.out)["report"]
    there = {(p["agent"], p["seed"]) for p in said["points"] if p["measure"] == "zero-shot"}
    assert there == {("erm", 0), ("erm", 1), ("irm", 0)}
    (missing,) = (n for n in said["caveats"] if n.startswith("Missing: lunar-lander engine-power"))
    assert "AIRL-IRM 1" in missing
    (budgets,) = (t for t in said["tables"] if t["title"] == "Budgets")
    weight = json.loads((copy / made.out.strip().split("/")[-1] / "reward.json").read_text())
    assert budgets["rows"][1][4].endswith(f"irm 0: {weight['airl']['penalty_weight']:g}")
    # Each candidate's students in each setting left out, and the candidate with the best mean.
    scores = pd.DataFrame(said["choices"])
    assert set(zip(scores["penalty_weight"], scores["left_out"], strict=True)) == {
        (w, s) for w in (1.0, 10.0) for s in ("engine-power=1x", "engine-power=1.25x")
    }
    means = scores.groupby("penalty_weight")["true_return"].mean()
    assert set(scores[scores["chosen"]]["penalty_weight"]) == {means.idxmax()}
    assert means.idxmax() == weight["airl"]["penalty_weight"]
    (choices,) = (t for t in said["tables"] if t["title"] == "Choice of lambda")
    assert [line[3] for line in choices["rows"]] == ["1", "10"]
    # Without asking for it, the fixed lambda's runs are what the table is made of.
    fixed = json.loads(report("table1", copy, *ROW, "--json").out)["report"]
    assert sum(p["agent"] == "irm" and p["measure"] == "zero-shot" for p in fixed["points"]) == 2


def test_a_copied_report_is_whole_or_the_one_before(report, table_store, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert report("table1", table_store, *ROW, "--out", out).code == 0
    before = {path: path.read_bytes() for path in out.iterdir()}

    def half(source, target):
        Path(target).write_bytes(Path(source).read_bytes()[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", half)
    done = report("table1", table_store, *ROW, "--out", out)
    assert done.code == 1 and "No space left" in done.err
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_results_of_another_profile_are_named(report, irl, table_store, tmp_path):
    store = tmp_path / "runs"
    shutil.copytree(table_store, store, symlinks=True)
    for profile, hint in (
        ("standard", "there are results of --profile standard"),
        ("smoke", "its results in the store have other keys"),
    ):
        name = f"{profile}.lunar-lander.bounce.erm.0"
        assert irl("name", "erm.0", name, "--store", store).code == 0
        # A reward is nothing that the report shows.
        assert hint not in report("table1", store, small=[]).err
        assert irl("name", "erm.0", f"{name}.id-returns", "--store", store).code == 0
        assert hint in report("table1", store, small=[]).err


def test_a_profile_without_runs_is_no_table(report, irl, table_store):
    done = report("table1", table_store, small=[])
    assert done.code == 3
    assert "holds no evaluation of table1" in done.err and "irl run table1" in done.err
    assert report("figure3", table_store).code == 3
    nowhere = irl("report", "table1", "--store", table_store.parent / "new")
    assert nowhere.code == 3
    assert not (table_store.parent / "new").exists()


@pytest.mark.parametrize(
    ("arguments", "message", "hint"),
    [
        (["table3"], "unknown table 'table3'", "table1, table1-5, table2"),
        (["table1", "--methods", "erm,irn"], "--methods: unknown 'irn'", "did you mean 'irm'"),
        (["table1", "--methods", "erm,erm"], "--methods: erm appears twice", "once"),
        (["table1", "--seeds", "0,0"], "--seeds: 0 appears twice", "once"),
        (["table1", "--seeds", "0-4"], "--seeds '0-4' is not a list of seeds", "0,1,2,3,4"),
        (["table1", "--seeds", "-1"], "--seeds '-1' is out of range", "from 0 to 9007199254740992"),
        (
            ["table1", "--seeds", "9007199254740993"],
            "is out of range",
            "from 0 to 9007199254740992",
        ),
        (["table1", "--seeds", "+1"], "--seeds '+1' is not a list of seeds", "0,1,2,3,4"),
        (["table1", "--seeds", "1_000"], "--seeds '1_000' is not a list of seeds", "0,1,2,3,4"),
        (["table1", "--rows", "reacher"], "--rows: unknown 'reacher'", "lunar-lander.bounce"),
        (["table1", "demos"], "table1 takes no references", "found by their configuration"),
        (["figure2", "--seeds", "1"], "figure2 takes no --seeds", "omit --seeds"),
        (["experts", "--methods", "erm"], "experts takes no --methods", "omit --methods"),
        (["table2", "--format", "pdf"], "unknown --format 'pdf'", "markdown"),
        (["table1", "--format", "latex"], "table1 takes no --format", "omit --format"),
    ],
)
def test_bad_requests_are_refused(irl, table_store, arguments, message, hint):
    done = irl("report", *arguments, "--store", table_store)
    assert done.code == 2
    first, second = done.err.splitlines()[-2:]
    assert message in first and first.startswith("error: ")
    assert hint in second and second.startswith("hint: ")


def test_table2_needs_no_store_and_prints_the_settings(irl, tmp_path):
    done = irl("report", "table2", "--json", "--store", tmp_path / "none")
    rows = json.loads(done.out)["rows"]
    ant = load_config("ant").interventions
    assert {(r["knob"], tuple(r["id"]), tuple(r["ood"])) for r in rows if r["env"] == "ant"} == {
        (knob, values.id, values.ood) for knob, values in ant.items()
    }
    text = irl("report", "table2", "--store", tmp_path / "none").out
    markdown = irl("report", "table2", "--format", "markdown", "--store", tmp_path / "none").out
    latex = irl("report", "table2", "--format", "latex", "--store", tmp_path / "none").out
    assert "| ant | leg-length | 1x, 2x | 3x |" in markdown
    assert r"ant & leg-length & 1x, 2x & 3x \\" in latex
    assert len(text.splitlines()) == 1 + len(rows) == len(markdown.splitlines()) - 1
    assert not (tmp_path / "none").exists()


def test_goal_demonstrations_favour_the_right(irl, tmp_path):
    """Figure 4 (Sec. 5.2): more demonstrations of y = -900; asked for, the counts are those."""
    plan = ["--dry-run", "--json", "--store", tmp_path / "runs"]
    collect = ["collect-experts", "--env", "ant", "--intervention"]
    assert irl(*collect, "goal-y", *plan).code == 0
    listed = load_config("ant").interventions["goal-y"]
    assert dict(zip(listed.id, listed.episodes, strict=True)) == {"-900": 10, "0": 3}
    refused = irl(*collect, "goal-y", "--episodes", "1,2,3", *plan)
    assert refused.code == 2 and "3 episode counts for 2 settings" in refused.err


def test_the_experts_of_every_setting(irl, table_store, tmp_path):
    """What is there is said as the evaluations say it, what is not is named."""
    common = ["--store", table_store, "--profile", "smoke", *SMALL]
    done = irl("report", "experts", *ROW, *common, "--name", "experts")
    assert done.code == 0, done.err
    directory = Path(done.out.strip())
    found = pd.read_csv(directory / "experts.csv").set_index("setting")
    assert set(found["env"]) == {"lunar-lander"}
    assert set(found.index[found["use"] == "held out"]) == {
        f"{knob}={value}"
        for knob, listed in load_config("lunar-lander", "smoke").interventions.items()
        if environment("lunar-lander").knobs[knob].cue is None
        for value in listed.ood
    }
    row = found.loc["engine-power=1.5x"]
    for agent, name in (
        ("expert", "true_return"),
        ("idle", "idle_return"),
        ("random", "random_return"),
    ):
        evaluated = irl("evaluate", f"--{agent}", *ENV, "--ood", "engine-power", *common)
        (place,) = json.loads((Path(evaluated.out.split()[0]) / "summary.json").read_text())[
            "settings"
        ]
        assert row[name] == pytest.approx(place["mean_return"], rel=1e-5)
    assert (row["steps"], row["episodes"], row["status"]) == (1024, 2, "done")
    assert found.loc["bounce=0.9", "status"] == "no result of train-expert"
    assert pd.isna(found.loc["bounce=0.9", "true_return"])
    (missing,) = caveats(done)
    assert missing.startswith("Missing: the evaluations of 6 of 9 experts: lunar-lander bounce=0.1")
    assert (
        "| lunar-lander bounce=0.9 | held out | no result of train-expert |"
        in (directory / "README.md").read_text()
    )
    again = irl("report", "experts", *ROW, *common)
    assert again.out == done.out and "HIT" in again.err
    barred = irl("report", "experts", *ROW, *common, "--set", "expert.bar=1000")
    (low, _) = caveats(barred)
    assert "below their bar" in low and "engine-power=1.5x" in low


def test_a_table_of_experts_may_have_another_name(irl, table_store, tmp_path):
    tables = tmp_path / "tables.toml"
    tables.write_text('[mine]\ntitle = "My experts"\nkind = "experts"\n')
    line = ["report", "mine", "--experiments", tables, *ROW, "--store", table_store]
    line += ["--profile", "smoke", *SMALL]
    done = irl(*line)
    assert done.code == 0 and re.search(r"^lunar-lander +engine-power=1.5x ", done.err, re.M)
    document = json.loads(irl(*line, "--json").out)
    assert document["report"]["caveats"] == caveats(done)


@pytest.mark.parametrize("table", ["table1", "experts"])
def test_a_report_warns_of_artefacts_of_other_library_versions(
    irl, table_store, monkeypatch, table
):
    line = ["report", table, *ROW, "--store", table_store, "--profile", "smoke", *SMALL]
    assert "other library versions" not in irl(*line).err
    present = provenance.libraries()
    monkeypatch.setattr(provenance, "libraries", lambda: {**present, "torch": "99.0"})
    told = irl(*line).err
    assert f"of this report: torch {present['torch']} (now 99.0)" in told


def test_no_experts(irl, tmp_path):
    empty = irl("report", "experts", *ROW, "--store", tmp_path / "runs")
    assert empty.code == 3 and "irl run experts" in empty.err
    tabular = irl("report", "experts", "--rows", "gridworld", "--store", tmp_path / "runs")
    assert tabular.code == 2 and "gridworld" in tabular.err
    refused = irl("report", "experts", "--seeds", "0", "--store", tmp_path / "runs")
    assert refused.code == 2 and "--seeds" in refused.err


def test_an_intervention_without_held_out_values_has_experts(irl, table_store, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("[interventions.engine-power]\nood = []\n")
    common = ["--store", table_store, "--profile", "smoke", *SMALL, "--settings", file]
    done = irl("report", "experts", *ROW, *common)
    assert done.code == 0, done.err
    found = pd.read_csv(Path(done.out.strip()) / "experts.csv").set_index("setting")
    assert "engine-power=1.5x" not in found.index
    assert found.loc["engine-power=1x", "status"] == "done"
    # It cannot be a row of a comparison.
    refused = irl("plan", "table1", *ROW, *common)
    assert refused.code == 2
    assert "lunar-lander.engine-power: settings to train in: 2, held out: 0" in refused.err


def test_baselines_alone_make_a_report(irl, tmp_path):
    """As after `make experts`: nobody has learned a reward yet."""
    common = ["--store", tmp_path / "runs", "--profile", "smoke", *SMALL]
    assert irl("evaluate", "--idle", *ENV, "--ood", "bounce", *common).code == 0
    done = irl("report", "table1", *ROW, *common)
    assert done.code == 0, done.err
    points = pd.read_csv(Path(done.out.strip()) / "seeds.csv")
    assert list(points["agent"]) == ["idle"] and points["seed"].isna().all()


def test_returns_of_runs_that_differ_are_not_one_row(irl, table_store):
    common = ["--store", table_store, "--profile", "smoke", *SMALL]
    pooled = irl("report", "returns", "erm.0.zero", "erm.1.zero", "--store", table_store)
    assert pooled.code == 0, pooled.err
    longer = [str(w).replace("airl.total_steps=2048", "airl.total_steps=4096") for w in common]
    longer += ["--seed", "2"]
    assert (
        irl("train-airl", "--demos", "demos", "--method", "erm", *longer, "--name", "x").code == 0
    )
    where = ["--policy", "x", "--ood", "engine-power"]
    assert irl("evaluate", *where, *common, "--name", "x.zero").code == 0
    apart = irl("report", "returns", "erm.0.zero", "x.zero", "--store", table_store, "--json")
    names = [row["agent"] for row in json.loads(apart.out)["rows"]]
    assert [name.partition(", airl.total_steps ")[2] for name in names] == ["2048", "4096"]


def test_a_run_that_went_on_elsewhere_is_mixed(report, table_store, tmp_path):
    """Its attempts ran on two commits; the last one alone does not say so."""
    store = tmp_path / "runs"
    shutil.copytree(table_store, store, symlinks=True)
    artefact = Store(store).resolve("erm.0").artefact
    path = artefact.directory / "provenance.json"
    said = artefact.provenance()
    (attempt,) = said["attempts"]
    said["attempts"] = [{**attempt, "commit": "0" * 40}, attempt]
    artefact.directory.chmod(0o755)
    path.chmod(0o644)
    path.write_bytes(encode_provenance(artefact.manifest.id, said))
    assert not any(n.startswith("Mixed") for n in caveats(report("table1", table_store, *ROW)))
    (mixed,) = (n for n in caveats(report("table1", store, *ROW)) if n.startswith("Mixed"))
    assert re.search(r"0000000000[^,;]* then ", mixed)


def test_what_a_report_does_not_take_is_refused(irl, table_store):
    for line in (
        ["returns", "erm.0.zero", "--name", "x"],
        ["table2", "--name", "x"],
        ["table2", "--format", "latex", "--json"],
        ["returns", "erm.0.zero", "--profile", "nope"],
        ["table1", "--seeds", ""],
    ):
        refused = irl("report", *line, "--store", table_store)
        assert refused.code == 2, line
        assert "error:" in refused.err


def test_make_passes_its_variables_on():
    def commands(*words):
        line = ["make", "-n", "-C", str(ROOT), "-o", ".venv/.installed", *words]
        done = subprocess.run(line, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        joined = done.stdout.replace("\\\n", " ")
        return [text for text in joined.splitlines() if "/irl " in text]

    plain = commands("table1")
    until = ["--until experts", "--until rewards", "--until transfers", "--until returns"]
    assert [line.split("--jobs 2 ")[1].strip() for line in plain] == [
        *until,
        "--out results/standard/table1",
    ]
    assert all(" run table1 --store runs --profile standard " in line for line in plain)
    assert len(commands("figure4.rewards")) == 2
    assert len(commands("table1", "CLUSTER=slurm")) == 2
    assert "--store elsewhere " in commands("demo", "IRL_STORE=elsewhere")[0]
    assert "--store here " in commands("demo", "IRL_STORE=elsewhere", "STORE=here")[0]
    assert "--from settings " in commands("demo", "FROM=settings")[0]
    assert "--from zooo " in commands("demo", "FROM=zooo")[0]
    assert "--from" not in commands("demo", "FROM=")[0]
    assert "--from zoo " in plain[0]
    chosen = commands("figure3", "SEEDS=0 1", "METHODS=erm irm", "ROWS=ant", "TAG=x", "JOBS=4")[-1]
    for words in ('--seeds "0 1"', '--methods "erm irm"', "--rows ant", "--tag x", "--jobs 4"):
        assert f" {words} " in chosen
    assert chosen.endswith("--out results/x/figure3-ant-erm-irm-seeds-0-1")
    assert commands("experts", "RESULTS=docs/results/experts")[0].endswith(
        "--out docs/results/experts"
    )
    ablation = commands("retraining", "METHODS=irm", "FROM=settings", "JOBS=4", "TAG=x")
    assert len(ablation) == 5 and ablation[-1].endswith("--out results/x/retraining-irm")
    assert all(f" {w} " in ablation[-1] for w in ('--methods "irm"', "--from settings", "--jobs 4"))
    report = commands("report-table1")[0]
    assert report.endswith("--out results/standard/table1")
    part = commands("report-table1", "ROWS=ant", "METHODS=irm,erm", "SEEDS=1 0")[0]
    assert part.endswith("--out results/standard/table1-ant-erm-irm-seeds-0-1")


def test_what_another_store_holds_is_not_called_missing(irl, table_store, tmp_path):
    """The report reads one store only, and says where the rest is."""
    place = [
        *ROW,
        "--store",
        tmp_path / "runs",
        "--from",
        table_store,
        "--profile",
        "smoke",
        *SMALL,
    ]
    refused = irl("report", "table1", *place)
    assert refused.code == 3 and f"--from {table_store}" in refused.err
    step = "x.lunar-lander.engine-power.idle-returns"
    one = irl("run", "table1", *place, "--tag", "x", "--only", step)
    assert one.code == 0, one.err
    done = irl("report", "table1", *place)
    assert done.code == 0 and f"is in {table_store}" in done.err
