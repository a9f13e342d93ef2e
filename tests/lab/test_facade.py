"""irlcli.Lab: the command line's artefacts from Python, its errors, and interruption."""

import inspect
import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer

import irlcli
from irlcli.cli.app import app
from irlcli.errors import IntegrityError, Interrupted, NotFound, UsageError
from irlcli.lab.arguments import overrides, words
from irlcli.lab.display import NotebookConsole
from irlcli.store import Store

IDLE = {"env": "lunar-lander", "intervention": "bounce=0.9", "episodes": 2}


@pytest.fixture
def lab(store_copy):
    return irlcli.Lab(store_copy.path, profile="smoke", workers=1)


def stored(lab):
    return set(Store(lab.store).index().artefacts)


def test_what_the_commands_made_are_hits(lab, store_copy, capsys):
    before = stored(lab)
    demos = lab.collect_experts("lunar-lander", "engine-power=1x,1.25x")
    airl = lab.train_airl(demos, method="irm")
    moved = lab.transfer(airl, ood="1.5x")
    score = lab.evaluate(moved, ood="1.5x")
    assert [demos.id, airl.id] == [store_copy.demos, store_copy.airl]
    assert [moved.id, score.id] == [store_copy.transfer, store_copy.evaluation]
    assert stored(lab) == before
    out, err = capsys.readouterr()
    assert not out and all(line.startswith("HIT ") for line in err.splitlines())
    assert sum("train-airl" in line for line in err.splitlines()) == 1


def test_what_a_lab_made_are_hits_for_the_recorded_command(irl, lab, tmp_path):
    """The command is what `irl show` prints, and what a damaged artefact shows as its repair."""
    recording = tmp_path / "demos.parquet"
    exported = irl("export", "demos", "--to", f"parquet:{recording}", "demos", "--store", lab.store)
    assert exported.code == 0, exported.err
    grid = lab.collect_experts("gridworld", "path-group", episodes=[3, 2, 1], seed=2)
    made = [
        grid,
        lab.train_maxent(grid, method="erm"),
        lab.import_demonstrations(recording, "lunar-lander", "engine-power=1x,1.25x"),
        lab.evaluate(idle=True, **IDLE),
        irlcli.Lab(
            lab.store, profile="smoke", set=["transfer.total_steps=1024", "transfer.ppo.n_epochs=2"]
        ).transfer("airl", "1.5x", seed=1, set={"transfer.ppo.n_epochs": 1}),
    ]
    config = made[-1].parameters["transfer"]
    assert (config["total_steps"], config["ppo"]["n_epochs"]) == (1024, 1)
    before = stored(lab)
    for one in made:
        record = Store(lab.store).resolve(one.id).artefact.provenance()
        done = irl(*record["command"][1:])
        assert (done.code, done.out.strip()) == (0, str(one.path)), done.err
        assert done.err.startswith("HIT ")
    assert stored(lab) == before


COMMANDS = {
    "collect-experts": irlcli.Lab.collect_experts,
    "import": irlcli.Lab.import_demonstrations,
    "train-airl": irlcli.Lab.train_airl,
    "train-maxent": irlcli.Lab.train_maxent,
    "transfer": irlcli.Lab.transfer,
    "evaluate": irlcli.Lab.evaluate,
    "assess": irlcli.Lab.assess,
    "plan": irlcli.Lab.plan,
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_a_command_is_an_argument(command):
    group = typer.main.get_command(app)
    _, found, _ = group.resolve_command(group.make_context("irl", ["ls"]), [command])
    # Of the lab or of every call, of output on a terminal, and the plan for another engine.
    general = {"profile", "settings", "overrides", "sources", "wait", "workers", "quiet", "store"}
    general |= {"tensorboard", "dry_run", "as_json", "debug", "to"}
    arguments = set(inspect.signature(COMMANDS[command]).parameters) - {"self", "configs"}
    assert arguments == {option.name for option in found.params} - general


def test_a_lab_keeps_its_files_when_the_working_directory_changes(
    store_copy, monkeypatch, tmp_path
):
    monkeypatch.chdir(store_copy.path.parent)
    Path("my.toml").write_text("[evaluation]\nepisodes = 2\n")
    where = {"settings": "my.toml", "from_": store_copy.path.name}
    lab = irlcli.Lab(store_copy.path.name, profile="smoke", **where)
    monkeypatch.chdir(tmp_path.parent)
    assert lab.plan("table1", rows="lunar-lander", tag="x").steps
    assert lab.artefact("airl").id == store_copy.airl
    assert len(lab.artefact("demos").to_pandas())


@pytest.mark.parametrize("url", ["https://example.org/runs", "s3://bucket/x"])
def test_a_lab_has_no_store_behind_a_url(url):
    with pytest.raises(UsageError, match="is a URL"):
        irlcli.Lab(url)
    assert irlcli.Lab("runs", from_=url).sources == [url]


def test_a_path_with_two_dashes_is_named_as_it_is(lab):
    with pytest.raises(NotFound, match=r"/data/run--old/a--b\.parquet"):
        lab.import_demonstrations("/data/run--old/a--b.parquet", "lunar-lander", "bounce=0.1")


@pytest.mark.parametrize("widths", [[np.array([8, 8])], [object()], [{8}]])
def test_a_list_of_something_else_than_numbers_is_refused(lab, widths):
    with pytest.raises(UsageError):
        lab.train_airl("demos", method="irm", set={"airl.hidden": widths})


def test_a_recorded_command_says_what_a_call_turned_off():
    assert words("train-airl", {"state_only": False}) == ["irl", "train-airl", "--no-state-only"]
    assert words("collect-experts", {"trust": False}) == ["irl", "collect-experts"]


def test_a_call_may_set_a_field_of_the_labs(lab):
    steps = lab.artefact("airl").parameters["airl"]["total_steps"]
    other = irlcli.Lab(lab.store, profile="smoke", set={"airl.total_steps": 2 * steps})
    table = {"table": "table1", "seeds": 0, "methods": "irm", "rows": "lunar-lander.engine-power"}

    def status(**configs):
        found = {
            step["name"]: step["status"]
            for step in other.plan(**table, **configs, tag="smoke").steps
        }
        return found["smoke.lunar-lander.engine-power.irm.0"]

    assert (status(), status(set={"airl.total_steps": steps})) == ("RUN", "HIT")


def test_tables_are_data_frames(lab, irl, store_copy):
    demos, airl, score = (lab.artefact(name) for name in ("demos", "airl", "score"))
    assert list(demos.to_pandas()["setting"]) == ["engine-power=1x", "engine-power=1.25x"]
    assert {"round", "setting", "cross_entropy"} <= set(airl.to_pandas())
    assert score.to_pandas()["setting"].tolist() == ["engine-power=1.5x"]
    (row,) = score.to_pandas()[["method", "seed"]].to_dict("records")
    origin = json.loads(airl.output("reward.json").read_text())
    assert row == {"method": origin["method"], "seed": origin["seed"]}
    assert len(score.to_pandas("episodes.parquet")) == score.to_pandas()["episodes_per_seed"][0]
    with pytest.raises(UsageError, match=r"reward\.pt"):
        airl.to_pandas("reward.pt")
    experts = lab.evaluate(expert=True, trained_in=["engine-power"], **{**IDLE, "episodes": 1})
    assert experts.to_pandas()["agent"].tolist() == [
        "expert of engine-power=1x",
        "expert of engine-power=1.25x",
    ]
    with pytest.raises(UsageError, match="2 evaluations"):
        _ = experts.id


def test_an_assessment_is_the_commands_and_a_table_of_its_bank(lab, irl):
    # Without the setting's expert there is no verdict.
    lab.evaluate(expert=True, env="lunar-lander", ood="engine-power=1.5x", episodes=1)
    made = lab.assess("airl", ood="1.5x", name="assessed")
    table = made.to_pandas().set_index("policy")
    document = json.loads(made.output("assessment.json").read_text())
    true = {entry["policy"]: entry["true"]["mean"] for entry in document["bank"]}
    assert table["true"].to_dict() == true and set(table["setting"]) == {"engine-power=1.5x"}
    judged = table["verdict"].dropna().to_dict()
    (setting,) = document["settings"]
    assert setting["retrained"]
    kinds = {entry["kind"]: entry["true"]["mean"] for entry in document["bank"]}
    verdicts = {split["policy"]: split["verdict"] for split in setting["retrained"]}
    assert judged == (verdicts if kinds["expert"] > kinds["random"] else {})
    record = Store(lab.store).resolve(made.id).artefact.provenance()
    done = irl(*record["command"][1:], "--json")
    assert json.loads(done.out)["id"] == made.id and "HIT assess" in done.err


def test_an_uncertain_verdict_and_a_malformed_assessment_of_another_store(tmp_path, publish):
    score = {"mean": 1.0, "error": 0.5}
    entries = [("expert", 9.0), ("random", 0.0), ("retrained", 1.0)]
    bank = [
        {"policy": kind, "kind": kind, "setting": "mass=4x", "progress": None, "learned": score}
        | {"true": {"mean": mean, "error": 0.5}}
        for kind, mean in entries
    ]
    split = {"policy": "retrained", "true_regret": score, "learned_gap": score}
    split |= {"verdict": "wrong reward", "clear": False}
    none = {"policies": 3, "spearman": None, "pearson": None}
    setting = {"setting": "mass=4x", "overall": none, "lower_half": none, "retrained": [split]}
    reward = {"method": "erm", "seed": 0, "settings": ["mass=2x"]}
    document = {"env": "ant", "reward": reward, "settings": [setting], "pooled": None, "bank": bank}
    store = Store(tmp_path / "runs")

    def table(document, seed):
        files = {"assessment.json": json.dumps(document).encode()}
        made = publish(store, files, stage="assess", parameters={"seed": seed})
        return irlcli.Lab(store.root).artefact(made.artefact.id).to_pandas()

    found = table(document, 0).set_index("policy")
    assert found.loc["retrained", ["verdict", "clear"]].tolist() == ["wrong reward", False]
    assert found.loc["expert", ["verdict", "clear"]].isna().all()
    with pytest.raises(IntegrityError, match=r"assessment\.json"):
        table(document | {"bank": 7}, 1)


def test_a_recording_is_a_table_of_one_setting(tmp_path, publish):
    means = {"setting": "mass=4x", "episodes": 2, "mean_return": 3.0}
    store = Store(tmp_path / "runs")
    made = publish(store, {"summary.json": json.dumps(means).encode()}, stage="record")
    table = irlcli.Lab(store.root).artefact(made.artefact.id).to_pandas()
    assert table.to_dict("records") == [means]


def test_settings_may_be_lists(lab):
    both = lab.evaluate(idle=True, env="lunar-lander", ood=["engine-power=1.5x", "2x"])
    assert [one.id for one in both] == [
        one.id for one in lab.evaluate(idle=True, env="lunar-lander", ood="engine-power=1.5x,2x")
    ]


def test_what_numpy_holds_is_a_value():
    given = {"a.b": np.True_, "c": np.float64(0.5), "d": np.array([1, 2]), "e": [np.int64(3)]}
    assert overrides(given) == ["a.b=true", "c=0.5", "d=[1, 2]", "e=[3]"]


def test_a_path_may_be_any_path_like_object(lab, tmp_path):
    class Place:
        def __fspath__(self):
            return str(lab.store)

    new = irlcli.Lab(tmp_path / "new", profile="smoke", from_=Place())
    assert new.collect_experts("lunar-lander", "engine-power=1x,1.25x").path.parent == new.store


def test_a_plan_says_what_irl_plan_says(lab, irl):
    choice = {"seeds": [0], "methods": ["irm"], "rows": "lunar-lander"}
    new = lab.store.parent / "new"
    assert set(irlcli.Lab(new).plan("table1", **choice).counts) == {"RUN", "BLOCKED"}
    assert not new.exists()
    steps = lab.plan("table1", **choice).to_pandas().set_index("name")["status"]
    line = ["--seeds", "0", "--methods", "irm", "--rows", "lunar-lander", "--profile", "smoke"]
    shown = irl("plan", "table1", *line, "--store", lab.store).out
    assert [line.split()[0] for line in shown.splitlines()] == steps.tolist()


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda lab: lab.transfer("airl", "1.5x", setting="bounce=0.1"), UsageError, "give one of"),
        (lambda lab: lab.train_airl("demos", "imr"), UsageError, "hint: did you mean 'irm'"),
        (lambda lab: lab.train_airl("demos", metod="irm"), UsageError, "did you mean 'method'"),
        (lambda lab: lab.train_airl("demos", penalty=10), UsageError, "penalty 10 is not text"),
        (lambda lab: lab.train_airl("demos", 3), UsageError, "method 3 is not text"),
        (lambda lab: lab.train_airl("nothing"), NotFound, "nothing"),
        (lambda lab: irlcli.Lab("s", set={"airl.foo": 1}), UsageError, "airl.foo"),
        (lambda lab: irlcli.Lab(3), UsageError, "store 3 is not text or a path"),
        (lambda lab: irlcli.Lab("s", set=3), UsageError, "set 3 is not a dict or a list"),
        (lambda lab: irlcli.Lab("s", set=[3]), UsageError, "set 3 is not text"),
        (lambda lab: lab.train_airl("demos", seed=True), UsageError, "seed True is not a whole"),
        (lambda lab: lab.evaluate(idle="yes", **IDLE), UsageError, "idle 'yes' is not True or"),
        (lambda lab: lab.train_airl("demos", "irm", 10), UsageError, "train_airl: too many"),
        (lambda lab: lab.collect_experts(), UsageError, "collect_experts: missing a required"),
        (lambda lab: lab.plan(None), UsageError, "table None is not text"),
        (lambda lab: lab.import_demonstrations([], "ant", "mass=2x"), UsageError, "no demonstra"),
        (
            lambda lab: lab.train_airl("demos", "irm", penalty_weight=10**400),
            UsageError,
            "penalty_weight is too large",
        ),
        (lambda lab: lab.evaluate("airl", settings=3), UsageError, "settings 3 is not text or a"),
        (lambda lab: irlcli.Lab("s", storee=1), UsageError, "Lab has no argument 'storee'"),
        (lambda lab: lab.artefact("airl", profile="smoke"), UsageError, "no argument 'profile'"),
        (lambda lab: lab.evaluate(idle=True, **{**IDLE, "seed": -1}), UsageError, "seed=0 or more"),
        (
            lambda lab: lab.train_airl("demos", seed=2**53 + 1),
            UsageError,
            "9007199254740992 or less",
        ),
        (lambda lab: lab.evaluate("airl", seed="0"), UsageError, "seed '0' is not a whole number"),
        (lambda lab: lab.evaluate("airl", profile="large"), UsageError, "smoke"),
        (
            lambda lab: lab.evaluate(
                idle=True, **IDLE, set=["transfer.total_steps=5", "transfer.total_steps=7"]
            ),
            UsageError,
            "transfer.total_steps is given twice",
        ),
        (lambda lab: lab.train_airl(None), UsageError, "demos None is not an artefact"),
        (lambda lab: lab.transfer(None, ood="2x"), UsageError, "reward None is not an artefact"),
        (lambda lab: lab.assess(3), UsageError, "reward 3 is not an artefact"),
        (lambda lab: lab.evaluate("airl", setting=[None]), UsageError, "setting None is not text"),
        (lambda lab: irlcli.Lab("/dev/null/runs").evaluate(idle=True, **IDLE), UsageError, "hint"),
    ],
)
def test_a_mistake_raises_the_error_with_its_hint(lab, capsys, call, error, text):
    with pytest.raises(error) as caught:
        call(lab)
    assert text in str(caught.value)
    outside_commands = re.sub("`[^`]*`", "", str(caught.value))
    assert "--" not in outside_commands, "options are named as arguments"
    assert capsys.readouterr() == ("", "")


@pytest.fixture
def cell(monkeypatch):
    """What a cell shows, each display by its updates; the process counts as a notebook's kernel."""
    displays = []

    def display(line, display_id):
        displays.append([line])
        return SimpleNamespace(update=displays[-1].append)

    kernel = SimpleNamespace(kernel=object())
    monkeypatch.setattr("IPython.get_ipython", lambda: kernel)
    monkeypatch.setattr("IPython.display.display", display)
    return displays


def test_an_interrupted_cell_resumes(cell, store_copy, monkeypatch):
    lab = irlcli.Lab(store_copy.path, profile="smoke")
    train = {"reward": "airl", "ood": "1.5x", "seed": 1}
    shown = NotebookConsole.progress

    def interrupt(console, *progress):
        shown(console, *progress)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(NotebookConsole, "progress", interrupt)
        with pytest.raises(Interrupted, match="the same call again"):
            lab.transfer(**train)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    lab.transfer(**train)
    stopped, resumed = cell
    assert [repr(line).split()[0] for line in stopped] == ["RUN", "50%", "STOPPED"]
    assert (repr(resumed[0]).split()[0], repr(resumed[-1]).split()[0]) == ("RESUME", "DONE")
    assert "<progress" in stopped[1]._repr_html_() and stopped[2]._repr_html_() is None


def test_the_package_is_light_to_import():
    heavy = "{'torch', 'numpy', 'pandas', 'msgspec', 'typer', 'rich', 'IPython'}"
    code = f"import sys, irlcli; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_field_that_a_call_sets_in_vain_is_named(lab, capsys):
    lab.evaluate(idle=True, **IDLE, set={"transfer.total_steps": 5})
    warned = capsys.readouterr().err
    assert "reads set transfer.total_steps=5" in warned and "--" not in warned
    # One of the lab's may be for other calls.
    other = irlcli.Lab(lab.store, profile="smoke", set={"transfer.total_steps": 5})
    other.evaluate(idle=True, **IDLE)
    other.plan("figure2", tag="x")
    assert "transfer.total_steps" not in capsys.readouterr().err
