"""``irl report returns`` through the command line: what shares a row, and what does not."""

import json

SMOKE = ["--profile", "smoke", "--quiet"]


def test_evaluations_from_other_start_states_do_not_share_a_row(irl, store_copy):
    """They would differ by their start states and look like a deviation over seeds."""
    common = ["--store", store_copy.path]
    done = irl("evaluate", "--policy", "moved", "--seed", 1, "--name", "again", *SMOKE, *common)
    assert done.code == 0, done.err
    rows = json.loads(irl("report", "returns", "score", "again", "--json", *common).out)["rows"]
    assert [row["agent"].partition(", ")[2] for row in rows] == [
        "evaluate.seed 0",
        "evaluate.seed 1",
    ]


def test_a_mistyped_report_is_suggested(irl, smoke_store):
    done = irl("report", "return", "score", "--store", smoke_store.path)
    assert done.code == 2 and "did you mean 'returns'" in done.err
    known = irl("report", "table1", "score", "--store", smoke_store.path)
    assert known.code == 2 and "table1 takes no references" in known.err
