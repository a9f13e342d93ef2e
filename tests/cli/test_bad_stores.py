"""Damaged artefacts, places that are no store, full disks, missing permissions and locks."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from answers import LANDER, Done, arguments, assert_answered, flip_last, halve, snapshot

from irlcli.store import Store, references

# Damaged artefacts


@pytest.mark.parametrize("damage", [flip_last, halve, Path.unlink])
@pytest.mark.parametrize(
    ("field", "file", "text"),
    [
        ("airl", "reward.pt", "transfer --reward airl --ood 1.75x"),
        ("airl", "reward.json", "transfer --reward airl --ood 1.75x"),
        ("airl", "policy.json", "evaluate --policy airl --ood 1.75x"),
        ("airl", "manifest.json", "show airl"),
        ("airl", "provenance.json", "show airl"),
        ("airl", "metrics.parquet", "verify airl"),
        ("demos", "steps.parquet", "train-airl --demos demos --seed 5"),
        ("demos", "manifest.json", "lineage moved"),
        ("expert", "policy.pt", f"collect-experts {LANDER} --seed 5"),
        ("transfer", "policy.pt", "evaluate --policy moved --ood 1.75x"),
        ("evaluation", "summary.json", "report returns score"),
        ("evaluation", "manifest.json", "ls"),
        ("evaluation", "manifest.json", "gc"),
    ],
)
def test_damaged_artefacts(irl, store_copy, field, file, text, damage):
    id16 = getattr(store_copy, field)
    damage(store_copy.path / id16 / file)
    result = irl(*arguments(text, store_copy.path), "--json")
    assert_answered(result, 4, id16, as_json=True)


@pytest.mark.parametrize("damage", [flip_last, halve])
def test_damage_is_repaired_by_running_the_same_commands(irl, store_copy, damage):
    damage(store_copy.path / store_copy.transfer / "policy.pt")
    line = arguments("verify", store_copy.path)
    result = irl(*line)
    assert_answered(result, 4, store_copy.transfer)
    # The command that repairs it, with the id in place of a name that may move.
    assert f"irl transfer --reward {store_copy.airl}/reward.pt" in result.err
    again = irl(*arguments("transfer --reward airl/reward.pt --ood 1.5x", store_copy.path))
    assert Path(again.out.strip()).name == store_copy.transfer
    assert irl(*line).code == 0


# Hand-made artefacts: sound by their digests, senseless inside


@pytest.mark.parametrize(
    ("stage", "files", "parameters", "text"),
    [
        ("evaluate", {"summary.json": b"{}"}, {}, "report returns {id}"),
        ("evaluate", {"summary.json": b"[]"}, {}, "report returns {id}"),
        ("evaluate", {"summary.json": b"{"}, {}, "report returns {id}"),
        ("evaluate", {"summary.json": b'{"policy":{},"settings":[]}'}, {}, "report returns {id}"),
        (
            "evaluate",
            {"summary.json": b'{"policy":{"agent":"x"},"settings":[]}'},
            {},
            "report returns {id}",
        ),
        ("evaluate", {"other": b""}, {}, "report returns {id}"),
        ("collect-experts", {"a": b""}, {}, "train-airl --demos {id}"),
        ("collect-experts", {"a": b""}, {"env": [], "settings": 3}, "train-airl --demos {id}"),
        (
            "train-airl",
            {"reward.pt": b"", "reward.json": b"[]"},
            {},
            "transfer --reward {id} --ood 2x",
        ),
        (
            "train-airl",
            {"reward.pt": b"", "reward.json": b"{}"},
            {},
            "transfer --reward {id} --ood 2x",
        ),
        ("train-airl", {"reward.pt": b""}, {}, "transfer --reward {id} --ood 2x"),
        (
            "train-airl",
            {"policy.pt": b"", "policy.json": b'{"env":1}'},
            {},
            "evaluate --policy {id}",
        ),
    ],
)
def test_senseless_artefacts_are_refused(irl, empty_store, publish, stage, files, parameters, text):
    made = publish(empty_store, files, stage=stage, parameters=parameters).artefact
    result = irl(*arguments(text.format(id=made.id), empty_store.root))
    assert_answered(result, result.code, "")
    assert result.code in (2, 3, 4)


@pytest.mark.parametrize(
    "parameters",
    [{"settings": 5}, {"airl": 3}, {"setting": {"a": [1]}}, {"env": ["x"]}, {"agent": "\x1b[2J"}],
)
def test_senseless_parameters_do_not_break_listing(irl, store_copy, publish, parameters):
    made = publish(Store(store_copy.path), parameters=parameters).artefact
    for text in ("ls", "ls --json", f"lineage {made.id}", "gc"):
        result = irl(*arguments(text, store_copy.path))
        assert result.code == 0, result.err
        assert text == "gc" or made.id in result.out
        assert "\x1b" not in result.out  # nor drive the terminal


# Stores


@pytest.mark.parametrize("text", ["ls", "show airl", f"evaluate --idle {LANDER}", "verify", "gc"])
@pytest.mark.parametrize(
    ("kind", "code", "named"),
    [
        ("file", 2, "not a directory"),
        ("foreign", 2, "not a store"),
        ("newer", 4, "format 7"),
        ("damaged", 4, "STORE"),
        ("too long", 2, "aaaa"),
        ("below a file", 2, "notes"),
    ],
)
def test_places_that_are_no_store(irl, tmp_path, kind, code, named, text):
    place = tmp_path / "place"
    match kind:
        case "file":
            place.write_text("x")
        case "foreign":
            place.mkdir()
            (place / "thesis.tex").write_text("x")
        case "newer":
            place.mkdir()
            (place / "STORE").write_text('{"format": 7}')
        case "damaged":
            place.mkdir()
            (place / "STORE").write_text("{")
        case "too long":
            place = tmp_path / ("a" * 300)
        case "below a file":
            (tmp_path / "notes").write_text("x")
            place = tmp_path / "notes" / "runs"
    before = sorted(tmp_path.rglob("*"))
    assert_answered(irl(*arguments(text, place), "--json"), code, named, as_json=True)
    assert sorted(tmp_path.rglob("*")) == before


def test_reading_a_store_that_is_not_there_makes_none(irl, tmp_path):
    for text in ("ls", "verify", "gc", "gc --delete"):
        result = irl(*arguments(text, tmp_path / "absent"))
        assert_answered(result, 3, f"no store at {tmp_path / 'absent'}")
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.EIO])
@pytest.mark.parametrize("call", ["fsync", "rename", "link", "replace"])
def test_full_or_read_only_disk(irl, store_copy, monkeypatch, call, number):
    """The kernel refuses one call: a named error, nothing published, and a rerun completes."""

    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    line = arguments(f"evaluate --idle {LANDER} --episodes 1", store_copy.path)
    before = Store(store_copy.path).ids()
    with monkeypatch.context() as patch:
        patch.setattr(os, call, refuse)
        result = irl(*line)
    assert_answered(result, 1, os.strerror(number))
    assert irl(*arguments("verify", store_copy.path)).code == 0
    again = irl(*line)
    assert again.code == 0
    assert len(Store(store_copy.path).ids()) == len(before) + 1


def test_a_full_disk_is_the_failure_of_the_stage_that_met_it(irl, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    Store(tmp_path / "runs").create()
    monkeypatch.setattr(os, "fsync", refuse)
    line = f"evaluate --expert {LANDER} --set expert.total_steps=64 --profile smoke"
    result = irl(*arguments(line, tmp_path / "runs"))
    stage = "train-expert lunar-lander engine-power=1x seed 0"
    assert_answered(result, 1, f"error: {stage}: {os.strerror(errno.ENOSPC)}")
    assert "if there is one" in result.err


# Permissions and quotas

_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH, _PR_CAPBSET_DROP = 1, 2, 24


def obey_permissions() -> None:
    """In the child: permission bits bind root, too, once these capabilities are gone."""
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
            if libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), "prctl")


def small_files_only() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))


@pytest.fixture
def read_only(store_copy):
    directories = [store_copy.path, *(p for p in store_copy.path.iterdir() if p.is_dir())]
    for path in directories:
        path.chmod(0o555)
    for path in (store_copy.path / ".locks").iterdir():
        path.chmod(0o444)
    yield store_copy
    for path in directories:
        path.chmod(0o755)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (f"evaluate --idle {LANDER}", "ermission denied"),
        ("name airl better", "ermission denied"),
        ("gc --delete --grace-days 0", "ermission denied"),
    ],
)
def test_read_only_store(read_only, text, named):
    before = snapshot(read_only.path)
    done = Done(arguments(text, read_only.path), preexec_fn=obey_permissions)
    assert_answered(done, 1, named)
    assert snapshot(read_only.path) == before


def test_a_store_that_cannot_be_created(tmp_path):
    parent = tmp_path / "read-only"
    parent.mkdir(mode=0o555)
    line = arguments(f"evaluate --idle {LANDER}", parent / "runs")
    done = Done(line, preexec_fn=obey_permissions)
    assert_answered(done, 1, str(parent / "runs"))
    assert "--store" in done.err.splitlines()[-1]


def test_read_only_store_can_be_read(read_only):
    for text in ("transfer --reward airl/reward.pt --ood 1.5x --name moved", "verify"):
        done = Done(arguments(text, read_only.path), preexec_fn=obey_permissions)
        assert done.code == 0, done.err


def test_damage_in_a_read_only_store_is_still_damage(read_only):
    flip_last(read_only.path / read_only.evaluation / "summary.json")
    for text in ("report returns score", "verify"):
        done = Done(arguments(text, read_only.path), preexec_fn=obey_permissions)
        assert_answered(done, 4, read_only.evaluation)


def test_unreadable_store(store_copy):
    store_copy.path.chmod(0)
    try:
        done = Done(arguments("ls", store_copy.path), preexec_fn=obey_permissions)
    finally:
        store_copy.path.chmod(0o755)
    assert_answered(done, done.code, str(store_copy.path))
    assert done.code in (1, 2)


def test_file_size_limit(store_copy):
    """A quota at the system-call boundary: writes beyond it fail with EFBIG."""
    line = arguments(f"evaluate --idle {LANDER} --episodes 1", store_copy.path)
    done = Done(line, preexec_fn=small_files_only)
    assert_answered(done, 1, "evaluate")
    store = Store(store_copy.path)
    assert store.verify(store.ids()).damaged == {}


# Locks


@pytest.fixture
def hold():
    """Hold a lock in another process, as one at work does."""
    children = []

    def holding(path: Path, shared: bool = False) -> int:
        lock = "locked(Path(sys.argv[1]), shared=True)"
        if not shared:
            lock = "exclusive(Path(sys.argv[1]), Patience())"
        script = (
            "import sys; from pathlib import Path; from irlcli.store.lease import Patience\n"
            f"from irlcli.store.lock import exclusive, locked\nwith {lock}:\n"
            "    print('held', flush=True); sys.stdin.read()"
        )
        child = subprocess.Popen(
            [sys.executable, "-c", script, str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        children.append(child)
        assert child.stdout.readline() == b"held\n"
        return child.pid

    yield holding
    for child in children:
        child.communicate()


def test_busy(irl, store_copy, hold):
    key = Store(store_copy.path).resolve(store_copy.transfer).artefact.manifest.record.key
    (store_copy.path / ".keys" / key).unlink()
    pid = hold(store_copy.path / ".locks" / key)
    text = "transfer --reward airl --ood 1.5x --no-wait"
    line = arguments(text, store_copy.path)
    assert_answered(irl(*line), 75, f"process {pid}")
    assert_answered(Done([*line, "--json"]), 75, f"process {pid}", as_json=True)


def test_gc_while_the_store_is_used(irl, store_copy, hold):
    hold(store_copy.path / ".locks" / "gc", shared=True)
    before = snapshot(store_copy.path)
    line = arguments("gc --delete --grace-days 0", store_copy.path)
    assert_answered(irl(*line), 75, f"the store {store_copy.path}")
    assert snapshot(store_copy.path) == before
    assert irl(*arguments("gc --grace-days 0", store_copy.path)).code == 0  # a dry run reads only


def test_using_the_store_while_gc_runs(irl, store_copy, hold):
    pid = hold(store_copy.path / ".locks" / "gc")
    line = arguments(f"evaluate --idle {LANDER} --no-wait", store_copy.path)
    assert_answered(irl(*line), 75, f"process {pid}")


def test_verify_names_lost_names_beside_damaged_artefacts(irl, store_copy):
    store = store_copy.path
    shutil.rmtree(store / store_copy.evaluation)
    damaged = store / store_copy.transfer / "policy.pt"
    damaged.chmod(0o644)
    damaged.write_bytes(b"x")
    done = irl("verify", "--store", store)
    assert done.code == 4 and store_copy.transfer in done.err
    assert "these names point to nothing now: moved, score" in done.err


def test_ls_lists_what_is_sound_beside_the_damaged(irl, store_copy):
    store = store_copy.path
    for id16 in (store_copy.transfer, store_copy.evaluation):
        halve(store / id16 / "manifest.json")
    done = irl("ls", "--store", store)
    assert done.code == 4 and store_copy.transfer in done.err and store_copy.evaluation in done.err
    assert sum(line.startswith("error: ") for line in done.err.splitlines()) == 1
    assert store_copy.airl in done.out and store_copy.transfer not in done.out
    again = irl("ls", "--store", store)
    assert (again.code, again.out) == (0, done.out)
    assert "warning: names of missing artefacts: moved, score; " in again.err


@pytest.mark.parametrize("content", [None, "zzz"])
def test_verify_restores_a_lost_key(irl, store_copy, content):
    key = Store(store_copy.path).resolve("moved").artefact.manifest.record.key
    pointer = store_copy.path / ".keys" / key
    pointer.unlink()
    if content is not None:
        pointer.write_text(content)
    line = arguments("transfer --reward airl --ood 1.5x --dry-run", store_copy.path)
    assert irl(*line).out.startswith("RUN")
    done = irl(*arguments("verify", store_copy.path))
    assert done.code == 0 and f"artefact {store_copy.transfer} had lost its key" in done.err
    assert irl(*line).out.startswith("HIT")
    assert irl(*arguments("verify", store_copy.path)).err == ""


@pytest.mark.parametrize("file", ["provenance.json", "manifest.json"])
def test_the_hint_of_a_lost_file_does_not_promise_more_than_there_is(irl, store_copy, file):
    """The provenance holds the command that makes the artefact again."""
    lost = file == "provenance.json"
    (store_copy.path / store_copy.airl / file).unlink()
    first = irl(*arguments("show airl", store_copy.path))
    assert first.code == 4 and ("record of this command is lost" in first.err) == lost
    verified = irl(*arguments("verify", store_copy.path))
    assert ("made by: a command whose record is lost" in verified.err) == lost
    after = irl(*arguments("show airl", store_copy.path))
    hint = after.err.splitlines()[-1]
    assert after.code == 3
    assert ("record of this command is lost" in hint) == lost
    assert ("irl train-airl" in hint) != lost


def test_verify_restores_the_keys_of_a_store_that_was_copied_without_them(irl, store_copy):
    """``cp -r runs/*`` leaves out what begins with a dot."""
    for hidden in store_copy.path.glob(".*"):
        shutil.rmtree(hidden)
    done = irl(*arguments("verify", store_copy.path))
    assert done.code == 0 and "cannot be restored" not in done.err
    line = ["transfer", "--reward", store_copy.airl, "--ood", "1.5x", "--profile", "smoke"]
    assert irl(*line, "--store", store_copy.path, "--dry-run").out.startswith("HIT")


def test_a_damaged_name_is_named(irl, store_copy):
    store = store_copy.path
    (store / ".names" / "airl").write_bytes(b"\xff")
    listed = irl("ls", "--store", store)
    assert listed.code == 0 and store_copy.airl in listed.out
    assert "warning: the name 'airl' is damaged" in listed.err
    line = arguments("transfer --reward airl --ood 1.75x", store)
    done = irl(*line)
    assert_answered(done, 3, "'airl' is damaged")
    hint = done.err.splitlines()[-1]
    named = shlex.split(hint.partition("`")[2].partition("`")[0])[1:]
    assert irl(*[store_copy.airl if word == "REF" else word for word in named]).code == 0
    assert irl(*line, "--dry-run").code == 0


def test_a_store_without_its_marker_says_how_to_mend_it(irl, store_copy):
    marker = store_copy.path / "STORE"
    marker.unlink()
    done = irl(*arguments("ls", store_copy.path))
    assert_answered(done, 4, "has no file STORE")
    content, place = re.search(r"write (\{.*\}) to (.*)", done.err).groups()
    assert place == str(marker)
    marker.write_text(content)
    assert irl(*arguments("ls", store_copy.path)).code == 0


def test_lineage_names_what_is_not_in_the_store(irl, store_copy):
    store = store_copy.path
    shutil.rmtree(store / store_copy.airl)
    missing = f"{store_copy.airl}  not in this store"
    assert missing in irl("lineage", "moved", "--store", store).out
    document = json.loads(irl("lineage", "moved", "--store", store, "--json").out)
    assert [i["missing"] for i in document["inputs"]] == [store_copy.airl]


def test_a_quick_verification_says_that_it_read_no_contents(irl, store_copy):
    flip_last(store_copy.path / store_copy.airl / "reward.pt")
    done = irl("verify", "--quick", "--store", store_copy.path)
    assert done.code == 0 and "contents were not read" in done.out
    full = irl("verify", "--store", store_copy.path)
    assert full.code == 4 and "were not read" not in full.out


@pytest.mark.parametrize(("days", "said"), [("7", True), ("0", False)])
def test_gc_says_what_grace_keeps(irl, store_copy, days, said):
    done = irl("gc", "--grace-days", days, "--store", store_copy.path)
    assert done.code == 0 and ("younger than 7 days is kept" in done.err) == said


def test_a_stage_that_fails_is_named(irl, tmp_path):
    text = f"collect-experts {LANDER} --set expert.ppo.learning_rate=1e30"
    result = irl(*arguments(text, tmp_path / "runs"))
    assert_answered(result, 1, "train-expert lunar-lander engine-power=1x seed 0: ")
    assert "not finite" in result.err and not Store(tmp_path / "runs").ids()


def test_a_name_that_moves_says_what_it_leaves(irl, store_copy):
    result = irl(*arguments("name airl demos", store_copy.path))
    assert result.code == 0
    assert f"warning: demos no longer names {store_copy.demos}" in result.err
    again = irl(*arguments("name airl demos", store_copy.path))
    assert again.code == 0 and again.err == ""


@pytest.mark.parametrize(
    "words",
    [
        ["ls", "--store", os.fsdecode(b"s\xff")],
        ["plan", "small", "--experiments", os.fsdecode(b"t\xff.toml")],
    ],
)
def test_a_path_that_is_not_utf_8_is_refused_before_the_work(irl, words):
    assert_answered(irl(*words), 2, "is not UTF-8")


def test_a_name_in_a_store_that_cannot_be_written(irl, empty_store, publish, monkeypatch):
    def refuse(path, data):
        raise OSError(errno.EROFS, "Read-only file system", f"{path}.temporary")

    monkeypatch.setattr(references, "write_durably", refuse)
    done = irl("name", publish(empty_store).artefact.id, "best", "--store", empty_store.root)
    assert_answered(done, 1, f"the store {empty_store.root} cannot be written: Read-only file")
    assert "temporary" not in done.err
