"""Learned against true return of a bank of policies, a panel for each setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from irlcli.data.descriptions import Assessment, BankEntry
from irlcli.report.plots import INK, as_svg, plt, style

# Kind of policy to its name in the legend and to Okabe and Ito's colours.
KINDS = {
    "idle": ("idle", "#777777"),
    "random": ("random", "#AAAAAA"),
    "clone": ("clone, with noise", "#56B4E9"),
    "student": ("student", "#0072B2"),
    "reused": ("expert of another setting", "#E69F00"),
    "expert": ("the setting's expert", "#009E73"),
    "retrained": ("retrained", "#D55E00"),
}


def draw_bank(directory: Path, assessment: Assessment) -> None:
    """Write ``scatter.png`` and ``scatter.svg``."""
    panels = {
        s.setting: [e for e in assessment.bank if e.setting == s.setting]
        for s in assessment.settings
    }
    with style("black"):
        figure = scatter(panels)
        figure.savefig(directory / "scatter.png", dpi=130)
        plt.close(figure)
    with style(INK):
        (directory / "scatter.svg").write_text(as_svg(scatter(panels), "scatter") + "\n")


def scatter(panels: Mapping[str, Sequence[BankEntry]]) -> plt.Figure:
    """A panel for each title; bars are standard errors over episodes."""
    size = (0.6 + 3.4 * len(panels), 3.6)
    figure, axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
    for axis, (title, entries) in zip(axes[0], panels.items(), strict=True):
        for kind, (_, colour) in KINDS.items():
            found = [e for e in entries if e.kind == kind]
            axis.errorbar(
                [e.true.mean for e in found],
                [e.learned.mean for e in found],
                [e.learned.error or 0.0 for e in found],
                [e.true.error or 0.0 for e in found],
                fmt="o",
                **{"ms": 5, "color": colour, "lw": 0.8, "alpha": 0.85},
            )
        axis.set_title(title)
        axis.set_xlabel("true return")
        axis.grid(alpha=0.25)
    axes[0, 0].set_ylabel("learned return")
    drawn = {e.kind for entries in panels.values() for e in entries}
    handles = [
        plt.Line2D([], [], marker="o", ls="", color=colour, label=name)
        for kind, (name, colour) in KINDS.items()
        if kind in drawn
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure
