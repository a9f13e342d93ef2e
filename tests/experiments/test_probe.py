"""What a probe job finds out before anything is submitted, by a Slurm of shell scripts."""

from __future__ import annotations

import json
import os
import re
import time
from types import SimpleNamespace

import pytest

from irlcli.errors import StageFailed, UsageError
from irlcli.experiments.cluster.probe import look
from irlcli.experiments.cluster.resources import Resources, parse_minutes
from irlcli.experiments.cluster.slurm import Slurm
from irlcli.store import Store


@pytest.fixture
def probe(tmp_path, monkeypatch):
    """``probe(script)``: the warnings of a probe whose srun is that shell script."""
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")

    def run(script):
        for name in ("sbatch", "squeue", "scancel", "scontrol", "sinfo"):
            (tmp_path / name).write_text("#!/bin/sh\necho short\necho long\n")
        (tmp_path / "srun").write_text(f"#!/bin/sh\n{script}\n")
        for path in tmp_path.glob("s*"):
            path.chmod(0o755)
        warnings = []
        slurm = Slurm(Resources("P", cpus=3))
        (tmp_path / "runs").mkdir()
        console = SimpleNamespace(say=lambda text: None, warn=warnings.append)
        slurm.probe(Store(tmp_path / "runs"), console)
        assert list((tmp_path / "runs" / ".jobs").iterdir()) == []
        return warnings

    return run


def answer(**facts):
    facts = {
        "host": "n1",
        "time": time.time(),
        "seen": True,
        "directory": True,
        "free": 1 << 40,
        **facts,
    }
    return f"echo '{json.dumps(facts)}'"


def test_a_good_node_is_not_mentioned(probe):
    assert probe(answer()) == []


def test_a_store_out_of_sight(probe):
    with pytest.raises(StageFailed, match="the node n1 does not see the store"):
        probe(answer(seen=False))


def test_a_working_directory_out_of_sight(probe):
    with pytest.raises(StageFailed, match="the node n1 does not see the working directory"):
        probe(answer(directory=False))


def test_an_option_that_slurm_refuses(probe):
    with pytest.raises(UsageError, match="refused: srun: unrecognized option '--nothing'"):
        probe("""echo "srun: unrecognized option '--nothing'" >&2
        echo 'Try "srun --help" for more information' >&2; exit 1""")


def test_the_probe_asks_for_what_the_jobs_ask_for(probe):
    """A node that has no room for a job refuses the probe, before anything is submitted."""
    asked = 'case "$*" in *--partition=P*--cpus-per-task=3*)'
    assert probe(f"{asked} {answer()};; *) exit 1;; esac") == []


def test_a_probe_that_waits_says_why_unless_the_partition_is_just_full(probe, tmp_path):
    full = "echo 'srun: job 1 queued and waiting for resources' >&2; "
    full += "echo 'srun: job 1 has been allocated resources' >&2; "
    assert probe(full + answer()) == []
    (tmp_path / "runs" / ".jobs").rmdir()
    (tmp_path / "runs").rmdir()
    (warning,) = probe("echo 'srun: Requested nodes are busy' >&2; " + full + answer())
    assert warning == "Slurm does not start the probe job: Requested nodes are busy"


def test_a_probe_from_inside_an_allocation_is_a_job_of_its_own(probe, monkeypatch):
    monkeypatch.setenv("SLURM_JOB_ID", "7")
    assert probe(f'[ -z "$SLURM_JOB_ID" ] && {answer()}') == []


def test_jobs_that_cannot_be_cancelled_are_an_error(probe, tmp_path):
    probe(answer())
    (tmp_path / "scancel").write_text("#!/bin/sh\necho 'error: Access denied' >&2; exit 1\n")
    with pytest.raises(StageFailed, match="scancel: Access denied"):
        Slurm(Resources()).cancel(["7"])


def test_a_refused_job_does_not_keep_others_from_being_cancelled(probe, tmp_path):
    probe(answer())
    script = f"""#!/bin/sh
for last; do :; done; echo "$last" >> {tmp_path}/cancelled
case "$*" in 0*) echo 'error: Access denied' >&2; exit 1;; esac
"""
    (tmp_path / "scancel").write_text(script)
    with pytest.raises(StageFailed, match="scancel: Access denied"):
        Slurm(Resources()).cancel(map(str, range(501)))
    assert (tmp_path / "cancelled").read_text().split() == ["499", "500"]


def test_a_store_that_cannot_be_written(probe):
    with pytest.raises(StageFailed, match=r"cannot write to .*: No space left on device"):
        probe(answer(problem="No space left on device"))


@pytest.mark.parametrize("seconds", [-3600, 3600])
def test_clocks_that_differ(probe, seconds):
    (warning,) = probe(answer(time=time.time() + seconds))
    assert re.search(r"the clock of the node n1 differs by 3(60\d|59\d) s", warning)


def test_a_disk_that_is_nearly_full(probe):
    (warning,) = probe(answer(free=5 << 20))
    assert "5 MiB left" in warning


def test_a_wrong_partition_names_the_others(probe):
    with pytest.raises(UsageError) as caught:
        probe("echo 'srun: error: invalid partition specified: P' >&2; exit 1")
    assert "invalid partition" in caught.value.message
    assert caught.value.hint == "partitions: long, short"


def test_a_node_without_python(probe):
    with pytest.raises(StageFailed, match="No such file or directory"):
        probe("echo 'slurmstepd: error: execve(): python: No such file or directory' >&2; exit 2")


def test_a_node_looks_for_the_token(tmp_path):
    assert look(tmp_path, "token", tmp_path)["seen"] is False
    (tmp_path / "token").touch()
    assert look(tmp_path, "token", tmp_path).items() >= {"seen": True, "directory": True}.items()
    assert look(tmp_path, "token", tmp_path / "elsewhere")["directory"] is False
    assert [path.name for path in tmp_path.iterdir()] == ["token"]


@pytest.mark.parametrize(
    "text, minutes",
    [("90", 90), ("4:00:00", 240), ("30:00", 30), ("1-12", 2160), ("2-0:30", 2910), ("1:30", 2)],
)
def test_time_limits_as_slurm_writes_them(text, minutes):
    assert parse_minutes(text) == minutes


@pytest.mark.parametrize("text", ["", "soon", "0", "1:2:3:4", "-5"])
def test_what_is_no_time_limit(text):
    with pytest.raises(UsageError, match="--time"):
        parse_minutes(text)
