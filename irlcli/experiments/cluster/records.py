"""What was submitted: a directory per submission in the store, with the jobs' logs.

Every later ``irl run`` on this store reads them, so that no step that is in the queue is submitted
again.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from irlcli.experiments.failures import Failure
from irlcli.store import Store
from irlcli.store.durable import write_durably

# Held, as a key is, by whoever submits jobs or removes records.
LOCK = "submission"
_FILE = "jobs-{:07}.json"
_SCHEMA = 1
_LONGEST_LINE = 1000


class Submitted(NamedTuple):
    """A job: the name of its step, the digest of its request (``Plan.identities``), and its id."""

    name: str
    identity: str
    job: str


@dataclass
class Record:
    """One submission.

    Attributes:
        directory: with the logs and the outcome of each step.
        place: of the queue that runs the jobs.
        jobs: in the order of their submission.
    """

    directory: Path
    place: str
    jobs: list[Submitted]

    @property
    def logs(self) -> Path:
        """submitit's directory."""
        return self.directory / "logs"

    @property
    def notes(self) -> Path:
        """Directory for the outcome of each step."""
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

    def failure(self, job: str) -> Failure | None:
        """Why a job failed, if it said so."""
        # Another command may call the same step otherwise.
        name = [submitted.name for submitted in self.jobs if submitted.job == job][-1]
        try:
            return Failure(**json.loads((self.notes / f"{name}.failed").read_bytes()))
        except (FileNotFoundError, ValueError, TypeError):
            return None

    def log(self, job: str) -> Path | None:
        """The stderr of a job, if there is one."""
        found = self.logs / f"{job}_0_log.err"
        return found if found.exists() else None

    def last_line(self, job: str) -> str:
        """What a job wrote last; empty if it wrote nothing yet."""
        log = self.log(job)
        lines: list[str] = []
        with suppress(OSError):
            if log is not None:
                with open(log, "rb") as file:
                    file.seek(max(0, log.stat().st_size - _LONGEST_LINE))
                    lines = file.read().decode("utf-8", "replace").splitlines()
        return lines[-1] if lines else ""


def new_record(store: Store, place: str) -> Record:
    """A new directory for a submission."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
    directory = store.jobs.absolute() / f"{stamp}-{os.urandom(3).hex()}"
    record = Record(directory, place, [])
    for path in (record.logs, record.notes):
        path.mkdir(parents=True)
    return record


def records(store: Store, place: str | None = None) -> list[Record]:
    """The submissions to the queue at ``place``, or to any, oldest first.

    What :func:`unreadable` names is left out.
    """
    found: dict[Path, Record] = {}
    for path in _files(store):
        read = _read(path)
        if read is not None and place in (None, read.place):
            found.setdefault(path.parent, Record(path.parent, read.place, [])).jobs += read.jobs
    return list(found.values())


def unreadable(store: Store) -> list[Path]:
    """Files whose jobs are not known: damaged, of a newer irlcli, or not readable by this user."""
    # gc may have removed one meanwhile.
    return [path for path in _files(store) if _read(path) is None and path.exists()]


def _files(store: Store) -> list[Path]:
    return sorted(store.jobs.absolute().glob("*/jobs-*.json"))


def _read(path: Path) -> Record | None:
    """The jobs that were submitted together; None if the file cannot be read."""
    try:
        value = json.loads(path.read_bytes())
        jobs = [Submitted(**job) for job in value["jobs"]]
        return Record(path.parent, value["place"], jobs) if value["schema"] == _SCHEMA else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def ended(
    store: Store, states_at: Callable[[str], Mapping[str, str] | None], grace_seconds: float
) -> list[Path]:
    """Directories and leftover files of submissions that have ended, unchanged for the grace period.

    Only root finds those of other people.

    Args:
        store: holds them.
        states_at: the states of the jobs in the queue at a place, by id; None if it cannot be
            asked from here, so that its submissions are kept.
        grace_seconds: grace period [s].
    """
    limit = time.time() - grace_seconds
    known = {record.directory: record for record in records(store)}
    found = []
    for path in sorted(store.jobs.absolute().glob("*")):
        record = known.get(path)
        if not _may_judge(path):
            continue
        if record is None and any(path.glob(_FILE.partition("{")[0] + "*")):
            # A newer irlcli wrote it.
            continue
        if record is not None:
            states = states_at(record.place)
            if states is None or any(submitted.job in states for submitted in record.jobs):
                continue
        if _changed(path) < limit:
            found.append(path)
    return found


def _may_judge(path: Path) -> bool:
    """Whether the queue shows this user the jobs of whoever wrote ``path``.

    A cluster may hide the jobs of other people from everybody but root.
    """
    try:
        return os.geteuid() in (0, path.stat().st_uid)
    except FileNotFoundError:
        return False


def _changed(path: Path) -> float:
    """When ``path``, or a file below it, was last changed [s since 1970]; now if it disappears."""
    try:
        return max(p.stat().st_mtime for p in (path, *path.rglob("*")))
    except FileNotFoundError:
        return time.time()


def remove(found: Iterable[Path]) -> None:
    """Remove what :func:`ended` found."""
    for path in found:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
