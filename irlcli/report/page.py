"""A report as Markdown, as LaTeX, and as one self-contained HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape

from irlcli.labels import duration
from irlcli.report.agents import title
from irlcli.report.build import Report
from irlcli.report.lineage import commits, lineage
from irlcli.report.parameters import Parameters, bank_picture
from irlcli.report.tables import REWARD_QUALITY, Table, latex_table, markdown_table
from irlcli.report.text import number

_RETURNS = "Every seed, the mean and its 95 % bootstrap interval."
_SHARES = "Every seed and the mean, as a share of the experts; the lines are the gates."
_VARIANT_FILES = "`variants.csv`: a row per variant. `shares.csv`: shares of the experts, by seed. "


def latex(report: Report) -> str:
    """Every table; the caveats and what stands above them are comments."""
    comments = "".join(f"% {line}\n" for line in (*report.in_short, *report.caveats))
    tables = [
        latex_table(t.columns, t.rows, f"{t.title}. {_plain(t.note)}".strip())
        for t in report.tables
    ]
    return f"% Needs \\usepackage{{booktabs,longtable}}.\n{comments}\n" + "\n".join(tables)


def markdown(p: Parameters, report: Report) -> str:
    """The report without learning curves and lineage."""
    parts = [f"# {p.title}\n", f"`{p.command}`, {_made(p)}\n"]
    parts.append(f"![every seed]({p.kind}.png)\n")
    for heading, lines in (("In short", report.in_short), ("Caveats", report.caveats)):
        if lines:
            parts += [f"## {heading}\n", "".join(f"- {line}\n" for line in lines)]
    for table in report.tables:
        parts += [f"## {table.title}\n", markdown_table(table.columns, table.rows)]
        if table.title == REWARD_QUALITY:
            rows = dict.fromkeys(report.reward_quality["row"])
            parts += [f"![{row}]({bank_picture(row)})\n" for row in rows]
        parts += [table.note + "\n"] if table.note else []
    parts.append("## Files\n")
    parts.append(
        f"`{p.kind}.csv`: a row per cell. `seeds.csv`: a row per seed and setting. `comparisons.csv`: a "
        f"row per comparison. {_VARIANT_FILES * bool(p.variants)}`{p.kind}.json`: all numbers. "
        f"`{p.kind}.html`: all of this with learning curves and lineage on one page. `{p.kind}.tex`: needs booktabs and longtable. `{p.kind}.png`, "
        f"`.pdf`: {(_SHARES if p.variants else _RETURNS).lower()}\n"
    )
    return "\n".join(parts)


def _plain(note: str) -> str:
    """``note`` without Markdown's emphasis and code."""
    return note.replace("*", "").replace("`", "")


def _made(p: Parameters) -> str:
    # Only runs behind a number that is shown.
    runs = [p.runs[i] for i in lineage(p, p.cells)]
    states = {state for run in runs for state in run.code}
    named = sorted({state.commit or "unknown" for state in states})
    dirty = " with uncommitted changes" if any(state.dirty for state in states) else ""
    total = duration(sum(run.seconds or 0.0 for run in runs))
    return f"from {len(runs)} runs that took {total}, at commit {', '.join(named)}{dirty}."


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
.lines li { margin: .2rem 0; }
@media print { nav, .skip { display: none; } body { font-size: 10pt; max-width: none; }
  .wide { overflow: visible; } figure, tr { break-inside: avoid; } h2 { break-after: avoid; } }
"""


def html(
    p: Parameters,
    report: Report,
    points: str,
    banks: Mapping[str, str],
    curves: Mapping[str, str],
) -> str:
    """One self-contained page.

    Args:
        points: SVG of every seed's point.
        banks, curves: SVGs by title.
    """
    first = len(p.rows) if p.variants else len(p.measures)
    sections = [
        *([("In short", _list(report.in_short))] if report.in_short else []),
        (
            "Caveats",
            _list(report.caveats)
            if report.caveats
            else "<p>None: no run is missing, mixed or left out.</p>",
        ),
        *((t.title, _html_table(t)) for t in report.tables[:first]),
        ("Every seed", _figure(_SHARES if p.variants else _RETURNS, points)),
        *((t.title, _html_table(t)) for t in report.tables[first:]),
        *(
            [("Learned against true return", "".join(_figure(t, svg) for t, svg in banks.items()))]
            if banks
            else []
        ),
        ("Every seed in numbers", _html_table(_seeds(report))),
        (
            "Learning curves",
            "<p>A thin line is a seed, the thick one their mean. The true return is only recorded; "
            "no policy learns from it.</p>" + "".join(_figure(t, svg) for t, svg in curves.items())
            if curves
            else "<p>No learning curves exist yet.</p>",
        ),
        ("Lineage", _lineage(p)),
        ("Configs and libraries", _configs(p)),
    ]
    body = "".join(
        f'<section id="s{i}"><h2>{escape(heading)}</h2>{content}</section>'
        for i, (heading, content) in enumerate(sections)
    )
    links = "".join(
        f'<li><a href="#s{i}">{escape(heading.partition(":")[0])}</a></li>'
        for i, (heading, _) in enumerate(sections)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(p.title)}</title><style>{_CSS}</style></head><body>"
        '<a class="skip" href="#content">Skip to the results</a>'
        f"<header><h1>{escape(p.title)}</h1>"
        f"<p><code>{escape(p.command)}</code>, {escape(_made(p))}</p></header>"
        f'<nav aria-label="Contents"><ul>{links}</ul></nav>'
        f'<main id="content">{body}</main></body></html>\n'
    )


def _list(lines: Sequence[str]) -> str:
    return f'<ul class="lines">{"".join(f"<li>{escape(line)}</li>" for line in lines)}</ul>'


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
    # Focusable, so that the keyboard can scroll a table that is wider than the page.
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{escape(table.title)}"><table>'
        f"<caption>{escape(_plain(table.note) or table.title)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _seeds(report: Report) -> Table:
    rows = [
        [
            point.row,
            title(point.agent),
            point.measure,
            number(point.seed, 0),
            str(point.retraining),
            point.setting,
            number(point.true_return),
            number(point.progress),
            number(point.learned_return),
            str(point.episodes),
            point.evaluation,
        ]
        for point in report.points.itertuples()
    ]
    columns = ["row", "agent", "measure", "seed", "retraining", "setting"]
    columns += ["true return", "progress", "learned return", "episodes", "evaluation"]
    note = "Means over the episodes of an evaluation."
    return Table("Every seed in numbers", note, columns, rows, 6)


def _lineage(p: Parameters) -> str:
    """For every cell, the artefacts behind it, down to the experts."""
    parts = []
    for cell in p.cells:
        if cell.run:
            seed = "" if cell.seed is None else f", seed {cell.seed}"
            seed += f", retraining {cell.retraining}" if cell.retraining else ""
            setting = f", {cell.setting}" if cell.setting else ""
            heading = f"{cell.row}, {title(cell.agent)}, {cell.measure}{setting}{seed}"
            tree = escape("\n".join(_tree(p, cell.run)))
            parts.append(
                f"<details><summary>{escape(heading)}</summary><pre>{tree}</pre></details>"
            )
    return "".join(parts)


def _tree(p: Parameters, id16: str, descendants: tuple[str, ...] = ()) -> list[str]:
    indent = "  " * len(descendants)
    if id16 in descendants:
        # Only in a crafted store.
        return [f"{indent}{id16}  made from itself"]
    if id16 not in p.runs:
        return [f"{indent}{id16}  not a run of this report"]
    run = p.runs[id16]
    took = "" if run.seconds is None else f"  {duration(run.seconds)}"
    line = f"{indent}{id16}  {run.stage}  {run.about}{took}  at {', '.join(commits([run]))}"
    return [line, *(x for i in run.inputs for x in _tree(p, i, (*descendants, id16)))]


def _configs(p: Parameters) -> str:
    parts = ["<p>Configs are those of the rows. A method sets its own grouping and penalty.</p>"]
    parts += [
        f"<details><summary>{escape(row.name)}</summary><pre>"
        f"{escape(json.dumps(row.config, indent=1, sort_keys=True))}</pre></details>"
        for row in p.rows
    ]
    parts += [
        f"<details><summary>libraries {escape(name)}</summary><pre>"
        f"{escape(json.dumps(versions, indent=1, sort_keys=True))}</pre></details>"
        for name, versions in p.libraries.items()
    ]
    return "".join(parts)
