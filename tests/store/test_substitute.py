"""Copying from other stores: whole or absent, every byte checked, the other store untouched."""

# ruff: noqa: B023 (the closures over a loop's variables run within their own iteration)

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from every_step import ENOUGH, counter, in_child, intercept, kill_self

from irlcli.errors import IntegrityError, NotFound, UsageError
from irlcli.store import Artefact, Store
from irlcli.store.sources import find_in, open_sources

FILES = {"f": b"content", "nested/g": b"PAR1" * 64}


class Zoo:
    """A store as git ships it: without empty directories, files with mode 644.

    ``demos`` was made from ``expert``, and ``airl`` from ``demos``.
    """

    def __init__(self, root: Path, publish: Callable):
        self.root = root
        self.warnings: list[str] = []
        store = Store(root)
        self.made: dict[str, Artefact] = {}
        parent = None
        for name in ("expert", "demos", "airl"):
            inputs = {"input": parent.output("f").sha256} if parent else {}
            places = {"input": f"{parent.id}/f"} if parent else {}
            files = {**FILES, "f": name.encode()}
            parent = publish(
                store, files, parameters={"of": name}, inputs=inputs, places=places
            ).artefact
            self.made[name] = parent
        for name in (".locks", ".names", ".work", ".quarantine"):
            shutil.rmtree(root / name)
        for path in root.rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)

    def __getitem__(self, name: str) -> Artefact:
        return self.made[name]

    def key(self, name: str) -> str:
        return self.made[name].manifest.record.key

    def open(self) -> Store:
        (store,) = open_sources([self.root], self.warnings.append)
        return store

    def tree(self) -> list[tuple[str, int, int, int]]:
        """Whatever a change would change."""
        paths = [self.root, *self.root.rglob("*")]
        status = [(str(p), p.lstat()) for p in paths]
        return sorted((p, s.st_mode, s.st_size, s.st_mtime_ns) for p, s in status)


@pytest.fixture
def zoo(tmp_path, publish) -> Zoo:
    return Zoo(tmp_path / "zoo", publish)


@pytest.fixture
def store(tmp_path) -> Store:
    return created(tmp_path / "runs")


def created(root: Path, warnings: list[str] | None = None) -> Store:
    store = Store(root, [].append if warnings is None else warnings.append)
    store.create()
    return store


def adopt(store: Store, zoo: Zoo, name: str = "airl"):
    """As the runner does."""
    source = zoo.open()
    with store.in_use(), store.working_on(zoo.key(name), wait=True):
        found = find_in([source], zoo.key(name))
        assert found is not None
        return store.adopt(found.store, found.artefact)


def assert_same(artefact: Artefact, original: Artefact) -> None:
    assert artefact.id == original.id
    for path in original.directory.rglob("*"):
        copy = artefact.directory / path.relative_to(original.directory)
        if path.is_file():
            assert copy.read_bytes() == path.read_bytes()
            assert stat.S_IMODE(copy.stat().st_mode) == 0o444


# What arrives


def test_the_artefact_and_its_ancestors_are_copied_byte_for_byte(store, zoo):
    before = zoo.tree()
    published = adopt(store, zoo)
    assert published.diverged is None
    assert set(store.ids()) == {a.id for a in zoo.made.values()}
    for original in zoo.made.values():
        found = store.find(original.manifest.record.key)
        assert_same(found, original)
    assert store.verify(store.ids()).damaged == {}
    assert list((store.root / ".work").iterdir()) == []
    assert zoo.tree() == before and zoo.warnings == []


def test_gc_keeps_the_ancestors_of_a_named_copy(store, zoo):
    store.set_name("best", adopt(store, zoo).artefact)
    assert store.garbage(-1.0) == [] and store.missing(store.index()) == {}
    (parent,) = store.index().parents(store.resolve("best").artefact)["input"]
    assert parent.id == zoo["demos"].id


def test_only_what_is_needed_is_copied(store, zoo):
    adopt(store, zoo, "demos")
    assert set(store.ids()) == {zoo["expert"].id, zoo["demos"].id}


def test_ancestors_that_are_present_are_not_copied_again(store, zoo):
    adopt(store, zoo, "demos")
    directory = store.root / zoo["demos"].id
    inode = (directory / "f").stat().st_ino
    assert adopt(store, zoo).artefact.id == zoo["airl"].id
    assert (directory / "f").stat().st_ino == inode


def test_ancestors_that_the_other_store_lacks_are_left_out(store, zoo):
    shutil.rmtree(zoo["expert"].directory)
    adopt(store, zoo)
    assert set(store.ids()) == {zoo["demos"].id, zoo["airl"].id}


def test_ancestors_that_the_other_store_gains_while_it_is_open_are_copied(tmp_path, store, publish):
    """Somebody else may be working in it."""
    other = Store(tmp_path / "other")

    def chain(seed: int) -> Artefact:
        parent = publish(other, {"f": b"parent %d" % seed}, parameters={"of": seed}).artefact
        inputs = {"reward": parent.output("f").sha256}
        return publish(other, {"f": b"%d" % seed}, parameters={"of": seed}, inputs=inputs).artefact

    first = chain(1)
    (source,) = open_sources([other.root], pytest.fail)
    store.adopt(source, first)
    store.adopt(source, chain(2))
    assert set(store.ids()) == set(other.ids()) and len(store.ids()) == 4


def test_ancestors_whose_content_leads_back_are_copied_once(store, tmp_path, publish):
    """Equal files are one content, so each of the two may have been made from the other."""
    other = Store(tmp_path / "other")
    sha = publish(other, {"f": b"same"}).artefact.output("f").sha256
    second = publish(other, {"f": b"same"}, parameters={"seed": 1}, inputs={"reward": sha}).artefact
    publish(other, {"f": b"same"}, parameters={"seed": 2}, inputs={"reward": sha})
    (source,) = open_sources([other.root], pytest.fail)
    store.adopt(source, second)
    assert set(store.ids()) == set(other.ids())


def test_an_ancestor_that_diverges_is_kept_beside_the_holder_of_its_key(store, zoo, publish):
    own = publish(store, {"f": b"other bytes"}, parameters={"of": "expert"}).artefact
    assert own.manifest.record.key == zoo.key("expert")
    adopt(store, zoo)
    assert store.find(zoo.key("expert")) == own
    assert {own.id, zoo["expert"].id} <= set(store.ids())


def test_a_checkpoint_of_the_adopted_key_is_removed(store, zoo):
    with store.working_on(zoo.key("airl"), wait=False) as scratch:
        scratch.save(b"state")
    adopt(store, zoo)
    assert not store.has_checkpoint(zoo.key("airl"))


def test_a_checkpoint_of_an_ancestor_is_kept(store, zoo):
    """Its key is not locked: another process may be computing it."""
    with store.working_on(zoo.key("demos"), wait=False) as scratch:
        scratch.save(b"state")
        adopt(store, zoo)
        assert scratch.load() == b"state"


def test_a_shipped_store_can_be_used_as_it_is(zoo, publish):
    """Cloned by git, then given as --store: its missing directories are created when needed."""
    store = Store(zoo.root)
    store.create()
    found = store.find(zoo.key("airl"))
    store.set_name("best", found)
    publish(store, parameters={"seed": 5})
    assert len(store.ids()) == 4 and store.verify(store.ids()).damaged == {}
    assert len(store.collect(-1.0)[0]) == 1


# Looking


def test_the_first_store_that_has_the_key_is_used(tmp_path, zoo, publish):
    second = Zoo(tmp_path / "second", publish)
    empty = created(tmp_path / "empty")
    stores = open_sources([empty.root, zoo.root, second.root], pytest.fail)
    assert find_in(stores, zoo.key("airl")).store.root == zoo.root
    assert find_in(stores, "0" * 64) is None and find_in([], zoo.key("airl")) is None


def test_a_damaged_artefact_in_one_store_leads_to_the_next(tmp_path, zoo, publish):
    second = Zoo(tmp_path / "second", publish)
    (zoo["airl"].directory / "f").unlink()
    warnings: list[str] = []
    stores = open_sources([zoo.root, second.root], warnings.append)
    assert find_in(stores, zoo.key("airl")).store.root == second.root
    assert len(warnings) == 1 and str(zoo["airl"].directory / "f") in warnings[0]


@pytest.mark.parametrize("lost", [".keys", ".keys/KEY"])
def test_without_a_key_entry_it_is_a_miss(store, zoo, lost):
    path = zoo.root / lost.replace("KEY", zoo.key("airl"))
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert find_in([zoo.open()], zoo.key("airl")) is None and zoo.warnings == []


def test_an_ancestor_needs_no_key_entry_to_be_copied(store, zoo):
    (zoo.root / ".keys" / zoo.key("demos")).unlink()
    adopt(store, zoo)
    assert store.find(zoo.key("demos")).id == zoo["demos"].id


@pytest.mark.parametrize("make", [lambda p: None, lambda p: p.mkdir()], ids=["absent", "empty"])
def test_a_directory_that_is_no_store_is_refused(tmp_path, make):
    make(tmp_path / "zoo")
    with pytest.raises(NotFound, match="not a store") as caught:
        open_sources([tmp_path / "zoo"], pytest.fail)
    assert "--from" in caught.value.hint


def test_a_newer_store_is_refused(zoo):
    (zoo.root / "STORE").write_bytes(b'{"format": 2}')
    with pytest.raises(IntegrityError, match="newer"):
        zoo.open()


def test_a_file_is_refused(zoo):
    with pytest.raises(UsageError, match="not a directory"):
        open_sources([zoo.root / "STORE"], pytest.fail)


# Damage in the other store


def flip(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


def newer(path: Path) -> None:
    path.write_text(json.dumps({**json.loads(path.read_bytes()), "schema": 2}))


def to_link(path: Path) -> None:
    """The same bytes, reached through a link out of the store."""
    outside = path.parents[2] / "outside"
    shutil.move(path, outside)
    path.symlink_to(outside)


NAMES = ["f", "nested/g", "manifest.json", "provenance.json"]
DAMAGE = {
    **{f"{name} flipped": (name, flip) for name in NAMES},
    **{f"{name} missing": (name, Path.unlink) for name in NAMES},
    **{f"{name} linked": (name, to_link) for name in [*NAMES, "nested"]},
    "manifest.json newer": ("manifest.json", newer),
    "extra link": ("extra", lambda path: path.symlink_to("/etc/passwd")),
    "extra file": ("extra", Path.touch),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_artefact_is_a_miss_with_a_warning(tmp_path, zoo, kind):
    name, damage = DAMAGE[kind]
    damage(zoo["airl"].directory / name)
    before = zoo.tree()
    warnings: list[str] = []
    store = created(tmp_path / "runs", warnings)
    found = find_in([zoo.open()], zoo.key("airl"))
    assert found is None or store.adopt(found.store, found.artefact) is None
    (warning,) = {w for w in warnings + zoo.warnings if zoo["airl"].id in w}
    assert name in warning and str(zoo.root) in warning
    assert store.find(zoo.key("airl")) is None and zoo["airl"].id not in store.ids()
    assert list((store.root / ".work").iterdir()) == []
    assert zoo.tree() == before


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_ancestor_is_left_out_with_a_warning(tmp_path, zoo, kind):
    name, damage = DAMAGE[kind]
    damage(zoo["expert"].directory / name)
    warnings: list[str] = []
    store = created(tmp_path / "runs", warnings)
    assert adopt(store, zoo).artefact.id == zoo["airl"].id
    assert set(store.ids()) == {zoo["demos"].id, zoo["airl"].id}
    assert any(zoo["expert"].id in w and name in w for w in warnings + zoo.warnings)


def test_an_artefact_that_is_a_link_is_refused(store, zoo, tmp_path):
    source = zoo.open()
    found = find_in([source], zoo.key("airl"))
    shutil.move(zoo["airl"].directory, tmp_path / "elsewhere")
    zoo["airl"].directory.symlink_to(tmp_path / "elsewhere")
    assert find_in([source], zoo.key("airl")) is None
    assert store.adopt(source, found.artefact) is None
    assert zoo["airl"].id not in store.ids()


def test_what_vanishes_between_finding_and_copying_is_a_miss(store, zoo):
    source = zoo.open()
    found = find_in([source], zoo.key("airl"))
    shutil.rmtree(zoo["airl"].directory)
    assert store.adopt(source, found.artefact) is None
    assert zoo["airl"].id not in store.ids()


# Interruptions


def assert_whole_or_absent(store: Store, zoo: Zoo) -> None:
    assert store.verify(store.ids()).damaged == {}
    for original in (zoo["expert"], zoo["demos"]):
        found = store.find(original.manifest.record.key)
        if found is not None:
            assert_same(found, original)


def assert_adopts_again(store: Store, zoo: Zoo, *names: str) -> None:
    """The last of ``names``, with its ancestors before it."""
    artefact = adopt(store, zoo, names[-1]).artefact
    assert set(store.ids()) == {zoo[name].id for name in names}
    assert store.verify(store.ids()).damaged == {}
    assert list((store.root / ".quarantine").iterdir()) == []
    for name in names:
        assert_same(store.find(zoo.key(name)), zoo[name])
    store.set_name("best", artefact)
    store.collect(-1.0)
    assert len(store.ids()) == len(names) and list((store.root / ".work").iterdir()) == []


def test_sigkill_at_every_step_of_adopt(tmp_path, zoo):
    before = zoo.tree()
    for n in range(ENOUGH):
        store = created(tmp_path / str(n))

        def work() -> None:
            intercept(setattr, counter(n, kill_self))
            adopt(store, zoo, "demos")

        status = in_child(work)
        assert_whole_or_absent(Store(store.root), zoo)
        assert_adopts_again(Store(store.root), zoo, "expert", "demos")
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            break
        assert os.WTERMSIG(status) == signal.SIGKILL
    assert n > 45 and zoo.tree() == before


@pytest.mark.parametrize("persist", [False, True], ids=["once", "from-then-on"])
def test_failing_call_at_every_step_of_adopt(tmp_path, zoo, persist):
    """A full disk fails the command; whatever was copied before is whole."""

    def fail(half: Callable[[], None]) -> None:
        half()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before, failures = zoo.tree(), 0
    for n in range(ENOUGH):
        store, source = created(tmp_path / str(n)), zoo.open()
        found = find_in([source], zoo.key("expert"))
        seen = 0

        def count(name: str, args: tuple, half: Callable[[], None]) -> None:
            nonlocal seen
            seen += 1
            at_call(name, args, half)

        at_call = counter(n, fail, persist)
        with pytest.MonkeyPatch.context() as patch:
            intercept(patch.setattr, count)
            try:
                store.adopt(source, found.artefact)
            except OSError as error:
                assert error.errno == errno.ENOSPC
                failures += 1
        assert_whole_or_absent(Store(store.root), zoo)
        assert_adopts_again(Store(store.root), zoo, "expert")
        if seen <= n:
            break
    assert failures > 15 and zoo.tree() == before


def test_many_processes_adopt_at_once(tmp_path, zoo):
    """Without the lock of the key, which is only there to save work."""
    store = created(tmp_path / "runs")
    children = []
    for _ in range(4):
        pid = os.fork()
        if pid == 0:
            code = 99
            try:
                source = zoo.open()
                found = find_in([source], zoo.key("demos"))
                published = Store(store.root).adopt(source, found.artefact)
                assert published.artefact.id == zoo["demos"].id and published.diverged is None
                code = 0
            finally:
                os._exit(code)
        children.append(pid)
    assert [os.waitpid(pid, 0)[1] for pid in children] == [0] * 4
    assert_whole_or_absent(store, zoo)
    assert len(store.ids()) == 2 and list((store.root / ".work").iterdir()) == []


def test_two_adopters_interleaved_at_every_step(tmp_path, zoo):
    """The second one adopts completely before the n-th call of the first."""
    for n in range(ENOUGH):
        store, source = created(tmp_path / str(n)), zoo.open()
        found = find_in([source], zoo.key("expert"))
        calls, rival = 0, None

        def at_call(name: str, args: tuple, half: Callable[[], None]) -> None:
            nonlocal calls, rival
            calls += 1
            if calls == n + 1:
                rival = store.adopt(source, found.artefact)

        with pytest.MonkeyPatch.context() as patch:
            intercept(patch.setattr, at_call)
            slow = store.adopt(source, found.artefact)
        assert slow.artefact.id == zoo["expert"].id and slow.diverged is None
        assert_whole_or_absent(store, zoo)
        assert len(store.ids()) == 1
        if rival is None:
            break
        assert rival == slow
    assert n > 20


# From the command line

IDLE = ["evaluate", "--idle", "--env", "lunar-lander", "--intervention", "bounce=0.9"]
IDLE += ["--profile", "smoke", "--episodes", "1", "--quiet"]


def test_what_another_store_has_is_not_computed_again(irl, smoke_store, tmp_path):
    line = ["collect-experts", "--env", "lunar-lander", "--profile", "smoke", "--store", tmp_path]
    line += ["--intervention", "engine-power=1x,1.25x", "--from", smoke_store.path]
    planned = irl(*line, "--dry-run")
    assert planned.code == 0 and "FOUND" in planned.out and "RUN" not in planned.out
    assert list(tmp_path.iterdir()) == []
    result = irl(*line)
    assert result.code == 0 and "RUN " not in result.err, result.err
    assert Path(result.out.strip()).name == smoke_store.demos
    assert Store(tmp_path).verify(Store(tmp_path).ids()).damaged == {}


def test_what_is_damaged_there_is_computed_with_a_warning(irl, tmp_path):
    made = Path(irl(*IDLE, "--store", tmp_path / "zoo").out.strip())
    (made / "summary.json").chmod(0o644)
    flip(made / "summary.json")
    result = irl(*IDLE, "--store", tmp_path / "runs", "--from", tmp_path / "zoo")
    assert result.code == 0 and Path(result.out.strip()).name == made.name, result.err
    (warning,) = [line for line in result.err.splitlines() if line.startswith("warning")]
    assert str(made / "summary.json") in warning
    assert made.exists() and not list((tmp_path / "zoo" / ".quarantine").iterdir())


def test_the_environment_names_stores_too(irl, tmp_path, monkeypatch):
    irl(*IDLE, "--store", tmp_path / "zoo")
    monkeypatch.setenv("IRL_FROM", str(tmp_path / "zoo"))
    planned = irl(*IDLE, "--dry-run", "--store", tmp_path / "runs")
    assert "FOUND" in planned.out and str(tmp_path / "zoo") in planned.out
