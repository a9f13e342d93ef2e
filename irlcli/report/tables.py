"""Tables of text, as Markdown and LaTeX."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

# Titles by which the pages and the terminal find a table.
EVERY_CELL = "Every cell"
REWARD_QUALITY = "Reward quality"
# LaTeX cuts off a float that is longer than a page.
_PAGE_ROWS = 40
_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "<": r"$<$",
    ">": r"$>$",
    "|": r"\textbar{}",
    "†": r"\textdagger{}",
    "‡": r"\textdaggerdbl{}",
}


class Table(NamedTuple):
    """Text in columns. The first ``heads`` columns name the row."""

    title: str
    note: str
    columns: list[str]
    rows: list[list[str]]
    heads: int = 1


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines
    )


def latex_table(columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> str:
    """A LaTeX table for booktabs. One that may not fit a page also needs longtable."""
    body = [columns, *rows]
    lines = [" & ".join(latex_text(cell) for cell in line) + r" \\" for line in body]
    rules = [r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
    title = rf"\caption{{{latex_text(caption)}}}"
    form = "l" * len(columns)
    if len(rows) > _PAGE_ROWS:
        begin = [rf"\begin{{longtable}}{{{form}}}", title + r" \\"]
        return "\n".join([*begin, *rules, r"\end{longtable}", ""])
    begin = [r"\begin{table}", r"\centering", title, rf"\begin{{tabular}}{{{form}}}"]
    return "\n".join([*begin, *rules, r"\end{tabular}", r"\end{table}", ""])


def latex_text(text: str) -> str:
    """``text`` with LaTeX's special characters escaped."""
    return "".join(_LATEX.get(c, c) for c in text)
