"""The tables and the picture of the recorded runs."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import pandas as pd

from benchmarks.peers.checks import EPISODES, EVERY, GOALS, first_kept, share
from benchmarks.peers.tasks import METHODS, Task
from irlcli.report.tables import markdown_table

# Okabe and Ito's colours, and Tol's; experts are never in a panel with students.
_COLOURS = ["#0072B2", "#56B4E9", "#E69F00", "#D55E00", "#009E73", "#117733", "#CC79A7", "#882255"]
_NOTE = f"""Median over the seeds, and the range; every value where a seed never got there. A method earns 80 or 90 % of its experts' true return at the first
check at which the mean over the settings of (true return / expert's true return) is at least that, and is so at the next
check, too. The expert's true return is that of the published demonstrations in `zoo/`. Checks: {EPISODES} episodes in
each setting, with the policy's modes as actions, at the first end of a round after each multiple of {EVERY:,} steps. CPU
seconds are those of training, without checks and imports. Steps include those of challengers. A run stops at 90 %, at the limit
of CPU seconds, or where its budget of steps ends (`irl` only). *Kept*: the largest share of two checks in a row. *Stopped
after*: medians.
"""


class Run(NamedTuple):
    """A finished run: its task, its checks (cpu_seconds, steps, returns) and why it ended."""

    task: Task
    about: dict[str, Any]
    checks: list[dict[str, Any]]
    end: str

    @property
    def shares(self) -> list[float]:
        """Of the experts' true return, at each check."""
        return [share(check["returns"], self.about["targets"]) for check in self.checks]

    def until(self, goal: float, unit: str) -> float:
        """What it cost to earn ``goal``, in ``cpu_seconds`` or ``steps``; infinite if it never did."""
        found = first_kept(self.shares, goal)
        return math.inf if found is None else self.checks[found][unit]

    @property
    def kept(self) -> float:
        """The largest share of two checks in a row; NaN if there were no two."""
        pairs = zip(self.shares, self.shares[1:], strict=False)
        return max((min(pair) for pair in pairs), default=math.nan)


def read_run(path: Path) -> Run:
    """A recorded run."""
    about, *checks, last = map(json.loads, path.read_text().splitlines())
    task = Task(about["method"], about["row"], tuple(about["settings"]), about["seed"])
    return Run(task, about, checks, last["end"])


def until_text(values: Sequence[float]) -> str:
    """Median and range of costs; infinite ones are of runs that never got there."""
    got = sorted(value for value in values if math.isfinite(value))
    never = f"never ({len(values) - len(got)} of {len(values)})"
    if not got:
        return never
    if len(got) < len(values):
        return f"{', '.join(map(_number, got))}; {never}"
    middle = _number(statistics.median(got))
    return middle if len(got) == 1 else f"{middle} ({_number(got[0])} to {_number(got[-1])})"


def tables(runs: Sequence[Run]) -> dict[str, str]:
    """A Markdown table for each group of comparable runs."""
    found = {}
    for group in dict.fromkeys(run.task.group for run in runs):
        rows = []
        for method in METHODS.values():
            own = [r for r in runs if r.task.group == group and r.task.method == method.name]
            if not own:
                continue
            costs = [
                until_text([run.until(goal, unit) for run in own])
                for unit in ("cpu_seconds", "steps")
                for goal in GOALS
            ]
            ends = [
                _number(
                    statistics.median([run.checks[-1][unit] for run in own if run.checks] or [0])
                )
                for unit in ("cpu_seconds", "steps")
            ]
            kept = [run.kept for run in own if not math.isnan(run.kept)]
            rows.append(
                [
                    method.title,
                    str(len(own)),
                    *costs,
                    f"{statistics.median(kept):.0%}" if kept else "-",
                    f"{ends[0]} s, {ends[1]} steps",
                ]
            )
        columns = [
            "method",
            "seeds",
            "CPU s to 80 %",
            "to 90 %",
            "steps to 80 %",
            "to 90 %",
            "kept",
        ]
        found[group] = markdown_table([*columns, "stopped after"], rows)
    return found


def write(directory: Path, runs: Sequence[Run], wanted: int, command: str) -> None:
    """Write ``README.md``, ``peers.csv`` (a row a run), ``checks.csv`` (a row a check), ``peers.png``."""
    about = [
        {**run.task._asdict(), "settings": ", ".join(run.task.settings), "end": run.end}
        | {f"{unit}_{goal:.0%}": run.until(goal, unit) for unit in _UNITS for goal in GOALS}
        | {"kept": run.kept, "limit": run.about["limit"], "commit": run.about["commit"]}
        for run in runs
    ]
    pd.DataFrame(about).to_csv(directory / "peers.csv", index=False, float_format="%.6g")
    checks = [
        {"run": run.task.name, "share": part, **{unit: check[unit] for unit in _UNITS}}
        | {f"return_{k}": value for k, value in enumerate(check["returns"])}
        for run in runs
        for part, check in zip(run.shares, run.checks, strict=True)
    ]
    pd.DataFrame(checks).to_csv(directory / "checks.csv", index=False, float_format="%.6g")
    sections = [f"## {group}\n\n{table}\n" for group, table in tables(runs).items()]
    missing = f"Missing: {wanted - len(runs)} of {wanted} runs.\n\n" if wanted > len(runs) else ""
    (directory / "README.md").write_text(
        f"# CPU seconds to a result, beside other libraries\n\n`{command}`\n\n{missing}"
        f"{''.join(sections)}{_NOTE}\n![share of the experts' return](peers.png)\n\n"
        "Share of the experts' true return at every check, a line per seed. Shares below -1 are drawn at "
        "-1.\n\n"
        "`peers.csv` has a row per run, `checks.csv` a row per check.\n\n" + _provenance(runs)
    )
    _draw(directory / "peers.png", runs)


_UNITS = ("cpu_seconds", "steps")


def _number(value: float) -> str:
    return f"{value:,.0f}"


def _provenance(runs: Sequence[Run]) -> str:
    """Which code, libraries and processor made the runs."""

    def listed(values: Iterable[str]) -> str:
        return "; ".join(dict.fromkeys(values))

    versions = {
        module: listed(
            ", ".join(f"{name} {v}" for name, v in run.about["versions"].items() if v)
            for run in runs
            if METHODS[run.task.method].module == module
        )
        for module in ("ours", "theirs")
    }
    lines = [
        f"- Commit: {listed(_of_commit(run.about['commit'], runs) for run in runs)}",
        f"- Demonstrations: {listed(run.about['demonstrations'] for run in runs)}",
        f"- Limit: {listed(_number(run.about['limit']) for run in runs)} CPU seconds a run",
        f"- Machine: {listed(run.about['machine'] for run in runs)}",
        f"- `irlcli`: {versions['ours'] or 'not run'}",
        f"- Others: {versions['theirs'] or 'not run'}",
    ]
    return "\n".join(lines) + "\n"


def _of_commit(commit: str, runs: Sequence[Run]) -> str:
    """``commit`` and which runs it made."""
    made = {f"{r.task.row} seed {r.task.seed}" for r in runs if r.about["commit"] == commit}
    return f"{commit} ({', '.join(sorted(made))})"


def _colour(method: str) -> str:
    alike = [name for name, other in METHODS.items() if other.expert == METHODS[method].expert]
    return _COLOURS[alike.index(method)]


def _draw(path: Path, runs: Sequence[Run]) -> None:
    groups = list(dict.fromkeys(run.task.group for run in runs))
    with plt.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        size = (9, 0.3 + 2.8 * len(groups))
        figure, axes = plt.subplots(
            len(groups), 1, figsize=size, squeeze=False, layout="constrained"
        )
        for axis, group in zip(axes[:, 0], groups, strict=True):
            members = [run for run in runs if run.task.group == group]
            for run in members:
                first = run is next(r for r in members if r.task.method == run.task.method)
                axis.plot(
                    [check["cpu_seconds"] for check in run.checks],
                    [max(part, -1.0) for part in run.shares],
                    color=_colour(run.task.method),
                    marker=".",
                    ms=3,
                    lw=1.0,
                    label=METHODS[run.task.method].title if first else None,
                )
            for goal in GOALS:
                axis.axhline(goal, color="black", lw=0.6, ls=":")
            axis.set_title(group, loc="left", size=8)
            axis.set_xlabel("CPU seconds")
            axis.set_ylabel("share of the expert's return")
            axis.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        figure.savefig(path, dpi=110)
        plt.close(figure)
