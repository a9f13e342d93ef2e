"""The tables of a report, and tables as Markdown and LaTeX."""

import msgspec
import pytest
from report_examples import BOUNCE, POWER, column, complete, example, metrics, scored, table

from irlcli.labels import duration
from irlcli.methods import METHODS
from irlcli.report.agents import colours, title
from irlcli.report.build import build
from irlcli.report.parameters import Cell
from irlcli.report.tables import latex_table, latex_text, markdown_table


def test_the_papers_numbers_stand_under_ours():
    found = build(*example(complete()), {}, {})
    transfer = table(found, "Transfer")
    ours, theirs = transfer.rows[:2]
    assert ours[:4] == [f"{BOUNCE} = 0.9", "return", "2.0 ± 1.0", "4.0 ± 2.6"]
    assert theirs[1:5] == ["paper", "93.1 ± 30.6", "156.8 ± 53.1", "230.3 ± 15.6"]
    assert theirs[transfer.columns.index("p")] == "0.057"
    assert column(table(found, "Comparisons"), "Student, paper")[0] == "0.049"


@pytest.mark.parametrize(
    ("chosen", "shown"),
    [
        ({}, "1"),
        ({"irm": 10.0}, "irm: 10"),
        ({"irm 0": 10.0, "irm 1": 0.1, "irm 2": 3.0}, "irm 0: 10, irm 1: 0.1, irm 2: 3"),
        ({"irm 0": 10.0, "irm 2": 3.0}, "1, irm 0: 10, irm 2: 3"),
    ],
)
def test_the_configs_lambda_is_shown_where_a_run_has_it(chosen, shown):
    p, points = example(complete())
    rows = tuple(msgspec.structs.replace(row, chosen=chosen) for row in p.rows)
    p = msgspec.structs.replace(p, rows=rows)
    assert column(table(build(p, points, {}, {}), "Budgets"), "lambda")[0] == shown


def test_reused_experts_stand_in_every_table():
    found = build(*example(complete()), {}, {})
    reused = [column(t, "training experts, reused") for t in found.tables[:3]]
    assert [values[0] for values in reused] == ["110.0", "110.0", "250.0"]
    inside = table(found, "In distribution")
    share = next(r for r in inside.rows if r[1] == "of the expert")
    assert share[inside.columns.index("training experts, reused")] == "100%"


def test_a_student_that_did_not_imitate_is_marked():
    found = build(*example(complete(student=199.0)), {}, {})
    assert table(found, "In distribution").rows[0][2] == "199.0 ± 1.0 †"


def test_missing_seeds_are_counted():
    values = complete() | {(BOUNCE, "irm", "transfer"): [5.0, None, None]}
    assert table(build(*example(values), {}, {}), "Transfer").rows[0][3] == "5.0 (1/3)"


def test_a_mean_over_some_of_the_settings_is_marked_beside_the_missing_seeds():
    values = complete() | {(BOUNCE, "irm", "id"): [5.0, None, None]}
    parameters, points = example(values)
    lacking = Cell(BOUNCE, "irm", "id", 0, setting="another", why="no result of evaluate")
    parameters = msgspec.structs.replace(parameters, cells=(*parameters.cells, lacking))
    found = table(build(parameters, points, {}, {}), "In distribution").rows[0][3]
    assert found.startswith("5.0 (1/3) (part)")


@pytest.mark.parametrize("mark", ["†", "(part)", "exist", "‡", "Progress", "ant"])
def test_marks_that_no_cell_has_are_not_explained(mark):
    assert mark not in build(*example(complete()), {}, {}).tables[0].note


def test_marks_of_any_measure_are_explained_below_the_first():
    values = complete(student=199.0) | {(BOUNCE, "irm", "transfer"): [5.0, None, None]}
    note = build(*example(values), {}, {}).tables[0].note
    assert "†" in note and "n of m seeds" in note and "‡" not in note


def test_learned_returns_stand_side_by_side():
    pairs = {
        (BOUNCE, "erm"): [(4, 1), (5, 1), (9, 10)],
        (BOUNCE, "irm"): [(1, 2), (1, 1), (1, 2)],
    }
    assert [line[2:] for line in table(scored(pairs), "Learned returns").rows] == [
        ["3", "6.0", "4.0", "3/3", "2/3", "3/3"],
        ["3", "1.0", "1.7", "3/3", "1/3", "3/3"],
    ]


def test_the_discriminators_show_fresh_and_optimised_terms():
    learning = {
        (BOUNCE, "irm", 0): metrics(0.94, 0.001, 8.0),
        (BOUNCE, "irm", 1): metrics(0.98, 0.004, 0.5),
        (BOUNCE, "erm", 0): metrics(0.99, 0.0, 0.0),
        (POWER, "irm", 0): metrics(1.0, -0.0001, 4.0).assign(optimised_cross_entropy=0.0),
    }
    found = table(build(*example(complete()), {}, learning), "The discriminator")
    fresh = ["50.0", "0.400", "0.5000"]
    assert found.rows == [
        [BOUNCE, "AIRL-ERM", "1", "99.0%", *fresh, "0.200", "", ""],
        [BOUNCE, "AIRL-IRM", "2", "96.0%", *fresh, "0.200", "0.0025", "2.5%"],
        [POWER, "AIRL-IRM", "1", "100.0%", *fresh, "0.000", "-0.0001", "-"],
    ]


def test_methods_outside_the_table_have_a_title_and_a_colour():
    assert title("irm") == METHODS["irm"].title
    assert title("mine") == "mine"
    found = colours(("mine", "irm", *map(str, range(6))))
    assert found["irm"] == METHODS["irm"].colour
    assert found["mine"] not in {method.colour for method in METHODS.values()}
    assert found["5"] == found["0"] != found["mine"]
    values = complete() | {(BOUNCE, "mine", "transfer"): [1.0, 2.0, 4.0]}
    report = build(*example(values, methods=("erm", "irm", "mine")), {}, {})
    assert column(table(report, "Transfer"), "mine")[0] == "2.3 ± 1.5"


def test_markdown_and_latex_escape_special_characters():
    assert markdown_table(["a"], [["x|y"]]).splitlines()[-1] == "| x\\|y |"
    assert latex_text("mean |logit|") == r"mean \textbar{}logit\textbar{}"
    assert latex_text("50 % of a_b & {c} ± 1 < 2") == (r"50 \% of a\_b \& \{c\} $\pm$ 1 $<$ 2")
    found = latex_table(["a", "b"], [["1", "2"]], "C")
    assert found.index(r"\toprule") < found.index(r"\midrule") < found.index(r"\bottomrule")
    assert "a & b \\\\" in found and r"\begin{tabular}{ll}" in found


def test_a_latex_table_longer_than_a_page_breaks():
    found = latex_table(["a", "b"], [["1", "2"]] * 60, "C")
    assert r"\begin{longtable}{ll}" in found and r"\begin{table}" not in found
    assert r"\caption{C} \\" in found and found.count("1 & 2") == 60


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (61, "1:01"), (3725, "1:02:05")]
)
def test_durations_are_hours_minutes_and_seconds(seconds, text):
    assert duration(seconds) == text
