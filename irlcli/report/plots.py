"""Plots of a report: every seed's point, and learning curves, as files or as SVG for a page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from irlcli.report import ablation
from irlcli.report.agents import IN_DISTRIBUTION, beside, colours, own_measure, title
from irlcli.report.build import Report
from irlcli.report.compute import sample
from irlcli.report.drawing import offsets, panels, save
from irlcli.report.parameters import (
    REWARD_LEARNING,
    TRANSFER_LEARNING,
    Parameters,
    Row,
    curve_role,
)
from irlcli.report.result_tables import paper_row

_LINES = {"expert": "-", "reused": "-.", "random": "--", "idle": ":"}
_LEARNING = {
    "true_return": "true return",
    "progress": "progress",
    "accuracy": "accuracy, this round",
    "penalty": "IRMv1, this round",
    "optimised_penalty": "penalty, optimised",
    "mean_abs_logit": "mean |logit|, this round",
}
# Occurs nowhere else, so that a page can replace it by its own colour.
INK = "#010203"


@contextmanager
def style(ink: str) -> Iterator[None]:
    """The style of every plot here, drawn in ``ink``."""
    with matplotlib.rc_context(
        {
            "text.color": ink,
            "axes.edgecolor": ink,
            "axes.labelcolor": ink,
            "xtick.color": ink,
            "ytick.color": ink,
            "font.size": 9,
            "axes.titlesize": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "pdf.fonttype": 42,
            "svg.fonttype": "none",
            "svg.hashsalt": "irlcli",
        }
    ):
        yield


def as_svg(figure: Figure, name: str) -> str:
    """``figure`` as an SVG element that takes its ink from the surrounding text.

    Its ids start with ``name``, because one page holds several.
    """
    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    text = buffer.getvalue()
    text = re.sub(r'( id="|url\(#|href="#)', rf"\g<1>{name}-", text[text.index("<svg") :])
    return text.replace(INK, "currentColor").strip()


def draw_points(directory: Path, p: Parameters, report: Report) -> str:
    """Write ``KIND.png`` and ``KIND.pdf``: every seed, the mean and its interval. Return the SVG."""
    with style("black"):
        save(_figure(p, report), directory, p.kind)
    with style(INK):
        return as_svg(_figure(p, report), "points")


def _figure(p: Parameters, report: Report) -> Figure:
    return ablation.figure(p, report.shares) if p.variants else _points(p, report)


def _points(p: Parameters, report: Report) -> Figure:
    measures = [m for m in p.measures if m != "id"] or ["id"]
    # The names of many methods need a wider panel.
    width = max(3.2, 0.8 * len(p.methods))
    size = (0.6 + width * len(p.rows), 0.5 + 2.7 * len(measures))
    figure, axes = panels(len(measures), len(p.rows), size)
    for line, measure in zip(axes, measures, strict=True):
        for axis, row in zip(line, p.rows, strict=True):
            _panel(axis, p, report, row, measure)
        line[0].set_ylabel(f"true return, {measure}")
    _add_legend(figure, axes.flat)
    return figure


def _panel(axis: Axes, p: Parameters, report: Report, row: Row, measure: str) -> None:
    ink = matplotlib.rcParams["text.color"]
    cells = report.cells[report.cells["row"] == row.name].set_index(["agent", "measure"])
    # Drawn even without a value, so that the legend has it.
    for agent in beside(measure):
        value = cells["mean"].get((agent, own_measure(agent, measure)))
        axis.axhline(
            np.nan if pd.isna(value) else value,
            color=ink,
            lw=0.9,
            ls=_LINES[agent],
            alpha=0.7,
            label=title(agent),
        )
    for x, (method, colour) in enumerate(colours(p.methods).items()):
        values = sample(report.points, row.name, method, measure)["true_return"].to_numpy()
        axis.plot(
            x + offsets(len(values), 0.16), values, "o", ms=4.5, color=colour, alpha=0.6, mew=0
        )
        cell = cells.loc[(method, measure)]
        if not pd.isna(cell["mean"]):
            axis.plot([x - 0.25, x + 0.25], [cell["mean"]] * 2, color=colour, lw=2)
        if not pd.isna(cell["low"]):
            axis.plot([x + 0.25] * 2, [cell["low"], cell["high"]], color=colour, lw=1.5)
    printed = paper_row(p, row, measure)
    if printed is not None:
        for method, value in (("erm", printed.erm), ("irm", printed.irm)):
            if method in p.methods:
                axis.errorbar(
                    p.methods.index(method) - 0.33,
                    value.mean,
                    value.deviation,
                    fmt="D",
                    **{"ms": 4, "mfc": "none", "color": ink, "alpha": 0.6, "lw": 0.8},
                    label="paper, ± sd",
                )
    axis.set_xticks(
        range(len(p.methods)), [title(m).replace(", ", ",\n") for m in p.methods], size=7.5
    )
    axis.set_xlim(-0.6, len(p.methods) - 0.4)
    axis.set_title(row.name if measure in IN_DISTRIBUTION else f"{row.env} {row.unseen}")
    axis.grid(axis="y", alpha=0.25)


def learning_curves(p: Parameters, learning: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """An SVG per row and kind of learning, by title: a thin line per seed, a thick one for the mean.

    ``learning`` maps ``ROW METHOD SEED reward-learning`` (or ``transfer-learning``) to metrics.
    """
    found: dict[str, str] = {}
    with style(INK):
        for row in p.rows:
            for kind, what in (
                (REWARD_LEARNING, "reward learning: the student, in distribution"),
                (TRANSFER_LEARNING, "transfer: retraining on the frozen reward"),
            ):
                runs = {
                    (method, seed): learning[role]
                    for method in p.methods
                    for seed in p.seeds
                    if (role := curve_role(row.name, method, seed, kind)) in learning
                }
                if runs:
                    found[f"{row.name}, {what}"] = as_svg(_curves(p, runs), f"curves{len(found)}")
    return found


def _curves(p: Parameters, runs: Mapping[tuple[str, int], pd.DataFrame]) -> Figure:
    first = next(iter(runs.values()))
    settings = list(dict.fromkeys(first["setting"]))
    names = [n for n in _LEARNING if n in first and first[n].notna().any()]
    size = (1 + 3.6 * len(settings), 0.6 + 1.7 * len(names))
    figure, axes = panels(len(names), len(settings), size, sharex=True, sharey="row")
    for line, name in zip(axes, names, strict=True):
        for axis, setting in zip(line, settings, strict=True):
            for method, colour in colours(p.methods).items():
                series = [
                    metrics[metrics["setting"] == setting].set_index("steps")[name]
                    for (m, _), metrics in runs.items()
                    if m == method
                ]
                for one in series:
                    axis.plot(one.index / 1e6, one, color=colour, lw=0.6, alpha=0.45)
                if series:
                    # As far as all seeds go: training may end early.
                    mean = pd.concat(series, axis=1, join="inner").mean(axis=1)
                    label = f"{title(method)} ({len(series)})"
                    axis.plot(mean.index / 1e6, mean, color=colour, lw=1.7, label=label)
            axis.grid(alpha=0.25)
            if name.endswith("penalty"):
                # The unbiased estimate may be negative and spans decades.
                axis.set_yscale("symlog", linthresh=1e-3)
        line[0].set_ylabel(_LEARNING[name])
    for axis, setting in zip(axes[0], settings, strict=True):
        axis.set_title(setting)
    for axis in axes[-1]:
        axis.set_xlabel("million steps")
    _add_legend(figure, axes.flat)
    return figure


def _add_legend(figure: Figure, axes: Iterable[Axes]) -> None:
    """One legend for all panels, below them, in as many columns as the figure is wide enough for."""
    entries = {
        label: handle
        for axis in axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    # An entry takes up to 1.8 inches; the layout cuts what does not fit.
    columns = max(1, min(6, int(figure.get_figwidth() / 1.8)))
    figure.legend(
        entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False
    )
