"""What a report is about: the evaluations it wants, those that exist, and how they were made.

These are parameters of the stages ``report`` and ``report-experts``. Importing them loads nothing
heavy, because planning a report needs them.
"""

from collections.abc import Sequence
from typing import Any

import msgspec

from irlcli.report.agents import IN_DISTRIBUTION

# The measure of cells in which the held-out setting's expert is scored by a learned reward.
EXPERT_BY_REWARD = "expert by reward"
# The measure of cells that hold no returns but the assessment of a learned reward.
ASSESS = "assess"
# The measure of cells that hold no returns but how a learned reward depends on a cue.
CUE = "cue"
# The CSV files of a comparison, beside the one with the table's name.
PARTS = ("seeds", "comparisons", "variants", "shares")


def has_held_out(measures: Sequence[str]) -> bool:
    """Whether some of ``measures`` are taken in the held-out setting."""
    return not set(measures) <= {*IN_DISTRIBUTION, ASSESS, CUE}


# Parts of a run whose metrics a report draws.
REWARD_LEARNING = "reward-learning"
TRANSFER_LEARNING = "transfer-learning"
EXPERT_LEARNING = "learning"


def curve_role(row: str, method: str, seed: int, part: str) -> str:
    """The role of the metrics of a reward's ``part``, among the inputs of a report."""
    return f"{row} {method} {seed} {part}"


class Cell(msgspec.Struct, frozen=True):
    """One evaluation that the report needs.

    Attributes:
        row: ``ENV KNOB``.
        agent: a method, ``expert``, ``random``, ``idle``, or ``reused``: the expert of a training
            setting, evaluated in the other settings in which the students are evaluated.
        measure: ``transfer`` (the retrained policy), ``from-student`` (retrained from the student
            on), ``transfer-id`` (retrained in a training setting, ``setting``), ``zero-shot`` or
            ``id`` (the student, in the held-out setting or in distribution), ``ood`` for an agent
            without a reward, ``expert by reward``: the held-out setting's expert, scored by this
            seed's reward, ``assess``: the reward itself, measured on a bank of policies, or
            ``cue``: how it depends on a cue.
        seed: of the reward learning; None for agents without one.
        setting: that in which an expert was trained, or in which another agent is evaluated.
        run: id of the evaluation; empty if it is missing.
        why: what a missing one waits for.
        retraining: number of the policy trained on this seed's reward, from 0.
    """

    row: str
    agent: str
    measure: str
    seed: int | None = None
    setting: str = ""
    run: str = ""
    why: str = ""
    retraining: int = 0

    @property
    def env(self) -> str:
        """The row's environment."""
        return self.row.split()[0]

    @property
    def knob(self) -> str:
        """The row's knob."""
        return self.row.split()[1]

    @property
    def role(self) -> str:
        """Name of the evaluation among the stage's inputs."""
        seed = "-" if self.seed is None else self.seed
        text = f"{self.row} {self.agent} {seed} {self.measure} {self.setting}".strip()
        return f"{text} retraining {self.retraining}" if self.retraining else text

    def curve_role(self, part: str) -> str:
        """The role of the metrics of training behind it; an expert's have no part of a reward's run."""
        if self.agent == "expert":
            return f"{self.env} {self.setting} {part}"
        assert self.seed is not None
        return curve_role(self.row, self.agent, self.seed, part)


class Variant(msgspec.Struct, frozen=True):
    """A named set of overrides such as ``transfer.ceiling=none``."""

    name: str
    overrides: tuple[str, ...] = ()


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One environment and knob.

    Attributes:
        trained: the settings trained in.
        unseen: the held-out setting.
        demonstrations: episodes of each setting trained in.
        config: the configs of the row's stages, by stage, as JSON values.
        chosen: lambda by ``METHOD SEED``, where it was chosen by leaving a setting out, and by
            ``METHOD``, where the table says it.
        student_share: the weight of the student's cross-entropy in the discriminator's loss, by method
            or variant; missing without challengers, where it is 1.
    """

    env: str
    knob: str
    trained: tuple[str, ...]
    unseen: str
    demonstrations: tuple[int, ...]
    config: dict[str, Any]
    chosen: dict[str, float] = {}
    student_share: dict[str, float] = {}

    @property
    def name(self) -> str:
        """``ENV KNOB``."""
        return f"{self.env} {self.knob}"

    def settings_of(self, measure: str) -> tuple[str, ...]:
        """The settings in which ``measure`` is taken."""
        return self.trained if measure in IN_DISTRIBUTION else (self.unseen,)


class Code(msgspec.Struct, frozen=True, kw_only=True):
    """The code of a run: a commit, and a digest of uncommitted changes. None means unknown."""

    commit: str | None
    dirty: str | None


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """The provenance of one artefact; None if unknown.

    Attributes:
        about: environment, settings, method and agent, for people.
        code: the code of each of its attempts.
        libraries: a key of :attr:`Parameters.libraries`.
        seconds: run time of all attempts, each up to its last checkpoint.
        resumed: how often it was resumed.
        inputs: ids of the artefacts it was made from.
    """

    stage: str
    about: str
    code: tuple[Code, ...]
    libraries: str
    seconds: float | None
    resumed: int | None
    inputs: tuple[str, ...]


class Others(msgspec.Struct, frozen=True, kw_only=True):
    """Runs for the same cell as one in the report, made with other parameters and so left out."""

    stage: str
    about: str
    why: str
    ids: tuple[str, ...]


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a report on a table or figure depends on, besides its evaluations and metrics.

    Attributes:
        kind: of report, such as ``table1``.
        command: the command line that produces this report; printed in it.
        measures: keys of :data:`irlcli.report.agents.MEASURES`.
        methods: what is compared; the names of the variants where there are variants.
        variants: of the config, that with which the others are compared first.
        learned_by: the method of all variants; empty without variants.
        retrainings: policies trained on each reward.
        runs: provenance of the artefacts, by id.
        libraries: the sets of library versions that occur, by a short name.
    """

    kind: str
    title: str
    command: str
    measures: tuple[str, ...]
    rows: tuple[Row, ...]
    methods: tuple[str, ...]
    variants: tuple[Variant, ...] = ()
    learned_by: str = ""
    seeds: tuple[int, ...]
    retrainings: int = 1
    cells: tuple[Cell, ...]
    runs: dict[str, Run]
    libraries: dict[str, dict[str, str | None]]
    others: tuple[Others, ...]

    def cells_of(
        self, row: str, agent: str | None = None, measure: str | None = None
    ) -> list[Cell]:
        """The cells of a row, or of one of its agents, or of one measure of that agent."""
        return [
            c
            for c in self.cells
            if c.row == row and agent in (None, c.agent) and measure in (None, c.measure)
        ]


def bank_picture(row: str) -> str:
    """The file name of the bank of ``row``, ``ENV KNOB``."""
    return f"bank-{row.replace(' ', '-')}.png"
