"""Returns of evaluations, as a table."""

from collections.abc import Sequence

from irlcli.cli.console import number, print_table
from irlcli.report.returns import EvaluationRun, rows


def print_rows(evaluations: Sequence[EvaluationRun], stderr: bool = False) -> None:
    """A table row for each agent and setting."""
    columns = ["agent", "setting", "true return", "sd over seeds", "progress", "learned return"]
    columns += ["seeds", "episodes each", "stopped by an error"]
    table = [
        [
            row.agent,
            f"{row.env} {row.setting}",
            number(row.mean),
            number(row.deviation),
            number(row.progress),
            number(row.learned),
            str(len(row.returns)),
            str(row.episodes),
            f"{row.stopped[0]} of {row.stopped[1]}" if row.stopped[0] else "-",
        ]
        for row in rows(evaluations)
    ]
    optional = ("progress", "learned return", "stopped by an error")
    print_table(columns, table, stderr=stderr, optional=optional)
