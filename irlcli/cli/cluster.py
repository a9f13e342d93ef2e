"""``irl run --cluster``: the missing steps of a table as jobs."""

import importlib.util
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from irlcli.cli import console as out
from irlcli.cli.session import Session, StageSession
from irlcli.errors import StageFailed, UsageError, suggest
from irlcli.experiments.cluster.resources import DEFAULT_TIME, Resources, parse_minutes
from irlcli.requests.tables import TableChoice

if TYPE_CHECKING:
    from irlcli.experiments.cluster.queue import Queue
    from irlcli.experiments.execute import Outcome
    from irlcli.experiments.plan import Plan
    from irlcli.experiments.runner import Runner

CLUSTERS = ("slurm", "local")
DEFAULTS, DEFAULT_REQUEUES = Resources(), 20
# submitit's local executor starts a job six times at most.
LOCAL_REQUEUES = 5
# Options of sbatch that every job has already, and the option of irl run that changes them.
_SET_BY_IRL = {
    "array": "--array-parallelism",
    "cpus-per-task": "--cpus",
    "partition": "--partition",
    "requeue": "--requeues",
    "no-requeue": "--requeues 0",
    "time": "--time",
    **dict.fromkeys(
        ("dependency", "error", "job-name", "kill-on-invalid-dep", "open-mode", "output", "signal"),
        "",
    ),
}


class ClusterOptions(NamedTuple):
    """The options of ``irl run`` about jobs, None where they were not given.

    Attributes:
        cluster: ``slurm`` or ``local``.
        jobs: processes at a time, here or of ``local``.
    """

    cluster: str | None
    partition: str | None
    time: str | None
    cpus: int | None
    parallelism: int | None
    sbatch: Sequence[str]
    requeues: int | None
    jobs: int | None
    detach: bool
    status: bool
    cancel: bool

    def check(self, choice: TableChoice, directory: Path | None, dry_run: bool) -> None:
        """Refuse malformed options, and those that contradict each other or would be ignored.

        ``directory`` is that of ``--out``.

        Raises:
            UsageError: names the first of them.
        """
        asks = "--status" if self.status else "--cancel" if self.cancel else ""
        makes = directory is not None or self.jobs is not None
        if self.status + self.cancel + self.detach > 1:
            raise UsageError(
                "--status, --cancel and --detach exclude each other", "give one of them"
            )
        if choice.only is not None and makes:
            raise UsageError("--only takes no --out or --jobs", "omit them: it makes one step")
        if asks and makes:
            raise UsageError(f"{asks} makes no step", "omit --out and --jobs")
        if choice.until is not None and directory is not None:
            raise UsageError(
                "--out needs a report, but --until stops before it", "omit one of them"
            )
        if choice.only is not None and self.cluster is not None:
            raise UsageError("--only cannot be combined with --cluster", "omit one of them")
        if self.detach and directory is not None:
            raise UsageError(
                "--out needs a report, but --detach waits for none", "omit one of them"
            )
        if self.cluster is not None and self.cluster not in CLUSTERS:
            raise UsageError(f"unknown --cluster {self.cluster!r}", suggest(self.cluster, CLUSTERS))
        slurm = {
            "--partition": self.partition is not None,
            "--cpus": self.cpus is not None,
            "--array-parallelism": self.parallelism is not None,
            "--sbatch": bool(self.sbatch),
        }
        both = {
            "--detach": self.detach,
            "--time": self.time is not None,
            "--requeues": self.requeues is not None,
        }
        of_jobs = [name for name, given in (slurm | both).items() if given]
        if self.cluster is None and of_jobs:
            raise UsageError(
                f"{of_jobs[0]} needs --cluster", f"add --cluster slurm, or omit {of_jobs[0]}"
            )
        of_slurm = [name for name, given in slurm.items() if given]
        if self.cluster == "slurm" and self.jobs is not None:
            raise UsageError(
                "--jobs does not limit the jobs of Slurm", "use --array-parallelism instead"
            )
        if self.cluster == "local" and self.detach:
            raise UsageError(
                "--detach does not work with --cluster local",
                "omit --detach: the command must run until all steps exist",
            )
        if self.cluster == "local" and of_slurm:
            raise UsageError(
                f"{of_slurm[0]} needs --cluster slurm",
                f"omit {of_slurm[0]}; --jobs sets how many jobs of --cluster local run at a time",
            )
        if self.cluster == "local" and (self.requeues or 0) > LOCAL_REQUEUES:
            raise UsageError(
                f"--cluster local requeues a job at most {LOCAL_REQUEUES} times",
                f"--requeues {LOCAL_REQUEUES} or less; the same command again resumes",
            )
        if self.time is not None:
            parse_minutes(self.time)
        _sbatch_options(self.sbatch)
        if asks and dry_run:
            raise UsageError("--dry-run shows the plan, not the jobs", f"omit --dry-run or {asks}")


def open_queue(session: StageSession, options: ClusterOptions) -> "Queue":
    """The queue that ``--cluster`` names. Warns of submissions to it that cannot be read.

    Raises:
        UsageError: Slurm or submitit is missing.
    """
    from irlcli.experiments.cluster.local import Local
    from irlcli.experiments.cluster.records import unreadable
    from irlcli.experiments.cluster.slurm import Slurm

    if importlib.util.find_spec("submitit") is None:
        raise UsageError(
            "--cluster needs the package submitit, which is not installed",
            f"in irlcli's checkout: {sys.executable} -m pip install '.[slurm]'",
        )
    for path in unreadable(session.store):
        session.console.warn(f"{path} cannot be read: its jobs count as not submitted")
    minutes = parse_minutes(options.time or DEFAULT_TIME)
    # A job of few minutes is warned when half of them are over.
    warning = min(DEFAULTS.warning, 30 * minutes)
    resources = Resources(
        options.partition,
        minutes,
        options.cpus or DEFAULTS.cpus,
        options.parallelism or DEFAULTS.parallelism,
        warning,
        _sbatch_options(options.sbatch),
    )
    return Slurm(resources) if options.cluster == "slurm" else Local(session.store, resources)


def _sbatch_options(items: Sequence[str]) -> dict[str, str]:
    """The values of ``--sbatch OPTION=VALUE``, repeated, by name."""
    found: dict[str, str] = {}
    for item in items:
        name, equals, value = item.partition("=")
        if name in _SET_BY_IRL:
            option = _SET_BY_IRL[name]
            raise UsageError(
                f"irl sets sbatch's {name} itself", f"use {option}" if option else f"omit {name}"
            )
        if not equals or not re.fullmatch(r"[a-z][a-z-]*", name):
            raise UsageError(
                f"--sbatch {item!r} is not OPTION=VALUE",
                "write --sbatch account=NAME, for example",
            )
        if name in found:
            raise UsageError(f"--sbatch {name} is given twice", f"give {name} once")
        found[name] = value
    return found


def _queue_of(session: StageSession, plan: "Plan", options: ClusterOptions) -> "Queue":
    """The queue that ``--cluster`` names, or the one that has the plan's jobs.

    Raises:
        UsageError: this machine cannot ask that queue.
    """
    from irlcli.experiments.cluster.queue import last_place

    if options.cluster is not None:
        return open_queue(session, options)
    place = last_place(plan, session.store)
    # Without a record there is no job: Slurm need not be asked.
    slurm = place is not None and place.startswith("slurm ")
    queue = open_queue(session, options._replace(cluster="slurm" if slurm else "local"))
    if place not in (None, queue.place):
        raise UsageError(
            f"{plan.table.name} was submitted to: {place}. This machine has: {queue.place}",
            "run the same command there, or name a queue of this machine with --cluster",
        )
    return queue


def run_jobs(
    session: StageSession,
    runner: "Runner",
    plan: "Plan",
    step_command: Callable[[str], list[str]],
    options: ClusterOptions,
) -> "Outcome | None":
    """Submit what is missing and wait for it; None with ``--detach``."""
    from irlcli.cli.jobs import job_display
    from irlcli.experiments.cluster.submission import JobCommand, Submission

    queue = open_queue(session, options)
    # A job that waits for another process would hold its node idle: it exits and is requeued.
    impatient = ["--no-wait"] if session.wait and queue.starts_what_waits else []

    display = job_display(session.console)
    requeues = DEFAULT_REQUEUES if queue.starts_what_waits else LOCAL_REQUEUES
    if options.requeues is not None:
        requeues = options.requeues
    job = JobCommand(
        lambda name: [*step_command(name), *impatient], Path.cwd(), requeues, options.jobs or 1
    )
    submission = Submission(plan, runner, queue, job, display)
    try:
        count = submission.submit()
        if count:
            # A queue of this machine starts a job when it may run, and until then it has none.
            what = "submitted" if queue.starts_what_waits else "to run on this machine"
            session.console.say(f"{out.counted(count, 'job')} {what}")
        if options.detach:
            if session.as_json:
                out.print_json("submission", {"table": plan.table.name, "submitted": count})
            return None
        return submission.watch()
    finally:
        display.close()


def ended_submissions(session: Session, grace_seconds: float) -> list[Path]:
    """What gc may remove of the store's records of submissions."""
    from irlcli.experiments.cluster.local import Local
    from irlcli.experiments.cluster.records import ended
    from irlcli.experiments.cluster.slurm import Slurm

    @cache
    def states_at(place: str) -> Mapping[str, str] | None:
        local = Local(session.store, DEFAULTS)
        if place == local.place:
            return local.states()
        try:
            slurm = Slurm(DEFAULTS)
            return slurm.states() if place == slurm.place else None
        except (UsageError, StageFailed):
            return None

    return ended(session.store, states_at, grace_seconds)


def print_status(session: StageSession, plan: "Plan", options: ClusterOptions) -> None:
    """A line for each step that does not exist: its job, or why there is none."""
    from irlcli.experiments.cluster.queue import last_jobs, queued
    from irlcli.experiments.cluster.records import records

    queue = _queue_of(session, plan, options)
    there = queued(plan, queue, session.store)
    last = last_jobs(plan, records(session.store, queue.place))
    lines: list[dict[str, str | None]] = []
    exist = 0
    for name in plan.tasks:
        step = plan.step(name)
        if step.status == "HIT":
            exist += 1
            continue
        if name in there:
            state, _, place = there[name].state.partition(" ")
            why = f"job {there[name].job} {place}"
            lines.append({"name": name, "state": state, "job": there[name].job, "why": why})
            continue
        failure = None
        if name in last and step.status in ("RUN", "RESUME"):
            record, job = last[name]
            failure = record.failure(job)
        if failure is not None:
            lines.append({"name": name, "state": "FAILED", "job": None, "why": failure.message})
        else:
            lines.append({"name": name, "state": step.status, "job": None, "why": step.why})
    if session.as_json:
        out.print_json("status", {"table": plan.table.name, "exist": exist, "missing": lines})
        return
    for line in lines:
        out.print_data(f"{line['state']:11}{line['name']}: {line['why']}")
    jobs = sum(line["job"] is not None for line in lines)
    out.print_note(
        f"{exist} of {len(plan.tasks)} steps exist, {jobs} {'has' if jobs == 1 else 'have'} a job"
    )


def cancel(session: StageSession, plan: "Plan", options: ClusterOptions) -> None:
    """Cancel the jobs of a table; those that run write a checkpoint first."""
    from irlcli.experiments.cluster.queue import queued

    queue = _queue_of(session, plan, options)
    there = queued(plan, queue, session.store)
    queue.cancel(sorted({job.job for job in there.values()}))
    if session.as_json:
        out.print_json("cancel", {"table": plan.table.name, "jobs": len(there)})
        return
    after = "; those that ran leave a checkpoint" if there else ""
    after += ". An `irl run` that waits starts the next steps: stop it with Ctrl-C"
    out.print_note(f"{out.counted(len(there), 'job')} cancelled{after}")
