"""A report laid out as Markdown, LaTeX, and one HTML page that needs nothing else."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape

import pandas as pd

from irlcli.report.results import TITLES, Plan, Report, Table, commits, duration, lineage
from irlcli.report.tables import latex_table, markdown_table


def latex(report: Report) -> str:
    """Every table, and what must be known as comments."""
    notes = "".join(f"% {note}\n" for note in report.notes)
    tables = [latex_table(t.columns, t.rows, f"{t.title}. {t.note}".strip()) for t in report.tables]
    return f"% Needs \\usepackage{{booktabs}}.\n{notes}\n" + "\n".join(tables)


def markdown(plan: Plan, report: Report) -> str:
    """The whole report but for the learning curves and the lineage."""
    parts = [f"# {plan.title}\n", f"`{plan.command}`, {_made(plan)}\n"]
    parts.append(f"![every seed]({plan.kind}.png)\n")
    if report.notes:
        parts.append("## Before believing it\n")
        parts.append("".join(f"- {note}\n" for note in report.notes))
    for table in report.tables:
        parts += [f"## {table.title}\n", markdown_table(table.columns, table.rows)]
        parts += [table.note + "\n"] if table.note else []
    parts.append("## Files\n")
    parts.append(
        f"`{plan.kind}.csv`: a row per cell. `seeds.csv`: every seed's point. `comparisons.csv`. "
        f"`{plan.kind}.html`: all of this with learning curves and lineage in one page. "
        f"`{plan.kind}.tex`: booktabs and longtable. `{plan.kind}.png`, `.pdf`: every seed, the mean, its 95 % "
        "interval.\n"
    )
    return "\n".join(parts)


def _made(plan: Plan) -> str:
    # An intermediate result that nothing shown stands on is not counted.
    runs = [plan.runs[i] for i in lineage(plan, (c.run for c in plan.cells if c.run))]
    states = {state for run in runs for state in run.code}
    named = sorted({state.commit or "unknown" for state in states})
    dirty = " with uncommitted changes" if any(state.dirty for state in states) else ""
    total = duration(sum(run.seconds or 0.0 for run in runs))
    return f"on {len(runs)} runs, {total} in all, made at commit {', '.join(named)}{dirty}."


# HTML

_CSS = """
:root { color-scheme: light dark; --ink: #1b1b1b; --paper: #fff; --faint: #6663; --link: #0b57a4; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e4e4; --paper: #16181b; --faint: #9994;
  --link: #8ab8f0; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 84rem; margin: 0 auto; padding: 1rem; }
a { color: var(--link); }
a:focus-visible, summary:focus-visible, .wide:focus-visible { outline: 3px solid var(--link); }
.skip { position: absolute; left: -99rem; } .skip:focus { position: static; }
nav ul { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; padding: 0; list-style: none; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding: .3rem 0; max-width: 60rem; }
th, td { text-align: left; padding: .25rem .7rem; border-bottom: 1px solid var(--faint);
  vertical-align: top; white-space: nowrap; }
thead th { border-bottom: 2px solid var(--ink); white-space: normal; }
tbody th { font-weight: normal; }
tr.paper td, tr.paper th { font-style: italic; opacity: .8; }
figure { margin: 1rem 0; } figure svg { max-width: 100%; height: auto; }
pre { font-size: .82rem; overflow-x: auto; } summary { cursor: pointer; padding: .15rem 0; }
.notes li { margin: .2rem 0; }
@media print { nav, .skip { display: none; } body { font-size: 10pt; max-width: none; }
  .wide { overflow: visible; } figure, tr { break-inside: avoid; } h2 { break-after: avoid; } }
"""


def html(plan: Plan, report: Report, points: str, curves: Mapping[str, str]) -> str:
    """One self-contained page.

    Args:
        points: SVG of every seed's point.
        curves: SVGs by title.
    """
    sections = [
        (
            "Before believing it",
            f'<ul class="notes">{"".join(f"<li>{escape(n)}</li>" for n in report.notes)}</ul>'
            if report.notes
            else "<p>Nothing is missing, mixed or left out.</p>",
        ),
        *((t.title, _html_table(t)) for t in report.tables[: len(plan.measures)]),
        ("Every seed", _figure("Every seed, the mean and its 95 % bootstrap interval.", points)),
        *((t.title, _html_table(t)) for t in report.tables[len(plan.measures) :]),
        ("Every seed in numbers", _html_table(_seeds(report))),
        (
            "Learning curves",
            "<p>A thin line is a seed, the thick one their mean. The true return is only looked at, "
            "never learned from.</p>" + "".join(_figure(t, svg) for t, svg in curves.items())
            if curves
            else "<p>No learning curve is there yet.</p>",
        ),
        ("Lineage", _lineage(plan)),
        ("Settings and libraries", _settings(plan)),
    ]
    body = "".join(
        f'<section id="s{i}"><h2>{escape(title)}</h2>{content}</section>'
        for i, (title, content) in enumerate(sections)
    )
    links = "".join(
        f'<li><a href="#s{i}">{escape(title.partition(":")[0])}</a></li>'
        for i, (title, _) in enumerate(sections)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(plan.title)}</title><style>{_CSS}</style></head><body>"
        '<a class="skip" href="#content">Skip to the results</a>'
        f"<header><h1>{escape(plan.title)}</h1>"
        f"<p><code>{escape(plan.command)}</code>, {escape(_made(plan))}</p></header>"
        f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
        f'<main id="content">{body}</main></body></html>\n'
    )


def _figure(caption: str, svg: str) -> str:
    label = f'<svg role="img" aria-label="{escape(caption)}"'
    return f"<figure>{svg.replace('<svg', label, 1)}<figcaption>{escape(caption)}</figcaption></figure>"


def _html_table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(c)}</th>' for c in table.columns)
    lines = []
    for row in table.rows:
        cells = [
            f'<th scope="row">{escape(c)}</th>' if i < table.heads else f"<td>{escape(c)}</td>"
            for i, c in enumerate(row)
        ]
        kind = ' class="paper"' if row[1] == "paper" else ""
        lines.append(f"<tr{kind}>{''.join(cells)}</tr>")
    # Focusable, so that a keyboard can scroll what is wider than the page.
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{escape(table.title)}"><table>'
        f"<caption>{escape(table.note or table.title)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _seeds(report: Report) -> Table:
    rows = [
        [
            p.row,
            TITLES[p.agent],
            p.measure,
            "-" if pd.isna(p.seed) else f"{p.seed:.0f}",
            p.setting,
            f"{p.true_return:.1f}",
            *("-" if pd.isna(v) else f"{v:.1f}" for v in (p.progress, p.learned_return)),
            str(p.episodes),
            p.evaluation,
        ]
        for p in report.points.itertuples()
    ]
    columns = ["row", "agent", "measure", "seed", "setting", "true return", "progress"]
    columns += ["learned return", "episodes", "evaluation"]
    note = "A number is the mean over an evaluation's episodes."
    return Table("Every seed in numbers", note, columns, rows, 5)


def _lineage(plan: Plan) -> str:
    """For every cell, the artefacts it was made from, down to the experts."""
    parts = []
    for cell in plan.cells:
        if cell.run:
            seed = "" if cell.seed is None else f", seed {cell.seed}"
            place = f", {cell.place}" if cell.place else ""
            title = f"{cell.row}, {TITLES[cell.agent]}, {cell.measure}{place}{seed}"
            tree = escape("\n".join(_tree(plan, cell.run, "")))
            parts.append(f"<details><summary>{escape(title)}</summary><pre>{tree}</pre></details>")
    return "".join(parts)


def _tree(plan: Plan, id16: str, indent: str) -> list[str]:
    if id16 not in plan.runs:
        return [f"{indent}{id16}  not among the runs planned for"]
    run = plan.runs[id16]
    took = "" if run.seconds is None else f"  {duration(run.seconds)}"
    line = f"{indent}{id16}  {run.stage}  {run.about}{took}  at {', '.join(commits([run]))}"
    return [line, *(x for i in run.inputs for x in _tree(plan, i, indent + "  "))]


def _settings(plan: Plan) -> str:
    parts = [
        f"<details><summary>{escape(row.name)}</summary><pre>"
        f"{escape(json.dumps(row.settings, indent=1, sort_keys=True))}</pre></details>"
        for row in plan.rows
    ]
    parts += [
        f"<details><summary>libraries {escape(name)}</summary><pre>"
        f"{escape(json.dumps(versions, indent=1, sort_keys=True))}</pre></details>"
        for name, versions in plan.libraries.items()
    ]
    return "".join(parts)
