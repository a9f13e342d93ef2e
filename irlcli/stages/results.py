"""A table or figure of the paper from evaluations: numbers, statistics, curves, and one page.

Its inputs are evaluations and learning curves, known by their content. What else it prints (which
run on which commit took how long) are parameters, so that equal requests give equal bytes.
"""

from collections.abc import Mapping
from typing import Any

import msgspec

from irlcli.stages.base import Job, Request, Source, Stage


class Cell(msgspec.Struct, frozen=True, kw_only=False):
    """One evaluation that the table needs.

    Attributes:
        row: ``ENV KNOB``.
        agent: a method, ``expert``, ``random``, ``idle``, or ``carried``: an expert of a setting
            trained in, measured in others too.
        measure: ``transfer``, ``zero-shot``, ``id``, or ``ood`` of an agent that learns nothing;
            ``expert by reward``: what the unseen setting's expert earns of the seed's reward.
        seed: of the reward learning; None for agents without one.
        place: the setting that an expert was trained in, or where another agent is measured.
        run: id of the evaluation; empty if it is not there.
        why: what a missing one waits for.
    """

    row: str
    agent: str
    measure: str
    seed: int | None = None
    place: str = ""
    run: str = ""
    why: str = ""

    @property
    def role(self) -> str:
        """Name of the evaluation among the inputs."""
        seed = "-" if self.seed is None else self.seed
        return f"{self.row} {self.agent} {seed} {self.measure} {self.place}".strip()


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One environment and knob: the settings, and every setting (in both senses) of its stages.

    ``chosen`` maps ``METHOD SEED`` to its lambda where that was chosen by leaving a setting out.
    """

    env: str
    knob: str
    trained: tuple[str, ...]
    unseen: str
    demonstrations: tuple[int, ...]
    settings: dict[str, Any]
    chosen: dict[str, float] = {}

    @property
    def name(self) -> str:
        """``ENV KNOB``."""
        return f"{self.env} {self.knob}"


class Code(msgspec.Struct, frozen=True, kw_only=True):
    """What a process ran on: a commit, and a digest of what was not committed; None if unknown."""

    commit: str | None
    dirty: str | None


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of one artefact; None where its provenance does not say.

    ``code`` has each state that one of its attempts ran on; ``libraries`` names an entry of
    :attr:`Parameters.libraries`, ``inputs`` are artefacts' ids.
    """

    stage: str
    about: str
    code: tuple[Code, ...]
    libraries: str
    seconds: float | None
    resumed: int | None
    inputs: tuple[str, ...]


class Others(msgspec.Struct, frozen=True, kw_only=True):
    """Runs of what a cell is about that were made otherwise and are therefore left out."""

    stage: str
    about: str
    why: str
    ids: tuple[str, ...]


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a report depends on, besides its evaluations and learning curves."""

    kind: str
    title: str
    command: str
    measures: tuple[str, ...]
    rows: tuple[Row, ...]
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    cells: tuple[Cell, ...]
    runs: dict[str, Run]
    libraries: dict[str, dict[str, str | None]]
    others: tuple[Others, ...]


def request(parameters: Parameters, sources: Mapping[str, Source]) -> Request:
    """The report on ``sources``: evaluations by :attr:`Cell.role`, and ``metrics.parquet`` files.

    The latter are ``ROW METHOD SEED reward-learning`` and ``... transfer-learning``. Outputs
    ``README.md``, ``KIND.csv`` (a row per cell), ``seeds.csv`` (every seed's point),
    ``comparisons.csv``, ``KIND.json``, ``.tex``, ``.html``, ``.png`` and ``.pdf``.
    """
    return Request(STAGE, parameters, dict(sources), f"report {parameters.kind}")


def run(job: Job) -> None:
    """Read the evaluations and write what is said of them; nothing is computed but statistics."""
    import pandas as pd

    from irlcli.data import descriptions
    from irlcli.data.outputs import write_json
    from irlcli.report import curves, pages, results
    from irlcli.store import read_json

    p: Parameters = job.parameters
    points, episodes = [], {}
    for cell in p.cells:
        if not cell.run:
            continue
        directory = job.inputs[cell.role]
        path = directory / "summary.json"
        summary = descriptions.parse(read_json(path), descriptions.Evaluation, path)
        base = {"row": cell.row, "agent": cell.agent, "measure": cell.measure, "seed": cell.seed}
        of_expert = cell.agent in ("expert", "carried") or cell.measure == results.EXPERT_PAID
        base["expert_of"] = cell.place if of_expert else ""
        points += [
            {
                **base,
                "setting": place.setting,
                "true_return": place.mean_return,
                "progress": place.mean_progress,
                "learned_return": place.mean_learned_return,
                "episodes": place.episodes,
                "evaluation": cell.run,
            }
            for place in summary.settings
        ]
        if cell.seed is not None and cell.measure in p.measures:
            returns = pd.read_parquet(directory / "episodes.parquet", columns=["true_return"])
            group = episodes.setdefault((cell.row, cell.measure), {})
            group[cell.agent, cell.seed] = returns["true_return"].to_numpy()
    learning = {
        role: pd.read_parquet(path)
        for role, path in job.inputs.items()
        if role.endswith("-learning")
    }
    rewards = {
        (row.name, method, seed): learning[role]
        for row in p.rows
        for method in p.methods
        for seed in p.seeds
        if (role := f"{row.name} {method} {seed} reward-learning") in learning
    }
    report = results.build(p, pd.DataFrame(points), episodes, rewards)
    report.cells.to_csv(job.output / f"{p.kind}.csv", **_CSV)
    report.points.to_csv(job.output / "seeds.csv", **_CSV)
    report.comparisons.to_csv(job.output / "comparisons.csv", **_CSV)
    write_json(job.output / f"{p.kind}.json", results.as_json(report))
    (job.output / "README.md").write_text(pages.markdown(p, report))
    (job.output / f"{p.kind}.tex").write_text(pages.latex(report))
    picture = curves.draw_points(job.output, p, report)
    pictures = curves.learning_curves(p, learning)
    (job.output / f"{p.kind}.html").write_text(pages.html(p, report, picture, pictures))


_CSV = {"index": False, "float_format": "%.6g", "lineterminator": "\n"}
STAGE = Stage("report", 8, run)
