"""``irl run --cluster local``: the jobs of a cluster, on submitit's local executor."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_run import CHOSEN_REWARD, REWARDS, ROW, Runs, alive, choosing, publish_step

from irlcli.experiments.cluster.local import Local
from irlcli.experiments.cluster.records import LOCK, Submitted, ended, new_record
from irlcli.requests.tables import open_plan
from irlcli.store import Store

pytest.importorskip("submitit")


@pytest.fixture
def runs(tmp_path):
    return Runs(tmp_path)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The ids and the processes of a run without a cluster."""
    directory = tmp_path_factory.mktemp("plain")
    runs = Runs(directory)
    runs.run(directory / "runs", "--jobs", "8", *REWARDS)
    return Store(directory / "runs").ids(), sorted(runs.processes())


def test_it_ends_in_the_ids_of_a_run_without_a_cluster(irl, plain, runs, tmp_path):
    whole, processes = plain
    store = tmp_path / "runs"
    errors = runs.run(store, "--cluster", "local", "--jobs", "4", *REWARDS)
    assert Store(store).ids() == whole and sorted(runs.processes()) == processes
    assert "6 jobs to run" in errors and f"RUN {ROW}.irm.0" in errors
    runs.log.write_text("")
    errors = runs.run(store, "--cluster", "local", *REWARDS)
    assert "submitted" not in errors and runs.processes() == []
    (submission,) = (store / ".jobs").iterdir()
    young = irl("gc", "--delete", "--store", store)
    assert young.code == 0 and submission.exists(), young.err
    old = irl("gc", "--delete", "--grace-days", "0", "--store", store)
    assert f"{submission.name}  logs of jobs that have ended" in old.out
    assert not submission.exists() and Store(store).ids() == whole


def test_the_log_of_a_job_ends_in_how_far_it_is(tmp_path):
    record = new_record(Store(tmp_path), "here")
    assert record.last_line("7") == ""
    log = record.logs / "7_0_log.err"
    log.write_text("RUN expert\n" + "x" * 5000 + "\n  expert: 512/1,024 steps\n")
    assert record.last_line("7") == "  expert: 512/1,024 steps"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_another_run_sees_a_job_from_its_start_to_its_end(tmp_path):
    """A process has no command line in /proc for a moment after its start."""
    store = Store(tmp_path)
    store.create()
    queue = Local(store, None)
    for _ in range(20):
        record = new_record(store, queue.place)
        # The other run may have named the store by another path.
        logs = tmp_path / ".." / tmp_path.name / record.logs.relative_to(tmp_path)
        line = [sys.executable, "-S", "-c", "import sys; sys.stdin.read()", "submitit.local"]
        process = subprocess.Popen([*line, str(logs)], stdin=subprocess.PIPE)
        record.add([Submitted("step", "identity", str(process.pid))])
        assert str(process.pid) in queue.states()
        process.stdin.close()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert queue.states() == {}
        process.wait()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_job_of_another_store_with_the_same_process_id_is_neither_seen_nor_cancelled(tmp_path):
    """After a restart of the machine, ids of processes begin anew."""
    store = Store(tmp_path)
    store.create()
    queue = Local(store, None)
    line = [sys.executable, "-S", "-c", "import sys; sys.stdin.read()", "submitit.local", "/other"]
    with subprocess.Popen(line, stdin=subprocess.PIPE) as process:
        while b"submitit" not in Path(f"/proc/{process.pid}/cmdline").read_bytes():
            time.sleep(0.01)
        new_record(store, queue.place).add([Submitted("step", "identity", str(process.pid))])
        assert queue.states() == {}
        queue.cancel([str(process.pid)])
        time.sleep(0.1)
        assert process.poll() is None


def test_gc_keeps_submissions_that_have_a_job_or_a_queue_it_cannot_ask(tmp_path, monkeypatch):
    store = Store(tmp_path)
    store.create()
    names = "waiting", "done", "elsewhere"
    made = {name: new_record(store, f"the queue of {name}") for name in names}
    for name, record in made.items():
        record.add([Submitted("step", "identity", f"{name} 1")])
    states = {"the queue of waiting": {"waiting 1": "PENDING"}, "the queue of done": {}}
    leftover = store.jobs / "probe-1"
    leftover.touch()
    newer = store.jobs / "newer"
    newer.mkdir()
    (newer / "jobs-0000000.json").write_text('{"schema": 2}')
    time.sleep(0.05)
    assert ended(store, states.get, 3600.0) == []
    with monkeypatch.context() as other:
        other.setattr(os, "geteuid", lambda: 4321)
        assert ended(store, states.get, 0.0) == []
    assert set(ended(store, states.get, 0.0)) == {made["done"].directory, leftover.absolute()}


def test_a_failure_stops_only_what_needs_it(runs, tmp_path):
    store = tmp_path / "runs"
    errors = runs.run(
        store,
        "--cluster",
        "local",
        "--jobs",
        "4",
        code=1,
        IRL_TEST_FAIL="train_airl pooled",
    )
    assert "it was asked to fail" in errors and "hint: do not ask for it" in errors
    names = Store(store).names()
    assert f"{ROW}.irm.0.zero-shot-returns" in names and f"{ROW}.erm.0" not in names
    process = runs.start(store, "--cluster", "local", "--status", "--json")
    failed, blocked = json.loads(process.communicate()[0])["missing"]
    assert (failed["name"], failed["state"]) == (f"{ROW}.erm.0", "FAILED")
    assert blocked["name"] == f"{ROW}.erm.0.zero-shot-returns"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_two_runs_of_one_table_start_each_step_once(plain, runs, tmp_path):
    """With one job at a time each run comes to steps that the other one has started."""
    store = tmp_path / "runs"
    line = (store, "--cluster", "local", "--until", "experts")
    both = [runs.start(*line, IRL_TEST_ROUND="0.3") for _ in range(2)]
    errors = [process.communicate(timeout=600)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    experts = Store(store).ids()
    assert len(experts) == len(runs.processes()) == 3 and set(experts) < set(plain[0])
    assert max(runs.computed().values()) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ctrl_c_leaves_the_jobs_of_another_run(plain, runs, tmp_path):
    store = tmp_path / "runs"
    line = (store, "--cluster", "local", "--jobs", "3", "--until", "experts")
    first = runs.start(*line, IRL_TEST_ROUND="1.5")
    runs.wait_for(lambda line: "computes" in line, first)
    second = runs.start(*line)
    while not second.stderr.readline().startswith("RUN "):
        assert second.poll() is None
    os.killpg(second.pid, signal.SIGINT)
    assert "stopped: " in second.communicate(timeout=200)[1] and second.returncode == 130
    _, errors = first.communicate(timeout=200)
    assert first.returncode == 0, errors
    assert max(runs.computed().values()) == 1


def test_a_step_that_was_made_meanwhile_is_not_started(runs, tmp_path):
    store = tmp_path / "runs"
    process = runs.start(store, "--cluster", "local", "--until", "experts", IRL_TEST_ROUND="1.5")
    runs.wait_for(lambda line: "computes" in line, process)
    started = set(runs.processes())
    other, *_ = sorted({f"{ROW}.expert.{power}" for power in ("1x", "1.25x", "1.5x")} - started)
    runs.run(store, "--only", other)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert runs.processes().count(other) == 1 and len(Store(store).ids()) == 3
    assert f"DONE {other}" in errors


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_submission_keeps_what_others_recorded(runs, smoke_store, tmp_path):
    """The logs and the failures of jobs that have ended, and a record that has no job yet."""
    store = tmp_path / "runs"
    line = (store, "--cluster", "local", "--jobs", "4")
    there = ("--from", smoke_store.path)
    runs.run(*line, *REWARDS, *there, code=1, IRL_TEST_FAIL="train_airl pooled")
    empty = new_record(Store(store), f"local on {os.uname().nodename}")
    runs.run(*line, "--tag", "other", "--until", "experts", "--set", "expert.total_steps=999")
    assert empty.logs.is_dir()
    shown = runs.start(*line[:3], *REWARDS, "--status", "--json").communicate()[0]
    assert [step["state"] for step in json.loads(shown)["missing"]] == ["FAILED"]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_warned_job_saves_a_checkpoint_and_has_another_turn(plain, runs, tmp_path):
    """SIGUSR2 is what Slurm sends before a time limit, SIGTERM what it sends before a preemption."""
    store = tmp_path / "runs"
    line = (store, "--cluster", "local", "--jobs", "3", "--until", "experts")
    process = runs.start(*line, IRL_TEST_ROUND="1")
    runs.wait_for(lambda line: "computes" in line, process)
    warned = [line["pid"] for line in runs.lines() if "computes" in line]
    for number in (signal.SIGUSR2, signal.SIGTERM):
        # From Slurm itself, and passed on by the job.
        for pid in warned:
            os.kill(pid, number)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    experts = Store(store).ids()
    assert len(experts) == 3 and set(experts) < set(plain[0])
    assert max(runs.computed().values()) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("allocation", [{}, {"SLURM_JOB_ID": "5"}])
def test_ctrl_c_stops_the_jobs_at_a_checkpoint(irl, runs, tmp_path, monkeypatch, allocation):
    """The terminal signals the whole process group: submitit's processes and the steps' as well."""
    store = tmp_path / "runs"
    line = (store, "--cluster", "local", "--jobs", "2", "--until", "experts")
    process = runs.start(*line, IRL_TEST_ROUND="1.5", **allocation)
    while sum("computes" in line for line in runs.lines()) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    # Nobody names the queue: the record knows it, and no Slurm is asked.
    monkeypatch.setattr("shutil.which", lambda command: None)
    shown = irl(*runs.words, "--store", store, "--status", "--until", "experts")
    assert shown.out.count(f" {os.uname().nodename}\n") == 2, shown
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 130
    stopping, stopped, hint = errors.splitlines()[-3:]
    assert stopping.startswith("warning: stopping") and "Traceback" not in errors, errors
    assert stopped.startswith("error: stopped: ") and "same command again" in hint
    assert not alive(line["pid"] for line in runs.lines())
    assert len(list(store.glob(".work/*/checkpoint"))) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_signal_is_heard_while_another_command_submits(runs, tmp_path):
    store = tmp_path / "runs"
    process = runs.start(store, "--cluster", "local", "--until", "experts", IRL_TEST_ROUND="1.5")
    runs.wait_for(lambda line: "computes" in line, process)
    with Store(store).working_on(LOCK, wait=True):
        # The first job ends, and the next one cannot be started.
        while not Store(store).ids():
            time.sleep(0.05)
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=100)
    assert process.returncode == 130 and len(Store(store).ids()) == len(runs.processes()) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_failure_is_shown_for_its_own_request_only(runs, smoke_store, tmp_path):
    store = tmp_path / "runs"
    line = (store, "--cluster", "local", "--jobs", "4", *REWARDS)
    there = ("--from", smoke_store.path)
    runs.run(*line, *there, code=1, IRL_TEST_FAIL="train_airl pooled")

    def states(*more):
        shown = runs.start(*line[:3], *REWARDS, "--status", "--json", *more).communicate()[0]
        return [step["state"] for step in json.loads(shown)["missing"]]

    assert states() == ["FAILED"] == states("--tag", "other")
    # Also of a step that left a checkpoint, and from another directory's view of the store.
    late = (*line[:5], "--tag", "late", "--until", "experts", "--set", "expert.total_steps=999")
    process = runs.start(*late, "--requeues", "0", IRL_TEST_ROUND="1")
    while not list(store.glob(".work/*/checkpoint")):
        assert process.poll() is None
        time.sleep(0.01)
    for pid in {line["pid"] for line in runs.lines() if "computes" in line}:
        if alive([pid]):
            os.kill(pid, signal.SIGUSR2)
    assert process.communicate(timeout=200) and process.returncode == 130
    assert "FAILED" in states("--tag", "late", "--set", "expert.total_steps=999")
    assert "FAILED" not in states("--tag", "smoke", "--set", "airl.gradient_penalty=0.3")


def test_a_failure_is_found_after_its_lambda_was_chosen(irl, tmp_path):
    """The job was submitted before the choice, when the reward was another request."""
    session, choice = choosing(tmp_path)
    plan = open_plan(session, choice)
    record = new_record(session.store, Local(session.store, None).place)
    record.add([Submitted(CHOSEN_REWARD, plan.identities[CHOSEN_REWARD], "1")])
    failure = {"code": 1, "message": "it was asked to fail", "hint": ""}
    (record.notes / f"{CHOSEN_REWARD}.failed").write_text(json.dumps(failure))
    for name in [name for name in plan.tasks if name != CHOSEN_REWARD]:
        publish_step(plan, session.store, name)
    line = ["run", "tiny", "--experiments", choice.file, "--profile", "smoke", "--tag", "x"]
    line += ["--choose-penalty", "1,10", "--until", "rewards", "--cluster", "local"]
    done = irl(*line, "--status", "--json", "--store", session.store.root)
    assert done.code == 0, done.err
    (missing,) = json.loads(done.out)["missing"]
    assert (missing["name"], missing["state"]) == (CHOSEN_REWARD, "FAILED")


def test_the_status_of_jobs_of_another_machine_names_it(irl, runs, tmp_path):
    store = Store(tmp_path / "runs")
    store.create()
    step = f"{ROW}.expert.1x"
    new_record(store, "local on moon").add([Submitted(step, "identity", "1")])
    done = irl(*runs.words, "--store", store.root, "--status")
    assert done.code == 2 and "local on moon" in done.err and "hint: " in done.err


def test_submissions_that_cannot_be_read_are_named(irl, runs, tmp_path):
    store = Store(tmp_path / "runs")
    store.create()
    for name, text in (("newer", '{"schema": 2}'), ("cut", '{"schema": 1, "jo')):
        (store.jobs / name).mkdir(parents=True)
        (store.jobs / name / "jobs-0000000.json").write_text(text)
    done = irl(*runs.words, "--store", store.root, "--status")
    assert done.code == 0, done.err
    warnings = [line for line in done.err.splitlines() if line.startswith("warning: ")]
    assert [Path(line.split()[1]).parent.name for line in warnings] == ["cut", "newer"]
    assert all("count as not submitted" in line for line in warnings)


@pytest.mark.parametrize(
    "words, said",
    [
        (["--cluster", "slrum"], "did you mean 'slurm'?"),
        (["--cluster", "local", "--detach"], "--detach does not work with --cluster local"),
        (["--detach"], "--cluster slurm"),
        (["--partition", "long"], "--cluster slurm"),
        (["--sbatch", "account=mine"], "--cluster slurm"),
        (["--time", "4:00:00"], "--cluster slurm"),
        (["--cpus", "2"], "--cluster slurm"),
        (["--status", "--time", "60"], "--cluster slurm"),
        (["--array-parallelism", "2"], "--cluster slurm"),
        (["--requeues", "0"], "--cluster slurm"),
        (["--cluster", "local", "--partition", "long"], "--partition needs --cluster slurm"),
        (["--cluster", "local", "--cpus", "1"], "--cpus needs --cluster slurm"),
        (
            ["--cluster", "local", "--array-parallelism", "9"],
            "--array-parallelism needs --cluster slurm",
        ),
        (["--cluster", "local", "--requeues", "6"], "at most 5 times"),
        (["--cluster", "local", "--sbatch", "mem=4G"], "--sbatch needs --cluster slurm"),
        (["--status", "--cancel"], "exclude each other"),
        (["--status", "--out", "results"], "--status makes no step"),
        (["--cancel", "--jobs", "2"], "--cancel makes no step"),
        (["--only", "x", "--jobs", "2"], "--only takes no"),
        (["--cluster", "slurm", "--jobs", "4"], "use --array-parallelism"),
        (["--set", "airl.penalty=vrex", "--tag", "x"], "sets airl.penalty"),
        (["--cluster", "local", "--time", "soon"], "4:00:00"),
        (["--cluster", "slurm", "--sbatch", "account"], "account=NAME"),
        (["--cluster", "slurm", "--sbatch", "array=1-9"], "use --array-parallelism"),
        (["--cluster", "slurm", "--sbatch", "time=60"], "use --time"),
        (["--cluster", "slurm", "--sbatch", "no-requeue"], "use --requeues 0"),
        (["--cluster", "slurm", "--sbatch", "dependency=singleton"], "omit dependency"),
        (["--cluster", "slurm", "--only", "x"], "--only cannot be combined with --cluster"),
        (["--cluster", "slurm", "--sbatch", "mem=4", "--sbatch", "mem=8"], "mem is given twice"),
        (["--dry-run", "--cluster", "slrum"], "did you mean 'slurm'?"),
        (["--dry-run", "--cluster", "local", "--time", "soon"], "4:00:00"),
        (["--dry-run", "--cluster", "slurm", "--sbatch", "account"], "account=NAME"),
        (["--dry-run", "--cancel"], "--dry-run shows the plan"),
        (["--dry-run", "--detach"], "--cluster slurm"),
        (["--dry-run", "--partition", "long"], "--cluster slurm"),
        (["--dry-run", "--set", "airl.bc_epochs=3"], "--tag NAME"),
        (["--dry-run", "--out", "runs/results"], "lies in the store"),
    ],
)
def test_what_is_wrong_is_said_before_anything_starts(irl, tmp_path, words, said, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda command: f"/bin/{command}")
    monkeypatch.chdir(tmp_path)
    done = irl("run", "table1", "--profile", "smoke", "--store", tmp_path / "runs", *words)
    assert done.code == 2 and said in done.err, done.err
    assert not list((tmp_path / "runs").glob(".jobs/*"))


def test_without_slurm_the_hint_names_what_works(irl, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda command: None)
    words = ["run", "table1", "--cluster", "slurm", "--store", tmp_path / "runs"]
    done = irl(*words, "--profile", "smoke")
    assert done.code == 2 and "sbatch is not on the PATH" in done.err and "local" in done.err
