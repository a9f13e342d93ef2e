"""A Slurm cluster of one's own: munged, slurmctld and several slurmd on this machine.

No systemd, no cgroups and no files outside one directory. ``python tests/cluster/slurm.py DIR``
starts one, prints the environment variables that its commands need, and stops it at Ctrl-C.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "srun")
# Slurm waits for as long as credentials live (by default 120 s) before a requeued job starts.
_CREDENTIAL_SECONDS = 5
_CONF = """\
ClusterName=test
SlurmctldHost={host}
SlurmctldPort={port}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={directory}/munge.socket,cred_expire={credential}
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_interval=1,bf_interval=1,bf_resolution=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
JobRequeue=1
KillWait=10
MinJobAge=300
ReturnToService=2
SlurmctldTimeout=10
SlurmdTimeout=8
InactiveLimit=0
StateSaveLocation={directory}/state
SlurmdSpoolDir={directory}/spool.%n
SlurmctldPidFile={directory}/slurmctld.pid
SlurmdPidFile={directory}/slurmd.%n.pid
SlurmctldLogFile={directory}/slurmctld.log
SlurmdLogFile={directory}/slurmd.%n.log
SlurmctldDebug=info
SlurmdDebug=info
SlurmdParameters=config_overrides
{nodes}
PartitionName=main Nodes={names} Default=YES MaxTime=INFINITE State=UP PriorityTier=1 GraceTime=10
PartitionName=urgent Nodes={names} MaxTime=INFINITE State=UP PriorityTier=9
PartitionName=blind Nodes=blind MaxTime=INFINITE State=UP
"""


def missing() -> str | None:
    """Why no cluster can be started here; None if one can."""
    absent = [name for name in PROGRAMS if shutil.which(name, path=_PATH) is None]
    if absent:
        return f"Slurm is not installed ({', '.join(absent)}): apt-get install slurm-wlm munge"
    if os.geteuid() != 0:
        return "slurmd needs root"
    return None


_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])


class Cluster:
    """One controller, ``nodes`` nodes, and a node ``blind`` that does not see ``hidden``.

    With ``mount``, a shell command, each of the others has a host name and mounts of its own.

    Attributes:
        environment: for the commands that use it.
    """

    def __init__(
        self, directory: Path, hidden: Path, nodes: int = 2, cpus: int = 4, mount: str | None = None
    ):
        self.directory = directory
        self._names = [f"n{i + 1}" for i in range(nodes)]
        self._mounts = dict.fromkeys(self._names, mount)
        self._mounts["blind"] = f"mount -t tmpfs none {hidden}"
        self._processes: dict[str, subprocess.Popen] = {}
        self._ports = _free_ports(nodes + 2)
        for name in ("state", *(f"spool.{n}" for n in self._mounts)):
            (directory / name).mkdir(parents=True)
        host = os.uname().nodename
        lines = [
            f"NodeName={name} NodeHostname={host} Port={port} CPUs={cpus} RealMemory=1000 State=UNKNOWN"
            for name, port in zip(self._mounts, self._ports[1:], strict=True)
        ]
        self._conf = directory / "slurm.conf"
        self._conf.write_text(
            _CONF.format(
                host=host,
                port=self._ports[0],
                directory=directory,
                credential=_CREDENTIAL_SECONDS,
                nodes="\n".join(lines),
                names=",".join(self._names),
            )
        )
        self.environment = {"SLURM_CONF": str(self._conf), "PATH": _PATH}

    def start(self) -> None:
        """Start everything and wait until the nodes are idle."""
        key = self.directory / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        self.directory.chmod(0o755)
        munge = ["munged", "--foreground", "--force", f"--key-file={key}"]
        munge += [
            f"--socket={self.directory}/munge.socket",
            f"--pid-file={self.directory}/munge.pid",
        ]
        munge += [f"--log-file={self.directory}/munge.log", f"--seed-file={self.directory}/seed"]
        self._run("munged", munge)
        self._wait("munged", (self.directory / "munge.socket").exists)
        self.start_controller()
        for name in self._mounts:
            self.start_node(name)
        everyone = {f"{name} idle" for name in self._mounts}
        self._wait(
            "the nodes",
            lambda: set(self.say("sinfo", "-h", "-N", "-o", "%N %T").splitlines()) == everyone,
        )

    def warn_at_preemption(self, warn: bool) -> None:
        """Whether a preempted job gets the signal that it asked for before a time limit."""
        lines = self._conf.read_text().splitlines()
        lines = [line for line in lines if not line.startswith("SlurmctldParameters=")]
        lines += ["SlurmctldParameters=preempt_send_user_signal"] if warn else []
        self._conf.write_text("\n".join(lines) + "\n")
        self.say("scontrol", "reconfigure")

    def start_controller(self) -> None:
        self._run("slurmctld", ["slurmctld", "-D", "-f", str(self._conf)])

    def stop_controller(self) -> None:
        """End slurmctld; the jobs go on."""
        process = self._processes.pop("slurmctld")
        process.terminate()
        process.wait()

    def start_node(self, name: str) -> None:
        command = ["slurmd", "-D", "-N", name, "-f", str(self._conf)]
        mount = self._mounts[name]
        if mount is not None:
            private = ["unshare", "--uts", "--mount", "--propagation", "private"]
            line = f"hostname {name}; {mount} && exec {shlex.join(command)}"
            command = [*private, "sh", "-c", line]
        self._run(name, command)

    def kill_node(self, name: str, jobs_too: bool) -> None:
        """SIGKILL to a slurmd: with its jobs, as a power cut, or without, as the kernel may do."""
        process = self._processes.pop(name)
        process.kill()
        process.wait()
        # Again: a job that was being launched may have started processes meanwhile.
        while jobs_too and (found := _processes_of(name, self._conf)):
            for pid in found:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    def running_on(self, node: str) -> list[str]:
        """The ids of the steps' jobs that run on a node."""
        options = ("--noheader", "--array", "--name=irl", "--states=R", f"--nodelist={node}")
        return self.say("squeue", *options, "--format=%i").split()

    def say(self, *command: str) -> str:
        """What a Slurm command prints."""
        done = subprocess.run(
            command, capture_output=True, text=True, env={**os.environ, **self.environment}
        )
        return done.stdout

    def stop(self) -> None:
        """Cancel all jobs and end all processes."""
        limit = time.monotonic() + 30
        while self.say("squeue", "--noheader") and time.monotonic() < limit:
            self.say("scancel", "--user=root")
            time.sleep(0.5)
        for name in self._mounts:
            for pid in _processes_of(name, self._conf):
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        for process in reversed(self._processes.values()):
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _run(self, name: str, command: list[str]) -> None:
        with open(self.directory / f"{name}.out", "ab") as log:
            self._processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                preexec_fn=_unblock,
                stdout=log,
                stderr=log,
                env={**os.environ, **self.environment},
            )

    def _wait(self, what: str, ready, seconds: float = 90.0) -> None:
        limit = time.monotonic() + seconds
        while not ready():
            if time.monotonic() > limit:
                logs = "\n".join(p.read_text()[-1500:] for p in self.directory.glob("*.out"))
                raise AssertionError(f"{what} did not start within {seconds:.0f} s:\n{logs}")
            time.sleep(0.2)


def _unblock() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, [])


def _processes_of(node: str, conf: Path) -> list[int]:
    """The processes that the jobs of a node run, and the slurmstepd they belong to."""
    wanted = {f"SLURMD_NODENAME={node}".encode(), f"SLURM_CONF={conf}".encode()}
    parents: dict[int, int] = {}
    found: set[int] = set()
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):
            pid = int(path.name)
            parents[pid] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            if wanted <= set((path / "environ").read_bytes().split(b"\0")):
                found.add(pid)
    daemons = set()
    for pid in found:
        parent = parents.get(pid, 0)
        with suppress(OSError):
            if b"slurmstepd" in Path(f"/proc/{parent}/cmdline").read_bytes():
                daemons.add(parent)
    # The daemons first, so that they report no end of their jobs.
    return [*daemons, *(found - daemons)]


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for found in sockets:
        found.bind(("", 0))
    ports = [found.getsockname()[1] for found in sockets]
    for found in sockets:
        found.close()
    return ports


if __name__ == "__main__":
    reason = missing()
    if reason is not None:
        sys.exit(reason)
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
    place = Path(sys.argv[1]).absolute()
    (place / "hidden").mkdir(parents=True, exist_ok=True)
    cluster = Cluster(place / "slurm", place / "hidden")
    try:
        cluster.start()
        print(f"export SLURM_CONF={cluster.environment['SLURM_CONF']} PATH={_PATH}", flush=True)
        signal.sigwait([signal.SIGINT, signal.SIGTERM])
    finally:
        cluster.stop()
