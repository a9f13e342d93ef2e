"""Looking without touching: peek, and stores that are opened for reading only."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from irlcli.errors import IntegrityError, NewerFormat, NotFound, UsageError
from irlcli.store import Artefact, Peek, Store
from irlcli.store.lock import locked

DAMAGE = {
    "reward.pt is missing": lambda d: (d / "reward.pt").unlink(),
    "reward.pt is truncated": lambda d: truncate(d / "reward.pt"),
    "reward.pt is a link": lambda d: to_link(d / "reward.pt"),
    "manifest.json is missing": lambda d: (d / "manifest.json").unlink(),
    "manifest.json is truncated": lambda d: truncate(d / "manifest.json"),
}


def truncate(path: Path) -> None:
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1])


def to_link(path: Path) -> None:
    path.unlink()
    path.symlink_to("/etc/passwd")


def tree(root: Path) -> list[tuple[str, int, int, int]]:
    status = [(str(p), p.lstat()) for p in [root, *root.rglob("*")] if p.exists()]
    return sorted((p, s.st_mode, s.st_size, s.st_mtime_ns) for p, s in status)


@pytest.fixture
def artefact(empty_store, publish) -> Artefact:
    return publish(empty_store).artefact


def read_only(store: Store) -> Store:
    return Store(store.root, pytest.fail, read_only=True)


@pytest.mark.parametrize("open_store", [lambda s: s, read_only], ids=["writable", "read-only"])
def test_peek_finds_what_find_finds(empty_store, artefact, open_store):
    store = open_store(empty_store)
    assert store.peek(artefact.manifest.record.key) == Peek(artefact, None)
    assert store.peek("0" * 64) == Peek(None, None)
    shutil.rmtree(artefact.directory)
    assert store.peek(artefact.manifest.record.key) == Peek(None, None)


@pytest.mark.parametrize("kind", DAMAGE)
@pytest.mark.parametrize("open_store", [lambda s: s, read_only], ids=["writable", "read-only"])
def test_peek_names_the_damaged_file_and_moves_nothing(empty_store, artefact, open_store, kind):
    DAMAGE[kind](artefact.directory)
    before = tree(empty_store.root)
    found = open_store(empty_store).peek(artefact.manifest.record.key)
    assert found.artefact is None and str(artefact.directory / kind.split()[0]) in found.problem
    assert tree(empty_store.root) == before


def test_peek_follows_no_pointer_to_another_artefact(empty_store, artefact, publish):
    other = publish(empty_store, parameters={"seed": 1}).artefact
    (empty_store.root / ".keys" / artefact.manifest.record.key).write_text(other.id)
    assert empty_store.peek(artefact.manifest.record.key) == Peek(None, None)


def test_peek_names_a_newer_schema(empty_store, artefact):
    path = artefact.directory / "manifest.json"
    path.chmod(0o644)
    path.write_text(json.dumps({"schema": 2}))
    with pytest.raises(NewerFormat):
        empty_store.peek(artefact.manifest.record.key)


def test_a_store_that_does_not_exist_is_empty_and_stays_absent(tmp_path):
    store = Store(tmp_path / "absent", read_only=True)
    with store.in_use():
        assert store.peek("0" * 64) == Peek(None, None)
        assert store.find("0" * 64) is None and not store.has_checkpoint("0" * 64)
        assert (store.ids(), store.names(), store.index().artefacts) == ([], {}, {})
        with pytest.raises(NotFound):
            store.resolve("abc")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_read_only_store_reports_damage_and_moves_nothing(empty_store, artefact, kind):
    empty_store.set_name("best", artefact)
    DAMAGE[kind](artefact.directory)
    before = tree(empty_store.root)
    store = read_only(empty_store)
    with store.in_use(), pytest.raises(IntegrityError, match=kind.split()[0]) as caught:
        store.find(artefact.manifest.record.key)
    assert "irl train-airl" in caught.value.hint
    if "manifest" in kind:
        for read in (lambda: store.resolve("best"), lambda: store.resolve(artefact.id)):
            with pytest.raises(IntegrityError):
                read()
    else:
        with pytest.raises(IntegrityError):
            store.open(artefact, "reward.pt")
    assert list(store.verify(store.ids()).damaged) == [artefact.id]
    assert tree(empty_store.root) == before


def test_a_read_only_store_needs_none_of_its_own_directories(empty_store, artefact):
    """git does not keep empty directories."""
    for name in (".locks", ".names", ".work", ".quarantine"):
        shutil.rmtree(empty_store.root / name)
    before = tree(empty_store.root)
    store = read_only(empty_store)
    with store.in_use():
        assert store.find(artefact.manifest.record.key) == artefact
        assert store.resolve(artefact.id[:5]).artefact == artefact
        assert store.open(artefact, "reward.pt").is_file()
        assert store.names() == {} and store.verify(store.ids()).damaged == {}
        assert store.garbage(-1.0) == [artefact] and store.stale_work(-1.0) == []
    assert tree(empty_store.root) == before


def test_a_read_only_store_refuses_every_change(empty_store, artefact, publish):
    store = read_only(empty_store)
    before = tree(empty_store.root)
    for change in (
        store.create,
        lambda: store.set_name("best", artefact),
        lambda: store.working_on("0" * 64, wait=False).__enter__(),
        lambda: store.publish(artefact.manifest.record, store.root, {}),
        lambda: store.adopt(empty_store, artefact),
        lambda: store.collect(0.0),
    ):
        with pytest.raises(UsageError, match="reading only"):
            change()
    assert tree(empty_store.root) == before


def test_a_read_only_store_takes_no_lock(empty_store, artefact):
    lock = empty_store.root / ".locks" / "gc"
    with locked(lock), read_only(empty_store).in_use():
        assert read_only(empty_store).find(artefact.manifest.record.key) == artefact
    lock.unlink()
    with read_only(empty_store).in_use():
        assert not lock.exists()


DRY_RUNS = {
    "a hit": "transfer --reward {airl} --ood 1.5x",
    "its input by id": "train-airl --demos {demos} --method irm",
    "its input by name": "evaluate --policy moved --ood 1.5x",
    "all of a table": "plan table1",
}


@pytest.mark.parametrize("name", ["a manifest", "an output", "nothing"])
@pytest.mark.parametrize("kind", DRY_RUNS)
def test_a_dry_run_changes_nothing_also_where_artefacts_are_damaged(irl, store_copy, kind, name):
    """Whatever it prints, and whichever error it ends with."""
    for artefact in list(Store(store_copy.path).artefacts()):
        if name == "a manifest":
            truncate(artefact.directory / "manifest.json")
        elif name == "an output":
            for output in artefact.manifest.outputs:
                truncate(artefact.directory / output.path)
    before = tree(store_copy.path)
    line = DRY_RUNS[kind].format(airl=store_copy.airl, demos=store_copy.demos).split()
    dry = [] if line[0] == "plan" else ["--dry-run"]
    result = irl(*line, *dry, "--profile", "smoke", "--store", store_copy.path)
    assert result.code in ((0,) if name == "nothing" else (0, 4)), result.err
    assert tree(store_copy.path) == before


def test_a_dry_run_creates_no_store(irl, tmp_path):
    lander = ["--env", "lunar-lander", "--intervention", "bounce=0.9", "--profile", "smoke"]
    result = irl("evaluate", "--idle", *lander, "--dry-run", "--store", tmp_path / "absent")
    assert result.code == 0 and result.out.startswith("RUN"), result
    assert list(tmp_path.iterdir()) == []
