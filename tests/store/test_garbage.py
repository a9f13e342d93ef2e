"""Ancestry and garbage collection: what a name needs is kept, and what is in use or young."""

from __future__ import annotations

import errno
import os
import shutil
import time
from pathlib import Path

import pytest

from irlcli.errors import Busy
from irlcli.store import Artefact, Store
from irlcli.store.durable import machine, remove_leftovers
from irlcli.store.lease import Patience
from irlcli.store.lock import exclusive, locked

DAY = 86400.0


@pytest.fixture
def family(empty_store, publish) -> dict[str, Artefact]:
    """expert -> demos -> airl -> moved, and an unrelated one; all a year old."""
    made: dict[str, Artefact] = {}

    def make(name: str, *parents: str, whole: bool = False) -> None:
        inputs = {
            parent: made[parent].manifest.content if whole else made[parent].output("f").sha256
            for parent in parents
        }
        files = {"f": name.encode(), "log": b"the same in all"}
        made[name] = publish(empty_store, files, parameters={"of": name}, inputs=inputs).artefact

    make("expert")
    make("demos", "expert")
    make("airl", "demos", whole=True)
    make("moved", "airl")
    make("lonely")
    for artefact in made.values():
        age(artefact.directory, 365)
    return made


def age(path: Path, days: float) -> None:
    then = time.time() - days * DAY
    os.utime(path, (then, then))


def ids(*artefacts: Artefact) -> set[str]:
    return {a.id for a in artefacts}


def test_ancestors_are_found_by_content(empty_store, family):
    found = empty_store.index().parents(family["airl"])
    assert {role: [a.id for a in made] for role, made in found.items()} == {
        "demos": [family["demos"].id]
    }
    assert empty_store.index().parents(family["expert"]) == {}


def test_ancestor_that_is_not_in_the_store(empty_store, publish):
    orphan = publish(empty_store, inputs={"reward": "0" * 64}).artefact
    assert empty_store.index().parents(orphan) == {"reward": []}


@pytest.mark.parametrize(
    "named, kept",
    [
        ([], []),
        (["moved"], ["expert", "demos", "airl", "moved"]),
        (["demos"], ["expert", "demos"]),
        (["lonely", "expert"], ["lonely", "expert"]),
    ],
)
def test_names_and_their_ancestors_are_kept(empty_store, family, named, kept):
    for name in named:
        empty_store.set_name(f"name-{name}", family[name])
    spared = ids(*(family[name] for name in kept))
    everything = ids(*family.values())
    assert ids(*empty_store.garbage(DAY)) == everything - spared
    removed, _ = empty_store.collect(DAY)
    assert ids(*removed) == everything - spared
    assert set(empty_store.ids()) == spared
    assert empty_store.verify(empty_store.ids()).damaged == {}
    for artefact in removed:
        assert empty_store.find(artefact.manifest.record.key) is None
    assert list((empty_store.root / ".work").iterdir()) == []


def test_what_the_manifest_of_a_newer_version_mentions_is_kept(empty_store, family):
    """Its form is unknown, so whatever content it names is kept, with its ancestors."""
    directory = family["lonely"].directory
    directory.chmod(0o755)
    mentioned = family["demos"].manifest.content
    (directory / "manifest.json").unlink()
    (directory / "manifest.json").write_text(f'{{"schema": 99, "from": ["{mentioned}"]}}')
    removed, _ = empty_store.collect(0.0)
    assert ids(*removed) == ids(family["airl"], family["moved"])
    assert directory.is_dir()


def test_the_keys_of_what_is_removed_are_free_again(empty_store, family):
    keys = empty_store.root / ".keys"
    before = {path.name for path in keys.iterdir()}
    empty_store.set_name("kept", family["demos"])
    removed, _ = empty_store.collect(0.0)
    gone = {artefact.manifest.record.key for artefact in removed}
    assert len(gone) == 3
    assert {path.name for path in keys.iterdir()} == before - gone


def test_grace_period(empty_store, family):
    age(family["lonely"].directory, 0)
    age(family["moved"].directory, 2)
    assert family["lonely"].id not in ids(*empty_store.garbage(DAY))
    assert family["moved"].id in ids(*empty_store.garbage(DAY))
    assert family["moved"].id not in ids(*empty_store.garbage(3 * DAY))
    assert len(empty_store.garbage(400 * DAY)) == 0


def test_what_a_young_artefact_was_made_from_is_kept(empty_store, family):
    age(family["airl"].directory, 0)
    kept = ids(*(family[name] for name in ("airl", "demos", "expert")))
    assert ids(*empty_store.garbage(DAY)) == ids(*family.values()) - kept


def test_what_an_interrupted_run_needs_is_kept_while_it_can_be_resumed(empty_store, family):
    airl = family["airl"]
    with empty_store.working_on("a" * 64, wait=False) as scratch:
        scratch.inputs = [airl.output("f").sha256]
        scratch.save(b"state")
    kept = ids(*(family[name] for name in ("airl", "demos", "expert")))
    assert ids(*empty_store.garbage(DAY)) == ids(*family.values()) - kept
    age(scratch.directory, 2)
    assert ids(*empty_store.garbage(DAY)) == ids(*family.values())
    # Damaged, it protects nothing.
    age(scratch.directory, 0)
    (scratch.directory / "inputs").write_bytes(b"\xff\x00")
    assert ids(*empty_store.garbage(DAY)) == ids(*family.values())
    with empty_store.working_on("a" * 64, wait=False) as scratch:
        scratch.clear()
    assert not scratch.directory.exists()


def test_clock_set_back_removes_nothing(empty_store, family):
    """Artefacts dated in the future count as young."""
    for artefact in family.values():
        age(artefact.directory, -1000)
    assert empty_store.garbage(0) == []


def test_dry_run_removes_nothing(empty_store, family):
    def tree() -> list[tuple[str, int]]:
        return sorted((str(p), p.lstat().st_mtime_ns) for p in empty_store.root.rglob("*"))

    (empty_store.root / ".work" / ("a" * 64)).mkdir()
    age(empty_store.root / ".work" / ("a" * 64), 365)
    before = tree()
    assert len(empty_store.garbage(DAY)) == 5
    assert len(empty_store.stale_work(DAY)) == 1
    assert tree() == before


def test_what_a_damaged_name_protects_is_not_deleted(irl, empty_store, family):
    protected = empty_store.ids()[0]
    empty_store.set_name("best", empty_store.resolve(protected).artefact)
    for damage in ("", "garbage!!\n"):
        (empty_store.root / ".names" / "best").write_text(damage)
        listed = irl("gc", "--grace-days", "0", "--store", empty_store.root)
        assert listed.code == 0 and "best is damaged" in listed.err
        deleted = irl("gc", "--delete", "--grace-days", "0", "--store", empty_store.root)
        assert deleted.code == 4 and "best is damaged" in deleted.err
        assert f"irl name REF best --store {empty_store.root}`" in deleted.err
        checked = irl("verify", "--store", empty_store.root)
        assert checked.code == 4 and "best" in checked.err
        assert f"irl name REF NAME --store {empty_store.root}`" in checked.err
    assert len(empty_store.ids()) == 5
    assert irl("name", protected, "best", "--store", empty_store.root).code == 0
    assert irl("verify", "--store", empty_store.root).code == 0


def test_names_that_are_removed_protect_nothing(irl, empty_store, family):
    store = ("--store", empty_store.root)
    for name in ("trial.one", "trial.two", "standard.one"):
        empty_store.set_name(name, family["lonely" if name == "trial.two" else "demos"])
    (empty_store.root / ".names" / "trial.three").write_text("garbage")
    before = set(empty_store.ids())
    refused = irl("unname", "trial.*", "nothing", *store)
    assert refused.code == 3 and "'nothing'" in refused.err and "hint:" in refused.err
    assert set(empty_store.names()) == {"trial.one", "trial.two", "standard.one"}
    done = irl("unname", "trial.*", "trial.two", *store)
    assert (done.code, done.out.split()) == (0, ["trial.one", "trial.three", "trial.two"])
    assert set(empty_store.ids()) == before
    assert irl("gc", "--delete", "--grace-days", "0", *store).code == 0
    assert set(empty_store.ids()) == ids(family["demos"], family["expert"])
    assert irl("unname", "x", "--store", empty_store.root / "nowhere").code == 3


def test_a_collection_that_ended_is_not_named_as_the_user_of_the_store(empty_store, family):
    empty_store.collect(400 * DAY)
    with empty_store.in_use(), pytest.raises(Busy) as caught:
        Store(empty_store.root).collect(DAY)
    assert str(os.getpid()) not in caught.value.message


def test_collect_refuses_a_store_in_use(empty_store, family):
    with empty_store.in_use(), pytest.raises(Busy):
        Store(empty_store.root).collect(DAY)
    assert len(empty_store.ids()) == 5
    removed, _ = empty_store.collect(DAY)
    assert len(removed) == 5


def test_another_users_artefacts_are_left(empty_store, family, monkeypatch):
    """Only their owner may change the mode of a directory, which is read-only."""
    theirs, *ours = sorted(empty_store.ids())
    change = Path.chmod

    def chmod(path, mode, **options):
        if path.name == theirs:
            raise PermissionError(errno.EPERM, "Operation not permitted", str(path))
        change(path, mode, **options)

    monkeypatch.setattr(Path, "chmod", chmod)
    said = []
    empty_store.warn = said.append
    removed, _ = empty_store.collect(DAY)
    assert sorted(artefact.id for artefact in removed) == ours
    assert empty_store.ids() == [theirs] and not empty_store.verify([theirs]).damaged
    assert len(said) == 1 and theirs in said[0]
    key = next(iter(empty_store.artefacts())).manifest.record.key
    assert empty_store.find(key) is not None


def test_another_users_leftovers_are_left(empty_store, monkeypatch):
    dead = f"copy.999999999.{'0' * 32}.{machine()}"
    for name in ("theirs", "ours"):
        with empty_store.working_on(name, wait=False) as scratch:
            scratch.save(b"state")
        age(empty_store.root / ".work" / name, 30)
    (empty_store.root / ".work" / dead).mkdir()
    remove = shutil.rmtree

    def rmtree(path, *arguments, **options):
        if path.name in ("theirs", dead):
            raise PermissionError(errno.EACCES, "Permission denied", "f")
        remove(path, *arguments, **options)

    monkeypatch.setattr(shutil, "rmtree", rmtree)
    said = []
    empty_store.warn = said.append
    _, work = empty_store.collect(DAY)
    assert [path.name for path in work] == ["ours"]
    assert len(said) == 1 and "theirs" in said[0]
    assert empty_store.has_checkpoint("theirs") and not empty_store.has_checkpoint("ours")


def test_two_processes_may_remove_the_same_leftovers(tmp_path, monkeypatch):
    (tmp_path / f"copy.999999999.{'0' * 32}.{machine()}").mkdir()
    remove = shutil.rmtree

    def rmtree(path, *arguments, **options):
        for _ in range(2):
            remove(path, *arguments, **options)

    monkeypatch.setattr(shutil, "rmtree", rmtree)
    remove_leftovers(tmp_path)
    assert not [*tmp_path.iterdir()]


def test_locks_of_a_group_can_be_taken_by_its_members(tmp_path):
    before = os.umask(0o002)
    try:
        with locked(tmp_path / "lock"):
            assert (tmp_path / "lock").stat().st_mode & 0o777 == 0o664
        Store(tmp_path / "store").create()
        for lock in (tmp_path / "store" / ".locks").iterdir():
            assert lock.stat().st_mode & 0o777 == 0o664
    finally:
        os.umask(before)


def test_no_process_uses_the_store_while_it_is_collected(empty_store):
    gc_lock = exclusive(empty_store.root / ".locks" / "gc", Patience())
    with gc_lock, pytest.raises(Busy) as caught, empty_store.in_use():
        pytest.fail("used the store while gc was changing it")
    assert f"process {os.getpid()}" in caught.value.message and caught.value.hint


def test_readers_share(empty_store):
    with empty_store.in_use(), Store(empty_store.root).in_use(), pytest.raises(Busy):
        empty_store.collect(0.0)


def test_one_key_one_worker(empty_store):
    with empty_store.working_on("0" * 64, wait=False):
        second = empty_store.working_on("0" * 64, wait=False)
        with pytest.raises(Busy, match=f"process {os.getpid()}"), second:
            pytest.fail("two workers on one key")
        with empty_store.working_on("1" * 64, wait=False) as other:
            other.save(b"state")
    with empty_store.working_on("0" * 64, wait=False) as again:
        assert again.load() is None  # the scratch of one key is not that of another


def test_stale_work(empty_store):
    """Only old directories that no process holds; yesterday's checkpoint can be resumed."""
    for name in ("old", "held", "young"):
        with empty_store.working_on(name, wait=False) as scratch:
            scratch.save(b"state")
    for name in ("old", "held"):
        age(empty_store.root / ".work" / name, 30)
    with empty_store.working_on("held", wait=False):
        assert [p.name for p in empty_store.stale_work(7 * DAY)] == ["old"]
        assert [p.name for p in Store(empty_store.root).collect(7 * DAY)[1]] == ["old"]
    assert empty_store.has_checkpoint("held") and empty_store.has_checkpoint("young")
    assert not empty_store.has_checkpoint("old")


def test_collecting_works_after_an_interrupted_collection(empty_store, family, publish):
    """A killed gc left a half-removed artefact, which has since been computed again."""
    grave = empty_store.root / ".work" / f"removed-{family['lonely'].id}"
    grave.mkdir()
    (grave / "f").write_bytes(b"half")
    removed, _ = empty_store.collect(DAY)
    assert ids(*removed) == ids(*family.values())
    assert empty_store.ids() == []


def test_a_store_that_does_not_exist_has_nothing_to_collect(tmp_path):
    store = Store(tmp_path / "absent")
    assert (store.garbage(0), store.stale_work(0), store.names(), store.ids()) == ([], [], {}, [])
    assert store.collect(0) == ([], [])


def test_a_full_disk_is_collected(empty_store, family, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    assert len(empty_store.collect(DAY)[0]) == len(family)


def test_a_store_that_git_cloned_is_protected_from_the_first_command_on(empty_store):
    """git keeps no empty directories, so the one with the locks is missing."""
    shutil.rmtree(empty_store.root / ".locks")
    empty_store.create()
    with empty_store.in_use(), pytest.raises(Busy):
        Store(empty_store.root).collect(0)
