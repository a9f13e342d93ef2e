"""What a job of a cluster does: run the command that makes one step, and ask to be requeued if stopped.

This module is loaded on the nodes. It writes the outcome of the step beside the job's logs, because
Slurm forgets a job within minutes where it has no database.
"""

import json
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from irlcli.errors import Busy, Interrupted
from irlcli.experiments.failures import LAST_LINES, failure

# A process that the signal met before it could listen is as good as stopped at a checkpoint.
_ANOTHER_TURN = (Interrupted.exit_code, Busy.exit_code, -signal.SIGTERM, -signal.SIGUSR2)


class StepFailed(Exception):
    """Ends a job with a failure, so that Slurm starts nothing that depends on it."""


class StepJob(NamedTuple):
    """The job that makes one step.

    Attributes:
        name: of the step.
        command: its command line.
        directory: working directory of the command.
        notes: directory for the outcome of the step.
        requeues: how often the job may be requeued.
    """

    name: str
    command: tuple[str, ...]
    directory: str
    notes: str
    requeues: int

    def run(self) -> None:
        """Run the command.

        Raises:
            StepFailed: it failed, or was interrupted more often than ``requeues``.
            SystemExit: the job was put back into the queue, or is being cancelled.
        """
        note = Path(self.notes) / f"{self.name}.failed"
        note.unlink(missing_ok=True)
        code, lines, received = self._run()
        if code == 0:
            return
        if code in _ANOTHER_TURN:
            if not _is_running(received):
                # After scancel nobody wants the job requeued; after a preemption Slurm requeues it.
                sys.exit(Interrupted.exit_code)
            turns = self._turns()
            if turns < self.requeues:
                self._count_turn()
                _requeue()
                sys.exit(Interrupted.exit_code)
            if code != Busy.exit_code:
                # Otherwise the last lines say who else works on it.
                times = "once" if turns == 0 else f"{turns + 1} times"
                lines.append(f"error: {self.name} was interrupted {times}")
                lines.append(
                    "hint: give the jobs more time (--time), then run the same command again: it resumes"
                )
                # A process that a signal killed has another code, whose message would replace these.
                code = Interrupted.exit_code
        note.write_text(json.dumps(failure(code, lines)._asdict()))
        raise StepFailed(f"{self.name} ended with exit code {code}")

    def _run(self) -> tuple[int, deque[str], list[int]]:
        """The command's exit code, its last lines, and the signals that were passed on to it."""
        process = subprocess.Popen(
            self.command,
            cwd=self.directory,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )

        received: list[int] = []

        def stop(number: int, _: object) -> None:
            received.append(number)
            # Slurm may have sent its signal to the command as well: it counts this one only once.
            process.send_signal(signal.SIGUSR2)

        for number in (signal.SIGUSR2, signal.SIGTERM):
            signal.signal(number, stop)
        lines: deque[str] = deque(maxlen=LAST_LINES)
        assert process.stderr is not None
        for line in process.stderr:
            print(line, end="", file=sys.stderr, flush=True)
            lines.append(line.rstrip())
        return process.wait(), lines, received

    def _turns(self) -> int:
        try:
            return len(self._turns_file.read_bytes())
        except FileNotFoundError:
            return 0

    def _count_turn(self) -> None:
        with open(self._turns_file, "ab") as file:
            file.write(b".")

    @property
    def _turns_file(self) -> Path:
        return Path(self.notes) / f"{self.name}.requeued"


def _is_running(received: Sequence[int]) -> bool:
    """Whether the job may continue: nobody has cancelled it.

    To cancel, Slurm sends the same SIGTERM as before a preemption. submitit's local executor
    cancels by SIGTERM, and sends SIGUSR2 before a time limit.
    """
    if os.environ.get("SUBMITIT_EXECUTOR") == "local":
        # Inside an allocation of Slurm, SLURM_JOB_ID is that of the allocation.
        return signal.SIGTERM not in received
    job = os.environ.get("SLURM_JOB_ID")
    if "SLURM_ARRAY_TASK_ID" in os.environ:
        # The last element has the array's own id, by which Slurm shows all of them.
        job = f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    assert job is not None, "not started by Slurm"
    done = subprocess.run(
        ["scontrol", "show", "job", "--oneliner", job], capture_output=True, text=True
    )
    return done.returncode != 0 or "JobState=RUNNING" in done.stdout


def _requeue() -> None:
    """Put this job back into the queue, as submitit does at its own checkpoints."""
    import submitit

    submitit.JobEnvironment()._requeue(0)
