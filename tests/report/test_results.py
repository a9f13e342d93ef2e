"""A report's numbers and reservations, from evaluations made up here."""

import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace

from irlcli.configs import Config
from irlcli.report import pages, results
from irlcli.report.tables import latex_table, latex_text, markdown_table
from irlcli.stages.results import Cell, Code, Others, Parameters, Row, Run

SETTINGS = {
    "expert": {"total_steps": 1000},
    "demonstrations": {"episodes": 20},
    "airl": {"total_steps": 2000, "penalty_weight": 1.0},
    "transfer": {"total_steps": 3000},
    "evaluation": {"episodes": 20},
}
ROWS = tuple(
    Row(
        env="lunar-lander",
        knob=knob,
        trained=tuple(f"{knob}={v}" for v in trained),
        unseen=f"{knob}={unseen}",
        demonstrations=(20, 20),
        settings=SETTINGS,
    )
    for knob, trained, unseen in (
        ("bounce", ("0.1", "0.5"), "0.9"),
        ("engine-power", ("1x", "1.25x"), "1.5x"),
    )
)


def evaluation(number, commit="c0ffee", dirty=None, inputs=()):
    return Run(
        stage="evaluate",
        about=f"run {number}",
        code=(Code(commit=commit, dirty=dirty),),
        libraries="lib",
        seconds=90.0,
        resumed=0,
        inputs=inputs,
    )


def made(values, **more):
    """A plan and its points; ``values`` maps (row, agent, measure) to a return for each seed."""
    cells, points, runs = [], [], {}
    for (row, agent, measure), returns in values.items():
        for seed, value in enumerate(returns):
            learns = agent in ("erm", "irm", "erm-balanced", "irm-shuffled")
            id16 = f"{len(runs):016x}"
            there = value is not None
            cells.append(
                Cell(
                    row,
                    agent,
                    measure,
                    seed if learns else None,
                    run=id16 if there else "",
                    why="" if there else "train-airl has not run",
                )
            )
            if there:
                runs[id16] = evaluation(len(runs))
                points.append(
                    {
                        **{"row": row, "agent": agent, "measure": measure},
                        **{"seed": seed if learns else None, "setting": "bounce=0.9"},
                        **{"true_return": value, "progress": None, "episodes": 20},
                        "learned_return": None,
                        "evaluation": id16,
                    }
                )
    given = {"rows": ROWS, "methods": ("erm", "irm"), "seeds": (0, 1, 2), "others": ()} | more
    plan = Parameters(
        kind="table1",
        title="Table 1",
        command="irl report table1",
        measures=("transfer", "zero-shot", "id"),
        cells=tuple(cells),
        runs=runs,
        libraries={"lib": {"numpy": "2"}},
        **given,
    )
    return plan, pd.DataFrame(points)


def full(student=200.0):
    values = {}
    for row in ("lunar-lander bounce", "lunar-lander engine-power"):
        values |= {
            (row, "expert", "ood"): [250.0],
            (row, "random", "ood"): [-200.0],
            (row, "idle", "ood"): [-120.0],
            (row, "expert", "id"): [250.0],
            (row, "carried", "ood"): [90.0, 130.0],
            (row, "carried", "id"): [200.0, 300.0],
            (row, "erm", "id"): [student - 1, student, student + 1],
            (row, "irm", "id"): [240.0, 241.0, 242.0],
            (row, "erm", "zero-shot"): [100.0, 110.0, 120.0],
            (row, "irm", "zero-shot"): [150.0, 160.0, 175.0],
            (row, "erm", "transfer"): [1.0, 2.0, 3.0],
            (row, "irm", "transfer"): [2.0, 3.0, 7.0],
        }
    return values


def cell(report, row, agent, measure):
    c = report.cells
    return c[(c["row"] == row) & (c["agent"] == agent) & (c["measure"] == measure)].iloc[0]


def test_a_complete_table_has_numbers_and_nothing_to_say():
    report = results.build(*made(full()), {}, {})
    found = cell(report, "lunar-lander bounce", "irm", "transfer")
    assert (found["mean"], found["seeds"], found["seeds_wanted"]) == (4.0, 3, 3)
    assert found["deviation"] == pytest.approx(7**0.5)
    first = report.comparisons.iloc[0]
    assert (first["row"], first["x"], first["y"]) == ("lunar-lander bounce", "irm", "erm")
    assert first["difference"] == 2.0
    # Two rows with the same p: Holm doubles it.
    assert first["p_welch_holm"] == pytest.approx(2 * first["p_welch"])
    assert first["improvement"] == pytest.approx((1.5 + 2.5 + 3) / 9)
    assert report.notes == []


def test_experts_carried_over_are_one_number_and_no_sample():
    report = results.build(*made(full()), {}, {})
    row = "lunar-lander bounce"
    unseen, trained = (cell(report, row, "carried", m) for m in ("ood", "id"))
    assert (unseen["mean"], unseen["seeds"], unseen["seeds_wanted"]) == (110.0, 1, 1)
    assert pd.isna(unseen["deviation"]) and pd.isna(unseen["of_expert"])
    assert (trained["mean"], trained["of_expert"]) == (250.0, 1.0)
    assert trained["imitated"] is pd.NA
    for table, value in zip(report.tables, ("110.0", "110.0", "250.0"), strict=False):
        column = table.columns.index("experts, carried over")
        assert table.rows[0][column] == value
    share = next(r for r in report.tables[2].rows if r[1] == "of the expert")
    assert share[report.tables[2].columns.index("experts, carried over")] == "100%"
    partly = full() | {(row, "carried", "id"): [200.0, None]}
    assert cell(results.build(*made(partly), {}, {}), row, "carried", "id")["of_expert"] is pd.NA


def test_the_papers_numbers_stand_under_ours():
    report = results.build(*made(full()), {}, {})
    table = report.tables[0]
    ours, theirs = table.rows[:2]
    assert ours[:4] == ["lunar-lander bounce = 0.9", "return", "2.0 ± 1.0", "4.0 ± 2.6"]
    assert theirs[1:5] == ["paper", "93.1 ± 30.6", "156.8 ± 53.1", "230.3 ± 15.6"]
    assert theirs[table.columns.index("p")] == "0.057"
    (comparisons,) = (t for t in report.tables if t.title == "Comparisons")
    assert comparisons.rows[0][comparisons.columns.index("Student, paper")] == "0.049"


@pytest.mark.parametrize(
    ("student", "expert", "expected"),
    [
        *((80.0, 100.0, True), (79.9, 100.0, False), (-11.9, -10.0, True), (-12.1, -10.0, False)),
        *((None, 1.0, None), (1.0, None, None), (0.0, 0.0, True)),
    ],
)
def test_imitation_is_within_a_fifth_of_the_expert(student, expert, expected):
    assert results.imitates(student, expert) is expected


def test_a_student_that_did_not_imitate_is_marked_everywhere():
    report = results.build(*made(full(student=199.0)), {}, {})
    assert not cell(report, "lunar-lander bounce", "erm", "id")["imitated"]
    assert cell(report, "lunar-lander bounce", "irm", "id")["imitated"]
    assert cell(report, "lunar-lander bounce", "erm", "id")["of_expert"] == pytest.approx(0.796)
    assert set(report.comparisons["not_imitated"]) == {"erm"}
    marked = [
        n for n in report.notes if n.startswith("Not imitated: lunar-lander bounce, AIRL-ERM")
    ]
    assert len(marked) == 1 and "80% of the expert" in marked[0]
    (table,) = (t for t in report.tables if t.title.startswith("In distribution"))
    assert table.rows[0][2] == "199.0 ± 1.0 †"


def recorded(accuracy, penalty, weight):
    """Metrics of ten rounds in two settings; all but the last say nothing of the end."""
    rounds = range(10)
    return pd.DataFrame(
        {
            "round": k,
            "setting": setting,
            "accuracy": accuracy if k == 9 else 0.0,
            "cross_entropy": (0.1 if setting == "a" else 0.3) if k == 9 else 9.0,
            "penalty": penalty if k == 9 else 9.0,
            "penalty_weight": weight if k == 9 else 0.0,
            "mean_abs_logit": 50.0 if k == 9 else 0.0,
        }
        for k in rounds
        for setting in "ab"
    )


def test_a_discriminator_that_leaves_the_penalty_nothing_is_told():
    row, other = "lunar-lander bounce", "lunar-lander engine-power"
    learning = {
        # (8 * 0.001 + 0.5 * 0.004) / 2 of 0.2, not the product of the means.
        (row, "irm", 0): recorded(0.94, 0.001, 8.0),
        (row, "irm", 1): recorded(0.98, 0.004, 0.5),
        (row, "erm", 0): recorded(0.99, 0.002, 0.0),
        (other, "irm", 0): recorded(0.60, 0.5, 4.0),
    }
    report = results.build(*made(full()), {}, learning)
    (note,) = report.notes
    assert note.startswith("Saturated: lunar-lander bounce, AIRL-IRM: ")
    assert "96.0% of the samples" in note and "2.5% of the cross-entropy" in note
    (table,) = (t for t in report.tables if t.title == "The discriminator at the end")
    assert table.rows == [
        [row, "AIRL-ERM", "1", "99.0%", "0.200", "0.0020", "", "50.0"],
        [row, "AIRL-IRM", "2", "96.0%", "0.200", "0.0025", "2.5%", "50.0"],
        [other, "AIRL-IRM", "1", "60.0%", "0.200", "0.5000", "1000.0%", "50.0"],
    ]


def paid(values):
    """The report on :func:`full` with (new policy, expert) of each seed by (row, method)."""
    whole = full()
    for (row, method), pairs in values.items():
        whole[row, method, results.EXPERT_PAID] = [250.0 for _ in pairs]
    plan, points = made(whole)
    for (row, method), pairs in values.items():
        for measure, column in (("transfer", 0), (results.EXPERT_PAID, 1)):
            chosen = (points["row"] == row) & (points["agent"] == method)
            chosen &= points["measure"] == measure
            points.loc[chosen, "learned_return"] = [pair[column] for pair in pairs]
    return results.build(plan, points, {}, {})


def test_a_new_policy_that_falls_short_is_told_with_what_it_is_paid():
    row = "lunar-lander bounce"
    report = paid({(row, "erm"): [(4, 1), (5, 1), (9, 10)], (row, "irm"): [(1, 2), (1, 1), (1, 2)]})
    assert report.paid.to_dict("records") == [
        {
            **{"row": row, "agent": agent, "seeds": 3, "policy": policy, "expert": expert},
            **{"short": 3, "short_paid_more": more},
        }
        for agent, policy, expert, more in (("erm", 6.0, 4.0, 2), ("irm", 1.0, 5 / 3, 0))
    ]
    short = [note for note in report.notes if note.startswith("Short of the expert")]
    assert short == [
        f"Short of the expert: {row}, AIRL-{agent}: 3 of 3 new policies. The learned reward pays "
        f"{more} of them more than it would pay the setting's expert, {3 - more} less."
        for agent, more in (("ERM", 2), ("IRM", 0))
    ]
    (table,) = (t for t in report.tables if t.title == "What the learned reward pays")
    assert [line[2:] for line in table.rows] == [
        ["3", "6.0", "4.0", "3/3", "2/3"],
        ["3", "1.0", "1.7", "3/3", "0/3"],
    ]
    # The expert's returns under the rewards are in no cell.
    assert set(report.cells["measure"]) == {"ood", "id", "transfer", "zero-shot"}


def test_a_new_policy_as_good_as_the_expert_needs_no_excuse():
    row = "lunar-lander bounce"
    for returns, short in (([240.0, 250.0, 260.0], 0), ([280.0, 0.0, 0.0], 2)):
        whole = full() | {(row, "erm", "transfer"): returns}
        whole[row, "erm", results.EXPERT_PAID] = [250.0] * 3
        plan, points = made(whole)
        # The first seed is paid more: that counts only if it falls short.
        paid_more = (points["measure"] == "transfer") & (points["seed"] == 0)
        points["learned_return"] = paid_more.astype(float)
        report = results.build(plan, points, {}, {})
        assert [(r.agent, r.short, r.short_paid_more) for r in report.paid.itertuples()] == [
            ("erm", short, 0)
        ]
        assert any(note.startswith("Short of") for note in report.notes) == (short > 0)


def test_seeds_without_both_evaluations_are_left_out_of_what_is_paid():
    row = "lunar-lander bounce"
    whole = full()
    whole[row, "erm", results.EXPERT_PAID] = [250.0, None, 250.0]
    plan, points = made(whole)
    points["learned_return"] = 2.0
    points.loc[(points["measure"] == "transfer") & (points["seed"] == 0), "learned_return"] = None
    report = results.build(plan, points, {}, {})
    assert [(r.agent, r.seeds) for r in report.paid.itertuples()] == [("erm", 1)]


def test_a_share_of_nothing_is_no_number():
    row = "lunar-lander bounce"
    certain = recorded(1.0, -0.0001, 4.0).assign(cross_entropy=0.0)
    report = results.build(*made(full()), {}, {(row, "irm", 0): certain})
    (note,) = report.notes
    assert "lambda times the penalty is - of the cross-entropy" in note
    (table,) = (t for t in report.tables if t.title == "The discriminator at the end")
    assert table.rows[0][5:7] == ["-0.0001", "-"]


def test_missing_seeds_are_counted_and_one_seed_has_no_p():
    values = full()
    values["lunar-lander bounce", "irm", "transfer"] = [5.0, None, None]
    values["lunar-lander engine-power", "irm", "transfer"] = [None] * 3
    report = results.build(*made(values), {}, {})
    assert report.tables[0].rows[0][3] == "5.0 (1/3)"
    c = report.comparisons[report.comparisons["measure"] == "transfer"]
    assert c["p_welch"].isna().all() and c["p_welch_holm"].isna().all()
    assert "one seed" in c.iloc[0]["why"] and "no seed" in c.iloc[1]["why"]
    assert any(
        n.startswith("Missing: lunar-lander bounce: 24 of 26") and "AIRL-IRM 1, 2" in n
        for n in report.notes
    )
    assert any(n.startswith("No p-value: lunar-lander bounce: 1 of 3") for n in report.notes)


def test_runs_that_cannot_be_told_apart_are_named():
    same = {("irm", s): np.array([1.0, 2.0 + (s == 2)]) for s in range(3)}
    report = results.build(*made(full()), {("lunar-lander bounce", "transfer"): same}, {})
    (note,) = report.notes
    assert note.startswith("Identical: lunar-lander bounce, transfer: AIRL-IRM seed 0, AIRL-IRM")
    assert "seed 2" not in note
    methods = {("irm", 0): same["irm", 0], ("erm", 0): same["irm", 0]}
    report = results.build(*made(full()), {("lunar-lander bounce", "id"): methods}, {})
    assert "AIRL-IRM seed 0, AIRL-ERM seed 0 have the same returns" in report.notes[0]


def test_other_commits_behind_a_cell_are_marked_also_far_behind_it():
    plan, points = made(full())
    old = Run(
        **{
            **{f: getattr(evaluation(0), f) for f in Run.__struct_fields__},
            "code": (Code(commit="0ld", dirty=None),),
        }
    )
    (target,) = (
        c
        for c in plan.cells
        if (c.row, c.agent, c.measure, c.seed) == ("lunar-lander bounce", "irm", "transfer", 2)
    )
    runs = {**plan.runs, "parent": evaluation(1, inputs=("expert",)), "expert": old}
    runs[target.run] = evaluation(2, inputs=("parent",))
    report = results.build(replace(plan, runs=runs), points, {}, {})
    assert cell(report, "lunar-lander bounce", "irm", "transfer")["mixed"]
    assert not cell(report, "lunar-lander bounce", "erm", "transfer")["mixed"]
    assert report.tables[0].rows[0][3].endswith("‡")
    (note,) = report.notes
    assert note.startswith("Mixed: lunar-lander bounce") and "commit 0ld" in note


def test_uncommitted_changes_count_as_another_code():
    plan, points = made(full())
    runs = dict(plan.runs)
    runs[plan.cells[0].run] = evaluation(0, dirty="abc")
    notes = results.build(replace(plan, runs=runs), points, {}, {}).notes
    assert len(notes) == 1 and "with changes abc" in notes[0]


def test_runs_made_otherwise_are_counted_and_named():
    others = Others(stage="train-airl", about="x irm", why="seed 1 instead of 0", ids=("aa", "bb"))
    (note,) = results.build(*made(full(), others=(others,)), {}, {}).notes
    assert note == "Left out: 2 runs of train-airl, x irm (aa, bb): seed 1 instead of 0."


class Tags(HTMLParser):
    """Checks that tags close in order, and collects attributes."""

    VOID = frozenset({"meta", "br", "img", "link"})

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.text = [], [], []

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, *a) for a in attributes]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.attributes += [(tag, *a) for a in attributes]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def parsed(page):
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    return tags


def test_the_page_is_whole_and_needs_nothing_else():
    plan, points = made(full(), others=())
    plan = replace(plan, title="<script>alert(1)</script> & co")
    report = results.build(plan, points, {}, {})
    page = pages.html(plan, report, "<svg><g/></svg>", {"curves": "<svg></svg>"})
    tags = parsed(page)
    assert not [a for a in tags.attributes if a[0] == "script" or a[1] in ("src", "onload")]
    links = [value for _, name, value in tags.attributes if name == "href"]
    ids = {value for _, name, value in tags.attributes if name == "id"}
    assert links and all(link.startswith("#") and link[1:] in ids for link in links)
    assert not re.search(r"url\(|@import|http", page)
    text = "".join(tags.text)
    assert "<script>alert(1)</script> & co" in text
    for wanted in ("156.8 ± 53.1", "4.0 ± 2.6", plan.cells[0].run, "c0ffee"):
        assert wanted in text
    assert "prefers-color-scheme: dark" in page and "@media print" in page


def test_markdown_and_latex_escape_what_they_must():
    assert markdown_table(["a"], [["x|y"]]).splitlines()[-1] == "| x\\|y |"
    assert latex_text("50 % of a_b & {c} ± 1 < 2") == (r"50 \% of a\_b \& \{c\} $\pm$ 1 $<$ 2")
    table = latex_table(["a", "b"], [["1", "2"]], "C")
    assert table.index(r"\toprule") < table.index(r"\midrule") < table.index(r"\bottomrule")
    assert "a & b \\\\" in table and r"\begin{tabular}{ll}" in table


def test_a_latex_table_longer_than_a_page_breaks():
    table = latex_table(["a", "b"], [["1", "2"]] * 60, "C")
    assert r"\begin{longtable}{ll}" in table and r"\begin{table}" not in table
    assert r"\caption{C} \\" in table and table.count("1 & 2") == 60


def test_what_nothing_stands_on_is_not_counted():
    plan, points = made(full())
    said = re.search(
        r"on \d+ runs, \S+ in all", pages.markdown(plan, results.build(plan, points, {}, {}))
    )
    more = replace(plan, runs=plan.runs | {"e" * 16: evaluation(0)})
    again = re.search(
        r"on \d+ runs, \S+ in all", pages.markdown(more, results.build(more, points, {}, {}))
    )
    assert said[0].startswith(f"on {len(plan.runs)} runs") and again[0] == said[0]


def test_markdown_tables_are_rectangular():
    plan, points = made(full())
    text = pages.markdown(plan, results.build(plan, points, {}, {}))
    blocks = re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)
    assert len(blocks) == len(results.build(plan, points, {}, {}).tables)
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_settings_of_the_rows_are_those_that_the_budgets_read():
    import msgspec

    tree = msgspec.to_builtins(Config())
    for stage, values in SETTINGS.items():
        assert set(values) <= set(tree[stage])


def test_durations_are_read_by_people():
    assert [results.duration(s) for s in (0, 59.6, 61, 3725)] == ["0:00", "1:00", "1:01", "1:02:05"]
