"""What was submitted: a directory per submission in the store, with the jobs' logs.

Another ``irl run`` reads them, by whomever and for whichever table, so that no step that is in the
queue is submitted again.
"""

import json
import os
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from irlcli.experiments.failures import Failure
from irlcli.store import Store
from irlcli.store.durable import write_durably

_FILE = "jobs-{:07}.json"
_SCHEMA = 1


class Submitted(NamedTuple):
    """A job: the step it makes, what that step is, whatever its name, and its id."""

    name: str
    identity: str
    job: str


class Record:
    """One submission.

    Attributes:
        directory: with the logs and what became of the steps.
        place: of the queue that runs the jobs.
        jobs: in the order of their submission.
    """

    def __init__(self, directory: Path, place: str, jobs: list[Submitted]):
        self.directory = directory
        self.place = place
        self.jobs = jobs

    @property
    def logs(self) -> Path:
        """submitit's directory."""
        return self.directory / "logs"

    @property
    def notes(self) -> Path:
        """Directory for what became of the steps."""
        return self.directory / "steps"

    def add(self, jobs: list[Submitted]) -> None:
        """Record jobs that were just submitted."""
        value = {
            "schema": _SCHEMA,
            "place": self.place,
            "jobs": [job._asdict() for job in jobs],
        }
        # A file for each array: a table of 10,000 runs has 50,000 jobs in 54 arrays.
        path = self.directory / _FILE.format(len(self.jobs))
        write_durably(path, json.dumps(value).encode())
        self.jobs += jobs

    def failure(self, name: str) -> Failure | None:
        """Why the job of a step failed, if it said so."""
        try:
            return Failure(**json.loads((self.notes / f"{name}.failed").read_bytes()))
        except (FileNotFoundError, ValueError, TypeError):
            return None

    def log(self, name: str) -> Path | None:
        """The stderr of a step's job, if there is one."""
        for submitted in reversed(self.jobs):
            if submitted.name == name:
                found = self.logs / f"{submitted.job}_0_log.err"
                return found if found.exists() else None
        return None


def new_record(store: Store, place: str) -> Record:
    """A new directory for a submission."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    directory = store.jobs.absolute() / f"{stamp}-{os.urandom(3).hex()}"
    record = Record(directory, place, [])
    for path in (record.logs, record.notes):
        path.mkdir(parents=True)
    return record


def records(store: Store, place: str) -> list[Record]:
    """The submissions to the queue at ``place``, oldest first. What cannot be read is left out."""
    found: dict[Path, Record] = {}
    for path in sorted(store.jobs.absolute().glob("*/jobs-*.json")):
        with suppress(OSError, ValueError, KeyError, TypeError):
            value = json.loads(path.read_bytes())
            if value["schema"] == _SCHEMA and value["place"] == place:
                record = found.setdefault(path.parent, Record(path.parent, place, []))
                record.jobs += [Submitted(**job) for job in value["jobs"]]
    return list(found.values())


def remove_ended(found: list[Record], states: Mapping[str, str]) -> list[Record]:
    """Remove the directories of submissions without a job in the queue; returns the others."""
    kept = []
    for record in found:
        if any(submitted.job in states for submitted in record.jobs):
            kept.append(record)
        else:
            shutil.rmtree(record.directory, ignore_errors=True)
    return kept
