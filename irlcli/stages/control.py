"""The positive controls as one report: tables, and a picture of where invariance helps."""

from __future__ import annotations

import msgspec

from irlcli.configs import ControlConfig
from irlcli.stages import control_labels, control_maps
from irlcli.stages.base import From, Job, Request, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the report depends on, besides its results.

    ``control`` is for the captions.
    """

    control: ControlConfig


def parts(control: ControlConfig) -> dict[str, Request]:
    """The requests that the report is made from, by name.

    Raises:
        UsageError: as :func:`control_labels.request` and :func:`control_maps.parts`.
    """
    labels = {
        problem.replace(" ", "-"): control_labels.request(problem, control.labels)
        for problem in control_labels.PROBLEMS
    }
    return labels | control_maps.parts(control.maps)


def request(control: ControlConfig) -> Request:
    """Outputs ``README.md``, ``control.csv`` (every measure), ``control.png`` and ``control.pdf``.

    Raises:
        UsageError: as :func:`parts`.
    """
    inputs = {name: From(made) for name, made in parts(control).items()}
    return Request(STAGE, Parameters(control=control), inputs, "control")


def run(job: Job) -> None:
    """Summarise the results and draw; nothing is fitted here."""
    import pandas as pd

    from irlcli.data.outputs import write_csv
    from irlcli.report import control

    found: dict[str, list[pd.DataFrame]] = {"accuracy.parquet": [], "results.parquet": []}
    for directory in job.inputs.values():
        for name, frames in found.items():
            if (directory / name).is_file():
                frames.append(pd.read_parquet(directory / name))
    labels, maps = (pd.concat(frames, ignore_index=True) for frames in found.values())
    summary = control.summary(labels, maps)
    choices = control.choices(maps)
    write_csv(job.output / "control.csv", summary)
    control.draw(job.output, summary)
    page = control.page(summary, choices, job.parameters.control)
    (job.output / "README.md").write_text(page, encoding="utf-8")


STAGE = Stage("control", 4, run)
