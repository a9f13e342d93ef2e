"""Tables on terminals of any width show every word whole."""

import io
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.cli.console import print_table

WORD = st.text("abcxyz0123456789.-_%±日", min_size=1, max_size=14)
CELL = st.lists(WORD, max_size=4).map(" ".join)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def printed(columns, rows, width: int, title: str = "A title") -> str:
    with pytest.MonkeyPatch.context() as patch:
        terminal = Terminal()
        patch.setattr("sys.stdout", terminal)
        patch.setenv("COLUMNS", str(width))
        patch.setenv("TERM", "xterm")
        print_table(columns, rows, title)
    return re.sub(r"\x1b\[\d*m", "", terminal.getvalue())


@given(st.integers(1, 5).flatmap(lambda n: st.lists(st.tuples(*[CELL] * n), min_size=1, max_size=4)),
       st.integers(20, 160))  # fmt: skip
def test_no_word_is_cut(rows, width):
    columns = ["setting", "", "AIRL-ERM", "training experts", "p"][: len(rows[0])]
    words = printed(columns, rows, width).split()
    for row in rows:
        for cell in row:
            assert set(cell.split()) <= set(words)


def test_a_table_that_does_not_fit_becomes_blocks_that_name_their_columns():
    columns = ["setting", "", "AIRL-ERM", "training experts, reused"]
    rows = [["lunar-lander engine-power = 1.5x", "return", "291.7", "282.5"]]
    wide, narrow = (printed(columns, rows, width) for width in (120, 40))
    assert "│ 291.7" in wide
    assert [line.split() for line in narrow.splitlines()] == [
        ["A", "title"],
        ["lunar-lander", "engine-power", "=", "1.5x", "return"],
        ["AIRL-ERM", "291.7"],
        ["training", "experts,", "reused", "282.5"],
    ]


def test_headings_are_shown_without_rows_and_a_title_is_no_markup():
    assert printed(["setting", "AIRL-ERM"], [], 8).split() == ["A", "title", "setting", "AIRL-ERM"]
    assert "[bold]" in printed(["a column"], [["b"]], 80, title="[bold]T[/]")
