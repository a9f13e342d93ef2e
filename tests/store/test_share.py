"""Push and pull: whole artefacts with their lineage, to and from directories and URLs."""

from __future__ import annotations

import http.server
import json
import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import fsspec
import msgspec
import pytest
from every_step import counter, in_child, intercept, kill_self

from irlcli.errors import IntegrityError, StageFailed
from irlcli.experiments.status import Lookup
from irlcli.stages.base import Request, Stage
from irlcli.store import Artefact, Store
from irlcli.store import remote as remotes
from irlcli.store.remote import Remote
from irlcli.store.share import Shared, share
from irlcli.store.sources import open_place

FILES = {"nested/g": b"PAR1" * 64, "empty": b""}


@pytest.fixture
def store(empty_store) -> Store:
    return empty_store


@pytest.fixture
def chain(store, publish) -> dict[str, Artefact]:
    """``demos`` was made from ``expert``, and ``airl`` from ``demos``; the last two have names."""
    made: dict[str, Artefact] = {}
    parent = None
    for name in ("expert", "demos", "airl"):
        inputs = {"input": parent.output("f").sha256} if parent else {}
        places = {"input": f"{parent.id}/f"} if parent else {}
        parent = publish(
            store,
            {**FILES, "f": name.encode()},
            parameters={"of": name},
            inputs=inputs,
            places=places,
        ).artefact
        made[name] = parent
    store.set_name("demos", made["demos"])
    store.set_name("irm-0", made["airl"])
    return made


@pytest.fixture
def url(tmp_path) -> Iterator[str]:
    """A place in memory."""
    yield f"memory://{tmp_path.name}/lab"
    fsspec.filesystem("memory").rm(f"/{tmp_path.name}", recursive=True)


@pytest.fixture(scope="module")
def s3_server() -> Iterator[str]:
    """The address of an S3 server."""
    server = pytest.importorskip("moto.server", reason="moto is not installed")
    pytest.importorskip("s3fs")
    import logging

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running = server.ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    yield f"http://{host}:{port}"
    running.stop()


@pytest.fixture
def bucket(s3_server, monkeypatch, tmp_path) -> str:
    """The URL of a new bucket."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3_server)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "somebody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    name = tmp_path.name.replace("_", "-")[-40:].strip("-")
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir(name)
    return f"s3://{name}"


@pytest.fixture(params=["directory", "folders", "memory", "s3"])
def place(request, tmp_path) -> str:
    """A place to push to; ``folders`` have to be made before a file is written, as by sftp."""
    if request.param == "directory":
        return str(tmp_path / "there")
    if request.param == "folders":
        return f"local://{tmp_path}/there"
    if request.param == "memory":
        return request.getfixturevalue("url")
    return request.getfixturevalue("bucket") + "/lab"


def copy(source, target, *artefacts: Artefact, warn=pytest.fail) -> Shared:
    return share(source, target, artefacts, warn, lambda count, total: lambda number: None)


def push(store: Store, url: str, *artefacts: Artefact) -> Shared:
    return copy(store, open_place(url, pytest.fail), *artefacts)


def pull(url: str, store: Store, ref: str, warn=pytest.fail) -> Shared:
    there = open_place(url, warn)
    return copy(there, store, there.resolve(ref).artefact, warn=warn)


def files_of(artefact: Artefact) -> dict[str, bytes]:
    paths = [path for path in artefact.directory.rglob("*") if path.is_file()]
    return {p.relative_to(artefact.directory).as_posix(): p.read_bytes() for p in paths}


def other(tmp_path: Path) -> Store:
    return Store(tmp_path / "other", pytest.fail)


# What arrives


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
    assert theirs.verify(theirs.ids()) == {} and theirs.names() == store.names()
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
    assert Store(tmp_path).verify(Store(tmp_path).ids()) == {}


def test_directories_and_urls_in_the_environment(monkeypatch):
    from irlcli.cli.options import _places

    text = "zoo:/data/runs:s3://bucket/lab:https://host:8080/a/b:zoo 2"
    assert _places(text) == [
        "zoo",
        "/data/runs",
        "s3://bucket/lab",
        "https://host:8080/a/b",
        "zoo 2",
    ]
    assert _places("") == []


@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_a_name_never_moves(irl, store, chain, place, publish, tmp_path):
    push(store, place, chain["airl"])
    theirs = other(tmp_path)
    own = publish(theirs, {"f": b"own"}, parameters={"of": "own"}).artefact
    theirs.set_name("demos", own)
    pulled = irl("pull", "irm-0", "--from", place, "--store", theirs.root)
    assert pulled.code == 0
    assert f"'demos' was not copied: in {theirs.root} it names {own.id}" in pulled.err
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


# What is damaged or missing


def memory() -> fsspec.AbstractFileSystem:
    return fsspec.filesystem("memory")


def at(url: str, artefact: Artefact, name: str) -> str:
    return f"/{url.removeprefix('memory://')}/{artefact.id}/{name}"


def flip(path: str) -> None:
    data = memory().cat_file(path)
    memory().pipe_file(path, data[:-1] + bytes([data[-1] ^ 1]))


def longer(path: str) -> None:
    memory().pipe_file(path, memory().cat_file(path) + b"!")


def emptied(path: str) -> None:
    memory().pipe_file(path, b"")


@pytest.mark.parametrize("name", ["f", "nested/g", "manifest.json", "provenance.json"])
@pytest.mark.parametrize("damage", [flip, longer, emptied])
@pytest.mark.parametrize("which", ["expert", "airl"])
def test_damage_there_is_named_and_not_published(
    irl, store, chain, url, tmp_path, name, damage, which
):
    push(store, url, chain["airl"])
    damage(at(url, chain[which], name))
    result = irl("pull", chain["airl"].id, "--from", url, "--store", tmp_path / "other")
    assert result.code == 4 and f"{url}/{chain[which].id}/{name}" in result.err, result.err
    theirs = other(tmp_path)
    assert not {chain[which].id, chain["airl"].id} & set(theirs.ids())
    assert theirs.verify(theirs.ids()) == {}
    # A push repairs what it can see: the size of what the manifest lists, and of the manifest.
    if damage is not flip and name != "provenance.json":
        push(store, url, chain["airl"])
        assert len(pull(url, theirs, "irm-0").copied) > 0
        assert set(theirs.ids()) == {a.id for a in chain.values()}


def test_a_damaged_artefact_here_is_not_pushed(irl, store, chain, url):
    path = chain["demos"].directory / "f"
    path.chmod(0o644)
    path.write_bytes(b"DEMOS")
    result = irl("push", "irm-0", "--to", url, "--store", store.root)
    assert result.code == 4 and str(path) in result.err
    assert list(Remote(url, pytest.fail).index().artefacts) == [chain["expert"].id]


def test_a_damaged_artefact_here_replaces_nothing_there(store, chain, url):
    push(store, url, chain["expert"])
    memory().rm(at(url, chain["expert"], "nested/g"))
    path = chain["expert"].directory / "f"
    path.chmod(0o644)
    path.write_bytes(b"EXPERT")
    with pytest.raises(IntegrityError, match="differs"):
        push(store, url, chain["expert"])
    assert memory().cat_file(at(url, chain["expert"], "f")) == b"expert"


def test_what_changes_on_the_way_is_not_visible(store, chain, url, monkeypatch):
    monkeypatch.setattr(remotes.Remote, "read", lambda *_: iter([b"other"]))
    with pytest.raises(IntegrityError, match="differs"):
        push(store, url, chain["expert"])
    assert Remote(url, pytest.fail).index().artefacts == {}


@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_a_missing_ancestor_is_named(store, chain, place, tmp_path):
    push(store, place, chain["airl"])
    fsspec.core.url_to_fs(place)[0].rm(f"{place}/{chain['demos'].id}", recursive=True)
    warnings: list[str] = []
    pull(place, other(tmp_path), "irm-0", warnings.append)
    assert other(tmp_path).ids() == [chain["airl"].id]
    lost = f"{chain['demos'].id} is missing in {place}: {chain['airl'].id} was made from it"
    assert warnings == [lost]


# Hostile places


def planted(url: str, artefact: Artefact, **changes: object) -> None:
    path = at(url, artefact, "manifest.json")
    value = {**json.loads(memory().cat_file(path)), **changes}
    memory().pipe_file(path, json.dumps(value, sort_keys=True, indent=1).encode() + b"\n")


@pytest.mark.parametrize("path", ["../../evil", "/tmp/evil", "a/../../b", "manifest.json", "x\x1b"])
def test_no_path_leads_out_of_an_artefact(irl, store, chain, url, tmp_path, path):
    push(store, url, chain["expert"])
    planted(url, chain["expert"], outputs=[{"path": path, "size": 1, "sha256": "0" * 64}])
    result = irl("pull", chain["expert"].id, "--from", url, "--store", tmp_path / "new" / "runs")
    assert result.code == 4 and f"{url}/{chain['expert'].id}/manifest.json" in result.err
    assert not (tmp_path / "new").exists()


def test_only_outputs_are_taken(store, chain, url, tmp_path):
    """No checkpoint, no unlisted file, no odd name, no pointer to another place."""
    push(store, url, chain["expert"])
    root, key = f"/{url.removeprefix('memory://')}", chain["expert"].manifest.record.key
    for name in (f".work/{key}/checkpoint", f"{chain['expert'].id}/code.py", "0" * 15 + "g/x"):
        memory().pipe_file(f"{root}/{name}", b"cos\nsystem\n(S'touch evil'\ntR.")
    for name, text in {
        "ok": "../../x",
        "a b": chain["expert"].id,
        "abc": chain["expert"].id,
    }.items():
        memory().pipe_file(f"{root}/.names/{name}", text.encode())
    memory().pipe_file(f"{root}/.keys/{'0' * 64}", chain["expert"].id.encode())
    theirs = other(tmp_path)
    assert Remote(url, pytest.fail).peek("0" * 64) == (None, None)
    pull(url, theirs, chain["expert"].id)
    assert files_of(theirs.get(chain["expert"].id)) == files_of(chain["expert"])
    assert theirs.ids() == [chain["expert"].id] and theirs.names() == {}
    assert not theirs.has_checkpoint(key)


# Places that cannot be used


@pytest.mark.parametrize(
    ("place", "code", "words"),
    [
        ("nope://bucket/x", 2, "'nope' is unknown"),
        ("memory://nothing-here", 3, "is not a store"),
        ("zoo-of-nobody", 3, "is not a store"),
        ("", 2, "--from"),
    ],
)
def test_a_place_that_is_no_store(irl, tmp_path, place, code, words):
    result = irl("pull", "irm-0", "--from", place, "--store", tmp_path / "runs")
    error, hint = result.err.splitlines()
    assert result.code == code and words in error and hint.startswith("hint: ")
    assert not (tmp_path / "runs").exists()


def test_a_bucket_that_cannot_be_used(irl, store, chain, bucket, monkeypatch):
    def said(place: str) -> tuple[int, str]:
        result = irl("push", "irm-0", "--to", place, "--store", store.root)
        error, hint = result.err.splitlines()[-2:]
        assert hint.startswith("hint: ")
        return result.code, error

    code, error = said("s3://nobody/x")
    assert code == 3 and "bucket does not exist" in error
    code, error = said("s3://Not%valid/x")
    assert code == 2 and "not a valid URL" in error
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent")
    code, error = said(bucket)
    assert code == 2 and "no credentials" in error


def test_files_that_are_no_store_are_left_alone(irl, store, chain, url):
    memory().pipe_file(f"/{url.removeprefix('memory://')}/thesis.tex", b"x")
    result = irl("push", "irm-0", "--to", url, "--store", store.root)
    assert result.code == 4 and "not a store" in result.err
    assert result.err.endswith("hint: name a store, or an empty or new place\n")
    assert memory().ls(f"/{url.removeprefix('memory://')}", detail=False)[1:] == []


def test_an_empty_folder_of_a_bucket_can_be_pushed_to(store, chain, bucket):
    """Consoles make one as an object whose name ends in a slash."""
    fsspec.filesystem("s3").call_s3("put_object", Bucket=bucket[5:], Key="lab/", Body=b"")
    assert len(push(store, f"{bucket}/lab", chain["airl"]).copied) == 3


def test_a_web_server_needs_ranges_for_large_files(store, chain, tmp_path, monkeypatch):
    pytest.importorskip("aiohttp")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Quiet, directory=str(store.root))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}"
    assert len(pull(url, other(tmp_path), "demos").copied) == 2
    monkeypatch.setattr(remotes, "_CHUNK", 3)
    with pytest.raises(StageFailed, match="range"):
        pull(url, Store(tmp_path / "third", pytest.fail), "demos")
    server.shutdown()
    server.server_close()


def test_an_unknown_reference_names_the_place(irl, store, chain, url, tmp_path):
    push(store, url, chain["airl"])
    result = irl("pull", "imr-0", "--from", url, "--store", tmp_path / "new")
    assert result.code == 3 and url in result.err and f"irl ls --from {url}" in result.err


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
                assert files_of(store.get(artefact.id))["f"] == memory().cat_file(
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
        assert Store(theirs.root).verify(Store(theirs.root).ids()) == {}
        pull(url, theirs, "irm-0")
        assert theirs.ids() == store.ids() and theirs.names() == store.names()
        assert list((theirs.root / ".work").iterdir()) == []
        assert all(theirs.find(a.manifest.record.key) for a in chain.values())
        if ended:
            break
    assert limit > 100


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
