"""Pictures of a report: every seed's point, and the learning curves. Files, or SVG for a page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from irlcli.report import paper
from irlcli.report.results import BASELINES, TITLES, Plan, Report, sample

# Okabe and Ito's colours: told apart by colour-blind readers, on white and on black.
COLOURS = {
    "erm": "#0072B2",
    "irm": "#E69F00",
    "erm-balanced": "#009E73",
    "irm-shuffled": "#CC79A7",
}
_LINES = {"expert": "-", "carried": "-.", "random": "--", "idle": ":"}
_LEARNING = {
    "true_return": "true return",
    "progress": "progress",
    "accuracy": "discriminator accuracy",
    "penalty": "penalty",
    "mean_abs_logit": "mean |logit|",
}
# A colour that occurs nowhere else, so that a page can put its own in its place.
_INK = "#010203"


@contextmanager
def _style(ink: str) -> Iterator[None]:
    colours = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    with plt.rc_context(
        {
            **dict.fromkeys(colours, ink),
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


def _svg(figure: plt.Figure, name: str) -> str:
    """``figure`` as an SVG element whose ink is that of the text around it.

    Its ids begin with ``name``: several stand on one page.
    """
    buffer = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    plt.close(figure)
    text = buffer.getvalue()
    text = re.sub(r'( id="|url\(#|href="#)', rf"\g<1>{name}-", text[text.index("<svg") :])
    return text.replace(_INK, "currentColor").strip()


def draw_points(directory: Path, plan: Plan, report: Report) -> str:
    """Write ``KIND.png`` and ``KIND.pdf``: every seed, the mean, its interval; return the SVG."""
    with _style("black"):
        figure = _points(plan, report)
        figure.savefig(directory / f"{plan.kind}.png", dpi=130)
        figure.savefig(directory / f"{plan.kind}.pdf", metadata={"CreationDate": None})
        plt.close(figure)
    with _style(_INK):
        return _svg(_points(plan, report), "points")


def _points(plan: Plan, report: Report) -> plt.Figure:
    measures = [m for m in plan.measures if m != "id"]
    size = (0.6 + 3.2 * len(plan.rows), 0.5 + 2.7 * len(measures))
    figure, axes = plt.subplots(
        len(measures), len(plan.rows), figsize=size, squeeze=False, layout="constrained"
    )
    for line, measure in zip(axes, measures, strict=True):
        for axis, row in zip(line, plan.rows, strict=True):
            _panel(axis, plan, report, row, measure)
        line[0].set_ylabel(f"true return, {measure}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _panel(axis, plan: Plan, report: Report, row, measure: str) -> None:
    ink = plt.rcParams["text.color"]
    cells = report.cells[report.cells["row"] == row.name].set_index(["agent", "measure"])
    for agent in BASELINES:
        # Drawn without a value too: the legend is that of all panels.
        value = cells.loc[(agent, "ood"), "mean"]
        axis.axhline(
            np.nan if pd.isna(value) else value,
            color=ink,
            lw=0.9,
            ls=_LINES[agent],
            alpha=0.7,
            label=TITLES[agent],
        )
    for x, method in enumerate(plan.methods):
        colour = COLOURS[method]
        values = sample(report.points, row.name, method, measure)["true_return"].to_numpy()
        offsets = (
            np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else np.zeros(len(values))
        )
        axis.plot(x + offsets, values, "o", ms=4.5, color=colour, alpha=0.6, mew=0)
        cell = cells.loc[(method, measure)]
        if not pd.isna(cell["mean"]):
            axis.plot([x - 0.25, x + 0.25], [cell["mean"]] * 2, color=colour, lw=2)
        if not pd.isna(cell["low"]):
            axis.plot([x + 0.25] * 2, [cell["low"], cell["high"]], color=colour, lw=1.5)
    printed = paper.TABLE1.get((row.env, row.knob))
    if plan.kind == "table1" and measure == "transfer" and printed is not None:
        theirs = {"erm": printed.erm, "irm": printed.irm}
        for method, value in theirs.items():
            if method in plan.methods:
                axis.errorbar(
                    plan.methods.index(method) - 0.33,
                    value.mean,
                    value.deviation,
                    fmt="D",
                    **{"ms": 4, "mfc": "none", "color": ink, "alpha": 0.6, "lw": 0.8},
                    label="paper, ± sd" if method == next(iter(theirs)) else None,
                )
    axis.set_xticks(
        range(len(plan.methods)), [TITLES[m].replace(", ", ",\n") for m in plan.methods], size=7.5
    )
    axis.set_xlim(-0.6, len(plan.methods) - 0.4)
    axis.set_title(f"{row.env} {row.unseen}")
    axis.grid(axis="y", alpha=0.25)


def learning_curves(plan: Plan, learning: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """An SVG per row and kind of learning, by title: a thin line per seed, their mean thick.

    ``learning`` maps ``ROW METHOD SEED reward-learning`` (or ``transfer-learning``) to metrics.
    """
    found = {}
    with _style(_INK):
        for row in plan.rows:
            for kind, what in (
                ("reward-learning", "learning the reward, in distribution"),
                ("transfer-learning", "transfer: learning on the frozen reward"),
            ):
                runs = {
                    (method, seed): learning[role]
                    for method in plan.methods
                    for seed in plan.seeds
                    if (role := f"{row.name} {method} {seed} {kind}") in learning
                }
                if runs:
                    found[f"{row.name}, {what}"] = _svg(_curves(plan, runs), f"curves{len(found)}")
    return found


def _curves(plan: Plan, runs: Mapping[tuple[str, int], pd.DataFrame]) -> plt.Figure:
    first = next(iter(runs.values()))
    settings = list(dict.fromkeys(first["setting"]))
    names = [n for n in _LEARNING if n in first and first[n].notna().any()]
    size = (1 + 3.6 * len(settings), 0.6 + 1.7 * len(names))
    figure, axes = plt.subplots(
        len(names),
        len(settings),
        figsize=size,
        squeeze=False,
        sharex=True,
        sharey="row",
        layout="constrained",
    )
    for line, name in zip(axes, names, strict=True):
        for axis, setting in zip(line, settings, strict=True):
            for method in plan.methods:
                series = [
                    metrics[metrics["setting"] == setting].set_index("steps")[name]
                    for (m, _), metrics in runs.items()
                    if m == method
                ]
                for one in series:
                    axis.plot(one.index / 1e6, one, color=COLOURS[method], lw=0.6, alpha=0.45)
                if series:
                    mean = pd.concat(series, axis=1).mean(axis=1)
                    label = f"{TITLES[method]} ({len(series)})"
                    axis.plot(mean.index / 1e6, mean, color=COLOURS[method], lw=1.7, label=label)
            axis.grid(alpha=0.25)
            if name == "penalty":
                # The unbiased estimate may be negative, and spans decades.
                axis.set_yscale("symlog", linthresh=1e-3)
        line[0].set_ylabel(_LEARNING[name])
    for axis, setting in zip(axes[0], settings, strict=True):
        axis.set_title(setting)
    for axis in axes[-1]:
        axis.set_xlabel("million steps")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure
