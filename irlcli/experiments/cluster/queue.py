"""A place that runs jobs, and which steps of a plan are in it."""

from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from irlcli.experiments.cluster.job import StepJob
from irlcli.experiments.cluster.records import Record, records
from irlcli.experiments.plan import Plan
from irlcli.experiments.runner import RunConsole
from irlcli.store import Store


class Queue(Protocol):
    """A place that runs jobs.

    Attributes:
        place: tells it from other queues whose jobs the same store records.
        starts_what_waits: whether it starts a job by itself when those before it have ended.
        lag: how long after the end of a job its files may be invisible here [s].
    """

    starts_what_waits: bool
    lag: float

    @property
    def place(self) -> str: ...

    def submit(
        self, jobs: Sequence[StepJob], logs: Path, after: Sequence[str], matching: str | None
    ) -> list[str]: ...

    def states(self) -> dict[str, str]: ...

    def cancel(self, ids: Iterable[str]) -> None: ...

    def probe(self, store: Store, console: RunConsole) -> None: ...


class Queued(NamedTuple):
    """A job in the queue: its id, its state, and the record that holds its logs."""

    job: str
    state: str
    record: Record


def queued(plan: Plan, queue: Queue, store: Store) -> dict[str, Queued]:
    """The plan's steps that are in the queue, whoever submitted them, by name."""
    states = queue.states()
    jobs = last_jobs(plan, records(store, queue.place), states)
    return {name: Queued(job, states[job], record) for name, (record, job) in jobs.items()}


def last_jobs(
    plan: Plan, submissions: Iterable[Record], among: Container[str] | None = None
) -> dict[str, tuple[Record, str]]:
    """The last job of each of the plan's steps, by name; only jobs of ``among``, if that is given."""
    by_identity: dict[str, tuple[Record, str]] = {}
    by_name: dict[str, tuple[Record, str]] = {}
    for record in submissions:
        for name, identity, job in record.jobs:
            if among is None or job in among:
                by_identity[identity] = by_name[name] = record, job
    found = {}
    changing: set[str] = set()
    for name in plan.tasks:
        last = by_identity.get(plan.identities[name])
        if plan.chooses(name) or not changing.isdisjoint(plan.needs[name]):
            # Once a lambda is chosen, the reward is another request under the same name.
            changing.add(name)
            last = last or by_name.get(name)
        if last is not None:
            found[name] = last
    return found


def last_place(plan: Plan, store: Store) -> str | None:
    """Where steps of the plan were submitted to last; None if they never were."""
    identities = set(plan.identities.values())
    for record in reversed(records(store)):
        # A chosen lambda changes what a step is, and keeps its name.
        if any(job.identity in identities or job.name in plan.tasks for job in record.jobs):
            return record.place
    return None
