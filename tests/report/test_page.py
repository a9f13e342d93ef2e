"""A report as HTML, Markdown and LaTeX, and its plots."""

import json
import re
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import pandas as pd
import pytest
from msgspec.structs import replace
from report_examples import BOUNCE, complete, example, metrics, run_of

from irlcli.report import page, plots
from irlcli.report.agents import colours
from irlcli.report.build import as_json, build


class Tags(HTMLParser):
    """Checks that tags close in order, and collects attributes and text."""

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


def parsed(html):
    tags = Tags()
    tags.feed(html)
    assert tags.open == []
    return tags


def test_the_page_is_well_formed_and_self_contained():
    p, points = example(complete())
    p = replace(p, title="<script>alert(1)</script> & co")
    report = build(p, points, {}, {})
    html = page.html(p, report, "<svg><g/></svg>", {}, {"curves": "<svg></svg>"})
    tags = parsed(html)
    assert not [a for a in tags.attributes if a[0] == "script" or a[1] in ("src", "onload")]
    links = [value for _, name, value in tags.attributes if name == "href"]
    ids = {value for _, name, value in tags.attributes if name == "id"}
    assert links and all(link.startswith("#") and link[1:] in ids for link in links)
    assert not re.search(r"url\(|@import|http", html)
    text = "".join(tags.text)
    assert "<script>alert(1)</script> & co" in text
    for wanted in ("156.8 ± 53.1", "4.0 ± 2.6", p.cells[0].run, "c0ffee"):
        assert wanted in text
    assert "prefers-color-scheme: dark" in html and "@media print" in html


def test_a_run_that_was_made_from_itself_ends_its_lineage():
    p, points = example(complete())
    crafted = p.cells[0].run
    p = replace(p, runs=p.runs | {crafted: run_of(0, inputs=(crafted,))})
    html = page.html(p, build(p, points, {}, {}), "<svg/>", {}, {})
    assert f"{crafted}  made from itself" in "".join(parsed(html).text)


def test_what_came_out_and_caveats_are_in_every_format():
    p, points = example(complete() | {(BOUNCE, "irm", "transfer"): [5.0, None, None]})
    report = build(p, points, {}, {})
    html = "".join(parsed(page.html(p, report, "<svg/>", {}, {})).text)
    assert report.caveats and report.in_short
    for line in report.caveats + report.in_short:
        assert all(line in text for text in (html, page.markdown(p, report), page.latex(report)))
    assert as_json(report)["caveats"] == report.caveats
    assert as_json(report)["in_short"] == report.in_short


def test_json_has_no_nan():
    values = complete() | {(BOUNCE, "irm", "transfer"): [5.0, None, None]}
    learning = {(BOUNCE, "irm", 0): metrics(1.0, 0.1, 4.0).assign(optimised_cross_entropy=0.0)}
    found = as_json(build(*example(values), {}, learning))
    assert json.loads(json.dumps(found, allow_nan=False))["discriminators"][0]["share"] is None


def test_only_runs_behind_a_number_are_counted():
    p, points = example(complete())

    def counted(p):
        text = page.markdown(p, build(p, points, {}, {}))
        return re.search(r"from \d+ runs that took \S+,", text)[0]

    assert counted(p).startswith(f"from {len(p.runs)} runs")
    assert counted(replace(p, runs=p.runs | {"e" * 16: run_of(0)})) == counted(p)


def test_markdown_tables_are_rectangular():
    p, points = example(complete())
    report = build(p, points, {}, {})
    blocks = re.findall(r"(?:^\|.*\|\n)+", page.markdown(p, report), re.MULTILINE)
    assert len(blocks) == len(report.tables)
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1


@pytest.mark.parametrize(
    ("method", "markers"),
    [("irm", 2 * 2 * 3), ("mine", 1 * 1 * 3)],  # rows, measures, seeds
)
def test_every_seed_is_plotted(tmp_path, method, markers):
    """``mine`` is in no table of methods."""
    values = complete() | {(BOUNCE, method, "transfer"): [1.0, 2.0, 4.0]}
    p, points = example(values, methods=("erm", method))
    svg = plots.draw_points(tmp_path, p, build(p, points, {}, {}))
    parsed(svg)
    drawn = {
        name: svg.count(f"fill: {colour.lower()}; fill-opacity: 0.6")
        for name, colour in colours(p.methods).items()
    }
    assert drawn == {"erm": 2 * 2 * 3, method: markers}
    assert plots.draw_points(tmp_path, p, build(p, points, {}, {})) == svg
    assert (tmp_path / "table1.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "table1.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("methods", [("erm", "irm"), ("erm", "irm", "erm-balanced")])
def test_nothing_reaches_the_edge_of_a_picture(tmp_path, rows, methods):
    """What is cut off, as a legend that is too wide, leaves ink in the outermost pixels."""
    full = example(complete())[0]
    p, points = example(complete(), rows=full.rows[:rows], methods=methods)
    plots.draw_points(tmp_path, p, build(p, points, {}, {}))
    image = plt.imread(tmp_path / "table1.png")[..., :3]
    edges = [image[0], image[-1], image[:, 0], image[:, -1]]
    assert all((edge == 1.0).all() for edge in edges)
    assert (image < 1.0).any()


def test_the_student_in_distribution_is_plotted_if_nothing_else_is_measured(tmp_path):
    p, points = example(complete(), measures=("id",))
    svg = plots.draw_points(tmp_path, p, build(p, points, {}, {}))
    assert "true return, id" in svg


def test_policies_of_the_training_settings_are_not_drawn_under_the_held_out_one(tmp_path):
    p, points = example(complete(), measures=("transfer", "transfer-id"))
    unseen = f"{p.rows[0].env} {p.rows[0].unseen}"
    svg = plots.draw_points(tmp_path, p, build(p, points, {}, {}))
    # Titles of two panels.
    assert svg.count(unseen) == 1 and svg.count(BOUNCE) == 2
    p, points = example(complete(), measures=("transfer-id",))
    svg = plots.draw_points(tmp_path, p, build(p, points, {}, {}))
    assert unseen not in svg and ">random<" not in svg


def test_learning_curves_have_a_plot_per_row_and_kind():
    p, _ = example(complete())
    recorded = metrics(0.9, 0.1, 1.0)
    curve = recorded.assign(
        steps=recorded["round"] * 1000, true_return=recorded["round"], progress=float("nan")
    )
    learning = {f"{BOUNCE} {method} 0 reward-learning": curve for method in p.methods}
    learning[f"{BOUNCE} irm 0 transfer-learning"] = pd.DataFrame(
        {"setting": "a", "steps": [0, 1000], "true_return": [1.0, 2.0]}
    )
    found = plots.learning_curves(p, learning)
    assert [title.partition(", ")[0] for title in found] == [BOUNCE, BOUNCE]
    for svg in found.values():
        parsed(svg)
