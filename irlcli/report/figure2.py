"""Paper Fig. 2: pictures of recovered rewards, beside measures of how good they are.

The pictures show one dataset only. The table and the curves are means over all datasets, with
bootstrap 95 % intervals: the dataset is the unit of the statistics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from irlcli.report.drawing import save
from irlcli.report.means import interval_text, means
from irlcli.report.tables import markdown_table

MEASURES = (
    "goal_probability",
    "true_return",
    "value_difference",
    "rank_correlation",
    "log_likelihood",
)
# Okabe and Ito's colours, which colour-blind readers can tell apart.
GROUP_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")


def summary(quality: pd.DataFrame) -> pd.DataFrame:
    """Mean and interval over seeds of each measure, per variant and setting.

    The setting ``worst`` is the worst of the settings trained on, seed by seed. An undefined rank
    correlation (of a constant value) counts as 0.
    """
    filled = quality.fillna({"rank_correlation": 0.0})
    worst = filled[filled["seen"]].copy()
    worst["value_difference"] *= -1.0
    worst = worst.groupby(["variant", "seed"], sort=False)[list(MEASURES)].min().reset_index()
    worst["value_difference"] *= -1.0
    both = pd.concat([filled, worst.assign(setting="worst", seen=True)])
    found = means(both, ["variant", "setting", "seen"], MEASURES)
    return found.rename(columns={"n": "datasets"})


def differences(quality: pd.DataFrame, unseen: Sequence[str]) -> pd.DataFrame:
    """By how much a penalty changes the probability of reaching the goal in the ``unseen`` settings.

    Paired over datasets, each with its interval: ``variant`` minus ERM, minus ERM-balanced (lambda 0)
    and minus the same penalty with shuffled labels, the column ``against``.
    """
    rows = quality.drop_duplicates("variant")
    reached = quality[quality["setting"].isin(unseen)].set_index(["variant", "setting", "seed"])
    reached = reached["goal_probability"]
    plain = rows[(rows["l2"] == 0) & rows["grouping"].isin(["pooled", "balanced"])]["variant"]
    found = []
    for r in rows[rows["grouping"] == "per-setting"].itertuples():
        same = (rows["penalty"] == r.penalty) & (rows["penalty_weight"] == r.penalty_weight)
        shuffled = rows[same & (rows["grouping"] == "shuffled")]["variant"]
        for against in (*plain, *shuffled):
            difference = (reached[r.variant] - reached[against]).rename("difference").reset_index()
            found.append(difference.assign(variant=r.variant, against=against))
    return means(pd.concat(found), ["variant", "against", "setting"], ["difference"])


def differences_table(
    found: pd.DataFrame, unseen: Sequence[str]
) -> tuple[list[str], list[list[str]]]:
    """Column names, and a row per variant and what it is compared with."""
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for r in found.itertuples():
        row = rows.setdefault((r.variant, r.against), {})
        row[r.setting] = interval_text(r.mean, r.low, r.high, 2)
    lines = [[*pair, *(row[u] for u in unseen)] for pair, row in rows.items()]
    return ["method", "minus", *unseen], lines


def table(summarised: pd.DataFrame, unseen: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Column names, and a row per variant; its cells are ``mean [low, high]`` over datasets."""
    wanted = [("goal probability, worst trained", "goal_probability", "worst", 2)]
    wanted += [(f"goal probability, {u}", "goal_probability", u, 2) for u in unseen]
    wanted += [(f"true return, {u}", "true_return", u, 1) for u in unseen]
    wanted += [(f"value difference, {u}", "value_difference", u, 1) for u in unseen]
    wanted += [("log-likelihood, worst trained", "log_likelihood", "worst", 1)]
    wanted += [(f"rank correlation, {u}", "rank_correlation", u, 2) for u in unseen]
    cells = summarised.set_index(["variant", "measure", "setting"])
    rows = []
    for variant in dict.fromkeys(summarised["variant"]):
        row = [variant]
        for _, measure, setting, digits in wanted:
            c = cells.loc[(variant, measure, setting)]
            row.append(interval_text(c["mean"], c["low"], c["high"], digits))
        rows.append(row)
    return ["method", *(w[0] for w in wanted)], rows


def page(
    summarised: pd.DataFrame, changes: pd.DataFrame, unseen: Sequence[str], facts: Sequence[str]
) -> str:
    """The picture and the tables as Markdown; ``facts`` are what they were made from.

    ``changes`` are the :func:`differences`.
    """
    listed = "\n".join(f"- {fact}." for fact in facts)
    return f"""# Figure 2

![Figure 2](figure2.png)

{listed}

Cells are means over the datasets, with bootstrap 95 % intervals. *Worst trained* is the worst of the
settings trained on, in each dataset. The number after a penalty is its lambda, after `l2` the L2
weight. `irm-shuffled` deals the episodes out to the risks at random; every setting keeps its weight.

{markdown_table(*table(summarised, unseen))}
## Paired differences

Goal probability of a penalised method minus that of another one, paired over the datasets.

{markdown_table(*differences_table(changes, unseen))}"""


@dataclass(frozen=True)
class Curve:
    """A sweep over one weight: (weight, variant) from weight 0, and how it is drawn."""

    label: str
    points: tuple[tuple[float, str], ...]
    style: str  # of matplotlib, for example "o-"
    colour: str


def curves(quality: pd.DataFrame) -> list[Curve]:
    """The L2 of ERM, and lambda of each penalty with true and with shuffled labels (dashed).

    Without penalty both are ERM-balanced.
    """
    rows = quality.drop_duplicates("variant")
    erm, balanced = (rows[rows["grouping"] == name] for name in ("pooled", "balanced"))
    colours = iter(GROUP_COLOURS)
    found = [Curve("ERM + L2", _points(erm["l2"], erm["variant"]), "^-", next(colours))]
    for penalty, group in rows[rows["penalty"] != "none"].groupby("penalty", sort=False):
        colour = next(colours)
        for grouping, suffix, style in (
            ("per-setting", "", "o-"),
            ("shuffled", ", labels shuffled", "s--"),
        ):
            line = pd.concat([balanced, group[group["grouping"] == grouping]])
            points = _points(line["penalty_weight"], line["variant"])
            found.append(Curve(f"IRM {penalty}{suffix}", points, style, colour))
    return found


def _points(weights: pd.Series, variants: pd.Series) -> tuple[tuple[float, str], ...]:
    return tuple(zip(weights.tolist(), variants, strict=True))


@dataclass(frozen=True, eq=False)
class Panel:
    """One recovered reward [S], and by setting the route [T + 1] of its optimal policy."""

    title: str
    reward: np.ndarray
    routes: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Maze:
    """What the panels are drawn over.

    Attributes:
        size: cells a side.
        paths: by setting trained on, the experts' trajectories of state indices.
        gates: by setting trained on, its walls [S] bool.
        bars: by unseen setting, its walls [S] bool.
    """

    size: int
    paths: Mapping[str, Sequence[np.ndarray]]
    gates: Mapping[str, np.ndarray]
    bars: Mapping[str, np.ndarray]


def draw(
    directory: Path,
    maze: Maze,
    panels: Sequence[Panel],
    summarised: pd.DataFrame,
    lines: Sequence[Curve],
    seed: int,
) -> None:
    """Write ``figure2.png`` and ``figure2.pdf``.

    Args:
        panels: seven; the eighth place shows the experts' paths.
        summarised: as :func:`summary` returns it.
        lines: as :func:`curves` returns them.
        seed: the dataset that the panels show.
    """
    drawn = zip(maze.bars, ("solid", "dotted"), strict=False)
    routes = " and ".join(f"{setting} ({style})" for setting, style in drawn)
    caption = (
        f"Pictures: dataset {seed}, the first one. (b)-(h): recovered reward of each cell, each "
        "panel on its own colour scale. White crosses: the bars of the unseen mazes.\nOrange: route of the "
        f"reward's optimal policy in {routes} if no move slips; it ends at the dot.\nCurves and table: "
        f"means over {summarised['datasets'].iloc[0]} datasets, with bootstrap 95 % intervals."
    )
    with matplotlib.rc_context({"font.size": 9, "axes.titlesize": 10, "pdf.fonttype": 42}):
        figure = Figure(figsize=(15, 17), layout="constrained")
        figure.suptitle(caption, fontsize=10)
        grid = figure.add_gridspec(4, 1, height_ratios=[3.7, 3.7, 3.2, 6.5])
        tops = [grid[i].subgridspec(1, 4) for i in range(2)]
        axes = [figure.add_subplot(tops[k // 4][k % 4]) for k in range(8)]
        _draw_experts(axes[0], maze)
        for k, (axis, panel) in enumerate(zip(axes[1:], panels, strict=True)):
            _draw_reward(figure, axis, maze, panel, chr(ord("b") + k))
        _draw_curves(figure, grid[2].subgridspec(1, 3), summarised, lines, list(maze.bars))
        _draw_table(figure.add_subplot(grid[3]), summarised, list(maze.bars))
        save(figure, directory, "figure2")


def _frame(axis, size: int) -> None:
    axis.set(xlim=(-0.5, size - 0.5), ylim=(-0.5, size - 0.5), aspect="equal", xticks=[], yticks=[])


def _cells(axis, wall: np.ndarray, size: int, **style) -> None:
    for cell in np.flatnonzero(wall):
        axis.add_patch(Rectangle((cell % size - 0.5, cell // size - 0.5), 1, 1, **style))


def _ends(axis, size: int, colour: str) -> None:
    for position, text in ((0, "S"), (size - 1, "G")):
        axis.text(
            *(position, position, text),
            **{"ha": "center", "va": "center", "size": 12, "weight": "bold", "color": colour},
            path_effects=[
                withStroke(linewidth=2.5, foreground="black" if colour == "white" else "white")
            ],
            zorder=5,
        )


def _draw_experts(axis, maze: Maze) -> None:
    size = maze.size
    rng = np.random.default_rng(0)
    closed_to_all = np.logical_and.reduce(list(maze.gates.values()))
    some = np.logical_or.reduce(list(maze.gates.values())) & ~closed_to_all
    _cells(axis, closed_to_all, size, facecolor="0.35", edgecolor="none")
    _cells(axis, some, size, facecolor="0.85", edgecolor="0.35", hatch="///", linewidth=0.5)
    for colour, (setting, paths) in zip(GROUP_COLOURS, maze.paths.items(), strict=False):
        for path in paths[:25]:
            jitter = rng.normal(0, 0.07, (2, len(path)))
            axis.plot(
                path % size + jitter[0], path // size + jitter[1], color=colour, lw=0.8, alpha=0.5
            )
        axis.plot([], [], color=colour, lw=2, label=f"{setting.partition('=')[2]}: {len(paths)}")
    # Below the maze, because gates and paths fill its corners.
    axis.legend(
        title=f"{setting.partition('=')[0]}: episodes",
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=len(maze.paths),
        frameon=False,
        fontsize=8,
        title_fontsize=8,
        handlelength=1.2,
    )
    _ends(axis, size, "black")
    _frame(axis, size)
    axis.set_title(
        "(a) experts' paths (at most 25 a group);\nhatched: gates, each open to one group"
    )


def _draw_reward(figure, axis, maze: Maze, panel: Panel, letter: str) -> None:
    size = maze.size
    image = axis.imshow(
        panel.reward.reshape(size, size), origin="lower", cmap="viridis", interpolation="nearest"
    )
    figure.colorbar(image, ax=axis, shrink=0.82, pad=0.02)
    bars = np.logical_or.reduce(list(maze.bars.values()))
    _cells(axis, bars, size, facecolor="none", edgecolor="white", hatch="xxx", linewidth=0.8)
    for style, (setting, route) in zip(("-", ":"), panel.routes.items(), strict=False):
        axis.plot(route % size, route // size, style, color="#D55E00", lw=2.5, label=setting)
        axis.plot(route[-1] % size, route[-1] // size, "o", color="#D55E00", ms=6)
    _ends(axis, size, "white")
    _frame(axis, size)
    axis.set_title(f"({letter}) {panel.title}")


def _draw_curves(figure, places, summarised, lines, unseen: Sequence[str]) -> None:
    cells = summarised.set_index(["variant", "measure", "setting"])
    what = [(f"goal probability, {u} (unseen)", "goal_probability", u) for u in unseen[:2]]
    what.append(("log-likelihood, worst trained setting [nats]", "log_likelihood", "worst"))
    for k, (title, measure, setting) in enumerate(what):
        axis = figure.add_subplot(places[k])
        for line in lines:
            weights = [weight for weight, _ in line.points]
            rows = cells.loc[[(variant, measure, setting) for _, variant in line.points]]
            band = {"color": line.colour, "alpha": 0.15, "lw": 0}
            axis.fill_between(weights, rows["low"], rows["high"], **band)
            axis.plot(weights, rows["mean"], line.style, color=line.colour, label=line.label)
        axis.set_xscale("symlog", linthresh=1e-3)
        axis.set_xlim(left=-1e-4)
        axis.set(title=title, xlabel="$\\lambda$ of IRM (0: ERM-balanced), or L2 of ERM (0: ERM)")
        axis.grid(alpha=0.3)
        if measure == "goal_probability":
            axis.set_ylim(-0.03, 1.03)
        if measure == "log_likelihood":
            axis.legend(fontsize=8, loc="lower right")


def _draw_table(axis, summarised: pd.DataFrame, unseen: Sequence[str]) -> None:
    columns, rows = table(summarised, unseen)
    keep = [i for i, c in enumerate(columns) if not c.startswith("value difference")]
    axis.axis("off")
    drawn = axis.table(
        [[columns[i].replace(", ", ",\n") for i in keep]]
        + [[row[i] for i in keep] for row in rows],
        colWidths=[0.16] + [0.84 / (len(keep) - 1)] * (len(keep) - 1),
        cellLoc="center",
        bbox=[0, 0, 1, 1],
        edges="horizontal",
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    for (row, column), cell in drawn.get_celld().items():
        cell.set_linewidth(0.4)
        if column == 0:
            cell.set_text_props(ha="left")
        if row == 0:
            cell.set_height(1.8 * cell.get_height())
            cell.set_text_props(weight="bold", size=8)
