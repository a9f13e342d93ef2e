"""Push and pull where something is wrong: damage, hostile files, places that cannot be used."""

from __future__ import annotations

import http.server
import json
import shlex
import threading
from functools import partial
from pathlib import Path

import fsspec
import pytest
from places import at, files_of, memory, other, pull, push

from irlcli.errors import IntegrityError, StageFailed, UsageError
from irlcli.store import Artefact, Store
from irlcli.store import remote as remotes
from irlcli.store.remote import Remote
from irlcli.store.remote_errors import explained

# What is damaged or missing


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
    assert theirs.verify(theirs.ids()).damaged == {}
    # A push repairs what it can see: the size of what the manifest lists, and of the manifest.
    if damage is not flip and name != "provenance.json":
        push(store, url, chain["airl"])
        assert len(pull(url, theirs, "irm-0").copied) > 0
        assert set(theirs.ids()) == {a.id for a in chain.values()}


@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_a_damaged_manifest_there_leaves_the_others(irl, store, chain, place, tmp_path):
    push(store, place, *chain.values())
    if "://" in place:
        emptied(at(place, chain["airl"], "manifest.json"))
    else:
        manifest = Path(place) / chain["airl"].id / "manifest.json"
        manifest.chmod(0o644)
        manifest.write_bytes(b"")
    listed = irl("ls", "--from", place)
    assert listed.code == 0 and chain["demos"].id in listed.out and chain["airl"].id in listed.err
    pulled = irl("pull", "--all", "--from", place, "--store", tmp_path / "other")
    assert pulled.code == 4 and pulled.err.count(f"{chain['airl'].id}/manifest.json") == 1
    assert set(other(tmp_path).ids()) == {chain["expert"].id, chain["demos"].id}
    refused = irl("pull", chain["airl"].id, "--from", place, "--store", tmp_path / "other")
    assert refused.code == 4, refused.err
    if "://" in place:
        assert f"hint: remove what is damaged in {place}" in refused.err
        return
    hinted = refused.err.split("hint: `irl ")[1].split("`")[0]
    assert irl(*shlex.split(hinted)).code == 4 and not manifest.exists()


def test_an_unfinished_push_there_is_no_damage(irl, store, chain, url, tmp_path):
    push(store, url, *chain.values())
    memory().rm(at(url, chain["airl"], "manifest.json"))
    pulled = irl("pull", "--all", "--from", url, "--store", tmp_path / "other")
    assert pulled.code == 0, pulled.err
    assert set(other(tmp_path).ids()) == {chain["expert"].id, chain["demos"].id}


@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_an_artefact_of_a_newer_schema_there_is_listed_as_such(irl, store, chain, place):
    push(store, place, *chain.values())
    newer = chain["airl"].id
    if "://" in place:
        memory().pipe_file(at(place, chain["airl"], "manifest.json"), b'{"schema": 2}')
    else:
        manifest = Path(place) / newer / "manifest.json"
        manifest.chmod(0o644)
        manifest.write_bytes(b'{"schema": 2}')
    listed = irl("ls", "--json", "--from", place)
    assert json.loads(listed.out)["newer"] == [newer]
    assert f"skipping artefact {newer}: {place}/{newer}/manifest.json" in listed.err
    assert "upgrade irlcli" in listed.err


@pytest.mark.parametrize("damaged", ["manifest.json", "f"])
@pytest.mark.parametrize("place", ["directory", "memory"], indirect=True)
def test_what_was_made_from_a_damaged_artefact_is_left_out_of_all(
    irl, store, chain, place, publish, tmp_path, damaged
):
    other_expert = publish(store, parameters={"seed": 9}).artefact
    store.set_name("other", other_expert)
    push(store, place, *chain.values(), other_expert)
    if "://" in place:
        emptied(at(place, chain["demos"], damaged))
    else:
        file = Path(place) / chain["demos"].id / damaged
        file.chmod(0o644)
        file.write_bytes(b"")
    pulled = irl("pull", "--all", "--from", place, "--store", tmp_path / "other")
    assert pulled.code == 4 and f"skipping artefact {chain['airl'].id}" in pulled.err
    assert f"2 artefacts of {place} not copied" in pulled.err
    assert other(tmp_path).names() == {"other": other_expert.id}
    assert set(other(tmp_path).ids()) == {chain["expert"].id, other_expert.id}
    assert {Path(line).name for line in pulled.out.split()} == set(other(tmp_path).ids())


def test_a_damaged_manifest_here_leaves_the_others(irl, store, chain, tmp_path):
    manifest = chain["airl"].directory / "manifest.json"
    manifest.chmod(0o644)
    manifest.write_bytes(b"")
    pushed = irl("push", "--all", "--to", tmp_path / "other", "--store", store.root)
    assert pushed.code == 4 and chain["airl"].id in pushed.err
    assert set(other(tmp_path).ids()) == {chain["expert"].id, chain["demos"].id}
    # It is still there, for `irl verify` to report.
    assert manifest.exists()


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
    assert files_of(theirs.resolve(chain["expert"].id).artefact) == files_of(chain["expert"])
    assert theirs.ids() == [chain["expert"].id] and theirs.names() == {}
    assert not theirs.has_checkpoint(key)


# Places that cannot be used


@pytest.mark.parametrize(
    ("place", "code", "words"),
    [
        ("nope://bucket/x", 2, "'nope' is unknown"),
        ("memory://nothing-here", 3, "is not a store"),
        ("zoo-of-nobody", 3, "is not a store"),
        ("s3:/bucket/x", 2, "one slash"),
    ],
)
def test_a_place_that_is_no_store(irl, tmp_path, place, code, words):
    result = irl("pull", "irm-0", "--from", place, "--store", tmp_path / "runs")
    error, hint = result.err.splitlines()
    assert result.code == code and words in error and hint.startswith("hint: ")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("place", "example"),
    [
        ("s3://", "s3://BUCKET/PATH"),
        ("s3:///", "s3://BUCKET/PATH"),
        ("memory://", "memory://BUCKET/PATH"),
        ("file://", "file:///PATH"),
    ],
)
def test_a_url_of_nothing_is_no_directory(irl, store, chain, tmp_path, monkeypatch, place, example):
    """`s3://$BUCKET` with an empty variable."""
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.iterdir())
    for line in (("push", "irm-0", "--to"), ("pull", "irm-0", "--from"), ("ls", "--from")):
        result = irl(*line, place, "--store", store.root)
        assert result.code == 2 and f"{place} names no bucket or path" in result.err, result.err
        assert example in result.err
    result = irl("push", "irm-0", "--to", place, "--store", tmp_path / "none")
    assert result.code == 2 and example in result.err, result.err
    assert set(tmp_path.iterdir()) == before


def test_a_protocol_that_needs_more_than_a_url_is_bad_usage():
    error = TypeError("GithubFileSystem.__init__() missing 2 required positional arguments")
    assert isinstance(explained(error, "github://x"), UsageError)
    assert isinstance(explained(TypeError("a bug"), "github://x"), StageFailed)


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


@pytest.mark.parametrize("option", ["push --to", "pull --from"])
def test_a_store_is_not_copied_to_itself(irl, store, chain, option):
    command, place = option.split()
    # The same directory by another path.
    itself = store.root.parent / "." / store.root.name / ".." / store.root.name
    result = irl(command, "irm-0", place, itself, "--store", store.root)
    assert result.code == 2 and "itself" in result.err and not result.out


def test_files_that_are_no_store_are_left_alone(irl, store, chain, url):
    memory().pipe_file(f"/{url.removeprefix('memory://')}/thesis.tex", b"x")
    result = irl("push", "irm-0", "--to", url, "--store", store.root)
    assert result.code == 2 and "not a store" in result.err
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


# What the command line names


@pytest.mark.parametrize("line", [["push", "irm-0", "--to"], ["pull", "irm-0", "--from"]])
def test_a_place_without_a_name_is_refused(irl, store, chain, line, tmp_path, monkeypatch):
    """An unset variable of the shell, say. The current directory is not meant."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    result = irl(*line, "", "--store", store.root)
    assert result.code == 2 and "empty" in result.err and not any(Path().iterdir())
    assert irl(*line[:-1], "--store", store.root).code == 2


def test_a_file_is_no_artefact_to_push_or_pull(irl, store, chain, tmp_path):
    file, there = tmp_path / "README.md", tmp_path / "there"
    file.touch()
    pushed = irl("push", file, "--to", there, "--store", store.root)
    assert pushed.code == 3 and "is a file, not an artefact of the store" in pushed.err
    assert "irl ls" in pushed.err.partition("hint: ")[2]
    push(store, str(there), chain["airl"])
    pulled = irl("pull", file, "--from", there, "--store", tmp_path / "other")
    assert pulled.code == 3 and f"irl ls --from {there}" in pulled.err.partition("hint: ")[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [(("irm-0", "--all"), "REF and --all are both given"), ((), "name artefacts, or give --all")],
)
def test_either_artefacts_or_all_are_named(irl, store, chain, tmp_path, words, message):
    done = irl("push", *words, "--to", tmp_path / "there", "--store", store.root)
    assert done.code == 2 and message in done.err and "hint: " in done.err
