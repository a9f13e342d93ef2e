"""submitit's local executor: the jobs of a cluster as processes of this machine."""

import os
import signal
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from irlcli.experiments.cluster.job import StepJob
from irlcli.experiments.cluster.records import records
from irlcli.experiments.cluster.resources import Resources
from irlcli.experiments.runner import RunConsole
from irlcli.store import Store


class Local:
    """Jobs that run here, at once."""

    starts_what_waits = False
    lag = 1.0
    # Its jobs' ids are those of this machine's processes.
    place = f"local on {os.uname().nodename}"

    def __init__(self, store: Store, resources: Resources):
        self._store = store
        self._resources = resources
        self._jobs: dict[str, Any] = {}

    def submit(
        self, jobs: Sequence[StepJob], logs: Path, after: Sequence[str], matching: str | None
    ) -> list[str]:
        """Start jobs that wait for nothing; returns their ids."""
        import submitit

        assert not after and matching is None, "the local executor knows no dependencies"
        # submitit's own processes must not import from the working directory, either.
        os.environ["PYTHONSAFEPATH"] = "1"
        executor = submitit.LocalExecutor(folder=logs)
        executor.update_parameters(
            timeout_min=self._resources.minutes, signal_delay_s=self._resources.warning
        )
        # The jobs inherit the mask: Ctrl-C on the terminal reaches them through this process only.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            started = [executor.submit(StepJob.run, job) for job in jobs]
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._jobs |= {job.job_id: job for job in started}
        return [job.job_id for job in started]

    def states(self) -> dict[str, str]:
        """State and host of each job that has not ended, by id, those of earlier commands included."""
        logs = self._logs()
        return {i: f"RUNNING {os.uname().nodename}" for i in logs if self._runs(i, logs[i])}

    def _logs(self) -> dict[str, Path]:
        """Where each recorded job has its logs, by id."""
        of = records(self._store, self.place)
        return {job.job: record.logs for record in of for job in record.jobs}

    def _runs(self, job: str, logs: Path) -> bool:
        if job in self._jobs:
            return self._jobs[job].state == "RUNNING"
        process = Path("/proc", job)
        try:
            words = (process / "cmdline").read_bytes()
            # Another process may have the id by now, also a job of another store. One that just
            # started has no words yet; one that has ended has none left, and no program.
            # The path of a store may be written in several ways, the name of a record may not.
            ours = b"submitit.local" in words and os.fsencode(f"/{logs.parent.name}/") in words
            return ours or (not words and (process / "exe").exists())
        except OSError:
            return False

    def cancel(self, ids: Iterable[str]) -> None:
        """End jobs after their next checkpoint."""
        logs = self._logs()
        for job in ids:
            if job in logs and self._runs(job, logs[job]):
                with suppress(ProcessLookupError):
                    os.kill(int(job), signal.SIGTERM)

    def probe(self, store: Store, console: RunConsole) -> None:
        """Jobs of this machine see what it sees."""
