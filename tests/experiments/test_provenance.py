"""Provenance of results and checkpoints: attempts, library versions, code state."""

from __future__ import annotations

import json
import shlex
import subprocess
import time
from pathlib import Path
from typing import Any

import msgspec
import pytest

import irlcli
from irlcli.experiments import provenance
from irlcli.experiments.runner import Runner, Silent
from irlcli.stages.base import Job, Request, Stage
from irlcli.store import Store

ROUNDS = 4


class Parameters(msgspec.Struct, frozen=True):
    """Of a stage that only counts."""

    rounds: int = ROUNDS


class Died(Exception):
    """In place of a power cut."""


class Warned(Silent):
    """A console that remembers warnings."""

    def __init__(self):
        self.warnings: list[str] = []

    def warn(self, message: str) -> None:
        self.warnings.append(message)


def counting(dies_after: int = ROUNDS + 1, version: int = 1) -> Request:
    """A stage of four rounds of at least 20 ms that dies after some of them."""

    def run(job: Job) -> None:
        first = int(job.checkpoints.load() or b"0")
        for done in range(first + 1, job.parameters.rounds + 1):
            time.sleep(0.02)
            job.checkpoints.offer(lambda done=done: b"%d" % done)
            if done == dies_after:
                raise Died
        (job.output / "count").write_bytes(b"%d" % first)

    return Request(Stage("count", version, run), Parameters(), {}, "count")


def attempt(root, request: Request) -> tuple[Any, list[str]]:
    console = Warned()
    return Runner(root, console, checkpoint_seconds=0.0).run(request), console.warnings


def die(root, after: int) -> None:
    with pytest.raises(Died):
        attempt(root, counting(after))


def test_every_attempt_is_kept_with_its_seconds_and_its_code(tmp_path, monkeypatch):
    for after, commit in ((1, "aaa"), (3, "bbb")):
        monkeypatch.setattr(
            provenance, "git_state", lambda _, c=commit: {"commit": c, "dirty": f"dirty {c}"}
        )
        die(tmp_path, after)
    monkeypatch.setattr(provenance, "git_state", lambda _: {"commit": "ccc", "dirty": None})
    artefact, warnings = attempt(tmp_path, counting())
    assert warnings == [] and (artefact.directory / "count").read_bytes() == b"3"
    origin = artefact.provenance()
    attempts = origin["attempts"]
    assert [(a["commit"], a["dirty"]) for a in attempts] == [
        ("aaa", "dirty aaa"),
        ("bbb", "dirty bbb"),
        ("ccc", None),
    ]
    # One, two and one rounds: the time of each up to its last checkpoint, which is what it gave.
    for item, rounds in zip(attempts, (1, 2, 1), strict=True):
        assert item["seconds"] >= 0.02 * rounds
    assert origin["seconds"] == pytest.approx(sum(a["seconds"] for a in attempts), abs=1e-3)
    assert origin["resumed"] == 2 and origin["started"] == attempts[0]["started"]
    assert origin["git"] == {"commit": "ccc", "dirty": None}


def test_the_time_of_day_has_no_part_in_durations(tmp_path, monkeypatch):
    """The clock is set back while the stage runs, here at every look."""
    now = time.time()
    moments, seconds = iter(range(10**6)), iter(range(10**6))
    monkeypatch.setattr(time, "time", lambda: now - 3600.0 * next(moments))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(seconds)))
    artefact, _ = attempt(tmp_path, counting())
    assert 0.0 < artefact.provenance()["seconds"] <= next(seconds)


@pytest.mark.parametrize(
    ("name", "now", "named"),
    [
        ("torch", "0.1", "torch 9.9 (now 0.1)"),
        ("torch", None, "torch 9.9 (now None)"),
        ("python", "4.0", "python 9.9 (now 4.0)"),
    ],
)
def test_other_libraries_start_over_and_say_so(tmp_path, monkeypatch, name, now, named):
    real = provenance.libraries()
    monkeypatch.setattr(provenance, "libraries", lambda: {**real, name: "9.9"})
    die(tmp_path, 2)
    monkeypatch.setattr(provenance, "libraries", lambda: {**real, name: now})
    artefact, warnings = attempt(tmp_path, counting())
    assert (artefact.directory / "count").read_bytes() == b"0"
    assert len(warnings) == 1 and named in warnings[0] and "starting over" in warnings[0]
    # What was thrown away is no part of the result.
    assert len(artefact.provenance()["attempts"]) == 1


@pytest.mark.parametrize(
    ("before", "now", "first"), [(None, "3.3", b"2"), ("3.2", None, b"2"), ("3.2", "3.3", b"0")]
)
def test_a_library_that_is_missing_at_one_time_starts_nothing_over(
    tmp_path, monkeypatch, before, now, first
):
    real = provenance.libraries()
    monkeypatch.setattr(provenance, "libraries", lambda: {**real, "mujoco": before})
    die(tmp_path, 2)
    monkeypatch.setattr(provenance, "libraries", lambda: {**real, "mujoco": now})
    artefact, _ = attempt(tmp_path, counting())
    assert (artefact.directory / "count").read_bytes() == first


def test_a_checkpoint_is_due_ten_seconds_after_the_last(tmp_path, monkeypatch):
    clock, saved = [0.0], []
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])

    def run(job):
        for clock[0] in (9.0, 11.0, 20.0, 21.5):
            job.checkpoints.offer(lambda: saved.append(clock[0]) or b"x")
        (job.output / "f").touch()

    Runner(tmp_path).run(Request(Stage("count", 1, run), Parameters(), {}, "count"))
    assert saved == [11.0, 21.5]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"schema": 2}, "schema 2"),
        ({"schema": "1"}, "not readable"),
        ({"attempts": [{"started": 1}]}, "not readable"),
        ({"libraries": {}}, "written with"),
        ({"libraries": {"x" * 9999: "1"}}, "written with"),
        (None, "not readable"),
    ],
)
def test_headers_that_cannot_be_used(tmp_path, change, named):
    die(tmp_path, 2)
    (path,) = tmp_path.glob(".work/*/checkpoint")
    with Store(tmp_path).working_on(path.parent.name, wait=False) as scratch:
        stored = scratch.load()
        end = 4 + int.from_bytes(stored[:4], "big")
        if change is None:
            scratch.save(b"2")  # as before there were headers
        else:
            head = json.dumps({**json.loads(stored[4:end]), **change}).encode()
            scratch.save(len(head).to_bytes(4, "big") + head + stored[end:])
    artefact, warnings = attempt(tmp_path, counting())
    assert (artefact.directory / "count").read_bytes() == b"0"
    assert len(warnings) == 1 and named in warnings[0] and "starting over" in warnings[0]
    assert len(warnings[0]) < 500


def test_a_deeply_nested_header_is_refused(tmp_path):
    die(tmp_path, 2)
    (path,) = tmp_path.glob(".work/*/checkpoint")
    with Store(tmp_path).working_on(path.parent.name, wait=False) as scratch:
        head = b'{"schema": 1, "x": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
        scratch.save(len(head).to_bytes(4, "big") + head)
    _, (warning,) = attempt(tmp_path, counting())
    assert "not readable" in warning


def test_code_that_is_not_committed_counts_new_files_too(tmp_path, monkeypatch):
    def git(*arguments: str) -> str:
        who = ("-c", "user.name=x", "-c", "user.email=x@y")
        line = ["git", "-C", str(tmp_path), *who, *arguments]
        return subprocess.run(line, check=True, capture_output=True, text=True).stdout.strip()

    package = tmp_path / "package"
    (package / "penalties").mkdir(parents=True)
    (package / "__init__.py").touch()
    (tmp_path / ".gitignore").write_text("__pycache__/\n")
    assert provenance.git_state(package) == {"commit": None, "dirty": None}
    git("init")
    git("add", ".")
    git("commit", "-m", "x")
    clean = {"commit": git("rev-parse", "HEAD"), "dirty": None}
    assert provenance.git_state(package) == clean
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "x.pyc").write_bytes(b"x")
    (tmp_path / "notes").write_text("outside the package")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "elsewhere"))
    assert provenance.git_state(package) == clean
    monkeypatch.delenv("GIT_DIR")
    states = []
    for name, text in (
        ("new.py", "1"),
        ("new.py", "2"),
        ("penalties/other.py", "2"),
        ("__init__.py", "3"),
    ):
        (package / name).write_text(text)
        states.append(provenance.git_state(package)["dirty"])
    # Emacs' lock of a changed file.
    (package / ".#new.py").symlink_to("user@host.123:456")
    states.append(provenance.git_state(package)["dirty"])
    assert None not in states and len(set(states)) == 5
    monkeypatch.setattr(irlcli, "__file__", str(package / "__init__.py"))
    recorded = provenance.Clock().attempt()
    assert (recorded.commit, recorded.dirty) == (clean["commit"], states[-1])


def test_references_become_ids_wherever_they_stand():
    known = {"airl": "0123", "best": "4567"}
    for words, replaced in (
        (["irl", "assess", "--json", "airl"], ["irl", "assess", "--json", "0123"]),
        (["irl", "assess", "airl", "--name", "airl"], ["irl", "assess", "0123", "--name", "airl"]),
        (["irl", "evaluate", "--policy=best"], ["irl", "evaluate", "--policy=4567"]),
        (["irl", "transfer", "--name", "airl"], ["irl", "transfer", "--name", "airl"]),
    ):
        assert provenance.by_id(words, known) == replaced


def test_a_repair_reads_what_was_read_though_names_moved(irl, store_copy):
    """The command in the message gives the artefact of the same id."""
    store, common = Store(store_copy.path), ["--profile", "smoke", "--store", store_copy.path]
    made = irl("evaluate", "--policy", "moved", "--reward", "airl", "--seed", "7", *common)
    assert made.code == 0, made.err
    score = store.resolve(made.out.strip()).artefact
    idle = irl("evaluate", "--idle", "--env", "lunar-lander", "--ood", "bounce=0.9", *common)
    for name in ("moved", "airl"):
        moved = irl("name", Path(idle.out.strip()).name, name, "--store", store_copy.path)
        assert f"{name} no longer names" in moved.err and "undoes this" in moved.err
    summary = score.directory / "summary.json"
    summary.chmod(0o644)
    summary.write_text("{}")
    found = irl("verify", score.id, "--store", store_copy.path)
    assert found.code == 4
    lines = (found.out + found.err).splitlines()
    command = next(line[line.index("irl evaluate") :] for line in lines if "irl evaluate" in line)
    again = irl(*shlex.split(command)[1:])
    assert (again.code, again.out) == (0, made.out), again.err
