"""The experts' table and their learning curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.axes import Axes

from irlcli.labels import duration
from irlcli.report.agents import PROGRESS
from irlcli.report.drawing import panels, save
from irlcli.report.lineage import commits
from irlcli.report.parameters import EXPERT_LEARNING, Cell, Run
from irlcli.report.tables import Table, markdown_table

_TITLE = "Experts: true return in their own settings"
_NOTE = (
    f"Mean true return of whole episodes ± standard deviation over episodes. {PROGRESS} Robots that can "
    "fall are rewarded for being alive, even if they stand still. Random and idle agents learn nothing. "
    "Time: of one process on a machine shared with other runs; its first run includes loading the "
    "libraries."
)
_USES = {"id": "trained in", "ood": "held out"}


def summarise(
    cells: Sequence[Cell],
    runs: Mapping[str, Run],
    steps: Mapping[str, int],
    summaries: Mapping[tuple[str, str, str], Any],
) -> pd.DataFrame:
    """A row per setting: the returns of expert, idle and random agent, and the expert's training.

    ``status`` is ``done``, or what a missing evaluation waits for. Times are in seconds.

    Args:
        cells: the wanted evaluations; rows are ``ENV KNOB``.
        runs: provenance by id; an evaluation's only input is its policy.
        steps: an expert's budget, by row.
        summaries: the existing evaluations by (agent, environment, setting), each a
            :class:`irlcli.data.descriptions.Returns`.
    """
    rows = []
    for cell in cells:
        if cell.agent != "expert":
            continue
        env, knob = cell.env, cell.knob
        expert, idle, random = (
            summaries.get((agent, env, cell.setting)) for agent in ("expert", "idle", "random")
        )
        trained = [runs[i] for i in runs[cell.run].inputs if i in runs] if cell.run else []
        rows.append(
            {
                "env": env,
                "knob": knob,
                "setting": cell.setting,
                "use": _USES[cell.measure],
                "true_return": _value(expert, "mean_return"),
                "std_return": _value(expert, "std_return"),
                "progress": _value(expert, "mean_progress"),
                "length": _value(expert, "mean_length"),
                "terminated": _value(expert, "terminated"),
                "episodes": _value(expert, "episodes"),
                "stopped": _value(expert, "stopped"),
                "idle_return": _value(idle, "mean_return"),
                "random_return": _value(random, "mean_return"),
                "steps": steps[cell.row],
                "seconds": trained[0].seconds if trained else None,
                "resumed": trained[0].resumed if trained else None,
                "commit": ", ".join(commits(trained)) if trained else None,
                "status": "done" if cell.run else cell.why,
            }
        )
    return pd.DataFrame(rows)


def text_table(found: pd.DataFrame) -> Table:
    """:func:`summarise` for people."""
    rows = []
    for row in found.itertuples():
        value = f"{_text(row.true_return)} ± {_text(row.std_return)}"
        took = "-" if pd.isna(row.seconds) else duration(row.seconds)
        if not pd.isna(row.resumed) and row.resumed > 0:
            took += f", resumed {row.resumed:.0f}x"
        rows.append(
            [
                f"{row.env} {row.setting}",
                row.use,
                value if row.status == "done" else row.status,
                *(_text(v) for v in (row.progress, row.idle_return, row.random_return)),
                f"{row.steps:,}",
                took,
                row.commit if isinstance(row.commit, str) else "-",
            ]
        )
    columns = ["setting", "use", "expert", "progress", "idle", "random", "steps", "time", "commit"]
    return Table(_TITLE, _NOTE, columns, rows)


def caveats(cells: Sequence[Cell], found: pd.DataFrame, bars: Mapping[str, float]) -> list[str]:
    """Experts that do not reach the bar of their row, with stopped episodes, and missing ones."""
    experts = [cell for cell in cells if cell.agent == "expert"]
    missing = [f"{cell.env} {cell.setting}" for cell in experts if not cell.run]
    low = [
        f"{row.env} {row.setting} ({row.true_return:.1f} of {bar:g})"
        for row in found.itertuples()
        if (bar := bars.get(f"{row.env} {row.knob}")) is not None and row.true_return < bar
    ]
    sentences = [f"Experts below their bar: {', '.join(low)}."] if low else []
    broken = [
        f"{row.env} {row.setting} ({row.stopped:.0f} of {row.episodes:.0f})"
        for row in found.itertuples()
        if row.stopped and row.stopped > 0
    ]
    if broken:
        sentences.append(
            f"Episodes stopped by an error, which the means leave out unless they are all: {', '.join(broken)}."
        )
    if missing:
        sentences.append(
            f"Missing: the evaluations of {len(missing)} of {len(experts)} experts: {', '.join(missing)}."
        )
    return sentences


def markdown(command: str, table: Table, caveats: Sequence[str]) -> str:
    """The report as one page."""
    return "\n".join(
        [
            f"# {table.title}\n",
            f"`{command}`\n",
            *(f"- {caveat}\n" for caveat in caveats),
            markdown_table(table.columns, table.rows),
            f"{table.note}\n",
            "![learning curves](experts.png)\n",
            "Learning curves: episodes of the exploring policy; held-out settings are dashed.\n",
            "`experts.csv` has a row per setting.\n",
        ]
    )


def draw(directory: Path, cells: Sequence[Cell], learning: Mapping[str, pd.DataFrame]) -> None:
    """Write ``experts.png`` and ``experts.pdf``: return and progress of every expert over steps.

    ``learning`` maps ``ENV SETTING learning`` to an expert's metrics.
    """
    curves: dict[str, list[tuple[Cell, pd.DataFrame]]] = {}
    for cell in cells:
        if cell.agent == "expert" and cell.curve_role(EXPERT_LEARNING) in learning:
            metrics = learning[cell.curve_role(EXPERT_LEARNING)]
            curves.setdefault(cell.row, []).append((cell, metrics))
    with matplotlib.rc_context(
        {"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}
    ):
        # Experts that another store holds have an evaluation here, but no curve.
        figure, axes = panels(max(1, len(curves)), 2, (9, 0.4 + 1.9 * len(curves)))
        if not curves:
            for axis in axes.flat:
                axis.set_axis_off()
        for line, (row, experts) in zip(axes, curves.items(), strict=bool(curves)):
            for axis, name in zip(line, ("true_return", "progress"), strict=True):
                _panel(axis, f"{row}: {name.replace('_', ' ')}", name, experts)
            line[0].legend(frameon=False, fontsize=7)
        save(figure, directory, "experts", dpi=110)


def _panel(axis: Axes, title: str, name: str, experts: Sequence[tuple[Cell, pd.DataFrame]]) -> None:
    if not any(metrics[name].notna().any() for _, metrics in experts):
        axis.set_axis_off()
        return
    for cell, metrics in experts:
        style = "-" if cell.measure == "id" else "--"
        axis.plot(metrics["steps"] / 1e6, metrics[name], style, lw=1.2, label=cell.setting)
    axis.set_title(title, loc="left", size=8)
    axis.set_xlabel("million steps")
    axis.grid(alpha=0.25)


def _value(measured: Any, name: str) -> float | None:
    return None if measured is None else getattr(measured, name)


def _text(value: Any) -> str:
    return "-" if pd.isna(value) else f"{value:z,.0f}"
