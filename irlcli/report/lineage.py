"""How the artefacts behind a report were made: their inputs, code, libraries and run times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from irlcli.report.parameters import Cell, Code, Parameters, Run


class Origin(NamedTuple):
    """What a run was made with: the code of each attempt, and a set of library versions."""

    code: tuple[Code, ...]
    libraries: str


def lineage(p: Parameters, cells: Sequence[Cell]) -> list[str]:
    """The ids of the evaluations of ``cells`` that exist, and of all behind them; depth first."""
    found: dict[str, None] = {}
    pending = [cell.run for cell in reversed(cells)]
    while pending:
        id16 = pending.pop()
        if id16 in p.runs and id16 not in found:
            found[id16] = None
            pending += reversed(p.runs[id16].inputs)
    return list(found)


def demonstrations(p: Parameters, cells: Sequence[Cell]) -> list[str]:
    """The ids of the datasets that the agents of ``cells`` learned from."""
    return [i for i in lineage(p, cells) if p.runs[i].stage in ("collect-experts", "import")]


def origins(p: Parameters, cells: Sequence[Cell]) -> dict[Origin, list[str]]:
    """The runs behind ``cells`` by what they were made with, the largest group first."""
    groups: dict[Origin, list[str]] = {}
    for id16 in lineage(p, cells):
        run = p.runs[id16]
        groups.setdefault(Origin(run.code, run.libraries), []).append(id16)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


def is_mixed(found: Mapping[Origin, Sequence[str]]) -> bool:
    """Whether runs differ in code or libraries, or attempts of one run differ in code."""
    return len(found) > 1 or any(len(origin.code) > 1 for origin in found)


def commits(runs: Iterable[Run]) -> list[str]:
    """The commits of ``runs``, shortened; ``+`` marks uncommitted changes."""
    states = {state for run in runs for state in run.code}
    return sorted(f"{short(state)}{'+' if state.dirty else ''}" for state in states)


def short(code: Code) -> str:
    """The first ten digits of a commit."""
    return (code.commit or "unknown")[:10]
