"""``irl run --cluster slurm`` on a real Slurm: ``make test-cluster``.

The jobs, their command lines, signals, leases and artefacts are real. What the stages compute is
replaced by rounds of a hash chain (``tests/experiments/fake_stages``), so that a table with
two rows, three methods and three seeds takes a minute on two cores. One test trains a smaller
table.
"""

from __future__ import annotations

import errno
import json
import os
import random
import shlex
import shutil
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest
from slurm import Cluster, missing

from irlcli.store import Store

CHECKOUT = Path(__file__).parent.parent.parent
TABLES = """
[table1]
title = "Table 1"
rows = ["lunar-lander.engine-power", "lunar-lander.bounce"]
methods = ["erm", "irm", "irm-shuffled"]
seeds = [0, 1, 2]
measures = ["zero-shot"]

[other]
title = "Another table with some of the same steps"
rows = ["lunar-lander.engine-power"]
methods = ["irm", "vrex"]
seeds = [1, 2, 3]
measures = ["zero-shot"]

[small]
title = "A table that is small enough to be trained"
rows = ["lunar-lander.engine-power"]
methods = ["irm"]
seeds = [0]
measures = ["zero-shot"]
"""
UNTIL = ("--until", "returns")
# The reward's lambda is known only after four others were learned and evaluated.
CHOSEN = ("--choose-penalty", "1,10", "--tag", "chosen")
SLOW = {"IRL_TEST_ROUND": "0.5"}

if os.environ.get("IRL_TEST_CLUSTER") != "1":
    pytest.skip("run by `make test-cluster`", allow_module_level=True)
if missing() is not None:
    pytest.skip(missing(), allow_module_level=True)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    directory = tmp_path_factory.mktemp("cluster")
    (directory / "hidden").mkdir()
    made = Cluster(directory / "slurm", directory / "hidden")
    try:
        made.start()
        yield made
    finally:
        made.stop()


class Runs:
    """``irl`` in processes of its own, on the cluster."""

    def __init__(self, directory: Path, cluster: Cluster, train: bool = False):
        directory.mkdir(exist_ok=True)
        self.log = directory / "log"
        self.log.touch()
        self.tables = directory / "tables.toml"
        self.tables.write_text(TABLES)
        self.store = directory / "runs"
        fakes = [] if train else [str(CHECKOUT / "tests/experiments/fake_stages")]
        self.environment = {
            **os.environ,
            **cluster.environment,
            "PYTHONPATH": os.pathsep.join([*fakes, str(CHECKOUT)]),
            "IRL_TEST_LOG": str(self.log),
            "IRL_TEST_ROUND": "0.02",
        }

    def start(self, *words: object, **environment: str) -> subprocess.Popen:
        line = [sys.executable, "-m", "irlcli", *words]
        return subprocess.Popen(
            [str(word) for word in line],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**self.environment, **environment},
        )

    def table(self, *more: object, name: str = "table1", **environment: str) -> subprocess.Popen:
        words = ["run", name, "--experiments", self.tables, "--profile", "smoke"]
        return self.start(*words, "--store", self.store, *more, **environment)

    def submit(self, *more: object, **options: str) -> subprocess.Popen:
        jobs = ("--cluster", "slurm", "--time", "10")
        until = () if {"--status", "--cancel"} & set(more) else UNTIL
        return self.table(*jobs, *until, *more, **options)

    def lines(self) -> list[dict]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]

    def computed(self) -> Counter:
        """How often each artefact was computed, or resumed."""
        made = (line for line in self.lines() if "computes" in line)
        return Counter(json.dumps([line["parameters"], line["inputs"]]) for line in made)

    def submitted(self) -> list[str]:
        """The steps that were submitted, while the record of it exists."""
        records = (self.store / ".jobs").glob("*/jobs-*.json")
        return [job["name"] for path in records for job in json.loads(path.read_text())["jobs"]]

    def wait_for(self, count: int, process: subprocess.Popen | None = None) -> None:
        """Until ``count`` artefacts exist."""
        while not self.store.exists() or len(Store(self.store).ids()) < count:
            assert process is None or process.poll() is None, process.communicate()
            time.sleep(0.05)


def done(process: subprocess.Popen, code: int = 0) -> str:
    _, errors = process.communicate(timeout=500)
    assert process.returncode == code, errors
    return errors


@pytest.fixture
def runs(tmp_path, cluster):
    return Runs(tmp_path, cluster)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, cluster):
    """The ids of ``irl run table1 --jobs 2`` on this machine alone."""
    runs = Runs(tmp_path_factory.mktemp("whole"), cluster)
    done(runs.table("--jobs", "2", *UNTIL))
    return Store(runs.store).ids()


def verified(runs, whole):
    # A job that was killed as it published leaves a checkpoint, which nobody needs.
    done(runs.start("gc", "--delete", "--grace-days", "0", "--store", runs.store))
    assert Store(runs.store).ids() == whole
    assert Store(runs.store).verify(whole).damaged == {}
    assert list((runs.store / ".quarantine").iterdir()) == []
    assert list((runs.store / ".work").iterdir()) == []
    assert list((runs.store / ".jobs").iterdir()) == []


def test_the_ids_are_those_of_a_local_run_and_nothing_is_submitted_twice(runs, whole):
    errors = done(runs.submit())
    assert f"{len(whole)} jobs submitted" in errors
    assert len(runs.submitted()) == len(whole)
    verified(runs, whole)
    assert set(runs.computed().values()) == {1}
    errors = done(runs.submit())
    assert f"{len(whole)} of {len(whole)} steps exist" in errors
    assert "submitted" not in errors and "probe" not in errors
    assert runs.submitted() == []


@pytest.mark.parametrize("jobs_too", [True, False], ids=["with its jobs", "slurmd only"])
def test_a_node_killed_in_the_middle_changes_nothing(runs, whole, cluster, jobs_too):
    process = runs.submit(**SLOW)
    runs.wait_for(15, process)
    cluster.kill_node("n1", jobs_too)
    time.sleep(12)
    cluster.start_node("n1")
    done(process)
    verified(runs, whole)


def test_a_slurmd_that_dies_as_its_jobs_start_changes_nothing(runs, whole, cluster):
    """An inner srun could no longer launch its task, and the job would end as failed."""
    process = runs.submit(**SLOW)
    for delay in (0.0, 0.1, 0.3):
        before = set(cluster.running_on("n1"))
        while not set(cluster.running_on("n1")) - before:
            assert process.poll() is None, process.communicate()
        time.sleep(delay)
        cluster.kill_node("n1", jobs_too=False)
        time.sleep(12)
        cluster.start_node("n1")
    done(process)
    verified(runs, whole)


def test_real_training_and_a_chosen_lambda_on_a_node_that_is_killed(tmp_path, cluster):
    here = Runs(tmp_path / "here", cluster, train=True)
    there = Runs(tmp_path / "there", cluster, train=True)
    done(here.table("--jobs", "2", *UNTIL, *CHOSEN, name="small"))
    process = there.submit(*CHOSEN, name="small")
    # Some of what the choice is made from is there, and more is being made.
    there.wait_for(12, process)
    while not cluster.running_on("n1"):
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    cluster.kill_node("n1", jobs_too=True)
    time.sleep(12)
    cluster.start_node("n1")
    done(process)
    assert "chosen.lunar-lander.engine-power.irm.0.choice" in Store(there.store).names()
    submitted = there.submitted()
    assert len(submitted) == len(set(submitted))
    assert "submitted" not in done(there.submit(*CHOSEN, name="small"))
    verified(there, Store(here.store).ids())


def test_cancelled_at_random_fifty_times_it_ends_in_the_same_ids(runs, whole, cluster):
    chance = random.Random(0)
    cancelled = 0
    while cancelled < 50:
        process = runs.submit(**SLOW)
        for _ in range(10):
            time.sleep(chance.uniform(0.2, 1.0))
            jobs = cluster.say("squeue", "-h", "-r", "-o", "%i", "--name=irl").split()
            if jobs and cancelled < 50:
                cluster.say("scancel", chance.choice(jobs))
                cancelled += 1
        errors = process.communicate(timeout=500)[1]
        assert "Traceback" not in errors, errors
    done(runs.submit())
    verified(runs, whole)


def test_two_people_with_overlapping_tables_make_each_artefact_once(runs, whole):
    first = runs.submit("--tag", "first", **SLOW)
    second = runs.submit("--tag", "second", name="other", **SLOW)
    done(first)
    done(second)
    assert set(whole) < set(Store(runs.store).ids())
    assert set(runs.computed().values()) == {1}
    assert Store(runs.store).verify(Store(runs.store).ids()).damaged == {}


def test_gc_beside_it_takes_nothing_that_is_in_use(runs, whole, cluster):
    done(runs.submit("--detach"))
    codes = Counter()
    while cluster.say("squeue", "-h", "--name=irl").strip():
        gc = runs.start("gc", "--delete", "--grace-days", "0", "--store", runs.store)
        errors = gc.communicate(timeout=100)[1]
        codes[gc.returncode] += 1
        assert (gc.returncode in (0, 75) and " 0 artefacts" in f" {errors}") or gc.returncode == 75
    assert codes[75], codes
    done(runs.submit())
    verified(runs, whole)
    assert set(runs.computed().values()) == {1}


def test_gc_keeps_the_records_of_jobs_that_only_wait(runs, whole, cluster):
    done(runs.submit("--detach"))
    runs.wait_for(1)
    cluster.say("scontrol", "update", "PartitionName=main", "State=DOWN")
    while cluster.running_on("n1") or cluster.running_on("n2"):
        time.sleep(0.2)
    done(runs.start("gc", "--delete", "--grace-days", "0", "--store", runs.store))
    assert len(runs.submitted()) == len(whole)
    cluster.say("scontrol", "update", "PartitionName=main", "State=UP")
    assert "submitted" not in done(runs.submit())
    verified(runs, whole)


def test_without_locks_on_the_shared_disk(runs, whole, tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    source = CHECKOUT / "tests/torture/faults.c"
    shim = tmp_path / "faults.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", shim, source, "-ldl"], check=True)
    faults = {
        "LD_PRELOAD": str(shim),
        "IRL_FAULTS": f"flock {errno.ENOLCK} {runs.store}",
    }
    first = runs.submit(**faults)
    second = runs.submit("--tag", "second", name="other", **faults)
    errors = done(first)
    done(second)
    assert errors.count("without locks") == 1
    assert set(runs.computed().values()) == {1}
    assert set(whole) < set(Store(runs.store).ids())


def test_every_machine_with_its_own_mount_of_a_store_on_the_network(tmp_path, whole):
    """SFTP: each mount has caches of its own, and no lock of one is seen by another."""
    server = Path("/usr/lib/openssh/sftp-server")
    if shutil.which("sshfs") is None or not server.exists():
        pytest.skip("needs sshfs and openssh-sftp-server")
    for name in ("hidden", "served", "mounted"):
        (tmp_path / name).mkdir()
    connect = tmp_path / "connect"
    connect.write_text(f"#!/bin/sh\nexec {server}\n")
    connect.chmod(0o755)
    served, mounted = tmp_path / "served", tmp_path / "mounted"
    sshfs = f"sshfs -f -o ssh_command={connect} server:{served} {mounted}"
    ready = f"until mountpoint --quiet {mounted}; do sleep 0.1; done"
    mount = f"setpriv --pdeathsig TERM {sshfs} & {ready}"
    cluster = Cluster(tmp_path / "slurm", tmp_path / "hidden", mount=mount)
    here = None
    try:
        cluster.start()
        here = subprocess.Popen(shlex.split(sshfs))
        subprocess.run(ready, shell=True, check=True)
        runs = Runs(tmp_path / "runs", cluster)
        runs.store = mounted / "store"
        first = runs.submit("--tag", "first", **SLOW)
        # On the login node: it sees the jobs by their leases only.
        second = runs.table("--jobs", "2", "--tag", "second", *UNTIL, name="other", **SLOW)
        done(first)
        assert "on n" in done(second)
        assert set(runs.computed().values()) == {1}
        ids = Store(served / "store").ids()
        assert set(whole) < set(ids) and Store(served / "store").verify(ids).damaged == {}
        assert "submitted" not in done(runs.submit("--tag", "first"))
    finally:
        cluster.stop()
        if here is not None:
            here.terminate()
            here.wait()


def test_a_time_limit_ends_in_a_checkpoint_and_another_turn(runs):
    """Six rounds of 9 s do not fit: after 30 of 60 s the job is warned."""
    arguments = ("--cluster", "slurm", "--time", "1", "--until", "experts")
    errors = done(runs.table(*arguments, "--rows", "lunar-lander", IRL_TEST_ROUND="9"))
    assert "failed" not in errors
    assert min(runs.computed().values()) >= 2
    ids = Store(runs.store).ids()
    runs.store = runs.store.with_name("elsewhere")
    done(runs.table("--until", "experts", "--jobs", "6"))
    assert Store(runs.store).ids() == ids


@pytest.mark.parametrize("told", ["by SIGUSR2 at once", "by SIGTERM after the grace time"])
def test_preempted_jobs_go_on_later(runs, cluster, told):
    """The grace time is 10 s, and the six rounds of a step take 24 s."""
    at_once = "SIGUSR2" in told
    cluster.warn_at_preemption(at_once)
    process = runs.table("--cluster", "slurm", "--until", "experts", IRL_TEST_ROUND="4")
    while not cluster.running_on("n1") or not runs.computed():
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    time.sleep(2)
    urgent = ["srun", "--partition=urgent", "--exclusive", "--nodes=2", "sleep", "1"]
    started = time.monotonic()
    assert cluster.say(*urgent) == ""
    assert (time.monotonic() - started < 10) == at_once
    errors = done(process)
    assert "failed" not in errors
    assert max(runs.computed().values()) == 2
    assert list(runs.store.glob(".jobs/*/steps/*.requeued")) or not at_once


def test_whoever_waited_may_die(runs, whole):
    process = runs.submit(**SLOW)
    runs.wait_for(10, process)
    process.kill()
    process.communicate()
    errors = done(runs.submit(**SLOW))
    assert "submitted" not in errors
    verified(runs, whole)
    assert set(runs.computed().values()) == {1}


def test_a_controller_that_is_restarted_is_waited_for(runs, whole, cluster):
    process = runs.submit(**SLOW)
    runs.wait_for(10, process)
    cluster.stop_controller()
    time.sleep(10)
    cluster.start_controller()
    done(process)
    verified(runs, whole)


def test_status_and_cancel(runs, cluster):
    done(runs.submit("--detach", IRL_TEST_ROUND="5"))
    time.sleep(3)
    out, _ = runs.submit("--status", "--json").communicate()
    states = Counter(step["state"] for step in json.loads(out)["missing"])
    assert states["RUNNING"] and states["PENDING"], states
    done(runs.submit("--cancel"))
    limit = time.monotonic() + 60
    while cluster.say("squeue", "-h", "--name=irl").strip():
        assert time.monotonic() < limit, "cancelled jobs were put back into the queue"
        time.sleep(0.2)
    # Those that ran have left a checkpoint, and none of them was a failure.
    assert list(runs.store.glob(".work/*/checkpoint"))
    out, _ = runs.submit("--status", "--json").communicate()
    states = Counter(step["state"] for step in json.loads(out)["missing"])
    assert set(states) <= {"RESUME", "RUN", "BLOCKED"} and states["RESUME"]


def test_the_last_element_of_an_array_can_be_cancelled_alone(runs, cluster):
    """It has the array's own id."""
    done(runs.submit("--detach", IRL_TEST_ROUND="5"))
    runs_now = ["squeue", "-h", "-r", "--name=irl", "--states=R", "-o", "%i %A"]
    last = None
    while last is None:
        jobs = [line.split() for line in cluster.say(*runs_now).splitlines()]
        last = next((i for i, raw in jobs if i.partition("_")[0] == raw), None)
    time.sleep(2)
    cluster.say("scancel", last)
    limit = time.monotonic() + 60
    while state := cluster.say("squeue", "-h", "-j", last, "-o", "%T").strip():
        assert state in ("RUNNING", "COMPLETING") and time.monotonic() < limit, state
        time.sleep(0.2)
    done(runs.submit("--cancel"))


def test_a_failure_stops_only_what_depends_on_it(runs, whole):
    errors = done(runs.submit(IRL_TEST_FAIL="train_airl pooled"), 1)
    assert "it was asked to fail" in errors and "hint: do not ask for it" in errors
    made = len(Store(runs.store).ids())
    assert 0 < made < len(whole)
    names = Store(runs.store).names()
    assert any(".irm.2.zero-shot-returns" in name for name in names)
    assert not any(".erm.0" in name for name in names)
    done(runs.submit())
    verified(runs, whole)


@pytest.mark.parametrize(
    "words, code, said",
    [
        (["--partition", "nowhere"], 2, "partitions: blind, main, urgent"),
        (["--sbatch", "nothing=1"], 2, "nothing"),
        (["--sbatch", "nodelist=nowhere"], 2, "Invalid node name"),
    ],
)
def test_bad_options_submit_nothing(runs, words, code, said):
    assert said in done(runs.submit(*words), code)
    assert runs.submitted() == []


def test_a_store_that_the_nodes_do_not_see_is_found_before_anything_is_submitted(runs, cluster):
    runs.store = cluster.directory.parent / "hidden" / "runs"
    errors = done(runs.submit("--partition", "blind"), 1)
    assert f"does not see the store {runs.store}" in errors
    assert "shared" in errors or "share" in errors
    assert runs.submitted() == []


def test_a_full_disk_fails_the_steps_and_the_next_run_makes_them(runs, whole):
    """A tmpfs that the login node and the nodes share fills up in the middle."""
    runs.store.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=30m", "none", runs.store]
    subprocess.run(mount, check=True)
    try:
        process = runs.submit(**SLOW)
        runs.wait_for(10, process)
        with open(runs.store / ".locks" / "ballast", "wb", buffering=0) as ballast:
            for size in (1 << 20, 1 << 10, 1):
                with suppress(OSError):
                    while True:
                        ballast.write(bytes(size))
        errors = done(process, 1)
        assert "No space left on device" in errors and "Traceback" not in errors
        again = runs.submit()
        assert "No space left on device" in done(again, 1)
        (runs.store / ".locks" / "ballast").unlink()
        done(runs.submit())
        verified(runs, whole)
    finally:
        subprocess.run(["umount", "--lazy", runs.store], check=True)


def test_a_node_whose_clock_is_an_hour_ahead_is_reported_and_changes_nothing(runs, whole):
    errors = done(runs.submit("--tag", "first", IRL_TEST_AHEAD="n1 3600"))
    assert "the clock of the node" in errors and "differs by 3600 s" in errors
    verified(runs, whole)
    assert set(runs.computed().values()) == {1}
