"""docs/notebook.ipynb runs from a clone, and shows each stage once."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

CHECKOUT = Path(__file__).parent.parent.parent
PAGE = CHECKOUT / "docs" / "notebook.ipynb"


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """The notebook after its cells ran beside the zoo. A cell that raises fails here."""
    clone = tmp_path_factory.mktemp("clone")
    (clone / "docs").mkdir()
    (clone / "zoo").symlink_to(CHECKOUT / "zoo")
    notebook = nbformat.read(PAGE, as_version=4)
    where = {"metadata": {"path": str(clone / "docs")}}
    return NotebookClient(notebook, timeout=300, resources=where).execute()


def lines(notebook, containing):
    """What the first cell with ``containing`` displayed as plain text, each after its last update."""
    cell = next(c for c in notebook.cells if c.cell_type == "code" and containing in c.source)
    assert not [o for o in cell.outputs if o.get("name") == "stderr"]
    shown = [o.data for o in cell.outputs if o.output_type == "display_data"]
    assert all("text/html" not in data for data in shown), "a bar was left behind"
    return [data["text/plain"] for data in shown]


def test_a_stage_leaves_one_line(executed):
    (line,) = lines(executed, "lab.train_airl")
    assert line.startswith("DONE train-airl irm")
    found = lines(executed, "lab.collect_experts")
    assert [line.split()[:2] for line in found] == [
        ["FOUND", "train-expert"],
        ["FOUND", "train-expert"],
        ["FOUND", "collect-experts"],
    ]


def test_the_outputs_are_kept():
    saved = nbformat.read(PAGE, as_version=4)
    counts = [cell.execution_count for cell in saved.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert lines(saved, "lab.train_airl")[0].startswith("DONE train-airl irm")


def test_the_kept_messages_are_those_of_now(executed):
    kept, now = (
        [
            output.text
            for cell in notebook.cells
            for output in cell.get("outputs", [])
            if "text" in output
        ]
        for notebook in (nbformat.read(PAGE, as_version=4), executed)
    )
    # Ids of learned rewards differ between kinds of processor.
    assert [re.sub("[0-9a-f]{16}", "ID", text) for text in kept] == [
        re.sub("[0-9a-f]{16}", "ID", text) for text in now
    ]
