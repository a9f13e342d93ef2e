"""Slurm, by its own commands and by submitit."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from irlcli.errors import StageFailed, UsageError
from irlcli.experiments.cluster.job import StepJob
from irlcli.experiments.cluster.resources import Resources
from irlcli.experiments.runner import RunConsole
from irlcli.store import Store

JOB_NAME = "irl"
_CLOCK_SECONDS = 60.0
_LOW_BYTES = 1 << 30


class Slurm:
    """The Slurm cluster that this machine belongs to.

    Raises:
        UsageError: Slurm's commands are missing.
    """

    # Slurm starts what waits for other jobs, whether or not anybody watches.
    starts_what_waits = True
    # An NFS client may not ask its server for 60 s whether a file exists now.
    lag = 60.0

    def __init__(self, resources: Resources):
        needed = ("sbatch", "squeue", "scancel", "scontrol", "srun")
        absent = [command for command in needed if shutil.which(command) is None]
        if absent:
            raise UsageError(
                f"--cluster slurm needs Slurm, but {absent[0]} is not on the PATH",
                "run it on a login node of the cluster, or use --cluster local",
            )
        self._resources = resources

    @cached_property
    def place(self) -> str:
        """The cluster's name: several clusters may use a store, and each numbers its own jobs.

        Raises:
            StageFailed: Slurm does not answer.
        """
        done = _say("scontrol", "show", "config")
        found = re.search(r"^ClusterName\s*=\s*(\S+)", done.stdout, re.MULTILINE)
        if not found:
            raise StageFailed(
                f"scontrol: {_reason(done.stderr)}",
                "look at `scontrol ping`; add --cluster local if the jobs run on this machine",
            )
        return f"slurm cluster {found[1]}"

    def submit(
        self, jobs: Sequence[StepJob], logs: Path, after: Sequence[str], matching: str | None
    ) -> list[str]:
        """Submit an array; returns the jobs' ids.

        Args:
            jobs: its elements.
            logs: directory for scripts, pickled jobs and logs.
            after: ids of jobs that all elements start after.
            matching: id of an array whose element of the same index each element starts after.

        Raises:
            StageFailed: Slurm refused it.
        """
        import submitit

        # sbatch prefers these to the script, and jobs of another name would not be found again.
        for name in _overriding(self._resources):
            os.environ.pop(name, None)
        conditions = [f"afterok:{':'.join(after)}"] if after else []
        conditions += [f"aftercorr:{matching}"] if matching else []
        more: dict[str, Any] = {
            "requeue": True,
            "kill-on-invalid-dep": "yes",
            # B: to the batch script, which becomes the job itself.
            "signal": f"B:USR2@{self._resources.warning}",
        }
        more |= self._resources.extra
        # Without srun: a node that dies while srun launches a task would end the job as failed
        # instead of putting it back into the queue.
        executor = submitit.SlurmExecutor(logs, python=f"exec {shlex.quote(sys.executable)} -P")
        executor.update_parameters(
            job_name=JOB_NAME,
            partition=self._resources.partition,
            time=self._resources.minutes,
            cpus_per_task=self._resources.cpus,
            use_srun=False,
            array_parallelism=self._resources.parallelism,
            dependency=",".join(conditions) or None,
            additional_parameters=more,
            wckey=None,
        )
        try:
            with executor.batch():
                submitted = [executor.submit(StepJob.run, job) for job in jobs]
        except (submitit.core.utils.FailedJobError, submitit.core.utils.FailedSubmissionError) as e:
            raise StageFailed(
                f"Slurm refused {len(jobs)} jobs: {_reason(str(e))}",
                "what was submitted before continues; run the same command again to add the rest",
            ) from None
        return [job.job_id for job in submitted]

    def states(self) -> dict[str, str]:
        """State and place, or reason, of each job of ours that has not ended, by id.

        Raises:
            StageFailed: Slurm does not answer.
        """
        form = "%i|%T|%R"
        done = _say("squeue", "--noheader", "--array", f"--name={JOB_NAME}", f"--format={form}")
        if done.returncode != 0:
            raise StageFailed(
                f"squeue does not answer: {_reason(done.stderr)}",
                "look at `scontrol ping`; the controller may be down",
            )
        rows = (line.split("|", 2) for line in done.stdout.splitlines())
        return {row[0]: " ".join(row[1:]) for row in rows if len(row) == 3}

    def cancel(self, ids: Iterable[str]) -> None:
        """Cancel jobs; those that run write a checkpoint first.

        Raises:
            StageFailed: Slurm refused to cancel some, for example those of other people.
        """
        listed = list(ids)
        batches = [listed[start : start + 500] for start in range(0, len(listed), 500)]
        answers = [_say("scancel", *batch) for batch in batches]
        refused = [_reason(answer.stderr) for answer in answers if answer.returncode != 0]
        if refused:
            raise StageFailed(
                f"scancel: {refused[0]}",
                "the other jobs are cancelled; whoever submitted a job can cancel it",
            )

    def probe(self, store: Store, console: RunConsole) -> None:
        """Run a job that looks at the store from a node, and wait for it.

        Raises:
            UsageError: the partition or another option is wrong.
            StageFailed: a node cannot start Python, does not see or cannot write the store, or
                does not see the working directory.
        """
        token = f"probe-{os.urandom(8).hex()}"
        store.jobs.mkdir(exist_ok=True)
        (store.jobs / token).touch()
        command = ["srun", "--ntasks=1", "--time=2", f"--job-name={JOB_NAME}-probe"]
        elsewhere = os.environ.get("SBATCH_PARTITION")
        if elsewhere and self._resources.partition is None:
            # The jobs will run there; srun has another variable.
            command.append(f"--partition={elsewhere}")
        command += [
            *self._resources.words(),
            sys.executable,
            "-P",
            "-m",
            "irlcli.experiments.cluster.probe",
        ]
        console.say("a probe job checks the store from a node")
        try:
            before = time.time()
            printed, errors = _allocate(
                [*command, str(store.jobs.resolve()), token, str(Path.cwd())],
                lambda why: console.warn(f"Slurm does not start the probe job: {why}"),
            )
            after = time.time()
        finally:
            (store.jobs / token).unlink(missing_ok=True)
        try:
            facts = json.loads(printed.splitlines()[-1])
        except (IndexError, ValueError):
            raise _refused(errors) from None
        _judge(facts, max(facts["time"] - after, before - facts["time"]), store, console)


def _overriding(resources: Resources) -> list[str]:
    """sbatch's environment variables for what the script of an array says."""
    of_scripts = (
        *("JOB_NAME", "TIMELIMIT", "NO_REQUEUE", "REQUEUE", "SIGNAL", "ARRAY_INX", "DEPENDENCY"),
        *("OUTPUT", "ERROR", "OPEN_MODE", "CPUS_PER_TASK", "WCKEY"),
    )
    named = [*resources.extra, *([] if resources.partition is None else ["partition"])]
    variables = ["MEM_PER_NODE" if n == "mem" else n.replace("-", "_").upper() for n in named]
    return [f"SBATCH_{name}" for name in (*of_scripts, *variables)]


def _judge(facts: dict[str, Any], clock: float, store: Store, console: RunConsole) -> None:
    """Refuse a node that cannot make the jobs; warn of one whose clock differs by ``clock`` [s]."""
    where = f"the node {facts['host']}"
    if not facts["seen"]:
        raise StageFailed(
            f"{where} does not see the store {store.root.resolve()}",
            "put the store on a file system that the nodes share (--store)",
        )
    if not facts["directory"]:
        raise StageFailed(
            f"{where} does not see the working directory {Path.cwd()}",
            "run the command in a directory on a file system that the nodes share",
        )
    if "problem" in facts:
        raise StageFailed(
            f"{where} cannot write to {store.root.resolve()}: {facts['problem']}",
            "make room or change its permissions, then run the same command again",
        )
    if clock > _CLOCK_SECONDS:
        console.warn(
            f"the clock of {where} differs by {clock:.0f} s from this machine's: gc's grace "
            "period and the times in provenance are off by as much"
        )
    if facts["free"] < _LOW_BYTES:
        console.warn(f"the store's disk has {facts['free'] >> 20} MiB left")


def _refused(errors: str) -> UsageError | StageFailed:
    reason = _reason(errors)
    if "partition" in reason:
        known = _say("sinfo", "--noheader", "--format=%R").stdout.split()
        return UsageError(
            f"Slurm refused: {reason}", f"partitions: {', '.join(sorted(set(known)))}"
        )
    refused = re.search("Unable to allocate|[Ii]nvalid|unrecognized option", errors)
    if refused and not re.search("slurmstepd|task 0|Traceback", errors):
        return UsageError(
            f"Slurm refused: {reason}",
            "nothing was submitted: check --cpus and --sbatch (srun --help lists options)",
        )
    return StageFailed(
        f"the probe job failed: {reason}",
        f"nothing was submitted. The nodes must be able to start {sys.executable}, with its "
        "packages: install them on a file system that the nodes share",
    )


def _allocate(command: Sequence[str], explain: Callable[[str], None]) -> tuple[str, str]:
    """What an srun printed, and its errors; ``explain`` is told why it waits, if srun says so."""
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=_environment(),
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        errors: list[str] = []
        try:
            for line in process.stderr:
                if line.rstrip().endswith("queued and waiting for resources"):
                    if errors:
                        explain(errors[-1].removeprefix("srun:").strip())
                elif not line.rstrip().endswith("has been allocated resources"):
                    errors.append(line)
            return process.stdout.read(), "".join(errors)
        except BaseException:
            process.kill()
            raise


def _say(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, capture_output=True, text=True, errors="replace", env=_environment()
    )


def _environment() -> dict[str, str]:
    # Inside an allocation srun would start a step there, which may wait for the shell that asks.
    # SQUEUE_STATES or SQUEUE_USERS would hide jobs, and their steps would be submitted again.
    return {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("SLURM_", "SQUEUE_")) or name in ("SLURM_CONF", "SLURM_CLUSTERS")
    }


def _reason(text: str) -> str:
    """The line of an error that says why."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    lines = [line for line in lines if "Exited with exit code" not in line] or lines
    lines = [line for line in lines if not line.startswith('Try "')] or lines
    for line in reversed(lines):
        if "rror:" in line and "Unable to allocate" not in line:
            return line.partition("rror:")[2].strip()
    return lines[-1].rpartition("allocate resources: ")[2] if lines else "no reason given"
