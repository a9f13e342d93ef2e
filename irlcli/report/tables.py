"""Tables of text as Markdown and LaTeX."""

from collections.abc import Iterable, Sequence

# A float that is longer than a page is cut off.
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
    "†": r"\textdagger{}",
    "‡": r"\textdaggerdbl{}",
}


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines
    )


def latex_table(columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> str:
    """A LaTeX table for the package booktabs; if it may not fit a page, also for longtable."""
    body = [columns, *rows]
    lines = [" & ".join(latex_text(cell) for cell in line) + r" \\" for line in body]
    rules = [r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
    captions = [rf"\caption{{{latex_text(caption)}}}"] if caption else []
    form = "l" * len(columns)
    if len(rows) > _PAGE_ROWS:
        captions = [line + r" \\" for line in captions]
        begin = [rf"\begin{{longtable}}{{{form}}}", *captions]
        return "\n".join([*begin, *rules, r"\end{longtable}", ""])
    begin = [r"\begin{table}", r"\centering", *captions, rf"\begin{{tabular}}{{{form}}}"]
    return "\n".join([*begin, *rules, r"\end{tabular}", r"\end{table}", ""])


def latex_text(text: str) -> str:
    """``text`` with what LaTeX would read as commands escaped."""
    return "".join(_LATEX.get(c, c) for c in text)
