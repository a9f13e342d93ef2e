"""The report of the positive controls: how each reward depends on the cue, and what follows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib
import pandas as pd

from irlcli.configs import ControlConfig
from irlcli.report.drawing import panels, save
from irlcli.report.means import interval_text, means
from irlcli.report.statistics import bootstrap_interval
from irlcli.report.tables import markdown_table

ACCURACIES = ("trained", "unseen")
MEASURES = (
    *("quality", "optimal_quality", "value_difference", "pays_texture", "pays_colour"),
    *("log_likelihood", "penalty_before", "penalty"),
)
# Okabe and Ito's colours, which colour-blind readers can tell apart.
_COLOURS = {
    "irmv1-full": "#E69F00",
    "irmv1": "#CC79A7",
    "closed-form": "#56B4E9",
    "vrex": "#D55E00",
    "erm": "#0072B2",
    "texture": "#009E73",
}


def summary(labels: pd.DataFrame, maps: pd.DataFrame) -> pd.DataFrame:
    """Mean and interval over seeds of each measure, per case and method.

    ``labels`` has a row per problem, method and seed; ``maps`` per case, variant, seed and setting
    left out.
    """
    of_labels = labels.rename(columns={"problem": "case"})
    whole = maps[maps["left_out"] < 0].rename(columns={"variant": "method"})
    parts = [
        means(frame, ["case", "method"], measures)
        for frame, measures in ((of_labels, ACCURACIES), (whole, MEASURES))
    ]
    return pd.concat(parts, ignore_index=True).rename(columns={"n": "seeds"})


def choices(maps: pd.DataFrame) -> pd.DataFrame:
    """For each case in which settings were left out, and each seed, the method that was chosen.

    The one whose rewards explain the demonstrations of the settings left out best, on average.
    ``quality`` is what its reward, learned from all settings, reaches in the unseen one.
    """
    left = maps[maps["left_out"] >= 0]
    risk = left.groupby(["case", "seed", "variant"], sort=False)["held_out_risk"].mean()
    rows = []
    for (case, seed), group in risk.groupby(["case", "seed"], sort=False):
        variant = group.idxmin()[2]
        chosen = maps[
            (maps["case"] == case)
            & (maps["seed"] == seed)
            & (maps["variant"] == variant)
            & (maps["left_out"] < 0)
        ]
        quality = float(chosen["quality"].iloc[0])
        rows.append({"case": case, "seed": seed, "method": variant, "quality": quality})
    return pd.DataFrame(rows)


def page(summarised: pd.DataFrame, chosen: pd.DataFrame, control: ControlConfig) -> str:
    """Picture and tables as Markdown."""
    c, m = control.labels, control.maps
    cells = _Cells(summarised)
    wanted = ("quality", "optimal_quality", "value_difference", "pays_texture", "pays_colour")
    columns = [
        *("method", "quality visited", "by the optimal policy", "value difference"),
        *("weight of texture", "weight of colour"),
    ]
    parts = [
        "# Positive controls",
        "![Positive controls](control.png)",
        "Cells are means with bootstrap 95 % intervals. The number after a method is its lambda. "
        "All measures are in `control.csv`; [what they mean](../../when-invariance-helps.md).",
        "## Colored MNIST without images",
        f"{c.seeds} seeds. The digit agrees with the label in {_percents([1 - c.noise])}, the colour in "
        f"{_percents(c.strengths)} of the samples of the settings trained on, and in {_percents([c.unseen])} "
        "of the unseen one. Published, with images: ERM 0.87 and 0.17, IRM 0.71 and 0.67, the "
        "invariant optimum 0.75 and 0.75 (Arjovsky et al. 2019, Sec. 5.2).",
        markdown_table(
            ["method", "accuracy trained on", "accuracy unseen"],
            cells.rows("coloured digits", ACCURACIES),
        ),
        "## Linear unit tests",
        f"{c.seeds} seeds, linear classifiers, three settings (Aubin et al. 2021). Accuracy where "
        "the spurious inputs are uninformative; 0.5 is chance. The oracle learned from such samples.",
        markdown_table(
            ["method", "cows and camels", "small margin"],
            [
                [name, one, other]
                for (name, one), (_, other) in zip(
                    cells.rows("example 2", ("unseen",)),
                    cells.rows("example 3", ("unseen",)),
                    strict=True,
                )
            ],
        ),
        "## Maps",
        f"{m.seeds} draws of maps of {m.size}x{m.size} cells, {m.episodes} demonstrations of {m.horizon} "
        f"steps a setting. The texture agrees with a cell's quality in {_percents([m.texture])} of the cells, the "
        f"colour in {_percents(m.strengths)} in the settings trained on, and in {_percents([m.unseen])} in the "
        "unseen one, where all columns but the last two are measured. A quality of 0.5 is chance.",
    ]
    for features in ("linear", "learned"):
        own = [*cells.cases(f"{features}."), f"cold.{features}"]
        rows = [row for case in own for row in cells.rows(case, wanted)]
        parts += [f"### {features.capitalize()} features", markdown_table(columns, rows)]
    parts += [
        "## Number of settings",
        f"Quality visited in the unseen setting. The strength of one colour is spread evenly between "
        f"{_percents(m.spread)}; two colours draw theirs from there.",
        _across(cells, {f"{n} settings": f"settings.{n}.colours." for n in m.settings}),
        "## Gap of the cue's strengths",
        "Quality visited in the unseen setting, by the difference between the colour's strengths in "
        "two settings.",
        _by_gap(cells, m.gaps),
        "## Choosing lambda without the unseen setting",
        "Each setting trained on is left out in turn; the lambda is chosen whose rewards explain its "
        "demonstrations best. ERM-balanced is lambda 0.",
        _chosen(cells, chosen, m.choices),
    ]
    return "\n\n".join(part.strip("\n") for part in parts) + "\n"


class _Cells:
    """Means and intervals as text."""

    def __init__(self, summarised: pd.DataFrame):
        self._frame = summarised
        self._cells = summarised.set_index(["case", "method", "measure"])

    def cases(self, prefix: str) -> list[str]:
        return _cases(self._frame, prefix)

    def methods(self, case: str) -> list[str]:
        return list(self._frame[self._frame["case"] == case]["method"].unique())

    def text(self, case: str, method: str, measure: str) -> str:
        cell = self._cells.loc[(case, method, measure)]
        return interval_text(cell["mean"], cell["low"], cell["high"], 2)

    def rows(self, case: str, measures: Sequence[str]) -> list[list[str]]:
        return [
            [method, *(self.text(case, method, measure) for measure in measures)]
            for method in self.methods(case)
        ]


def _percents(shares: Sequence[float]) -> str:
    """For example ``95, 87.5 and 80 %``."""
    *first, last = (f"{100 * share:g}" for share in shares)
    return f"{', '.join(first)} and {last} %" if first else f"{last} %"


def _across(cells: _Cells, starts: dict[str, str]) -> str:
    """A row per method and number of colours, a column per number of settings."""
    rows = []
    for colours in (1, 2):
        names = [f"{start}{colours}" for start in starts.values()]
        for method in cells.methods(names[0]):
            texts = [cells.text(case, method, "quality") for case in names]
            rows.append([str(colours), method, *texts])
    return markdown_table(["colours", "method", *starts], rows)


def _by_gap(cells: _Cells, gaps: Sequence[float]) -> str:
    names = [f"gap.{gap:g}" for gap in gaps]
    rows = [
        [method, *(cells.text(case, method, "quality") for case in names)]
        for method in cells.methods(names[0])
    ]
    return markdown_table(["method", *(f"gap {gap:g}" for gap in gaps)], rows)


def _chosen(cells: _Cells, chosen: pd.DataFrame, strengths: Sequence[Sequence[float]]) -> str:
    """For each case how often each lambda was chosen, and the quality with each and as chosen."""
    rows = []
    for number, shares in enumerate(strengths):
        case = f"choice.{number + 1}"
        own = chosen[chosen["case"] == case]
        for method in cells.methods(case):
            count = int((own["method"] == method).sum())
            quality = cells.text(case, method, "quality")
            rows.append([_percents(shares), method, f"{count} of {len(own)}", quality])
        sample = own["quality"].to_numpy()
        text = interval_text(sample.mean(), *bootstrap_interval(sample), 2)
        rows.append([_percents(shares), "as chosen", "", text])
    return markdown_table(["strengths trained on", "method", "chosen", "quality visited"], rows)


# The picture


def draw(directory: Path, summarised: pd.DataFrame) -> None:
    """Write ``control.png`` and ``control.pdf``: against lambda, settings and gap."""
    with matplotlib.rc_context({"font.size": 9, "axes.titlesize": 10, "pdf.fonttype": 42}):
        figure, axes = panels(2, 2, (11, 9.5))
        for axis, measure, title in (
            (axes[0, 0], "pays_colour", "weight of the colour in the reward (learned features)"),
            (axes[0, 1], "quality", "quality visited in the unseen setting (learned features)"),
        ):
            _draw_lambda(axis, summarised, measure)
            axis.set(title=title, xlabel="$\\lambda$ (0: ERM-balanced)")
            axis.set_xscale("symlog", linthresh=1.0)
            axis.set_xlim(left=-0.3)
        axes[0, 0].axhline(0.0, color="0.7", lw=0.8, zorder=0)
        _draw_against(axes[1, 0], summarised, "settings")
        axes[1, 0].set(title="quality visited: number of settings", xlabel="settings trained on")
        axes[1, 0].set_xscale("log")
        counts = sorted({int(c.split(".")[1]) for c in _cases(summarised, "settings.")})
        axes[1, 0].set_xticks(counts, [str(count) for count in counts], minor=False)
        axes[1, 0].minorticks_off()
        _draw_against(axes[1, 1], summarised, "gap")
        axes[1, 1].set(
            title="quality visited: gap of the colour's strengths",
            xlabel="gap between two settings",
        )
        for axis in axes.flat[1:]:
            axis.axhline(0.5, color="0.7", lw=0.8, zorder=0)
        for axis in axes.flat:
            # Below the panel: lines and bands fill its corners.
            axis.legend(
                fontsize=8,
                frameon=False,
                loc="upper center",
                bbox_to_anchor=(0.5, -0.13),
                ncols=2,
            )
        save(figure, directory, "control")


def _cases(summarised: pd.DataFrame, prefix: str) -> list[str]:
    return [case for case in summarised["case"].unique() if case.startswith(prefix)]


def _line(axis, x, rows: pd.DataFrame, label: str, **style) -> None:
    axis.plot(x, rows["mean"], label=label, ms=4, **style)
    axis.fill_between(x, rows["low"], rows["high"], color=style["color"], alpha=0.15, lw=0)


def _draw_lambda(axis, summarised: pd.DataFrame, measure: str) -> None:
    rows = summarised[summarised["measure"] == measure].set_index(["case", "method"])
    base = rows.loc[[("learned.erm", "erm-balanced")]]
    for penalty in ("irmv1-full", "irmv1", "closed-form", "vrex"):
        for suffix, style in (("", "o-"), (", labels shuffled", "s--")):
            if suffix and penalty != "irmv1-full":
                continue
            found = dict(_weights(rows.loc[f"learned.{penalty}"], penalty, suffix))
            line = pd.concat([base, rows.loc[[(f"learned.{penalty}", v) for v in found.values()]]])
            colour = _COLOURS[penalty]
            _line(
                axis,
                [0.0, *found],
                line,
                f"{penalty}{suffix}",
                ls=style[1:],
                marker=style[0],
                color=colour,
            )
    oracle = rows.loc[("learned.erm", "erm, sees the texture only")]
    axis.axhline(oracle["mean"], color=_COLOURS["texture"], ls=":", label="sees the texture only")


def _weights(rows: pd.DataFrame, penalty: str, suffix: str) -> Iterator[tuple[float, str]]:
    """(lambda, method) of one penalty, with true or with shuffled labels."""
    for method in rows.index:
        number, comma, rest = method.removeprefix(penalty).strip().partition(",")
        if comma + rest == suffix:
            yield float(number), method


def _draw_against(axis, summarised: pd.DataFrame, part: str) -> None:
    """Quality against the number in the case's name, a line per method and number of colours."""
    rows = summarised[summarised["measure"] == "quality"].set_index(["case", "method"])
    cases = _cases(summarised, f"{part}.")
    groups: dict[str, dict[float, str]] = {}
    for case in cases:
        number, _, colours = case.removeprefix(f"{part}.").partition(".colours.")
        groups.setdefault(colours, {})[float(number)] = case
    for colours, found in groups.items():
        for method in rows.loc[cases[0]].index:
            line = rows.loc[[(case, method) for case in found.values()]]
            name = "texture" if "texture" in method else method.split()[0]
            several = colours not in ("", "1")
            label = f"{method}{f', {colours} colours' if several else ''}"
            style = {"ls": "--" if several else "-", "marker": "s" if several else "o"}
            _line(axis, list(found), line, label, color=_COLOURS[name], **style)
