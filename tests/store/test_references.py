"""References: what a user writes finds one artefact or file, or nothing."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.errors import NotFound, UsageError
from irlcli.store import Artefact, Store
from irlcli.store.artefact import recorded_command
from irlcli.store.layout import Layout

DAY = 86400.0


@pytest.fixture
def artefact(empty_store, publish) -> Artefact:
    return publish(empty_store).artefact


# Forms of a reference


@pytest.mark.parametrize("digits", [3, 4, 15, 16, 17, 63, 64])
def test_prefixes_of_at_least_three_digits(empty_store, artefact, digits):
    ref = artefact.manifest.id[:digits]
    assert empty_store.resolve(ref).artefact == artefact
    inside = empty_store.resolve(f"{ref}/reward.pt")
    assert (inside.artefact, inside.output) == (artefact, "reward.pt")


def test_a_store_that_another_process_creates_meanwhile_is_a_store(tmp_path, monkeypatch):
    """Between the look for its marker and the look for other files."""
    root = tmp_path / "runs"
    root.mkdir()
    listed = Path.iterdir

    def meanwhile(path):
        monkeypatch.undo()
        Store(root).create()
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", meanwhile)
    Store(root).create()
    assert (root / "STORE").is_file()


@pytest.mark.parametrize("digits", [0, 1, 2])
def test_shorter_prefixes_name_nothing(empty_store, artefact, digits):
    with pytest.raises(NotFound):
        empty_store.resolve(artefact.id[:digits])


def test_a_long_prefix_that_differs_after_the_directory_name_finds_nothing(empty_store, artefact):
    """The directory name has 16 digits; the other 48 are compared too."""
    last = "0" if artefact.manifest.id[-1] != "0" else "1"
    with pytest.raises(NotFound):
        empty_store.resolve(artefact.manifest.id[:-1] + last)
    with pytest.raises(NotFound):
        empty_store.resolve(artefact.manifest.id + "0")


@pytest.mark.parametrize("rest", ["", "/", "/reward.pt", "/nested/table.parquet"])
@pytest.mark.parametrize("form", ["relative", "absolute", "dotted", "bare", "prefix", "name"])
def test_paths_inside_the_store(empty_store, artefact, monkeypatch, form, rest):
    monkeypatch.chdir(empty_store.root.parent)
    store = Store("runs")
    store.set_name("best", artefact)
    ref = {
        "relative": f"runs/{artefact.id}",
        "absolute": str(empty_store.root / artefact.id),
        "dotted": f"./runs/../runs/{artefact.id}",
        "bare": artefact.id,
        "prefix": f"runs/{artefact.id[:5]}",
        "name": "runs/best",
    }[form]
    found = store.resolve(ref + rest)
    assert found.artefact is not None and found.artefact.manifest == artefact.manifest
    assert found.output == (rest.strip("/") or None)
    assert found.path.exists()


@pytest.mark.parametrize("rest", ["", "/reward.pt"])
@pytest.mark.parametrize(("store", "path"), [("link", "runs"), ("runs", "link")])
def test_a_store_behind_a_link_has_two_names(empty_store, artefact, monkeypatch, store, path, rest):
    monkeypatch.chdir(empty_store.root.parent)
    Path("link").symlink_to(empty_store.root)
    found = Store(store).resolve(os.path.abspath(f"{path}/{artefact.id[:5]}{rest}"))
    assert found.artefact is not None and found.artefact.id == artefact.id
    assert found.output == (rest.strip("/") or None)


def test_from_inside_the_store_directory(empty_store, artefact, monkeypatch):
    monkeypatch.chdir(empty_store.root)
    store = Store(".")
    assert store.resolve(artefact.id[:4]).artefact.id == artefact.id
    assert store.resolve(f"./{artefact.id}/reward.pt").output == "reward.pt"


@pytest.mark.parametrize("head", ["id", "prefix", "name"])
@pytest.mark.parametrize("rest", ["", "/", "/reward.pt", "/nested/table.parquet"])
@pytest.mark.parametrize("start", ["runs/", "./runs/", "runs//"])
def test_a_path_below_runs_finds_the_artefact_in_any_store(
    tmp_path, publish, monkeypatch, head, rest, start
):
    store = Store(tmp_path / "elsewhere")
    artefact = publish(store).artefact
    store.set_name("best", artefact)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    ref = {"id": artefact.id, "prefix": artefact.id[:3], "name": "best"}[head]
    found = store.resolve(start + ref + rest)
    assert (found.artefact, found.output) == (artefact, rest.strip("/") or None)


def test_an_existing_path_below_runs_is_that_file(tmp_path, publish, monkeypatch):
    store = Store(tmp_path / "elsewhere")
    artefact = publish(store).artefact
    other = publish(Store(tmp_path / "runs")).artefact
    monkeypatch.chdir(tmp_path)
    found = store.resolve(f"runs/{other.id}/reward.pt")
    assert (found.artefact, found.path) == (None, Path(f"runs/{other.id}/reward.pt"))
    # A path with a prefix does not exist.
    assert store.resolve(f"runs/{other.id[:5]}/reward.pt").artefact == artefact


@pytest.mark.parametrize(
    "ref",
    [
        "runs",
        "runs/",
        "runs/nothing",
        "runs/fff/reward.pt",
        "runs/../ID/reward.pt",
        "runs/../../ID",
        "other/ID/reward.pt",
        "/runs/ID",
        "runs/runs/ID",
        "runs/.names/best",
    ],
)
def test_other_paths_find_nothing_in_another_store(tmp_path, publish, monkeypatch, ref):
    store = Store(tmp_path / "elsewhere")
    artefact = publish(store).artefact
    store.set_name("best", artefact)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(NotFound):
        store.resolve(ref.replace("ID", artefact.id))


def test_a_mistyped_name_below_runs_is_suggested(tmp_path, publish, monkeypatch):
    store = Store(tmp_path / "elsewhere")
    store.set_name("airl-irm-seed0", publish(store).artefact)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NotFound) as caught:
        store.resolve("runs/airl-irm-sede0/reward.pt")
    assert "did you mean 'airl-irm-seed0'" in caught.value.hint


def test_ambiguity_names_the_candidates(empty_store, artefact):
    """Two artefacts with the same first digits: certain among 4097 for three digits."""
    twin = artefact.id[:6] + "0" * 10
    (empty_store.root / twin).mkdir()
    with pytest.raises(NotFound, match="ambiguous") as caught:
        empty_store.resolve(artefact.id[:6])
    assert artefact.id in caught.value.message and twin in caught.value.message
    assert "more digits" in caught.value.hint
    assert empty_store.resolve(artefact.id).artefact == artefact


@pytest.mark.parametrize(
    "ref", ["nothing", "fff/reward.pt", "no/such/file.pt", "", "a" * 5000, "a\0b"]
)
def test_missing_is_named_with_a_hint(empty_store, artefact, ref):
    with pytest.raises(NotFound) as caught:
        empty_store.resolve(ref)
    assert repr(ref) in caught.value.message
    assert "irl ls" in caught.value.hint


def test_mistyped_name_is_suggested(empty_store, artefact):
    empty_store.set_name("airl-irm-seed0", artefact)
    with pytest.raises(NotFound) as caught:
        empty_store.resolve("airl-irm-sede0")
    assert "did you mean 'airl-irm-seed0'" in caught.value.hint


def test_unknown_output_is_suggested(empty_store, artefact):
    with pytest.raises(NotFound, match=r"'reward\.tp'") as caught:
        empty_store.resolve(f"{artefact.id}/reward.tp")
    assert "reward.pt" in caught.value.hint


@pytest.mark.parametrize(
    "rest",
    [
        "/../STORE",
        "/../../secret",
        "/nested/../../secret",
        "/reward.pt/../../../secret",
        "/manifest.json",
        "/provenance.json",
        "/nested",
        "//etc/passwd",
        "/./reward.pt/x",
    ],
)
@pytest.mark.parametrize("head", ["id", "prefix", "name"])
def test_a_reference_never_leaves_its_artefact(empty_store, artefact, monkeypatch, head, rest):
    """Neither by ``..`` nor to files that are not outputs. A bare id or name is not normalised."""
    (empty_store.root.parent / "secret").write_bytes(b"secret")
    monkeypatch.chdir(empty_store.root.parent / "runs" / ".work")
    empty_store.set_name("best", artefact)
    ref = {"id": artefact.id, "prefix": artefact.id[:4], "name": "best"}[head]
    with pytest.raises(NotFound):
        empty_store.resolve(ref + rest)


@pytest.mark.parametrize(
    "inner", [".keys", ".names/best", "STORE", ".work", ".quarantine", ".locks/gc"]
)
def test_the_store_s_own_files_cannot_be_referenced(empty_store, artefact, inner):
    empty_store.set_name("best", artefact)
    with pytest.raises(NotFound):
        empty_store.resolve(str(empty_store.root / inner))


def test_files_outside_the_store_are_used_as_they_are(empty_store, artefact, tmp_path, monkeypatch):
    (tmp_path / "reward.pt").write_bytes(b"x")
    found = empty_store.resolve(str(tmp_path / "reward.pt"))
    assert (found.artefact, found.path, found.output) == (None, tmp_path / "reward.pt", None)
    monkeypatch.chdir(tmp_path)
    assert empty_store.resolve("reward.pt").path == Path("reward.pt")
    assert empty_store.resolve("./").artefact is None


def test_a_name_wins_over_a_file_and_an_explicit_path_over_the_name(
    empty_store, artefact, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "best").write_bytes(b"x")
    empty_store.set_name("best", artefact)
    assert empty_store.resolve("best").artefact == artefact
    assert empty_store.resolve("./best").artefact is None


@given(ref=st.text(max_size=30))
def test_any_text_is_found_or_refused(tmp_path_factory, ref):
    store = Store(tmp_path_factory.getbasetemp() / "any-text")
    store.create()
    try:
        found = store.resolve(ref)
    except NotFound as error:
        assert error.hint
    else:
        assert found.artefact is None and os.path.exists(ref)


# Names


@pytest.mark.parametrize(
    "name",
    [
        "abc",
        "deadbeef",
        "f" * 64,
        "",
        "1st",
        "-x",
        ".hidden",
        "a/b",
        "..",
        "a b",
        "é",
        "a\n",
        "a\0",
        "x" * 101,
    ],
    ids=ascii,
)
def test_invalid_names_are_refused(empty_store, artefact, name):
    """Above all names that read as an id, which would hide an artefact."""
    with pytest.raises(UsageError) as caught:
        empty_store.set_name(name, artefact)
    assert repr(name) in caught.value.message and caught.value.hint
    assert list((empty_store.root / ".names").iterdir()) == []


@pytest.mark.parametrize("name", ["ab", "best", "x" * 100, "Deadbeef", "a.b-c_1", "beefs"])
def test_valid_names_are_accepted(empty_store, artefact, name):
    empty_store.set_name(name, artefact)
    assert empty_store.resolve(name).artefact == artefact


def test_naming_again_leaves_the_file_alone(empty_store, artefact, publish):
    """Names can be make targets: a newer file would rebuild everything after it."""
    empty_store.set_name("best", artefact)
    path = empty_store.root / ".names" / "best"
    os.utime(path, (1, 1))
    empty_store.set_name("best", artefact)
    assert path.stat().st_mtime == 1
    other = publish(empty_store, parameters={"seed": 1}).artefact
    with warnings.catch_warnings(record=True) as caught:
        empty_store.set_name("best", artefact)
        assert not caught
        empty_store.set_name("best", other)
    (warning,) = (str(w.message) for w in caught)
    assert warning.startswith(f"best no longer names {artefact.id}")
    assert f"irl name {artefact.id} best" in warning
    assert path.stat().st_mtime > 1
    assert empty_store.names() == {"best": other.id}


def test_the_name_of_a_missing_artefact_is_reported(empty_store, artefact):
    empty_store.set_name("best", artefact)
    artefact.directory.rename(empty_store.root / ".quarantine" / "gone")
    with pytest.raises(NotFound, match=f"'best' points to {artefact.id}, which is missing"):
        empty_store.resolve("best")


def test_the_name_of_a_quarantined_artefact_comes_with_the_command_that_made_it(
    empty_store, artefact
):
    empty_store.set_name("best", artefact)
    output = next(artefact.directory / o.path for o in artefact.manifest.outputs)
    output.chmod(0o644)
    output.write_bytes(b"other bytes")
    assert list(empty_store.verify([artefact.id]).damaged) == [artefact.id]
    (place,) = (empty_store.root / ".quarantine").iterdir()
    with pytest.raises(NotFound, match=f"'best' points to {artefact.id}") as caught:
        empty_store.resolve("best")
    assert str(place) in caught.value.message
    assert caught.value.hint.startswith("compute it again")


@pytest.mark.parametrize(
    "words",
    [
        ["--store", "elsewhere", "--seed", "1"],
        ["--seed", "1", "--store=elsewhere"],
        ["--seed", "1"],
        ["--out", "shown", "--seed", "1"],
        ["--seed", "1", "--out=shown"],
    ],
)
def test_a_copied_store_is_repaired_in_its_own_place(tmp_path, monkeypatch, publish, words):
    """Not where the artefact was first made, which the recorded command names; nor beside a store."""
    monkeypatch.delenv("IRL_STORE", raising=False)
    copied = Layout(tmp_path / "copied")
    directory = publish(Store(copied.root)).artefact.directory
    provenance = directory / "provenance.json"
    provenance.chmod(0o644)
    provenance.write_text(json.dumps({"record": {"command": ["irl", "transfer", *words]}}))
    line = f"irl transfer --seed 1 --store {copied.root}"
    assert recorded_command(directory, copied) == line
    monkeypatch.setenv("IRL_STORE", str(copied.root))
    assert recorded_command(directory, copied) == "irl transfer --seed 1"
    provenance.write_text('{"record": {"command": [1]}}')
    assert recorded_command(directory, copied) == ""


@pytest.mark.parametrize("content", [b"", b"../../etc", b"\xff\xff", b"zzz"])
def test_a_damaged_name_is_ignored(empty_store, artefact, content):
    (empty_store.root / ".names" / "best").write_bytes(content)
    assert empty_store.names() == {}
    with pytest.raises(NotFound):
        empty_store.resolve("best")
