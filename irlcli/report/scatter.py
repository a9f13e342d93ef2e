"""Learned against true return of a bank of policies, a panel for each setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from irlcli.data.descriptions import Assessment, BankEntry
from irlcli.report import drawing
from irlcli.report.agents import title
from irlcli.report.compute import Assessments
from irlcli.report.parameters import Parameters, bank_picture
from irlcli.report.plots import INK, as_svg, style

# Kind of policy to its name in the legend and to Okabe and Ito's colours.
KINDS = {
    "idle": ("idle", "#777777"),
    "random": ("random", "#AAAAAA"),
    "clone": ("clone, every noise", "#56B4E9"),
    "student": ("student", "#0072B2"),
    "reused": ("expert of another setting", "#E69F00"),
    "expert": ("the setting's expert", "#009E73"),
    "retrained": ("retrained", "#D55E00"),
    "from-student": ("retrained from the student", "#CC79A7"),
}
_DPI = 110


def draw_bank(directory: Path, assessment: Assessment) -> None:
    """Write ``scatter.png`` and ``scatter.svg``: a panel for each setting."""
    panels = [_by_setting(assessment)]
    with style("black"):
        _scatter(panels).savefig(directory / "scatter.png", dpi=_DPI)
    with style(INK):
        (directory / "scatter.svg").write_text(
            as_svg(_scatter(panels), "scatter") + "\n", encoding="utf-8"
        )


def draw_banks(directory: Path, p: Parameters, assessments: Assessments) -> dict[str, str]:
    """Write ``bank-ENV-KNOB.png`` for each row: a line of panels per method, all seeds in them.

    Returns:
        the same as SVGs, by title.
    """
    found: dict[str, str] = {}
    for row in p.rows:
        lines = []
        for method in p.methods:
            seeds = [assessments.get((row.name, method, seed)) for seed in p.seeds]
            panels: dict[str, list[BankEntry]] = {}
            for assessment in filter(None, seeds):
                for setting, entries in _by_setting(assessment).items():
                    panels.setdefault(f"{title(method)}, {setting}", []).extend(entries)
            lines += [panels] if panels else []
        if not lines:
            continue
        with style("black"):
            _scatter(lines).savefig(directory / bank_picture(row.name), dpi=_DPI)
        with style(INK):
            name = f"{row.name}: the bank's policies, bars are standard errors over episodes"
            found[name] = as_svg(_scatter(lines), f"bank{len(found)}")
    return found


def _by_setting(assessment: Assessment) -> dict[str, list[BankEntry]]:
    return {
        s.setting: [e for e in assessment.bank if e.setting == s.setting]
        for s in assessment.settings
    }


def _scatter(lines: Sequence[Mapping[str, Sequence[BankEntry]]]) -> Figure:
    """A panel for each title; bars are standard errors over episodes."""
    wide = max(len(panels) for panels in lines)
    size = (0.6 + 3.4 * wide, 0.6 + 3.0 * len(lines))
    figure, axes = drawing.panels(len(lines), wide, size)
    for line, panels in zip(axes, lines, strict=True):
        line[0].set_ylabel("learned return")
        for axis, (heading, entries) in zip(line, panels.items(), strict=True):
            for kind, (_, colour) in KINDS.items():
                found = [e for e in entries if e.kind == kind]
                axis.errorbar(
                    [e.true.mean for e in found],
                    [e.learned.mean for e in found],
                    [e.learned.error or 0.0 for e in found],
                    [e.true.error or 0.0 for e in found],
                    fmt="o",
                    **{"ms": 5, "color": colour, "lw": 0.8, "alpha": 0.8},
                )
            axis.set_title(heading)
            axis.grid(alpha=0.25)
    for axis in axes[-1]:
        axis.set_xlabel("true return")
    drawn = {e.kind for panels in lines for entries in panels.values() for e in entries}
    handles = [
        Line2D([], [], marker="o", ls="", color=colour, label=name)
        for kind, (name, colour) in KINDS.items()
        if kind in drawn
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure
