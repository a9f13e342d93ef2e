"""Leases with a heartbeat: who works on what, seen from other machines."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys
import time

import pytest

from irlcli.errors import Busy
from irlcli.store import Store, durable, lease
from irlcli.store import store as store_module

KEY = "0" * 64


def foreign(path, seconds_ago=0.0, host="another-node", machine="another", process=1):
    """A lease as another machine writes it."""
    said = {"host": host, "machine": machine, "process": process, "token": "t"}
    path.write_text(json.dumps(said))
    os.utime(path, (time.time() - seconds_ago,) * 2)
    return path


@pytest.fixture
def leases(empty_store):
    return empty_store.root / ".locks"


def work(store, **options):
    with store.working_on(KEY, **{"wait": False, **options}):
        pass


def test_another_machine_at_work_is_busy(empty_store, leases):
    path = foreign(leases / f"{KEY}.claim")
    with pytest.raises(Busy, match="process 1 on another-node"):
        work(empty_store)
    path.unlink()
    work(empty_store)


def test_a_lease_without_a_heartbeat_is_taken_over(empty_store, leases):
    foreign(leases / f"{KEY}.claim", lease.STALE_SECONDS - 10)
    with pytest.raises(Busy):
        work(empty_store)
    foreign(leases / f"{KEY}.claim", lease.STALE_SECONDS + 1)
    with empty_store.working_on(KEY, wait=False):
        holder = lease.read(leases / f"{KEY}.claim")
        assert (holder.host, holder.process) == (os.uname().nodename, os.getpid())
    assert lease.read(leases / f"{KEY}.claim") is None


def test_a_dead_process_of_this_machine_is_replaced_at_once(empty_store, leases):
    foreign(leases / f"{KEY}.claim", machine=durable.machine(), process=2**22 + 1)
    work(empty_store)


def test_a_container_with_the_same_host_name_is_another_machine(empty_store, leases):
    """Its processes are not seen here."""
    foreign(leases / f"{KEY}.claim", host=os.uname().nodename, process=2**22 + 1)
    with pytest.raises(Busy):
        work(empty_store)


def test_what_other_machines_left_is_removed_after_a_day(empty_store, leases):
    left = [leases / f".x.{2**22 + 1}.{i * 32}.{os.uname().nodename}-other" for i in "ab"]
    for path in left:
        path.touch()
    yesterday = time.time() - 90000.0
    os.utime(left[1], (yesterday, yesterday))
    empty_store.collect(0.0)
    assert [path.exists() for path in left] == [True, False]


def test_waiting_ends_when_the_lease_ends(empty_store, leases, monkeypatch):
    monkeypatch.setattr(lease, "_POLL_SECONDS", 0.01)
    path = foreign(leases / f"{KEY}.claim")
    waited_for = []

    def on_wait(holder):
        waited_for.append(holder)
        path.unlink()

    work(empty_store, wait=True, on_wait=on_wait)
    assert waited_for == ["process 1 on another-node"]


def test_a_lease_is_kept_alive(empty_store, leases, monkeypatch):
    monkeypatch.setattr(lease, "HEARTBEAT_SECONDS", 0.02)
    with empty_store.working_on(KEY, wait=False):
        path = leases / f"{KEY}.claim"
        os.utime(path, (0, 0))
        limit = time.monotonic() + 10
        while path.stat().st_mtime == 0 and time.monotonic() < limit:
            time.sleep(0.01)
        assert lease.read(path).lives(locks_work=False)


def test_a_lease_that_is_gone_is_created_again(empty_store, leases, monkeypatch):
    """The disk was full when it was created, or another machine took its holder for dead."""
    monkeypatch.setattr(lease, "HEARTBEAT_SECONDS", 0.02)
    with empty_store.working_on(KEY, wait=False):
        path = leases / f"{KEY}.claim"
        path.unlink()
        limit = time.monotonic() + 10
        while lease.read(path) is None and time.monotonic() < limit:
            time.sleep(0.01)
        assert lease.read(path).process == os.getpid()
    time.sleep(0.1)
    assert lease.read(path) is None


def test_the_clock_of_a_machine_does_not_matter(empty_store, leases, monkeypatch):
    path = foreign(leases / f"{KEY}.claim")
    ahead = time.time() + 10 * lease.STALE_SECONDS
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: ahead)
        assert lease.read(path).lives(locks_work=True)


def test_whoever_lost_a_lease_does_not_keep_the_new_one_alive(empty_store, leases, monkeypatch):
    monkeypatch.setattr(lease, "HEARTBEAT_SECONDS", 0.01)
    with empty_store.working_on(KEY, wait=False):
        path = foreign(leases / f"{KEY}.claim", 1000.0)
        before = path.stat().st_mtime
        time.sleep(0.3)
        assert path.stat().st_mtime == before


def test_a_reader_is_seen_before_it_looks_for_gc(empty_store, leases, monkeypatch):
    """gc does the same the other way round, so that one of the two sees the other."""
    seen, original = [], lease.read

    def read(path):
        if path.name == "gc.claim":
            seen.append(len(list(leases.glob(".reader.*"))))
        return original(path)

    monkeypatch.setattr(lease, "read", read)
    with empty_store.in_use():
        pass
    assert seen == [1]


@pytest.mark.parametrize(
    "text", ["[" * 1000, '{"host": "a", "machine": "b", "process": 1e999, "token": "c"}', "7", ""]
)
def test_a_file_that_is_no_lease_ends_no_command(empty_store, leases, text):
    path = leases / f"{KEY}.claim"
    path.write_text(text)
    with pytest.raises(Busy):
        work(empty_store)
    os.utime(path, (0, 0))
    work(empty_store)


def test_a_process_that_cannot_exist_is_dead(empty_store, leases):
    foreign(
        leases / f"{KEY}.claim", host=os.uname().nodename, machine=lease.machine(), process=10**20
    )
    work(empty_store)


def test_a_named_pipe_in_place_of_a_lock_stops_no_command(empty_store):
    path = empty_store.root / ".locks" / "gc"
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    line = [sys.executable, "-P", "-m", "irlcli", "ls", "--store", str(empty_store.root)]
    # Whoever opened the pipe would wait for its other end for ever.
    assert subprocess.run(line, capture_output=True, timeout=120).returncode == 0


def test_whoever_lost_a_lease_leaves_the_new_one_alone(empty_store, leases):
    with empty_store.working_on(KEY, wait=False):
        foreign(leases / f"{KEY}.claim")
    assert lease.read(leases / f"{KEY}.claim").host == "another-node"


def test_gc_waits_for_readers_of_other_machines_and_not_for_dead_ones(empty_store, leases):
    reader = foreign(leases / ".reader.x")
    with pytest.raises(Busy, match="another-node"):
        empty_store.collect(0.0)
    foreign(reader, lease.STALE_SECONDS + 1)
    empty_store.collect(0.0)
    assert not reader.exists() and list(leases.glob("*.claim")) == []


def test_readers_wait_for_gc_on_another_machine(empty_store, leases):
    path = foreign(leases / "gc.claim")
    with pytest.raises(Busy, match="another-node"), empty_store.in_use():
        pass
    foreign(path, lease.STALE_SECONDS + 1)
    with empty_store.in_use():
        pass


def test_gc_keeps_the_scratch_of_a_live_lease(empty_store, leases):
    scratch = empty_store.root / ".work" / KEY
    scratch.mkdir()
    foreign(leases / f"{KEY}.claim")
    assert empty_store.collect(0.0) == ([], [])
    foreign(leases / f"{KEY}.claim", lease.STALE_SECONDS + 1)
    assert empty_store.collect(0.0) == ([], [scratch])
    assert list(leases.glob(f"{KEY}*")) == []


def test_a_lease_that_another_process_took_over_first_is_given_back(
    empty_store, leases, monkeypatch
):
    path = foreign(leases / f"{KEY}.claim", lease.STALE_SECONDS + 1)
    rename = os.rename

    def late(source, target):
        if source == path:
            foreign(path).write_text(path.read_text().replace('"t"', '"new"'))
        rename(source, target)

    monkeypatch.setattr(os, "rename", late)
    with pytest.raises(Busy, match="another-node"):
        work(empty_store)
    assert lease.read(path).token == "new"


@pytest.fixture
def no_locks(monkeypatch):
    """A file system without flock."""

    def refuse(code):
        def flock(*_):
            raise OSError(code, os.strerror(code))

        monkeypatch.setattr(fcntl, "flock", flock)
        monkeypatch.setattr(store_module, "_WITHOUT_LOCKS", set())

    return refuse


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_without_locks_leases_do_their_work(empty_store, publish, no_locks, leases, code):
    no_locks(code)
    said = []
    store = Store(empty_store.root, said.append)
    publish(store)
    publish(store, parameters={"seed": 1})
    assert len(said) == 1 and os.strerror(code) in said[0]
    # This process lives, so its lease holds here too.
    with store.working_on(KEY, wait=False), pytest.raises(Busy):
        work(store)
    with store.in_use(), pytest.raises(Busy):
        store.collect(0.0)
    store.collect(0.0)


def test_a_link_is_no_lease(empty_store, leases, tmp_path):
    (tmp_path / "other").write_text("other")
    (leases / f"{KEY}.claim").symlink_to(tmp_path / "other")
    work(empty_store)
    assert (tmp_path / "other").read_text() == "other"
    assert not os.path.lexists(leases / f"{KEY}.claim")


def test_a_directory_is_no_lease(empty_store, leases):
    for name in (f"{KEY}.claim", "gc.claim", ".reader.x"):
        (leases / name).mkdir()
    with empty_store.in_use():
        work(empty_store)
    empty_store.collect(0.0)
    assert not [path for path in leases.iterdir() if path.is_dir()]


def test_a_full_disk_stops_no_reader(empty_store, monkeypatch):
    def full(path, *_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(lease, "open", full, raising=False)
    monkeypatch.setattr(lease, "read", lambda path: None)
    with empty_store.in_use():
        pass


def test_of_many_processes_one_takes_a_stale_lease_over(empty_store, leases):
    """Without locks, so that the lease alone decides."""
    foreign(leases / f"{KEY}.claim", lease.STALE_SECONDS + 1)
    code = (
        "import fcntl, sys, errno\n"
        "def flock(*_): raise OSError(errno.ENOLCK, '')\n"
        "fcntl.flock = flock\n"
        "from irlcli.errors import Busy\n"
        "from irlcli.store import Store\n"
        "print('ready', flush=True); sys.stdin.readline()\n"
        "try:\n"
        f"    with Store({str(empty_store.root)!r}).working_on({KEY!r}, wait=False):\n"
        "        print('mine', flush=True); sys.stdin.read()\n"
        "except Busy: print('busy', flush=True)\n"
    )
    children = [
        subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(6)
    ]
    assert [child.stdout.readline() for child in children] == ["ready\n"] * 6
    for child in children:
        child.stdin.write("\n")
        child.stdin.flush()
    said = [child.stdout.readline().strip() for child in children]
    for child in children:
        child.communicate()  # which closes its stdin
    assert sorted(said) == ["busy"] * 5 + ["mine"]
