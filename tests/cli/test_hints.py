"""Hints name what is allowed, and are commands that work as they stand."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from irlcli.cli.app import app
from irlcli.cli.session import StageSession
from irlcli.errors import UsageError
from irlcli.requests.collect import collect_experts
from irlcli.store import Store

SMOKE = ["--profile", "smoke"]
BOUNCE = "--intervention bounce=0.1"


@pytest.mark.parametrize(
    "line",
    [
        f"collect-experts --env lunarlander {BOUNCE}",
        f"import steps.parquet --env lunarlander {BOUNCE}",
        "transfer --reward airl --ood 1.5x --env lunarlander",
        "evaluate --policy moved --env lunarlander",
        f"evaluate --idle --env lunarlander {BOUNCE}",
        "evaluate --idle --env lunarlander",
        f"evaluate --expert --env lunarlander {BOUNCE}",
        "evaluate --idle --reward airl --env lunarlander",
        *(f"{command} table1 --rows lunarlander" for command in ("plan", "run", "report")),
    ],
)
def test_a_mistyped_environment_is_suggested_by_every_command(irl, smoke_store, line):
    done = irl(*line.split(), *SMOKE, "--store", smoke_store.path)
    assert done.code == 2 and "'lunarlander'" in done.err
    assert "did you mean 'lunar-lander'" in done.err.splitlines()[-1]


@pytest.mark.parametrize("text", ["abc", "9q", "900x", "engine-powr"])
@pytest.mark.parametrize(
    "command", ["transfer --reward airl", "evaluate --policy airl", "assess airl"]
)
def test_a_wrong_value_names_the_forms_and_the_listed_values(irl, smoke_store, command, text):
    """The knob is that of the reward: its held-out value is 1.5x."""
    done = irl(*command.split(), "--ood", text, *SMOKE, "--store", smoke_store.path)
    assert done.code == 2 and text in done.err
    hint = done.err.splitlines()[-1]
    assert "1.5x" in hint and ("2x" in hint or "0.05x and 20x" in hint)
    assert ("'engine-power'" in hint) == (text == "engine-powr")


@pytest.mark.parametrize(
    ("item", "hint"),
    [
        ("transfer.ceiling=9", "a quantile from 0 to 1, or none"),
        ("transfer.ceiling=high", "a quantile from 0 to 1, or none"),
        ("airl.replay_share=2", "a number from 0 to 1, for example 0.5"),
        ("airl.ppo.n_envs=5000", "a number from 1 to 1024, for example 16"),
        ("airl.plateau_rounds=0", "write a whole number from 1, or none"),
        ("airl.columns=first", "write a value, or none"),
        ("airl.symmetries=maybe", "write true, false or none"),
    ],
)
def test_a_bounded_field_names_its_bounds(irl, smoke_store, item, hint):
    line = ["transfer", "--reward", "airl", "--ood", "1.5x", "--set", item]
    done = irl(*line, *SMOKE, "--store", smoke_store.path)
    assert done.code == 2 and done.err.splitlines()[-1] == f"hint: {hint}"


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("airl.ppo.n_envs=70000", "expected a whole number of at most 1024"),
        ("airl.learning_rate=-1", "expected a number above 0"),
        ("airl.penalty_weight=-1", "expected a number of at least 0"),
    ],
)
def test_a_value_out_of_range_is_refused_in_plain_words(irl, tmp_path, item, message):
    done = irl("plan", "demo", "--set", item, "--store", tmp_path)
    assert done.code == 2 and done.err.splitlines()[0] == f"error: --set {item}: {message}"


def test_an_expert_lacks_only_what_is_not_given(irl, tmp_path):
    done = irl("evaluate", "--expert", "--ood", "engine-power=1.5x", "--store", tmp_path)
    assert done.code == 2 and done.err.splitlines()[-1] == "hint: add --env ENV"
    done = irl("evaluate", "--expert", "--env", "lunar-lander", "--store", tmp_path)
    assert done.code == 2 and "--env" not in done.err.splitlines()[-1]


def test_a_mistyped_name_may_also_be_in_another_store(irl, smoke_store):
    done = irl("show", "aril", "--store", smoke_store.path)
    assert done.code == 3 and "did you mean 'airl'?" in done.err and "`irl pull" in done.err


def test_a_mistyped_stage_has_a_suggestion(irl, smoke_store):
    done = irl("ls", "--stage", "tranfer", "--store", smoke_store.path)
    assert (done.code, done.out) == (0, "") and "did you mean 'transfer'?" in done.err
    assert "'tranfer'" in done.err and "train-airl, " in done.err


def test_a_stage_of_an_empty_store(irl, empty_store):
    done = irl("ls", "--stage", "transfer", "--store", empty_store.root)
    assert done.code == 0 and f"'transfer'; {empty_store.root} holds none" in done.err


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("0-2", "write 0,1,2"),
        ("3..5", "write 3,4,5"),
        ("0:40", "write 0,1, and so on to 40"),
        ("2-0", "write 0,1,2,3,4"),
        ("all", "write 0,1,2,3,4"),
    ],
)
def test_a_range_of_seeds_is_written_as_a_list(irl, tmp_path, text, hint):
    done = irl("plan", "table1", "--seeds", text, *SMOKE, "--store", tmp_path)
    assert done.code == 2 and done.err.splitlines()[-1] == f"hint: {hint}"


def test_a_reference_is_not_looked_up_in_a_store_that_does_not_exist(irl, tmp_path):
    done = irl("show", "airl", "--store", tmp_path / "rnus")
    assert done.code == 3 and f"no store at {tmp_path / 'rnus'}" in done.err


def test_no_text_is_not_taken_for_the_working_directory(irl, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = irl(
        "evaluate", "--idle", "--env", "lunar-lander", *BOUNCE.split(), *SMOKE, "--store", ""
    )
    assert done.code == 2 and "--store" in done.err
    assert list(tmp_path.iterdir()) == []


def test_a_url_is_not_taken_for_a_directory(irl, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = ["evaluate", "--idle", "--env", "lunar-lander", *SMOKE, "--store", "s3://bucket/runs"]
    done = irl(*line)
    assert done.code == 2 and "a URL" in done.err and "--from" in done.err
    assert list(tmp_path.iterdir()) == []


def test_what_a_reference_may_be_is_in_the_hint(irl, store_copy):
    store = store_copy.path

    def hint(ref):
        return irl("show", ref, "--store", store).err.splitlines()[-1]

    assert f"`irl ls --store {store}` lists" in hint("nothing")
    assert "did you mean 'airl'" in hint("air1")
    assert "at least 3 digits" in hint(store_copy.airl[:2])
    manifest = store / store_copy.airl / "manifest.json"
    manifest.chmod(0o644)
    manifest.write_text("{")
    # The first command moves it to quarantine, the second finds it there.
    assert hint(store_copy.airl) == hint(store_copy.airl)
    assert "irl train-airl" in hint(store_copy.airl)


def test_a_hint_for_a_recording_can_be_pasted(irl, tmp_path):
    recording, store = tmp_path / "two words.parquet", tmp_path / "runs"
    recording.write_bytes(b"")
    done = irl("train-airl", "--demos", recording, "--store", store)
    words = shlex.split(done.err.splitlines()[-1].split("`")[1])
    assert done.code == 3 and words[:3] == ["irl", "import", str(recording)]
    assert words[-2:] == ["--store", str(store)]


def session(store, profile="standard", overrides=(), sources=(), workers=1, tensorboard=None):
    return StageSession(
        store,
        False,
        profile=profile,
        file=None,
        overrides=overrides,
        sources=sources,
        dry_run=True,
        wait=True,
        workers=workers,
        quiet=True,
        tensorboard=tensorboard,
    )


@pytest.mark.parametrize(
    ("intervention", "counts"),
    [
        ("goal-y", [2, 1]),
        ("goal-y=-900,0", [2, 1]),
        ("goal-y=0,-900", [1, 2]),
        ("goal-y=-900", [2]),
        # The listed settings' counts say nothing about others.
        ("goal-y=-800,0", [1, 1]),
    ],
)
def test_a_knobs_own_counts_are_used_however_its_values_are_named(tmp_path, intervention, counts):
    wanted = {"env": "ant", "intervention": intervention, "setting": [], "seed": 0}
    request = collect_experts(
        session(tmp_path, "smoke"), **wanted, expert=[], trust=False, episodes=None
    )
    assert list(request.parameters.episodes) == counts


def test_a_suggested_command_repeats_what_is_no_default(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("IRL_STORE", raising=False)
    assert session("runs").suggestion("ls") == "irl ls"
    assert session("other").suggestion("ls") == "irl ls --store other"
    changed = session("runs", "smoke", ["airl.bc_epochs=3"])
    assert changed.suggestion("ls") == "irl ls --profile smoke --set airl.bc_epochs=3"
    assert session("runs", sources=["zoo"]).suggestion("ls") == "irl ls --from zoo"
    monkeypatch.setenv("IRL_STORE", "other")
    assert session("other").suggestion("ls") == "irl ls"
    assert session("runs").suggestion("ls") == "irl ls --store runs"


def test_other_processes_are_told_the_store_unless_it_is_everybodys_default(tmp_path, monkeypatch):
    """A job elsewhere may not know IRL_STORE. What they record is shown when a result is damaged."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("IRL_STORE", raising=False)
    assert session("runs").place_words() == []
    assert session("other").place_words() == ["--store", "other"]
    monkeypatch.setenv("IRL_STORE", "other")
    assert session("other").place_words() == ["--store", "other"]
    assert session("runs").place_words() == ["--store", "runs"]


def test_other_processes_have_the_workers_and_the_tensorboard_of_the_command(monkeypatch):
    monkeypatch.delenv("IRL_STORE", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    words = session("runs", workers=3, tensorboard=Path("logs")).place_words()
    assert words == ["--workers", "3", "--tensorboard", "logs"]


def test_the_command_that_trains_a_missing_expert_can_be_typed_as_it_stands(irl, store_copy):
    assess = ["assess", "airl", "--ood", "1.5x", "--dry-run", *SMOKE, "--store", store_copy.path]
    told = irl(*assess).err
    (command,) = re.findall(r"`irl ([^`]*)` trains it", told)
    assert irl(*command.split(), "--quiet").code == 0
    assert "trains it" not in irl(*assess).err


OWN_TABLE = """
[small]
rows = ["lunar-lander.engine-power"]
methods = ["erm"]
seeds = [0]
measures = ["zero-shot"]
"""


def suggested(done):
    (line,) = re.findall("`irl ([^`]*)`", done.err.splitlines()[-1])
    return shlex.split(line)


@pytest.mark.parametrize(
    "options", [["--profile", "smoke"], ["--set", "airl.bc_epochs=3"]], ids=["profile", "set"]
)
def test_suggested_lines_about_tables_can_be_typed_as_they_stand(irl, tmp_path, options):
    tables, store = tmp_path / "my tables.toml", tmp_path / "my runs"
    tables.write_text(OWN_TABLE)
    words = ["small", "--experiments", tables, "--store", store, "--seeds", "0", *options]
    lost = irl("plan", *words, "--only", "standard.small.none")
    assert lost.code == 2
    listed = irl(*suggested(lost))
    assert listed.code == 0
    if options[0] == "--profile":
        assert listed.out == irl("plan", *words).out
    lacking = irl("report", *words)
    assert lacking.code == 3
    made = irl(*suggested(lacking), "--until", "demos", "--dry-run")
    assert made.code == 0, made.err
    line = suggested(lacking)
    assert line[0] == "run" and ("--tag" in line) == ("--set" in options)


def test_suggested_lines_name_the_store(irl, tmp_path, empty_store):
    (tmp_path / "file").write_text("")
    lost = irl("show", tmp_path / "file", "--store", empty_store.root)
    assert lost.code == 3 and suggested(lost) == ["ls", "--store", str(empty_store.root)]
    there = tmp_path / "my place"
    Store(there).create()
    lost = irl("pull", "irm", "--from", there, "--store", empty_store.root)
    assert lost.code == 3 and suggested(lost) == ["ls", "--from", str(there)]


POWER = "--env lunar-lander --intervention engine-power=1x"


@pytest.mark.parametrize(
    ("line", "item", "unread"),
    [
        ("transfer --reward airl --ood 1.5x", "airl.penalty_weight=3", True),
        ("transfer --reward airl --ood 1.5x", "transfer.ceiling=0.5", False),
        ("evaluate --policy moved --ood 1.5x", "airl.penalty_weight=3", True),
        (f"evaluate --idle {POWER}", "expert.total_steps=9999", True),
        (f"evaluate --expert {POWER}", "expert.total_steps=9999", False),
        (f"collect-experts {POWER}", "transfer.ceiling=0.5", True),
        (f"collect-experts {POWER}", "expert.total_steps=9999", False),
        (f"collect-experts {POWER}", "gridworld.size=9", True),
        (f"collect-experts {POWER} --expert engine-power=1x=airl", "expert.total_steps=9", True),
        (f"collect-experts {POWER} --expert engine-power=1x=airl", "expert.bar=9", False),
        ("collect-experts --env gridworld --setting default", "gridworld.size=9", False),
        ("collect-experts --env gridworld --setting default", "expert.total_steps=9", True),
        ("collect-experts --env gridworld --setting default", "demonstrations.episodes=3", False),
        (
            "collect-experts --env gridworld --setting default",
            "demonstrations.deterministic=true",
            True,
        ),
        ("train-airl --demos demos --method irm", "transfer.ppo.gamma=0.9", False),
        ("train-airl --demos demos --method irm", "transfer.ceiling=0.5", True),
        ("train-airl --demos demos --method bc", "airl.gradient_penalty=3", True),
        ("train-airl --demos demos --method bc", "airl.ppo.net_arch=[8]", False),
        ("train-airl --demos demos --method bc", "airl.ppo.learning_rate=1", True),
        ("train-airl --demos demos --method irm", "expert.total_steps=9999", True),
        ("assess airl", "expert.total_steps=9999", False),
    ],
)
def test_a_field_that_no_stage_of_the_command_reads_is_named(irl, smoke_store, line, item, unread):
    done = irl(*line.split(), "--set", item, *SMOKE, "--store", smoke_store.path, "--dry-run")
    assert done.code == 0
    assert (f"warning: no stage of this command reads --set {item}" in done.err) == unread


@pytest.mark.parametrize(
    ("table", "item", "unread"),
    [
        ("control", "airl.penalty_weight=3", True),
        ("figure2", "airl.bc_epochs=3", True),
        ("experts", "transfer.ceiling=0.5", True),
        ("table1", "maxent.l2=1", True),
        ("table1", "airl.bc_epochs=3", False),
        ("table1", "clone.epochs=3", True),
        ("gates", "clone.epochs=3", False),
        ("gates", "assessment.noise=[0.5]", False),
        ("figure2", "maxent.iterations=9", False),
    ],
)
def test_a_field_that_no_step_of_a_table_reads_is_named(irl, tmp_path, table, item, unread):
    line = ["plan", table, "--set", item, "--tag", "x", *SMOKE, "--store", tmp_path / "runs"]
    done = irl(*line)
    assert done.code == 0, done.err
    assert (f"warning: no step of {table} reads --set {item}" in done.err) == unread


ERM = "train-airl --demos demos --method erm"
# Challengers in each setting, averaged by the rates of a schedule that falls.
PARTS = ("airl.challenger.per_setting=true", "airl.averaged_by=learning-rate")
CHALLENGED = ("airl.challenger.life=1", "airl.logit=f", "airl.policy_reward=f")


@pytest.mark.parametrize(
    ("line", "items", "unused"),
    [
        (ERM, [PARTS[0], "airl.challenger.life=0"], {PARTS[0]: "false"}),
        (ERM, [PARTS[0], *CHALLENGED], {}),
        (ERM, ["transfer.ppo.gamma=0.9"], {"transfer.ppo.gamma=0.9": "0.999"}),
        (ERM, ["transfer.ppo.gamma=0.9", *CHALLENGED], {}),
        (
            ERM,
            ["transfer.ppo.gamma=0.9", "airl.challenger.ppo.gamma=0.5", *CHALLENGED],
            {"transfer.ppo.gamma=0.9": "0.5"},
        ),
        (ERM, [PARTS[1], "airl.averaged_rounds=1"], {PARTS[1]: "rounds"}),
        (ERM, ["airl.pairing=pooled"], {"airl.pairing=pooled": "matched"}),
        (f"{ERM}-balanced", ["airl.pairing=pooled"], {}),
        (ERM, ["airl.dropout=0", "airl.averaged_rounds=1", "airl.columns=[]"], {}),
        (ERM, ["airl.ppo.batch_size=99999"], {"airl.ppo.batch_size=99999": "1024"}),
        (
            "transfer --reward airl --ood 1.5x --start student",
            ["transfer.total_steps=5", "transfer.from_student.total_steps=2050"],
            {"transfer.total_steps=5": "2050"},
        ),
        ("transfer --reward airl --ood 1.5x", ["transfer.ceiling=none"], {}),
        ("transfer --reward airl --ood 1.5x", ["expert.ppo.n_epochs=1"], {}),
        # The settings file gives retrained landers a gamma of their own.
        (
            "transfer --reward airl --ood 1.5x",
            ["expert.ppo.gamma=0.9"],
            {"expert.ppo.gamma=0.9": "0.99"},
        ),
        (
            "plan figure2 --tag x",
            ["maxent.penalty_weight=3", "maxent.iterations=9"],
            {"maxent.penalty_weight=3": "0.0"},
        ),
        (
            "collect-experts --env reacher --intervention gravity=1x",
            ["expert.ppo.sde_sample_freq=8", "expert.ppo.gamma=0.9"],
            {"expert.ppo.sde_sample_freq=8": "none"},
        ),
        (
            "plan table1 --rows lunar-lander --tag x",
            ["airl.select_every=3"],
            {"airl.select_every=3": "10"},
        ),
        (
            "plan table1 --rows lunar-lander --tag x",
            ["transfer.restarts=2", "transfer.restart_steps=9"],
            {},
        ),
    ],
)
def test_a_value_that_the_others_leave_without_effect_is_named(
    irl, smoke_store, line, items, unused
):
    sets = [word for item in items for word in ("--set", item)]
    dry = [] if line.startswith("plan") else ["--dry-run"]
    done = irl(*line.split(), *sets, *SMOKE, "--store", smoke_store.path, *dry)
    assert done.code == 0, done.err
    warned = dict(re.findall(r"--set (\S+) counts as (\S+) here", done.err))
    assert warned == unused


def test_a_phase_does_not_warn_of_what_a_later_phase_reads(irl, tmp_path):
    line = ["plan", "table1", "--rows", "lunar-lander", "--until", "experts", "--tag", "x"]
    done = irl(*line, "--set", "airl.penalty_weight=3", *SMOKE, "--store", tmp_path / "runs")
    assert done.code == 0 and "reads --set" not in done.err


@pytest.mark.parametrize("start", ["scratch", "student"])
def test_what_only_a_policy_from_the_student_reads_is_named(irl, smoke_store, start):
    line = ["transfer", "--reward", "airl", "--ood", "1.5x", "--start", start, "--dry-run"]
    item = "transfer.from_student.total_steps=9999"
    done = irl(*line, "--set", item, *SMOKE, "--store", smoke_store.path)
    assert done.code == 0
    warned = f"--set {item} has no effect: no policy begins as the student" in done.err
    assert warned == (start == "scratch")


def test_what_the_choice_of_lambda_reads_is_read(irl, store_copy):
    line = ["train-airl", "--demos", "demos", "--method", "irm", "--choose-penalty", "0.1,1"]
    items = ["--set", "evaluation.episodes=2", "--set", "airl.total_steps=2048"]
    done = irl(*line, *items, *SMOKE, "--store", store_copy.path)
    assert done.code == 0 and "reads --set" not in done.err


def test_a_bad_name_fails_before_the_choice_of_lambda(irl, store_copy):
    line = ["train-airl", "--demos", "demos", "--method", "irm", "--choose-penalty", "0.1,1"]
    before = set(store_copy.path.iterdir())
    done = irl(*line, "--name", "12ab", *SMOKE, "--seed", 9, "--store", store_copy.path)
    assert done.code == 2 and "12ab" in done.err and "RUN" not in done.err
    assert set(store_copy.path.iterdir()) == before


def test_a_line_that_is_wrong_can_be_completed():
    group = typer.main.get_command(app)
    context = group.make_context("irl", ["plan"], resilient_parsing=True)
    line = ["plan", "demo", "--rows", "ant", "--rows", ""]
    assert group.resolve_command(context, line)[0] == "plan"
    context.resilient_parsing = False
    with pytest.raises(UsageError, match="--rows is given twice"):
        group.resolve_command(context, line)


def test_stray_arguments_are_no_lists_where_no_list_is_given(irl):
    done = irl("ls", "surplus")
    assert done.code == 2 and "commas" not in done.err


def test_a_list_with_spaces_is_explained(irl, empty_store):
    done = irl("plan", "table1", "--rows", "ant", "lunar-lander", "--store", empty_store.root)
    assert done.code == 2 and "lunar-lander" in done.err
    assert "commas" in done.err.splitlines()[-1]


@pytest.mark.parametrize("tag", ["a b", ""])
def test_a_tag_that_cannot_begin_a_name_is_named(irl, empty_store, tag):
    done = irl("run", "demo", "--tag", tag, "--set", "airl.rounds=3", "--store", empty_store.root)
    assert done.code == 2 and f"--tag {tag!r} cannot begin a name" in done.err


@pytest.mark.parametrize("command", ["plan", "run", "report"])
def test_a_missing_table_lists_the_tables(irl, command):
    done = irl(command)
    assert done.code == 2
    assert {"table1", "figure2", "gates"} <= set(re.findall(r"\w+", done.err.splitlines()[-1]))


@pytest.mark.parametrize(
    "written",
    [
        None,
        "[airl]\npenalty_weight = 30",
        "[interventions.cue-strength.airl]\npenalty_weight = 30",
    ],
)
def test_a_lambda_for_all_methods_is_refused_where_the_table_lists_some(irl, tmp_path, written):
    (tmp_path / "own.toml").write_text(written or "")
    given = (
        ["--settings", tmp_path / "own.toml"] if written else ["--set", "airl.penalty_weight=30"]
    )
    line = ["plan", "control-airl", *given, "--rows", "lunar-lander", "--tag", "x"]
    line += ["--store", tmp_path / "s"]
    done = irl(*line, "--methods", "irm,l2")
    assert done.code == 2 and "l2" in done.err and "irm" not in done.err.splitlines()[0]
    assert irl(*line, "--methods", "irm").code == 0


def test_a_lambda_of_an_intervention_that_is_no_row_is_not_refused(irl, tmp_path):
    (tmp_path / "own.toml").write_text("[interventions.bounce.airl]\npenalty_weight = 30\n")
    line = ["plan", "control-airl", "--settings", tmp_path / "own.toml", "--methods", "l2"]
    line += ["--rows", "lunar-lander", "--tag", "x", "--store", tmp_path / "s"]
    assert irl(*line).code == 0


@pytest.mark.parametrize(
    ("of_all", "of_the_knob", "below"), [("-1e4", "1e4", 2), ("1e4", '"none"', 0)]
)
def test_an_expert_is_compared_with_the_bar_of_its_knob(
    irl, smoke_store, tmp_path, of_all, of_the_knob, below
):
    file = tmp_path / "bars.toml"
    file.write_text(
        f"[expert]\nbar = {of_all}\n"
        '[interventions.engine-power]\nid = ["1x", "1.25x"]\nood = ["1.5x"]\n'
        f"[interventions.engine-power.expert]\nbar = {of_the_knob}\n"
    )
    line = "collect-experts --env lunar-lander --intervention engine-power=1x,1.25x --settings"
    done = irl(*line.split(), file, *SMOKE, "--store", smoke_store.path)
    assert done.code == 0 and done.err.count("bar 10000") == below


@pytest.mark.parametrize("line", ["transfer --reward airl --ood 1.5x", "train-airl --demos demos"])
def test_inputs_from_the_smoke_profile_are_named(irl, smoke_store, line):
    words = [*line.split(), "--dry-run", "--store", smoke_store.path]
    assert "was made with --profile smoke" in irl(*words).err
    assert "was made with" not in irl(*words, *SMOKE).err


@pytest.mark.parametrize(
    ("words", "warned"),
    [
        (["--method", "l2"], True),
        (["--method", "l2", "--penalty-weight", "1"], False),
        (["--method", "l2", "--set", "airl.penalty_weight=1"], False),
        (["--method", "l2", "--choose-penalty", "own"], False),
        (["--method", "input-gradient"], False),
        (["--method", "vrex"], False),
    ],
)
def test_a_lambda_meant_for_another_penalty_is_named(irl, smoke_store, words, warned):
    """The settings' lambda of 1 suits irmv1. Candidates of l2 end at 0.01."""
    line = ["train-airl", "--demos", "demos", *words, "--dry-run", *SMOKE]
    done = irl(*line, "--store", smoke_store.path)
    assert done.code == 0 and ("lambda 1 is outside the range of l2" in done.err) == warned
    assert ("by --penalty-weight," in done.err) == warned


@pytest.mark.parametrize(("knobs", "warned"), [("bounce engine-power", True), ("bounce", False)])
def test_sections_of_two_knobs_that_cannot_be_combined_are_named(
    irl, smoke_store, tmp_path, knobs, warned
):
    own = "[interventions.{0}.transfer]\nceiling = 0.9\n[interventions.{0}.expert]\nbar = 9.0\n"
    (tmp_path / "my.toml").write_text("".join(own.format(knob) for knob in knobs.split()))
    words = ["--settings", tmp_path / "my.toml", "--setting", "engine-power=1.5x,bounce=0.9"]
    words += ["--dry-run", *SMOKE, "--store", smoke_store.path]
    for line, section in (
        (["transfer", "--reward", "airl"], "transfer"),
        (["collect-experts", "--env", "lunar-lander"], "expert"),
        (["evaluate", "--expert", "--env", "lunar-lander"], "expert"),
    ):
        done = irl(*line, *words)
        assert done.code == 0, done.err
        told = f"bounce and engine-power each have their own [{section}]"
        assert done.err.count(told) == warned


@pytest.mark.parametrize(("words", "warned"), [([], True), (["--choose-penalty", "own"], False)])
def test_a_table_names_a_lambda_meant_for_another_penalty(irl, tmp_path, words, warned):
    line = [
        "plan",
        "table1",
        "--rows",
        "lunar-lander.bounce",
        "--methods",
        "erm,l2",
        "--tag",
        "x",
    ]
    done = irl(*line, *words, *SMOKE, "--store", tmp_path / "runs")
    assert done.code == 0 and ("outside the range of l2" in done.err) == warned
    assert ("penalty_weights in a table" in done.err) == warned
