"""Push and pull: whole artefacts with their lineage, to and from directories and URLs."""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path

import msgspec
import pytest
from every_step import counter, in_child, intercept, kill_self
from places import at, files_of, memory, other, pull, push

from irlcli.cli.options import sources_of_environment
from irlcli.errors import Busy
from irlcli.experiments.status import Lookup
from irlcli.stages.base import Request, Stage
from irlcli.store import Store
from irlcli.store.remote import Remote
from irlcli.store.share import share
from irlcli.store.sources import open_place


def test_a_colleague_gets_the_artefact_its_lineage_and_names(irl, store, chain, place, tmp_path):
    pushed = irl("push", "irm-0", "--to", place, "--store", store.root, "--json", "--quiet")
    assert (pushed.code, pushed.err) == (0, "")
    assert set(json.loads(pushed.out)["copied"]) == {a.id for a in chain.values()}
    listed = irl("ls", "--from", place, "--store", tmp_path / "none").out
    assert all(a.id in listed for a in chain.values()) and "irm-0" in listed
    elsewhere = tmp_path / "elsewhere"
    pulled = irl("pull", chain["airl"].id[:6], "--from", place, "--store", elsewhere)
    assert (pulled.code, pulled.out) == (0, f"{elsewhere}/{chain['airl'].id}\n"), pulled.err
    theirs = Store(elsewhere)
    assert theirs.verify(theirs.ids()).damaged == {} and theirs.names() == store.names()
    for artefact in chain.values():
        found = theirs.find(artefact.manifest.record.key)
        assert files_of(found) == files_of(artefact)
    assert list((elsewhere / ".work").iterdir()) == []


def test_what_is_there_is_skipped(store, chain, place, tmp_path):
    assert [a.id for a in push(store, place, chain["demos"]).copied] == [
        chain["expert"].id,
        chain["demos"].id,
    ]
    again = push(store, place, chain["airl"])
    assert [a.id for a in again.copied] == [chain["airl"].id] and len(again.present) == 2
    theirs = other(tmp_path)
    assert len(pull(place, theirs, "demos").copied) == 2
    assert [a.id for a in pull(place, theirs, "irm-0").copied] == [chain["airl"].id]
    assert pull(place, theirs, "irm-0").copied == []


def test_what_a_url_has_is_not_computed_again(irl, smoke_store, bucket, tmp_path):
    """And all of a store is pushed with ``--all``."""
    place = f"{bucket}/lab"
    pushed = irl("push", "--all", "--to", place, "--store", smoke_store.path, "--json")
    assert pushed.code == 0, pushed.err
    line = ["collect-experts", "--env", "lunar-lander", "--profile", "smoke", "--store", tmp_path]
    line += ["--intervention", "engine-power=1x,1.25x", "--from", place]
    planned = irl(*line, "--dry-run")
    assert planned.code == 0 and f"in {place}" in planned.out and "RUN" not in planned.out
    result = irl(*line)
    assert result.code == 0 and "RUN " not in result.err, result.err
    assert Path(result.out.strip()).name == smoke_store.demos
    assert Store(tmp_path).verify(Store(tmp_path).ids()).damaged == {}


def test_directories_and_urls_in_the_environment(monkeypatch):
    monkeypatch.setenv("IRL_FROM", "zoo:/data/runs:s3://bucket/lab:https://host:8080/a/b:zoo 2")
    assert sources_of_environment() == [
        "zoo",
        "/data/runs",
        "s3://bucket/lab",
        "https://host:8080/a/b",
        "zoo 2",
    ]
    monkeypatch.setenv("IRL_FROM", "")
    assert sources_of_environment() == []


@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_a_name_never_moves(irl, store, chain, place, publish, tmp_path):
    push(store, place, chain["airl"])
    theirs = other(tmp_path)
    own = publish(theirs, {"f": b"own"}, parameters={"of": "own"}).artefact
    theirs.set_name("demos", own)
    pulled = irl("pull", "irm-0", "--from", place, "--store", theirs.root)
    assert pulled.code == 0
    assert f"{theirs.root} already uses the name 'demos' for {own.id}" in pulled.err
    assert theirs.names() == {"demos": own.id, "irm-0": chain["airl"].id}
    # Nor does that of the place, when the other store is pushed to it.
    assert push(theirs, place, own).taken == {"demos": chain["demos"].id}


@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_another_result_of_the_same_request_is_kept_beside(
    irl, store, chain, place, publish, tmp_path
):
    theirs = other(tmp_path)
    own = publish(theirs, {"f": b"own"}, parameters={"of": "expert"}).artefact
    push(theirs, place, own)
    pushed = irl("push", "irm-0", "--to", place, "--store", store.root)
    assert f"{chain['expert'].id} is kept beside {own.id}" in pushed.err
    pulled = irl("pull", "irm-0", "--from", place, "--store", theirs.root)
    assert f"{chain['expert'].id} is kept beside {own.id}" in pulled.err
    assert theirs.find(own.manifest.record.key) == own
    assert set(theirs.ids()) == {own.id, *store.ids()}


def test_a_file_of_what_was_found_behind_a_url(store, publish, url, tmp_path):
    """What a plan has to read, such as the lambda that was chosen."""

    class Parameters(msgspec.Struct, frozen=True):
        of: str = "choice"

    made = publish(store, {"choice.json": b"{}"}, parameters={"of": "choice"}).artefact
    push(store, url, made)
    request = Request(Stage("train-airl", 1, print), Parameters(), {}, "choice")
    lookup = Lookup(other(tmp_path), [Remote(url, pytest.fail)])
    assert lookup(request).status == "FOUND" and lookup(request).artefact.provenance()
    assert lookup.file(request, "choice.json").read_bytes() == b"{}"
    assert Lookup(store).file(request, "choice.json") == made.directory / "choice.json"
    assert Lookup(other(tmp_path)).file(request, "choice.json") is None


def test_an_ancestor_that_the_provenance_does_not_lead_to_is_found_by_content(
    empty_store, publish, url, tmp_path
):
    expert, stranger = (
        publish(empty_store, {"f": name}, parameters={"of": name.decode()}).artefact
        for name in (b"expert", b"stranger")
    )
    demos = publish(
        empty_store,
        inputs={"expert": expert.output("f").sha256},
        places={"expert": f"{stranger.id}/f"},
    ).artefact
    push(empty_store, url, demos, stranger)
    pulled = pull(url, other(tmp_path), demos.id)
    assert [a.id for a in pulled.copied] == [expert.id, demos.id]


def test_a_file_url_is_a_store_on_disk(store, chain, tmp_path):
    url = f"file://{tmp_path}/there"
    assert isinstance(open_place(url, pytest.fail), Store)
    push(store, url, chain["airl"])
    there = Store(tmp_path / "there", pytest.fail)
    assert there.ids() == store.ids() and not there.verify(there.ids()).damaged


# Interruptions


def test_a_killed_push_shows_nothing_and_is_repeated(store, chain, url, monkeypatch):
    """Stopped at each write in turn; the file at hand is left half written."""

    def stopped_after(limit: int) -> bool:
        left = limit

        def write(self: Remote, name: str, data: bytes) -> None:
            nonlocal left
            left -= 1
            memory().pipe_file(self._at(name), data if left >= 0 else data[: len(data) // 2])
            if left < 0:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(Remote, "_write", write)
            try:
                push(store, url, chain["airl"])
            except KeyboardInterrupt:
                return True
        return False

    for limit in range(99):
        memory().store.clear()
        memory().pseudo_dirs[:] = [""]
        stopped = stopped_after(limit)
        if limit > 0:  # the marker itself is half written before
            warnings: list[str] = []
            for artefact in Remote(url, warnings.append).index().artefacts.values():
                assert files_of(store.resolve(artefact.id).artefact)["f"] == memory().cat_file(
                    at(url, artefact, "f")
                )
            push(store, url, chain["airl"])
            there = Remote(url, pytest.fail)
            assert set(there.index().artefacts) == {a.id for a in chain.values()}
            assert there.names() == store.names()
            assert all(there.peek(a.manifest.record.key).artefact for a in chain.values())
        if not stopped:
            break
    assert limit > 10


def test_a_killed_pull_publishes_whole_artefacts_and_is_repeated(store, chain, url, tmp_path):
    """Killed at every 61st call that changes a file; the memory of the child has the place."""
    push(store, url, chain["airl"])
    for limit in range(0, 999, 61):
        theirs = Store(tmp_path / f"runs{limit}", pytest.fail)

        def killed(root: Path = theirs.root, limit: int = limit) -> None:
            intercept(setattr, counter(limit, kill_self))
            pull(url, Store(root), "irm-0")

        ended = not os.WIFSIGNALED(in_child(killed))
        assert Store(theirs.root).verify(Store(theirs.root).ids()).damaged == {}
        pull(url, theirs, "irm-0")
        assert theirs.ids() == store.ids() and theirs.names() == store.names()
        assert list((theirs.root / ".work").iterdir()) == []
        assert all(theirs.find(a.manifest.record.key) for a in chain.values())
        if ended:
            break
    assert limit > 100


def test_a_path_of_the_default_store_names_the_same_behind_a_url(store, chain, url):
    push(store, url, chain["airl"])
    for ref in ("irm-0", chain["airl"].id, f"runs/{chain['airl'].id}"):
        assert open_place(url, pytest.fail).resolve(ref).artefact.id == chain["airl"].id


def test_gc_at_the_destination_waits_for_a_push(store, chain, tmp_path):
    there, collected = other(tmp_path), []

    def advance(number):
        with pytest.raises(Busy):
            collected.append(Store(there.root).collect(-1.0))

    share(store, there, [chain["airl"]], pytest.fail, lambda count, total: advance)
    assert len(there.ids()) == 3 and not collected


def test_a_push_waits_for_gc_at_the_destination(store, chain, tmp_path):
    there, said = other(tmp_path), []
    there.create()
    with open(there.root / ".locks" / "gc", "a") as file:

        def warn(text: str) -> None:
            said.append(text)
            fcntl.flock(file, fcntl.LOCK_UN)

        fcntl.flock(file, fcntl.LOCK_EX)
        share(store, there, [chain["airl"]], warn, lambda count, total: lambda number: None)
    assert len(there.ids()) == 3 and "waiting" in said[0]


def test_two_pushes_at_once(store, chain, url, monkeypatch):
    """The second one starts and ends while the first writes each of its files."""
    write, active = Remote._write, False

    def interrupted(self: Remote, name: str, data: bytes) -> None:
        nonlocal active
        if not active:
            active = True
            push(store, url, chain["airl"])
            active = False
        write(self, name, data)

    monkeypatch.setattr(Remote, "_write", interrupted)
    push(store, url, chain["airl"])
    there = Remote(url, pytest.fail)
    assert set(there.index().artefacts) == {a.id for a in chain.values()}
    assert there.names() == store.names()


def test_a_lost_connection_is_one_line(irl, store, chain, url, tmp_path, monkeypatch):
    push(store, url, chain["airl"])

    def lost(*_: object, **__: object) -> bytes:
        raise ConnectionResetError("reset by peer")

    monkeypatch.setattr(type(memory()), "cat_file", lost)
    result = irl("pull", "irm-0", "--from", url, "--store", tmp_path / "new")
    error, hint = result.err.splitlines()[-2:]
    assert result.code == 1 and url in error and "reset by peer" in error
    assert "run the same command again" in hint
