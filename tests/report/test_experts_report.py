"""The experts' table, caveats, page and learning curves."""

from types import MappingProxyType, SimpleNamespace

import pandas as pd
import pytest
from report_examples import run_of

from irlcli.report import experts
from irlcli.report.parameters import Cell

ROW = "lunar-lander bounce"
CELLS = (
    Cell(ROW, "random", "id", setting="", run="r"),
    Cell(ROW, "expert", "id", setting="bounce=0.1", run="a"),
    Cell(ROW, "expert", "ood", setting="bounce=0.9", why="no result of train-expert"),
)
RUNS = {"a": run_of(0, inputs=("e",)), "e": run_of(1, "train-expert"), "r": run_of(2)}


def returns(mean, stopped=0):
    return SimpleNamespace(
        mean_return=mean,
        std_return=5.0,
        mean_progress=None,
        mean_length=300.0,
        terminated=20,
        episodes=20,
        stopped=stopped,
    )


def summarised(cells=CELLS, steps=MappingProxyType({ROW: 1000})):
    evaluated = {
        ("expert", "lunar-lander", "bounce=0.1"): returns(250.0),
        ("random", "lunar-lander", "bounce=0.1"): returns(-200.0),
    }
    return experts.summarise(cells, RUNS, steps, evaluated)


def test_a_setting_has_its_experts_return_and_training():
    found = summarised().set_index("setting")
    there = found.loc["bounce=0.1"]
    assert (there["true_return"], there["random_return"], there["seconds"]) == (250.0, -200.0, 90.0)
    assert (there["use"], there["status"], there["commit"]) == ("trained in", "done", "c0ffee")
    assert there["steps"] == 1000
    missing = found.loc["bounce=0.9"]
    assert missing["use"] == "held out" and pd.isna(missing["true_return"])
    table = experts.text_table(summarised())
    assert [row[2] for row in table.rows] == ["250 ± 5", "no result of train-expert"]


@pytest.mark.parametrize(("bar", "low"), [(200.0, 0), (260.0, 1)])
def test_caveats_name_missing_experts_and_those_below_their_bar(bar, low):
    found = experts.caveats(CELLS, summarised(), {ROW: bar, "lunar-lander friction": 999.0})
    assert found[-1] == "Missing: the evaluations of 1 of 2 experts: lunar-lander bounce=0.9."
    assert len(found) == 1 + low
    assert not low or "bounce=0.1 (250.0 of 260)" in found[0]


def test_episodes_of_an_expert_that_an_error_stopped_are_counted():
    evaluated = {("expert", "lunar-lander", "bounce=0.1"): returns(250.0, stopped=3)}
    table = experts.summarise(CELLS, RUNS, {ROW: 1000}, evaluated)
    found = experts.caveats(CELLS, table, {})
    assert any("stopped by an error" in c and "bounce=0.1 (3 of 20)" in c for c in found)


def test_an_intervention_may_hold_no_value_out(tmp_path):
    cells = [cell for cell in CELLS if cell.measure == "id"]
    found = summarised(cells)
    assert list(found["use"]) == ["trained in"]
    assert experts.caveats(cells, found, {}) == []
    page = experts.markdown("irl report experts", experts.text_table(found), [])
    assert "| lunar-lander bounce=0.1 | trained in | 250 ± 5 |" in page
    curve = pd.DataFrame({"steps": [0, 1000], "true_return": [0.0, 1.0], "progress": [None] * 2})
    for place, curves in (("one", {"lunar-lander bounce=0.1 learning": curve}), ("none", {})):
        (tmp_path / place).mkdir()
        experts.draw(tmp_path / place, cells, curves)
        assert {file.name for file in (tmp_path / place).iterdir()} == {
            "experts.png",
            "experts.pdf",
        }
