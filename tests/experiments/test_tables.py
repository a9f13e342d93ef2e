"""``settings/experiments.toml``: what it holds, and what is refused in it."""

from __future__ import annotations

import pytest

from irlcli.configs import load_config
from irlcli.configs.load import settings_directory
from irlcli.errors import NotFound, UsageError
from irlcli.experiments.tables import load_table, load_tables, narrowed

SOUND = """
[defaults]
methods = ["erm", "irm"]
seeds = [0, 1]
[mine]
title = "Mine"
rows = ["ant.leg-length", "lunar-lander.bounce"]
measures = ["transfer"]
"""


@pytest.fixture
def tables(tmp_path):
    """The tables of a file with the given text."""

    def load(text):
        path = tmp_path / "experiments.toml"
        path.write_text(text)
        return load_tables(path)

    return load


def test_the_shipped_tables_are_the_papers():
    tables = load_tables()
    assert set(tables) == {
        "table1",
        "figure2",
        "figure3",
        "figure4",
        "gates",
        "retraining",
        "retraining-ant",
        "control-airl",
        "control-airl-5",
        "table1-5",
        "demo",
        "mujoco",
        "mujoco-gates",
        "experts",
        "control",
    }
    rows = {name: [str(row) for row in table.rows] for name, table in tables.items()}
    assert rows["table1"] == [
        "lunar-lander.bounce",
        "lunar-lander.engine-power",
        "ant.friction",
        "ant.leg-length",
    ]
    assert rows["figure3"] == ["ant.leg-length", "half-cheetah.friction", "reacher.gravity"]
    assert rows["figure4"] == ["ant.goal-y", "half-cheetah.goal-y"]
    for name in ("table1", "figure3", "figure4"):
        assert tables[name].methods == ("erm", "irm", "erm-balanced", "irm-shuffled")
        assert tables[name].seeds == (0, 1, 2, 3, 4)
    assert tables["table1"].measures == ("transfer", "from-student", "zero-shot", "id")
    assert tables["mujoco"].methods == tables["table1"].methods
    assert tables["mujoco"].seeds == (0, 1, 2) and len(rows["mujoco"]) == 5
    assert set(rows["mujoco-gates"]) <= set(rows["mujoco"])
    assert tables["mujoco-gates"].measures == tables["gates"].measures
    assert (tables["demo"].methods, tables["demo"].seeds) == (("erm", "irm"), (0,))
    assert tables["demo"].settings.name == "lunar-lander.toml"


def test_experts_has_a_row_for_every_intervention_with_experts_of_its_own():
    rows = {str(row) for row in load_table("experts").rows}
    for env in ("ant", "half-cheetah", "lunar-lander", "reacher"):
        listed = load_config(env).interventions
        own = {f"{env}.{knob}" for knob in listed if knob != "cue-strength"}
        assert {row for row in rows if row.startswith(f"{env}.")} == own
    assert not any(row.startswith("gridworld") for row in rows)


def test_a_table_overrides_the_defaults(tables):
    mine = tables(SOUND)["mine"]
    assert (mine.methods, mine.seeds, mine.title) == (("erm", "irm"), (0, 1), "Mine")
    other = tables(SOUND + 'methods = ["irm"]\nseeds = [7]\n')["mine"]
    assert (other.methods, other.seeds) == (("irm",), (7,))


def test_two_tables_do_not_give_two_results_one_name(tables, tmp_path):
    other = SOUND.partition("[mine]")[2].replace("Mine", "Other")
    assert {*tables(f"{SOUND}\n[other]{other}")} == {"mine", "other"}
    weighed = f"{SOUND}\n[other]{other}\npenalty_weights = {{irm = 3}}\n"
    with pytest.raises(UsageError, match=r"'other' has irm in .* with another lambda than 'mine'"):
        tables(weighed)
    (tmp_path / "own.toml").write_text("")
    tables(weighed + 'settings = "own.toml"\n')


ABLATION = """
[{name}]
rows = ["lunar-lander.bounce"]
methods = ["{method}"]
seeds = [0]
measures = ["transfer-id"]
base = "full"
[{name}.variants]
"full" = []
"{variant}" = ["transfer.ceiling={ceiling}"]
"""


def test_variants_are_told_apart_as_the_names_of_steps_are(tables):
    first = ABLATION.format(name="a", method="erm", variant="no ceiling", ceiling="none")
    for method, variant, ceiling, alike in (
        ("erm", "no-ceiling", "0.5", False),
        ("erm", "no-ceiling", "none", True),
        ("gail", "no ceiling", "0.5", True),
        ("erm", "half", "0.5", True),
    ):
        second = ABLATION.format(name="b", method=method, variant=variant, ceiling=ceiling)
        if alike:
            assert {*tables(first + second)} == {"a", "b"}
            continue
        with pytest.raises(UsageError, match=r"'b' has no-ceiling\.erm in .* other overrides"):
            tables(first + second)


def test_a_bank_of_other_policies_is_another_result(tables):
    def table(name, measures, more=""):
        rows = 'rows = ["lunar-lander.bounce"]\nmethods = ["erm"]\nseeds = [0]'
        return f"[{name}]\n{rows}\nmeasures = {measures}\n{more}\n"

    first = table("a", ["transfer", "assess"])
    assert {*tables(first + table("b", ["id", "transfer", "assess"]))} == {"a", "b"}
    assert {*tables(first + table("b", ["transfer-id"], "retrainings = 2"))} == {"a", "b"}
    for measures, more in ((["id", "assess"], ""), (["transfer", "assess"], "retrainings = 2")):
        with pytest.raises(UsageError, match=r"'b' has erm\.assess in .* a bank of other policies"):
            tables(first + table("b", measures, more))


def test_only_what_a_command_takes_is_offered(irl, tmp_path):
    for command, offered in (("plan", False), ("run", False), ("report", True)):
        done = irl(command, "nope", "--store", tmp_path / "runs")
        assert done.code == 2 and ("returns" in done.err) == ("table2" in done.err) == offered


@pytest.mark.parametrize(
    ("old", "new", "message", "hint"),
    [
        ("ant.leg-length", "ant.leg-lenght", "mine.rows: ant has no intervention", "'leg-length'"),
        ("ant.leg-length", "antt.leg-length", "mine.rows: 'antt.leg-length'", "'ant.leg-length'"),
        ("ant.leg-length", "gridworld.blocked", "mine.rows: 'gridworld.blocked'", "ENVIRONMENT."),
        ("ant.leg-length", "ant", "mine.rows: 'ant' names no intervention", "ant.KNOB"),
        ("ant.leg-length", "ant.", "mine.rows: ant has no intervention ''", "known: "),
        (
            'measures = ["transfer"]',
            'measures = ["id"]\nretrainings = 3',
            "mine.retrainings: id retrains no policy",
            "omit",
        ),
        (
            '"Mine"',
            '"Mine"\npenalty_weights = {vrex = 3}',
            "mine.penalty_weights: vrex is not among the methods of mine",
            "add vrex",
        ),
        ("[defaults]", "rows = 3\n[defaults]", "rows: expected a table, found 3", "[NAME]"),
        ("ant.leg-length", "lunar-lander.bounce", "lunar-lander.bounce appears twice", "once"),
        ('"irm"', '"imr"', "mine.methods: unknown 'imr'", "did you mean 'irm'"),
        ('"transfer"', '"tranfer"', "mine.measures: unknown 'tranfer'", "did you mean 'transfer'"),
        ('["transfer"]', "[]", "mine.measures: the list is empty", "at least one"),
        ('["transfer"]', '"transfer"', "mine.measures: expected a list, found text", "settings/"),
        ("measures", "meassures", "unknown field 'mine.meassures'", "did you mean 'measures'"),
        ('measures = ["transfer"]', "", "mine.measures is missing", "fields: "),
        ("[0, 1]", "[0, 0]", "mine.seeds: 0 appears twice", "once"),
        ("[0, 1]", "[-1]", "defaults.seeds[0]: expected a whole number of at", "settings/"),
        ("[0, 1]", "[true]", "defaults.seeds[0]: expected a whole number,", "settings/"),
        ("seeds", "seed", "unknown field 'defaults.seed'", "did you mean 'seeds'"),
        (
            '"Mine"',
            '"Mine"\nretrainings = 0',
            "mine.retrainings: expected a whole number of at",
            "see",
        ),
        ('"Mine"', '"Mine"\nretrainings = true', "mine.retrainings: expected a whole", "see"),
        ("[0, 1]", "[0, 1]\nretrainings = 2", "unknown field 'defaults.retrainings'", "known"),
        ("[mine]", "[table2]", "'table2' is a report of its own", "another name"),
        ("[mine]", "[returns]", "'returns' is a report of its own", "another name"),
        ("[mine]", "[seeds]", "'seeds' is a file of every table's report", "another name"),
        ("ant.leg-length", "none.toml.mass", "none.toml", "environment"),
        ("[mine]", "[Mine]", "'Mine' cannot be the name of a table", "lowercase"),
        ('"Mine"', "3", "mine.title: expected text, found a whole", "see"),
        ('"Mine"', '"Mine"\nkind = "expert"', "mine.kind: unknown 'expert'", "'experts'"),
        ('"Mine"', '"Mine"\nkind = "experts"', "mine.rows: kind 'experts' has no rows", "omit"),
        ('"Mine"', '"Mine"\npenalty_weights = 3', "mine.penalty_weights: expected a table", "see"),
        ('"Mine"', '"Mine"\npenalty_weights = {imr = 3}', "weights: unknown 'imr'", "'irm'"),
        ('"Mine"', '"Mine"\npenalty_weights = {erm = 3}', "weights: unknown 'erm'", "irm"),
        (
            '"Mine"',
            '"Mine"\npenalty_weights = {irm = -1}',
            "weights.irm: expected a number of at",
            "see",
        ),
        (
            '"Mine"',
            '"Mine"\npenalty_weights = {irm = nan}',
            "weights.irm: expected a number of at",
            "see",
        ),
        ('"Mine"', '"Mine"\nsettings = "none.toml"', "none.toml is not a file", "relative"),
        (
            "[mine]",
            '[smoke]\nsettings = "experiments.toml"',
            "'smoke' cannot be the name",
            "another",
        ),
        (
            "[mine]",
            '[x-paper]\nsettings = "experiments.toml"',
            "of --profile paper",
            "another name",
        ),
        ("[mine]", "mine", "is not valid TOML", "example"),
        ("[defaults]", "mine = 3\n[defaults]", "is not valid TOML", "example"),
    ],
)
def test_a_mistake_is_named_with_its_file_and_field(tables, tmp_path, old, new, message, hint):
    assert old in SOUND
    with pytest.raises((UsageError, NotFound)) as caught:
        tables(SOUND.replace(old, new, 1))
    assert str(tmp_path / "experiments.toml") in caught.value.message
    assert message in caught.value.message and "\n" not in caught.value.message
    assert hint in caught.value.hint


def test_rows_are_of_an_environment_or_single():
    table = load_table("table1")

    def rows(*names):
        return [str(row) for row in narrowed(table, rows=names).rows]

    lander, ant = ("lunar-lander.bounce", "lunar-lander.engine-power"), ("ant.friction",)
    assert rows("lunar-lander") == [*lander]
    assert rows(*ant, "lunar-lander.engine-power") == [lander[1], *ant]
    assert rows("lunar-lander", lander[0]) == [*lander]


def test_the_command_line_refuses_what_no_table_has(irl, tmp_path):
    def refused(*words):
        done = irl(*words, "--store", tmp_path / "runs")
        assert done.code == 2 and not done.out
        error, hint = done.err.splitlines()
        assert error.startswith("error: ") and hint.startswith("hint: ")
        assert not (tmp_path / "runs").exists()
        return done.err

    assert "unknown table 'tabel1'" in refused("plan", "tabel1")
    assert "returns has no steps" in refused("plan", "returns")
    assert "did you mean 'table1'" in refused("run", "tabel1")
    assert "did you mean 'irm'" in refused("run", "table1", "--methods", "erm,imr")
    assert "--rows: unknown 'reacher'" in refused("plan", "table1", "--rows", "reacher")
    assert "lunar-lander.bounce" in refused("plan", "table1", "--rows", "lunar-lander.bonce")
    assert "ant appears twice" in refused("plan", "table1", "--rows", "ant,ant")
    assert "the list is empty" in refused("plan", "table1", "--rows", ",")
    absent = irl("plan", "table1", "--rows", "cart.toml")
    assert absent.code == 3 and "cart.toml" in absent.err
    assert "figure2 takes no --rows" in refused("plan", "figure2", "--rows", "ant")
    assert "experts takes no --seeds" in refused("plan", "experts", "--seeds", "1")
    assert "did you mean 'rewards'" in refused("run", "table1", "--until", "reward")
    step = "smoke.lunar-lander.bounce.irm.0.transfr"
    assert "did you mean 'smoke.lunar-lander.bounce.irm.0.transfer'" in refused(
        "run", "table1", "--profile", "smoke", "--only", step
    )
    (tmp_path / "empty.toml").touch()
    for other in (
        ("--set", "airl.penalty_weight=3"),
        ("--settings", tmp_path / "empty.toml"),
        ("--choose-penalty", "1,10"),
    ):
        for command in ("plan", "run"):
            assert "--tag NAME" in refused(command, "table1", "--methods", "irm", *other)
    for command in ("plan", "run"):
        assert "cannot begin a name" in refused(command, "table1", "--tag", "a b")
    assert "the list is empty" in refused("plan", "table1", "--methods", "")
    assert "unknown --until ''" in refused("plan", "table1", "--until", "")
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    for place in ("file", "file/sub", "loop", "loop/sub"):
        for command in ("report", "run"):
            assert "is not a directory" in refused(command, "demo", "--out", tmp_path / place)
    assert "lies in the store" in refused("run", "demo", "--out", tmp_path / "runs" / "out")
    for command in ("report", "run"):
        assert "is not empty" in refused(command, "demo", "--out", tmp_path)
        assert "--out" in refused(command, "demo", "--out", "")
    assert "--until stops before it" in refused("run", "demo", "--until", "demos", "--out", "x")
    for command in ("plan", "run"):
        both = refused(command, "demo", "--only", "x", "--until", "demos")
        assert "--only takes no --until" in both
    one_too_few = [
        "table1",
        "--choose-penalty",
        "own",
        "--tag",
        "x",
        "--rows",
        "lunar-lander.bounce",
    ]
    for method in ("irm-shuffled", "group-dro"):
        told = refused("plan", *one_too_few, "--methods", method)
        assert f"lunar-lander.bounce, {method}: " in told and "2 settings are too few" in told
        assert "--" not in told.splitlines()[-1]
    assert "--choose-penalty" in refused("run", "experts", "--choose-penalty", "1,2", "--tag", "x")
    unweighed = ["table1", "--methods", "erm,erm-balanced", "--choose-penalty", "1,2", "--tag", "x"]
    told = refused("plan", *unweighed)
    assert "no method of erm, erm-balanced has a penalty" in told and "irm" in told.splitlines()[-1]
    five = ["table1-5", "--rows", "lunar-lander.engine-power", "--methods", "irm", "--tag", "x"]
    for worlds in (4, 5):
        unequal = f"airl.ppo.n_envs={worlds}"
        told = refused("plan", *five, "--choose-penalty", "1,2", "--set", unequal)
        assert "a multiple of 20" in told.splitlines()[-1]
    own = tmp_path / "mine.toml"
    own.write_text(SOUND.replace("leg-length", "leg-lenght"))
    assert f"{own}: mine.rows" in refused("plan", "mine", "--experiments", own)
    own.write_text(f"{SOUND}penalty_weights = {{irm = 3}}\n")
    for command in ("plan", "run"):
        assert "add --tag NAME" in refused(command, "mine", "--experiments", own)
    sound = ["plan", "mine", "--experiments", own, "--store", tmp_path / "runs"]
    for more in (["--tag", "x"], ["--methods", "erm"]):
        assert irl(*sound, *more).code == 0
    absent = irl("plan", "mine", "--experiments", tmp_path / "none.toml")
    assert absent.code == 3 and "none.toml" in absent.err and "--experiments" in absent.err


def test_settings_of_another_table_of_a_shipped_name_need_a_tag(irl, tmp_path):
    """Names of steps begin with the name of a table that has settings."""
    shipped = (settings_directory() / "five-settings" / "lunar-lander.toml").read_text()
    own = tmp_path / "mine.toml"
    own.write_text(
        """
        [table1-5]
        rows = ["lunar-lander.bounce"]
        methods = ["erm", "irm"]
        seeds = [0]
        measures = ["transfer"]
        settings = "mine/lunar-lander.toml"
        """
    )
    settings = tmp_path / "mine" / "lunar-lander.toml"
    settings.parent.mkdir()
    words = ["plan", "table1-5", "--experiments", own, "--store", tmp_path / "runs"]
    settings.write_text(shipped)
    assert irl(*words).code == 0
    settings.write_text(f"{shipped}\n[evaluation]\nepisodes = 3\n")
    done = irl(*words)
    assert done.code == 2 and "other settings than the shipped table" in done.err
    assert "--tag NAME" in done.err.splitlines()[-1]
    assert irl(*words, "--tag", "x").code == 0
