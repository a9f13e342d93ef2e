"""Publishing: an artefact is whole or absent, wherever a process is killed or a call fails."""

# ruff: noqa: B023 (the closures over a loop's variables run within their own iteration)

from __future__ import annotations

import errno
import os
import signal
import stat
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from every_step import ENOUGH, counter, in_child, intercept, kill_self

from irlcli.errors import StageFailed
from irlcli.store import KeyRecord, Published, Store

FILES = {"reward.pt": bytes(range(256)) * 4, "nested/table.parquet": b"PAR1" * 64}
RECORD = KeyRecord("train-airl", 1, {"seed": 0, "rate": 1e-5}, {"demonstrations": "0" * 64})


def attempt(
    store: Store, files: dict[str, bytes] = FILES, attempt_name: str = "out.0"
) -> Published:
    """Publish without the lock: correctness must not depend on it."""
    output = stage_output(store, files, attempt_name)
    return store.publish(RECORD, output, {"command": ["irl", "train-airl"]})


def stage_output(store: Store, files: dict[str, bytes], attempt_name: str) -> Path:
    """An output directory as a stage leaves it."""
    output = store.root / ".work" / RECORD.key / attempt_name
    for name, data in files.items():
        (output / name).parent.mkdir(parents=True, exist_ok=True)
        (output / name).write_bytes(data)
    return output


def assert_whole_or_absent(store: Store) -> None:
    """Whatever readers can see is complete and unaltered."""
    assert store.verify(store.ids()).damaged == {}
    found = store.find(RECORD.key)
    if found is not None:
        for name, data in FILES.items():
            assert store.open(found, name).read_bytes() == data
        assert found.provenance()["command"] == ["irl", "train-airl"]
    for id16 in store.names().values():
        assert id16 in store.ids()


def assert_publishes_again(store: Store, expected: str) -> None:
    again = attempt(store, attempt_name="out.again")
    assert (again.artefact.id, again.diverged) == (expected, None)
    found = store.find(RECORD.key)
    assert found is not None and found.id == expected
    assert store.ids() == [expected]
    assert store.verify([expected]).damaged == {}
    assert list((store.root / ".quarantine").iterdir()) == []


@pytest.fixture(scope="module")
def expected_id(tmp_path_factory: pytest.TempPathFactory) -> str:
    return attempt(Store(_created(tmp_path_factory.mktemp("clean")))).artefact.id


def _created(root: Path) -> Path:
    Store(root).create()
    return root


def new_stores(tmp_path: Path) -> Iterator[tuple[int, Store]]:
    for n in range(ENOUGH):
        yield n, Store(_created(tmp_path / str(n)))
    pytest.fail("publishing never completed")


def test_sigkill_at_every_step_of_publish(tmp_path, expected_id):
    for n, store in new_stores(tmp_path):

        def work() -> None:
            output = stage_output(store, FILES, "out.0")
            intercept(setattr, counter(n, kill_self))
            store.publish(RECORD, output, {"command": ["irl", "train-airl"]})

        status = in_child(work)
        assert_whole_or_absent(Store(store.root))
        assert_publishes_again(Store(store.root), expected_id)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            break
        assert os.WTERMSIG(status) == signal.SIGKILL
    assert n > 25  # each file and directory is made durable: fewer calls were not intercepted


def test_sigkill_at_every_step_of_create(tmp_path):
    for n in range(ENOUGH):
        root = tmp_path / str(n)

        def work() -> None:
            store = Store(root)
            intercept(setattr, counter(n, kill_self))
            store.create()

        status = in_child(work)
        Store(root).create()  # a store that a crash left half made is one that can be finished
        assert attempt(Store(root)).artefact.id in Store(root).ids()
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0
            break
    assert n >= 6


def test_sigkill_at_every_step_of_naming(tmp_path):
    """A name points to the old artefact or the new one, and other names stay readable."""
    store = Store(_created(tmp_path / "runs"))
    old = attempt(store).artefact
    new = store.publish(
        RECORD._replace(stage_version=2), stage_output(store, FILES, "out.1"), {}
    ).artefact
    for n in range(ENOUGH):
        store.set_name("best", old)

        def work() -> None:
            intercept(setattr, counter(n, kill_self))
            store.set_name("best", new)

        status = in_child(work)
        names = Store(store.root).names()
        assert set(names) == {"best"} and names["best"] in (old.id, new.id)
        if os.WIFEXITED(status):
            assert names["best"] == new.id
            break
    assert n >= 3


@pytest.mark.parametrize("persist", [False, True], ids=["once", "from-then-on"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_failing_call_at_every_step_of_publish(tmp_path, expected_id, number, persist):
    """A full disk, a file system that turned read-only, a failing device."""

    def fail(half: Callable[[], None]) -> None:
        half()
        raise OSError(number, os.strerror(number))

    failures = 0
    for n, store in new_stores(tmp_path):
        output = stage_output(store, FILES, "out.0")
        seen = 0

        def count(name: str, args: tuple, half: Callable[[], None]) -> None:
            nonlocal seen
            seen += 1
            at_call(name, args, half)

        at_call = counter(n, fail, persist)
        with pytest.MonkeyPatch.context() as patch:
            intercept(patch.setattr, count)
            try:
                store.publish(RECORD, output, {"command": ["irl", "train-airl"]})
            except OSError as error:
                assert error.errno == number
                failures += 1
        assert_whole_or_absent(Store(store.root))
        assert_publishes_again(Store(store.root), expected_id)
        if seen <= n:
            break
    assert failures > 20


@contextmanager
def recorded() -> Iterator[list[tuple[str, str]]]:
    """The calls that make a path durable or visible, in order."""
    log: list[tuple[str, str]] = []

    def record(name: str, args: tuple, half: Callable[[], None]) -> None:
        if name == "fsync":
            target = args[0] if isinstance(args[0], int) else args[0].fileno()
            log.append((name, os.readlink(f"/proc/self/fd/{target}")))
        elif name in ("rename", "replace", "link"):
            log.append((name, str(args[1])))

    with pytest.MonkeyPatch.context() as patch:
        intercept(patch.setattr, record)
        yield log


def test_durable_before_visible(tmp_path):
    """The page cache survives SIGKILL but not a power cut, so the order of calls matters."""
    store = Store(_created(tmp_path / "runs"))
    output = stage_output(store, FILES, "out.0")
    with recorded() as log:
        artefact = store.publish(RECORD, output, {}).artefact
    appears = log.index(("rename", str(artefact.directory)))
    claimed = log.index(("link", str(store.root / ".keys" / RECORD.key)))
    durable = {path for call, path in log[:appears] if call == "fsync"}
    for path in (output, output / "nested", *(output / name for name in FILES)):
        assert str(path) in durable
    # Manifest and provenance are written under a temporary name and synced there.
    for name in ("manifest.json", "provenance.json"):
        assert any(Path(p).name.startswith(f".{name}.") for p in durable)
    assert ("fsync", str(store.root)) in log[appears:claimed]
    assert ("fsync", str(store.root / ".keys")) in log[claimed:]


def test_a_name_and_a_checkpoint_are_durable_when_written(tmp_path):
    store = Store(_created(tmp_path / "runs"))
    artefact = attempt(store).artefact
    with store.working_on(RECORD.key, wait=False) as scratch, recorded() as log:
        store.set_name("best", artefact)
        store.claim_name("pulled", artefact)
        scratch.save(b"state")
    names = store.root / ".names"
    for call, path in (
        ("replace", names / "best"),
        ("link", names / "pulled"),
        ("replace", scratch.directory / "checkpoint"),
    ):
        appears = log.index((call, str(path)))
        # The content before, the name after.
        assert any(
            call == "fsync" and Path(p).name.startswith(f".{path.name}.")
            for call, p in log[:appears]
        )
        assert ("fsync", str(path.parent)) in log[appears:]


def test_a_checkpoint_is_in_memory_once(tmp_path):
    """SAC's may be larger than half of the memory."""
    store, data = Store(_created(tmp_path / "runs")), bytes(4 << 20)
    with store.working_on(RECORD.key, wait=False) as scratch:
        tracemalloc.start()
        try:
            scratch.save(data)
            assert tracemalloc.get_traced_memory()[1] < len(data) / 2
            assert scratch.load() == data
            assert tracemalloc.get_traced_memory()[1] < 1.5 * len(data)
        finally:
            tracemalloc.stop()


def test_published_files_are_read_only_and_scratch_is_gone(tmp_path):
    store = Store(_created(tmp_path / "runs"))
    artefact = attempt(store).artefact
    for path in artefact.directory.rglob("*"):
        if path.is_file():
            assert stat.S_IMODE(path.stat().st_mode) == 0o444, path
    assert stat.S_IMODE(artefact.directory.stat().st_mode) == 0o555
    assert list((store.root / ".work").iterdir()) == []
    assert [p.name for p in (store.root / ".keys").iterdir()] == [RECORD.key]


def test_find_before_and_after(tmp_path):
    store = Store(tmp_path / "runs")
    assert store.find(RECORD.key) is None  # a store that does not exist yet
    assert not store.root.exists()
    store.create()
    assert store.find(RECORD.key) is None
    artefact = attempt(store).artefact
    assert store.find(RECORD.key) == artefact
    assert store.find("0" * 64) is None
    assert Store(store.root).resolve(artefact.id).artefact.manifest == artefact.manifest


def test_equal_content_is_one_artefact(tmp_path):
    store = Store(_created(tmp_path / "runs"))
    first = attempt(store)
    second = attempt(store, attempt_name="out.1")
    assert first.artefact.id == second.artefact.id and second.diverged is None
    assert store.ids() == [first.artefact.id]


def test_id_depends_on_record_and_content_only(tmp_path):
    """Not on the store, the provenance, or the order in which files were written."""
    one, two = (Store(_created(tmp_path / name)) for name in ("one", "two"))
    reverse = dict(reversed(FILES.items()))
    first = attempt(one).artefact
    second = two.publish(RECORD, stage_output(two, reverse, "out.0"), {"seconds": 3.5}).artefact
    assert first.manifest == second.manifest
    assert (first.directory / "manifest.json").read_bytes() == (
        second.directory / "manifest.json"
    ).read_bytes()
    third = two.publish(RECORD._replace(stage_version=2), stage_output(two, FILES, "out.1"), {})
    assert third.artefact.id != first.id
    assert third.artefact.manifest.content == first.manifest.content


def test_second_different_result_is_kept_and_reported(tmp_path):
    store = Store(_created(tmp_path / "runs"))
    first = attempt(store).artefact
    second = attempt(store, {**FILES, "reward.pt": b"other"}, "out.1")
    assert second.diverged == first
    assert second.artefact.id != first.id
    assert store.find(RECORD.key) == first  # the first writer wins
    assert store.ids() == sorted([first.id, second.artefact.id])
    assert store.verify(store.ids()).damaged == {}


def test_damaged_twin_is_replaced_not_trusted(tmp_path):
    """Publishing over a damaged artefact of the same id must not keep the damaged bytes."""
    store = Store(_created(tmp_path / "runs"))
    artefact = attempt(store).artefact
    path = artefact.directory / "reward.pt"
    path.chmod(0o644)
    path.write_bytes(b"x" * path.stat().st_size)
    again = attempt(store, attempt_name="out.1").artefact
    assert again.id == artefact.id
    assert store.open(again, "reward.pt").read_bytes() == FILES["reward.pt"]
    assert len(list((store.root / ".quarantine").iterdir())) == 1


@pytest.mark.parametrize("kind", ["symlink", "fifo"])
def test_outputs_other_than_plain_files_are_refused(tmp_path, kind):
    store = Store(_created(tmp_path / "runs"))
    output = stage_output(store, FILES, "out.0")
    if kind == "symlink":
        (output / "extra").symlink_to("/etc/passwd")
    else:
        os.mkfifo(output / "extra")
    with pytest.raises(ValueError, match="not a plain file"):
        store.publish(RECORD, output, {})
    assert store.ids() == [] and store.find(RECORD.key) is None


@pytest.mark.parametrize("other", [FILES, {"reward.pt": b"other"}], ids=["equal", "different"])
def test_two_publishers_interleaved_at_every_step(tmp_path, other):
    """Two processes publish one key at once, as happens where flock has no effect.

    The second one publishes completely before the n-th call of the first.
    """
    for n, store in new_stores(tmp_path):
        output = stage_output(store, FILES, "out.slow")
        rival = stage_output(store, other, "out.fast")
        calls, won = 0, None

        def at_call(name: str, args: tuple, half: Callable[[], None]) -> None:
            nonlocal calls, won
            calls += 1
            if calls == n + 1:
                won = store.publish(RECORD, rival, {"command": ["irl", "train-airl"]})

        with pytest.MonkeyPatch.context() as patch:
            intercept(patch.setattr, at_call)
            slow = store.publish(RECORD, output, {"command": ["irl", "train-airl"]})
        assert store.verify(store.ids()).damaged == {}
        if won is None:
            break
        # The first claim holds the key, both processes report it, and both results are kept.
        holder = store.find(RECORD.key)
        assert holder is not None
        assert holder in (slow.artefact, slow.diverged)
        assert holder in (won.artefact, won.diverged)
        assert {slow.artefact.id, won.artefact.id} == set(store.ids())
    assert n > 25


def test_many_processes_publish_at_once(tmp_path):
    """Half of them with different bytes: one holds the key, and nothing is partial or lost."""
    store = Store(_created(tmp_path / "runs"))
    children = []
    for i in range(6):
        pid = os.fork()
        if pid == 0:
            code = 99
            try:
                files = FILES if i % 2 else {**FILES, "reward.pt": b"other"}
                with store.working_on(RECORD.key, wait=True) as scratch:
                    output = scratch.new_output()
                    for name, data in files.items():
                        (output / name).parent.mkdir(exist_ok=True)
                        (output / name).write_bytes(data)
                    store.publish(RECORD, output, {"command": ["irl", "train-airl"]})
                code = 0
            finally:
                os._exit(code)
        children.append(pid)
    assert [os.waitpid(pid, 0)[1] for pid in children] == [0] * 6
    assert len(store.ids()) == 2
    assert store.verify(store.ids()).damaged == {}
    found = store.find(RECORD.key)
    assert found is not None and found.id in store.ids()


def test_a_file_system_without_hard_links_is_refused_before_the_work(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patch:
        patch.setattr(os, "link", refuse)
        for _ in range(2):
            with pytest.raises(
                StageFailed, match="is on a file system without hard links"
            ) as caught:
                Store(tmp_path / "runs").create()
            assert "--store" in caught.value.hint
    store = Store(tmp_path / "runs")
    store.create()
    assert [p.name for p in (store.root / ".locks").iterdir()] == ["gc"]


def test_what_is_published_again_leaves_the_first_as_it_is(tmp_path):
    """It may be another user's, killed between its rename and its claim."""
    store = Store(_created(tmp_path / "runs"))
    first = attempt(store).artefact
    (store.root / ".keys" / RECORD.key).unlink()
    first.directory.chmod(0o755)
    again = attempt(store)
    assert again.artefact.id == first.id and again.diverged is None
    assert first.directory.stat().st_mode & 0o777 == 0o755
    assert store.find(RECORD.key) is not None
