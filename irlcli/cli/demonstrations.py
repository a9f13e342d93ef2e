"""Demonstrations that a command made: what they are worth, by setting."""

from irlcli.cli.console import number, print_table
from irlcli.cli.session import StageSession
from irlcli.data.descriptions import DemonstrationSummary
from irlcli.requests.collect import summary
from irlcli.stages.base import Request


def deliver_demonstrations(
    session: StageSession, request: Request, name: str | None
) -> DemonstrationSummary | None:
    """Run ``request``, and print a table beside its artefact. None with ``--dry-run``."""
    import msgspec

    artefacts = session.deliver(
        [request],
        name,
        lambda made: {"demonstrations": msgspec.to_builtins(summary(session, made).settings)},
    )
    if not artefacts:
        return None
    found = summary(session, artefacts[0])
    if not session.as_json:
        _print(found)
    return found


def _print(found: DemonstrationSummary) -> None:
    columns = ["demonstrations", "true return", "sd", "progress", "length", "episodes"]
    table = [
        [
            f"{found.env} {row.setting}",
            number(row.mean_return),
            number(row.std_return),
            number(row.mean_progress),
            f"{row.mean_length:.0f}",
            str(row.episodes),
        ]
        for row in found.settings
    ]
    print_table(columns, table, stderr=True, optional=("progress",))
