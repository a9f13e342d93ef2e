"""What a queue is told: which jobs, each after the jobs of what it needs."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path

import pytest
from test_run import TABLES, Unseen

from irlcli.experiments.cluster.job import StepJob
from irlcli.experiments.cluster.records import Record
from irlcli.experiments.cluster.resources import Resources
from irlcli.experiments.cluster.slurm import Slurm
from irlcli.experiments.cluster.submission import JobCommand, Submission
from irlcli.experiments.runner import Silent
from irlcli.requests.session import StageSession
from irlcli.requests.tables import TableChoice, open_plan


class Told:
    """A queue that notes what each job was told to wait for, and starts none."""

    name, place, starts_what_waits, lag = "told", "a queue", True, 0.0

    def __init__(self):
        self.jobs = {}

    def submit(self, jobs, logs, after, matching):
        number = str(len(self.jobs))
        ids = [f"{number}_{i}" for i in range(len(jobs))] if len(jobs) > 1 else [number]
        for i, (job, own) in enumerate(zip(jobs, ids, strict=True)):
            waits = [*after, *([f"{matching}_{i}"] if matching else [])]
            self.jobs[own] = job.name, {self.jobs[other][0] for other in waits}
        return ids

    def states(self):
        return dict.fromkeys(self.jobs, "PENDING (Dependency)")

    def cancel(self, ids):
        pytest.fail("a job was cancelled")

    def probe(self, store, console):
        pass


def closure(needs):
    """All that each step needs, directly or not."""

    def above(name):
        return set(needs[name]).union(*map(above, needs[name]))

    return {name: above(name) for name in needs}


@pytest.fixture
def session(tmp_path):
    line = {"profile": "smoke", "file": None, "overrides": [], "sources": [], "command": ["irl"]}
    session = StageSession(tmp_path / "runs", Silent(), **line)
    session.store.create()
    return session


def planned(session, tmp_path, seeds="[0]"):
    tables = tmp_path / "tables.toml"
    tables.write_text(TABLES.replace("[0]", seeds))
    return open_plan(session, TableChoice("tiny", tag="smoke", file=tables))


def submission(session, plan, queue, display):
    command = JobCommand(lambda name: ["true"], Path.cwd(), 0, 1)
    return Submission(plan, session.runner(), queue, command, display)


def submit(session, plan, queue):
    return submission(session, plan, queue, Unseen()).submit()


def test_each_job_waits_for_what_it_needs_and_is_submitted_once(session, tmp_path):
    plan, queue = planned(session, tmp_path, "[0, 1, 2]"), Told()
    assert submit(session, plan, queue) == len(plan.tasks) == len(queue.jobs)
    assert closure(dict(queue.jobs.values())) == closure(plan.needs)
    assert submit(session, plan, queue) == 0


def test_what_others_make_while_the_probe_waits_is_not_submitted(session, tmp_path):
    plan = planned(session, tmp_path)
    name = next(name for name in plan.tasks if name.endswith(".random-returns"))

    class Slow(Told):
        def probe(self, store, console):
            session.runner().run(plan.tasks[name].request)

    queue = Slow()
    assert submit(session, plan, queue) == len(plan.tasks) - 1
    assert name not in dict(queue.jobs.values())
    assert name in session.store.names()


class Deaf(Told):
    """The queue of this machine, with jobs that hear only the third request to end."""

    starts_what_waits = False
    asked = 0

    def states(self):
        return {} if self.asked > 2 else dict.fromkeys(self.jobs, "RUNNING")

    def cancel(self, ids):
        assert {*ids} == {*self.jobs}
        self.asked += 1


class Impatient(Unseen):
    """A display whose user presses Ctrl-C when the first job runs, ``times`` times."""

    def __init__(self, times):
        self.times = times

    def start(self, name):
        for _ in range(self.times):
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize(("times", "asked"), [(1, 3), (2, 1)])
def test_a_job_that_does_not_listen_yet_is_told_again_to_end(session, tmp_path, times, asked):
    """A second Ctrl-C ends the wait, not the request."""
    plan, queue = planned(session, tmp_path), Deaf()
    run = submission(session, plan, queue, Impatient(times))
    assert run.submit() == len(plan.tasks)
    assert run.watch().interrupted and len(queue.jobs) == 1 and queue.asked == asked


def test_jobs_that_cannot_be_recorded_are_cancelled(session, tmp_path, monkeypatch):
    plan, cancelled = planned(session, tmp_path), []

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    class Noting(Told):
        def cancel(self, ids):
            cancelled.extend(ids)

    monkeypatch.setattr(Record, "add", full)
    queue = Noting()
    with pytest.raises(OSError, match="No space left"):
        submit(session, plan, queue)
    assert cancelled == [*queue.jobs]


def test_an_array_is_submitted_without_variables_that_sbatch_prefers_to_its_script(
    monkeypatch, tmp_path
):
    sbatch = tmp_path / "sbatch"
    sbatch.write_text(
        f'#!/bin/sh\nenv | grep ^SBATCH_ | sort > {tmp_path}/seen\necho "Submitted batch job 7"\n'
    )
    for name in ("sbatch", "squeue", "scancel", "scontrol", "srun"):
        (tmp_path / name).touch()
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    given = ("PARTITION", "ACCOUNT", "MEM_PER_NODE", "OUTPUT", "ARRAY_INX", "QOS", "TIMELIMIT")
    for name in given:
        monkeypatch.setenv(f"SBATCH_{name}", "x")
    resources = Resources(partition="big", extra={"account": "new", "mem": "8G"})
    job = StepJob("step", ("true",), str(tmp_path), str(tmp_path), 0)
    assert Slurm(resources).submit([job], tmp_path / "logs", [], None) == ["7"]
    assert (tmp_path / "seen").read_text() == "SBATCH_QOS=x\n"
