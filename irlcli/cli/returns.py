"""Returns of evaluations, as a table."""

from collections.abc import Sequence

from irlcli.cli import console as out
from irlcli.report.returns import EvaluationRun, rows


def print_rows(evaluations: Sequence[EvaluationRun], stderr: bool = False) -> None:
    """A table row for each agent and setting."""
    found = rows(evaluations)
    table = [
        [
            row.agent,
            f"{row.env} {row.setting}",
            f"{row.mean:.1f}",
            number(row.deviation),
            str(len(row.returns)),
            str(row.episodes),
        ]
        for row in found
    ]
    columns = ["agent", "setting", "true return", "sd over seeds", "seeds", "episodes each"]
    optional = {
        "learned return": [row.learned for row in found],
        "progress": [row.progress for row in found],
    }
    # Both after the deviation of the true return.
    for column, values in optional.items():
        if any(value is not None for value in values):
            columns.insert(4, column)
            for cells, value in zip(table, values, strict=True):
                cells.insert(4, number(value))
    out.print_table(columns, table, stderr=stderr)


def number(value: float | None) -> str:
    """``value`` as a table shows it."""
    return "-" if value is None else f"{value:.1f}"
