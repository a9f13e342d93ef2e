"""References and collection: what a person writes finds what it means, or nothing at all."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.errors import Busy, NotFound, UsageError
from irlcli.store import Artefact, Store
from irlcli.store.lock import is_locked, locked

DAY = 86400.0


@pytest.fixture
def artefact(empty_store, publish) -> Artefact:
    return publish(empty_store).artefact


def outside(store: Store, artefact: Artefact) -> list[Path]:
    """Everything in the store but the artefact itself, as a caller could reach it."""
    return [p for p in store.root.rglob("*") if artefact.directory not in (p, *p.parents)]


# Ways to write one


@pytest.mark.parametrize("digits", [3, 4, 15, 16, 17, 63, 64])
def test_prefixes_of_at_least_three_digits(empty_store, artefact, digits):
    ref = artefact.manifest.id[:digits]
    assert empty_store.resolve(ref).artefact == artefact
    inside = empty_store.resolve(f"{ref}/reward.pt")
    assert (inside.artefact, inside.output) == (artefact, "reward.pt")


@pytest.mark.parametrize("digits", [0, 1, 2])
def test_shorter_prefixes_name_nothing(empty_store, artefact, digits):
    with pytest.raises(NotFound):
        empty_store.resolve(artefact.id[:digits])


def test_long_prefix_that_goes_wrong_behind_the_directory_name(empty_store, artefact):
    """The directory shows 16 digits; the rest of a 64-digit id counts too."""
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
    # A prefix is no existing path.
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
    """A second artefact with the same first digits, as 4096 artefacts are sure to bring."""
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
    """Neither by ``..`` nor to what is no output; with a bare head no path is normalised first."""
    (empty_store.root.parent / "secret").write_bytes(b"secret")
    monkeypatch.chdir(empty_store.root.parent / "runs" / ".work")
    empty_store.set_name("best", artefact)
    ref = {"id": artefact.id, "prefix": artefact.id[:4], "name": "best"}[head]
    with pytest.raises(NotFound):
        empty_store.resolve(ref + rest)


@pytest.mark.parametrize(
    "inner", [".keys", ".names/best", "STORE", ".work", ".quarantine", ".locks/gc"]
)
def test_the_store_s_own_files_are_no_references(empty_store, artefact, inner):
    empty_store.set_name("best", artefact)
    with pytest.raises(NotFound):
        empty_store.resolve(str(empty_store.root / inner))


def test_foreign_files_are_taken_as_they_are(empty_store, artefact, tmp_path, monkeypatch):
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
def test_what_cannot_be_a_name(empty_store, artefact, name):
    """Above all what reads as an id: it would hide an artefact, now or later."""
    with pytest.raises(UsageError) as caught:
        empty_store.set_name(name, artefact)
    assert repr(name) in caught.value.message and caught.value.hint
    assert list((empty_store.root / ".names").iterdir()) == []


@pytest.mark.parametrize("name", ["ab", "best", "x" * 100, "Deadbeef", "a.b-c_1", "beefs"])
def test_what_can_be_a_name(empty_store, artefact, name):
    empty_store.set_name(name, artefact)
    assert empty_store.resolve(name).artefact == artefact


def test_naming_rewrites_only_what_changes(empty_store, artefact, publish):
    """Make's targets are names: touching one would rebuild all that follows."""
    empty_store.set_name("best", artefact)
    path = empty_store.root / ".names" / "best"
    os.utime(path, (1, 1))
    empty_store.set_name("best", artefact)
    assert path.stat().st_mtime == 1
    other = publish(empty_store, parameters={"seed": 1}).artefact
    assert empty_store.set_name("best", artefact) is None
    assert empty_store.set_name("best", other) == artefact.id
    assert path.stat().st_mtime > 1
    assert empty_store.names() == {"best": other.id}


def test_a_name_of_something_that_is_gone(empty_store, artefact):
    empty_store.set_name("best", artefact)
    artefact.directory.rename(empty_store.root / ".quarantine" / "gone")
    with pytest.raises(NotFound, match=f"'best' points to {artefact.id}, which is missing"):
        empty_store.resolve("best")


def test_a_name_of_something_damaged_says_how_to_make_it_again(empty_store, artefact):
    empty_store.set_name("best", artefact)
    output = next(artefact.directory / o.path for o in artefact.manifest.outputs)
    output.chmod(0o644)
    output.write_bytes(b"other bytes")
    assert list(empty_store.verify([artefact.id])) == [artefact.id]
    (place,) = (empty_store.root / ".quarantine").iterdir()
    with pytest.raises(NotFound, match=f"'best' points to {artefact.id}") as caught:
        empty_store.resolve("best")
    assert str(place) in caught.value.message
    assert caught.value.hint.startswith("compute it again")


@pytest.mark.parametrize("content", [b"", b"../../etc", b"\xff\xff", b"zzz"])
def test_damaged_name_is_no_name(empty_store, artefact, content):
    (empty_store.root / ".names" / "best").write_bytes(content)
    assert empty_store.names() == {}
    with pytest.raises(NotFound):
        empty_store.resolve("best")


# Ancestry and collection


@pytest.fixture
def family(empty_store, publish) -> dict[str, Artefact]:
    """expert -> demos -> airl -> moved, beside a lonely one; all a year old."""
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
    assert empty_store.verify(empty_store.ids()) == {}
    for artefact in removed:
        assert empty_store.find(artefact.manifest.record.key) is None
    assert list((empty_store.root / ".work").iterdir()) == []


def test_grace_period(empty_store, family):
    age(family["lonely"].directory, 0)
    age(family["moved"].directory, 2)
    assert family["lonely"].id not in ids(*empty_store.garbage(DAY))
    assert family["moved"].id in ids(*empty_store.garbage(DAY))
    assert family["moved"].id not in ids(*empty_store.garbage(3 * DAY))
    assert len(empty_store.garbage(400 * DAY)) == 0


def test_clock_set_back_removes_nothing(empty_store, family):
    """Artefacts from the future are young."""
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


def test_collect_refuses_a_store_in_use(empty_store, family):
    with empty_store.in_use(), pytest.raises(Busy):
        Store(empty_store.root).collect(DAY)
    assert len(empty_store.ids()) == 5
    removed, _ = empty_store.collect(DAY)
    assert len(removed) == 5


def test_nobody_starts_while_collecting(empty_store):
    gc_lock = locked(empty_store.root / ".locks" / "gc")
    with gc_lock, pytest.raises(Busy) as caught, empty_store.in_use():
        pytest.fail("used a store that gc was changing")
    assert f"process {os.getpid()}" in caught.value.message and caught.value.hint


def test_readers_share(empty_store):
    with empty_store.in_use(), Store(empty_store.root).in_use():
        assert not is_locked(empty_store.root / ".locks" / ("0" * 64))


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
    """Only what is old and that nobody holds; a checkpoint of yesterday may be continued."""
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


def test_collecting_goes_on_after_a_crash_in_the_middle_of_it(empty_store, family, publish):
    """A gc that died left the half-emptied grave of an artefact, which was then made again."""
    grave = empty_store.root / ".work" / f"removed-{family['lonely'].id}"
    grave.mkdir()
    (grave / "f").write_bytes(b"half")
    removed, _ = empty_store.collect(DAY)
    assert ids(*removed) == ids(*family.values())
    assert empty_store.ids() == []


def test_nothing_to_collect_in_a_store_that_is_not_there(tmp_path):
    store = Store(tmp_path / "absent")
    assert (store.garbage(0), store.stale_work(0), store.names(), store.ids()) == ([], [], {}, [])
    assert store.collect(0) == ([], [])
