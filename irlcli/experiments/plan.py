"""A table as a list of named steps, and what a store holds of each."""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

from irlcli.configs import Config
from irlcli.data.descriptions import PenaltyChoice
from irlcli.errors import UsageError, closest
from irlcli.experiments import figures, rows
from irlcli.experiments.rows import PHASES, Chosen, RewardRun, Task
from irlcli.experiments.status import Identities, Lookup, Step, waiting
from irlcli.experiments.tables import Row, Table
from irlcli.experiments.variants import Overridable, config_under, loaded, step_name
from irlcli.stages import choose_penalty
from irlcli.stages.base import From, Request


class Selection(NamedTuple):
    """Which part of a table, under which names.

    Attributes:
        tag: what all names begin with.
        candidates: for lambda; empty if it is not to be chosen, ``own`` for each penalty's.
        until: the last phase.
        only: one step and what it needs.
        listing: the command line that lists the steps.
    """

    tag: str
    candidates: Sequence[float] | Literal["own"] = ()
    until: rows.Phase = "returns"
    only: str | None = None
    listing: str = "irl plan"


class Plan:
    """The steps of ``table``, each after what it needs.

    Attributes:
        tasks: by name, which begins with the tag. Equal requests are one task.
        identities: for each name, a digest that equal requests of any plan share.
        needs: for each name, the names of what it is made from.
        cells: all tasks that fill a cell of the report, equal requests included.
        figure: the request that draws the result, for tables without a report of cells.

    Raises:
        UsageError: a setting that a row needs is missing, or ``only`` names no step.
    """

    def __init__(self, table: Table, selection: Selection, load: Overridable, lookup: Lookup):
        self.table = table
        self.selection = selection
        self.lookup = lookup
        self._load = load
        self._config_of = loaded(load)
        self._under = {v: config_under(v, load) for v in table.variants}
        self._weighted = {
            method: loaded(load, [f"airl.penalty_weight={weight!r}"])
            for method, weight in table.penalty_weights.items()
        }
        self.figure: Request | None = None
        self.refresh()

    def refresh(self) -> None:
        """Make the tasks again, from what the store holds now: a lambda may have been chosen."""
        self.lookup.forget_missing()
        self.tasks: dict[str, Task] = {}
        self.identities: dict[str, str] = {}
        self.needs: dict[str, tuple[str, ...]] = {}
        self.cells: list[Task] = []
        names: dict[str, str] = {}
        identities = Identities()
        last = PHASES.index(self.selection.until)
        for task in self._all_tasks():
            if PHASES.index(task.phase) > last:
                continue
            name = f"{self.selection.tag}.{task.name}"
            if task.cell is not None:
                self.cells.append(task)
            identity = identities(task.request)
            if identity in names:
                continue
            assert name not in self.tasks, f"two steps are called {name}"
            names[identity] = name
            self.identities[name] = identity
            self.tasks[name] = task
            self.needs[name] = tuple(
                dict.fromkeys(
                    names[identities(source.request)]
                    for source in task.request.inputs.values()
                    if isinstance(source, From)
                )
            )
        if self.selection.only is not None:
            self._keep_only(self.selection.only)

    def _all_tasks(self) -> Iterator[Task]:
        if self.table.kind == "figure2":
            tasks, self.figure = figures.gridworld_figure(self._config_of)
            yield from tasks
        elif self.table.kind == "control":
            tasks, self.figure = figures.controls(self._config_of)
            yield from tasks
        only = self.selection.only
        for row in self.table.rows:
            if only is not None and not only.startswith(f"{self.selection.tag}.{row}."):
                continue
            if self.table.kind == "experts":
                yield from rows.experts(row, self._config_of)
                continue
            yield from rows.comparison(
                row,
                self.table.measures,
                self.table.retrainings,
                self._runs(row),
                self._config_of,
                Chosen(self.selection.candidates, self.lookup),
            )

    def _runs(self, row: Row) -> list[RewardRun]:
        """The row's rewards: all of them, because a step that several share has the first one's name."""
        methods, seeds = self.table.methods, self.table.seeds
        if self.table.variants:
            return [
                RewardRun(
                    variant.name, method, seed, f"{row}.{step_name(variant)}", self._under[variant]
                )
                for variant in self.table.variants
                for method in methods
                for seed in seeds
            ]
        return [
            RewardRun(method, method, seed, str(row), self._weighted.get(method, self._config_of))
            for method in methods
            for seed in seeds
        ]

    def _keep_only(self, only: str) -> None:
        if only not in self.tasks:
            everything = Plan(
                self.table, self.selection._replace(only=None), self._load, self.lookup
            )
            close = closest(only, everything.tasks)
            hint = f"did you mean {close!r}? " if close else ""
            raise UsageError(
                f"{self.table.name} has no step {only!r}",
                f"{hint}`{self.selection.listing}` lists the names",
            )
        kept, pending = set(), [only]
        while pending:
            name = pending.pop()
            kept.add(name)
            pending += self.needs[name]
        self.tasks = {name: task for name, task in self.tasks.items() if name in kept}
        self.identities = {name: self.identities[name] for name in self.tasks}
        self.needs = {name: self.needs[name] for name in self.tasks}

    def config(self, env: str) -> Config:
        """The config of ``env``, without any method's flags: the base's, if there are variants."""
        variants = self.table.variants
        return (self._under[variants[0]] if variants else self._config_of)(env, None)

    def step(self, name: str) -> Step:
        """The state of the step called ``name``; what it waits for is named as in the plan."""
        step = self.lookup(self.tasks[name].request)
        if step.status == "BLOCKED":
            missing = [n for n in self.needs[name] if not self.exists(n)]
            step = step._replace(why=waiting(missing))
        return step

    def exists(self, name: str) -> bool:
        """Whether the step's artefact is in the store or in another one."""
        return self.lookup(self.tasks[name].request).artefact is not None

    def chooses(self, name: str) -> bool:
        """Whether the step chooses a lambda: once it exists, later requests differ (:meth:`refresh`)."""
        return self.tasks[name].request.stage == choose_penalty.STAGE

    def choices(self) -> Iterator[tuple[str, PenaltyChoice]]:
        """The choices of lambda that were made, by the step's name."""
        for name in filter(self.chooses, self.tasks):
            found = rows.choice_made(self.tasks[name].request, self.lookup)
            if found is not None:
                yield name, found
