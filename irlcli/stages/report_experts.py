"""What the experts of every setting earn, how they learned, and which are missing.

Its inputs are evaluations and metrics, known by their content. What else it prints (which run took
how long, at which commit) are parameters, so that equal requests give equal bytes.
"""

from collections.abc import Mapping

import msgspec

from irlcli.report.parameters import EXPERT_LEARNING, Cell, Run
from irlcli.stages.base import Job, Request, Source, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the report depends on, besides its evaluations and metrics.

    Attributes:
        command: the command line that produces this report; printed in it.
        steps: the budget of an expert, by row: ``ENV KNOB``.
        bars: the least mean true return of an expert, by row that has a bar.
        cells: rows are ``ENV KNOB``; measures are ``id`` and ``ood``.
        runs: provenance of the artefacts, by id.
        libraries: the sets of library versions that occur, by a short name.
    """

    command: str
    steps: dict[str, int]
    bars: dict[str, float]
    cells: tuple[Cell, ...]
    runs: dict[str, Run]
    libraries: dict[str, dict[str, str | None]]


def request(parameters: Parameters, sources: Mapping[str, Source]) -> Request:
    """The report on ``sources``: evaluations by :attr:`Cell.role`, and ``metrics.parquet`` files.

    The latter are ``ENV SETTING learning``. Outputs ``README.md``, ``experts.csv`` (a row per
    setting), ``experts.json``, ``experts.png`` and ``experts.pdf``.
    """
    return Request(STAGE, parameters, dict(sources), "report experts")


def run(job: Job) -> None:
    """Read the evaluations and metrics, and lay them out."""
    import pandas as pd

    from irlcli.data import descriptions
    from irlcli.data.outputs import write_csv, write_json
    from irlcli.report import experts
    from irlcli.store import read_json

    p: Parameters = job.parameters
    summaries = {}
    for cell in p.cells:
        if cell.run:
            path = job.inputs[cell.role] / "summary.json"
            summary = descriptions.parse(read_json(path), descriptions.Evaluation, path)
            for measured in summary.settings:
                summaries[cell.agent, summary.policy.env, measured.setting] = measured
    learning = {
        role: pd.read_parquet(path)
        for role, path in job.inputs.items()
        if role.endswith(f" {EXPERT_LEARNING}")
    }
    numbers = experts.summarise(p.cells, p.runs, p.steps, summaries)
    table = experts.text_table(numbers)
    caveats = experts.caveats(p.cells, numbers, p.bars)
    write_csv(job.output / "experts.csv", numbers)
    write_json(job.output / "experts.json", {"tables": [table._asdict()], "caveats": caveats})
    (job.output / "README.md").write_text(
        experts.markdown(p.command, table, caveats), encoding="utf-8"
    )
    experts.draw(job.output, p.cells, learning)


STAGE = Stage("report-experts", 9, run)
