"""Damage: whatever happens to a published file is detected, set aside and repaired.

Also manifests made by an attacker: they may be refused, never believed, and nothing but
IntegrityError may come of reading them.
"""

from __future__ import annotations

import contextlib
import inspect
import itertools
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from irlcli.errors import IntegrityError, NotFound, UsageError
from irlcli.store import Artefact, KeyRecord, Manifest, Output, Store
from irlcli.store.digest import digest
from irlcli.store.manifest import check_output_path, read_manifest, read_provenance

FILES = ["reward.pt", "nested/table.parquet", "manifest.json", "provenance.json"]
PARAMETERS = {"seed": 0, "learning_rate": 1e-5, "name": "é"}


@pytest.fixture
def victim(empty_store, publish) -> Artefact:
    """An artefact to damage, beside a bystander with files of the same names."""
    publish(empty_store, dict.fromkeys(FILES[:2], b"bystander " * 50), parameters={"seed": 1})
    return publish(empty_store, parameters=PARAMETERS).artefact


def bystander(store: Store, victim: Artefact) -> Artefact:
    return next(a for a in store.artefacts() if a.id != victim.id)


def canonical(value: object) -> str:
    """JSON as manifests and provenance are written."""
    return json.dumps(value, sort_keys=True, indent=1) + "\n"


def rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.chmod(0o644)
    path.write_bytes(change(path.read_bytes()))


def flip(at: float) -> Callable[[Path, Path], None]:
    def damage(path: Path, other: Path) -> None:
        def change(data: bytes) -> bytes:
            i = int(at * (len(data) - 1))
            return data[:i] + bytes([data[i] ^ 1]) + data[i + 1 :]

        rewrite(path, change)

    return damage


def swap(path: Path, other: Path) -> None:
    path.unlink()
    shutil.copy(other, path)


def link_out(path: Path, other: Path) -> None:
    """The same bytes outside the store, where anyone may change them later."""
    outside = path.parents[2] / f"outside-{path.name}"
    shutil.copy(path, outside)
    path.unlink()
    path.symlink_to(outside)


def to_directory(path: Path, other: Path) -> None:
    path.unlink()
    path.mkdir()


def to_fifo(path: Path, other: Path) -> None:
    """A reader that opens it would wait forever."""
    path.unlink()
    os.mkfifo(path)


DAMAGE = {
    "first bit flipped": flip(0.0),
    "a bit in the middle flipped": flip(0.5),
    "last bit flipped": flip(1.0),
    "cut in half": lambda p, o: rewrite(p, lambda d: d[: len(d) // 2]),
    "last byte cut": lambda p, o: rewrite(p, lambda d: d[:-1]),
    "emptied": lambda p, o: rewrite(p, lambda d: b""),
    "a byte appended": lambda p, o: rewrite(p, lambda d: d + b"\n"),
    "deleted": lambda p, o: p.unlink(),
    "another's": swap,
    "symlinked out": link_out,
    "a directory": to_directory,
    "a fifo": to_fifo,
}


def assert_set_aside(store: Store, victim: Artefact) -> None:
    assert victim.id not in store.ids()
    (place,) = (store.root / ".quarantine").iterdir()
    assert place.name.startswith(victim.id)
    assert not (store.root / ".keys" / victim.manifest.record.key).exists()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", DAMAGE)
def test_verify_detects_sets_aside_and_recomputing_repairs(
    empty_store, victim, publish, name, kind
):
    store, untouched = empty_store, bystander(empty_store, victim)
    DAMAGE[kind](victim.directory / name, untouched.directory / name)
    damaged = store.verify(store.ids()).damaged
    assert list(damaged) == [victim.id]
    assert name in " ".join(damaged[victim.id].problems)
    assert_set_aside(store, victim)
    assert store.find(victim.manifest.record.key) is None
    assert store.find(untouched.manifest.record.key) == untouched
    again = publish(store, parameters=PARAMETERS)
    assert (again.artefact.id, again.diverged) == (victim.id, None)
    assert store.verify(store.ids()).damaged == {}


@pytest.mark.parametrize("name", ["extra.pt", "nested/extra", ".hidden", "new/extra"])
@pytest.mark.parametrize("kind", ["file", "symlink", "fifo"])
def test_verify_detects_added_files(empty_store, victim, name, kind):
    path = victim.directory / name
    path.parent.mkdir(exist_ok=True)
    match kind:
        case "file":
            path.write_bytes(b"")
        case "symlink":
            path.symlink_to("/nowhere")
        case "fifo":
            os.mkfifo(path)
    assert name in " ".join(empty_store.verify([victim.id]).damaged[victim.id].problems)
    assert_set_aside(empty_store, victim)


def test_verify_detects_a_file_below_more_directories_than_pythons_stack_has_frames(
    empty_store, victim, monkeypatch
):
    monkeypatch.chdir(victim.directory)
    # So few that the tests' own cleaning, with the limit as it was, can remove them.
    for _ in range(300):
        os.mkdir("d")
        os.chdir("d")
    Path("extra").touch()
    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack(0)) + 200)
    try:
        (problem,) = empty_store.verify([victim.id]).damaged[victim.id].problems
    finally:
        sys.setrecursionlimit(limit)
    assert problem.endswith("/d/extra is not in the manifest")


@pytest.mark.parametrize("depth", [100, 985, 990, 995])
def test_a_manifest_that_is_nested_too_deeply_is_refused(tmp_path, depth):
    """Also where it can just be parsed, and not be hashed."""
    value = "1"
    for level in reversed(range(depth)):
        value = f"[\n{' ' * (level + 3)}{value}\n{' ' * (level + 2)}]"
    form = Manifest(KeyRecord("s", 1, {"x": "HERE"}, {}), ()).encode()
    (tmp_path / "manifest.json").write_bytes(form.replace(b'"HERE"', value.encode()))
    with pytest.raises(IntegrityError, match="nested too deeply"):
        read_manifest(tmp_path)


def test_directories_in_place_of_manifests_leave_no_file_open(tmp_path):
    (tmp_path / "manifest.json").mkdir()
    before = os.listdir("/proc/self/fd")
    for _ in range(3):
        with pytest.raises(IntegrityError, match="missing or not a regular file"):
            read_manifest(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == len(before)


def test_verify_detects_an_artefact_that_is_a_link_out_of_the_store(empty_store, victim, tmp_path):
    victim.directory.chmod(0o755)
    shutil.move(victim.directory, tmp_path / "elsewhere")
    victim.directory.symlink_to(tmp_path / "elsewhere")
    assert list(empty_store.verify([victim.id]).damaged) == [victim.id]
    assert not victim.directory.is_symlink()
    assert (tmp_path / "elsewhere" / "reward.pt").exists()  # what it pointed to is left alone


@pytest.mark.parametrize("name", [".", "nested"])
def test_find_follows_no_link(empty_store, victim, tmp_path, name):
    path, key = victim.directory / name, victim.manifest.record.key
    path.chmod(0o755)
    shutil.move(path, tmp_path / "elsewhere")
    path.symlink_to(tmp_path / "elsewhere")
    found = empty_store.peek(key)
    assert found.artefact is None and "is reached through a symbolic link" in found.problem
    with pytest.raises(IntegrityError, match="is reached through a symbolic link"):
        empty_store.find(key)
    assert_set_aside(empty_store, victim)


def test_verify_detects_a_linked_directory_inside(empty_store, victim, tmp_path):
    shutil.move(victim.directory / "nested", tmp_path / "nested")
    (victim.directory / "nested").symlink_to(tmp_path / "nested")
    assert list(empty_store.verify([victim.id]).damaged) == [victim.id]


def test_swapped_artefacts_are_both_detected(empty_store, victim):
    """Each is intact; only its directory's name is wrong."""
    other = bystander(empty_store, victim)
    for directory in (victim.directory, other.directory):
        directory.chmod(0o755)
    victim.directory.rename(empty_store.root / ".swap")
    other.directory.rename(victim.directory)
    (empty_store.root / ".swap").rename(other.directory)
    assert set(empty_store.verify(empty_store.ids()).damaged) == {victim.id, other.id}
    assert empty_store.ids() == []


@pytest.mark.parametrize("kind", ["cut in half", "emptied", "deleted", "a directory", "a fifo"])
@pytest.mark.parametrize("name", ["reward.pt", "nested/table.parquet", "manifest.json"])
def test_find_detects_damage_of_manifest_and_size(empty_store, victim, name, kind):
    DAMAGE[kind](victim.directory / name, victim.directory)
    with pytest.raises(IntegrityError, match=victim.id) as caught:
        empty_store.find(victim.manifest.record.key)
    assert caught.value.hint
    assert_set_aside(empty_store, victim)
    assert empty_store.find(victim.manifest.record.key) is None  # and so it is computed again


@pytest.mark.parametrize("kind", DAMAGE)
def test_open_never_returns_altered_bytes(empty_store, victim, kind):
    other = bystander(empty_store, victim)
    DAMAGE[kind](victim.directory / "reward.pt", other.directory / "reward.pt")
    with pytest.raises(IntegrityError, match=victim.id) as caught:
        empty_store.open(victim, "reward.pt")
    assert "irl train-airl" in caught.value.hint  # how to repair
    assert_set_aside(empty_store, victim)


def test_open_of_a_sound_file_beside_a_damaged_one(empty_store, victim):
    flip(0.5)(victim.directory / "reward.pt", victim.directory)
    assert empty_store.open(victim, "nested/table.parquet").is_file()
    with pytest.raises(NotFound, match="nested/tabel"):
        empty_store.open(victim, "nested/tabel.parquet")


def test_quick_verify_sees_sizes_only(empty_store, victim):
    flip(0.5)(victim.directory / "reward.pt", victim.directory)
    assert empty_store.verify([victim.id], quick=True).damaged == {}
    rewrite(victim.directory / "reward.pt", lambda data: data[:-1])
    assert list(empty_store.verify([victim.id], quick=True).damaged) == [victim.id]


def test_the_word_newer_in_a_path_does_not_hide_damage(tmp_path, publish):
    """Only artefacts of a newer schema stay in place, whatever the store's directory is called."""
    store = Store(tmp_path / "newer-runs")
    victim = publish(store).artefact
    rewrite(victim.directory / "manifest.json", lambda data: data[:-20])
    with pytest.raises(IntegrityError):
        store.find(victim.manifest.record.key)
    assert_set_aside(store, victim)
    victim = publish(store).artefact
    flip(0.5)(victim.directory / "reward.pt", victim.directory)
    store.verify([victim.id])
    assert store.ids() == []


def test_verify_survives_an_artefact_that_gc_removes_meanwhile(empty_store, victim):
    listed = empty_store.ids()
    victim.directory.chmod(0o755)
    shutil.rmtree(victim.directory)
    assert empty_store.verify(listed).damaged == {}  # gone is not damaged
    assert len(listed) == 2
    assert list((empty_store.root / ".quarantine").iterdir()) == []


# Manifests

MASKS = (0x01, 0x20, 0x80)  # the last bit, the case of a letter, the bit that ASCII leaves clear


def test_every_byte_of_a_manifest_counts(victim, tmp_path):
    """Also bytes that do not change the meaning: 1E-05 for 1e-05, \\u00E9 for \\u00e9."""
    data = (victim.directory / "manifest.json").read_bytes()
    unnoticed = []
    for i, mask in itertools.product(range(len(data)), MASKS):
        changed = bytearray(data)
        changed[i] ^= mask
        (tmp_path / "manifest.json").write_bytes(changed)
        with contextlib.suppress(IntegrityError):
            if read_manifest(tmp_path).id == victim.manifest.id:
                unnoticed.append((i, bytes(changed[i - 9 : i + 9])))
    assert unnoticed == []


def test_every_byte_of_a_provenance_counts(empty_store, victim, tmp_path):
    data = (victim.directory / "provenance.json").read_bytes()
    for i, mask in itertools.product(range(len(data)), MASKS):
        changed = bytearray(data)
        changed[i] ^= mask
        (tmp_path / "provenance.json").write_bytes(changed)
        with pytest.raises(IntegrityError):
            read_provenance(tmp_path, victim.manifest.id)


def plant(store: Store, manifest: Manifest, encoded: bytes | None = None) -> str:
    """An artefact written by hand, in a directory that matches its manifest."""
    directory = store.root / manifest.id[:16]
    directory.mkdir()
    (directory / "manifest.json").write_bytes(encoded or manifest.encode())
    (store.root / ".keys" / manifest.record.key).write_text(directory.name)
    return directory.name


HOSTILE_PATHS = [
    "../../evil",
    "..",
    "a/../../evil",
    "/etc/passwd",
    "//etc/passwd",
    "a//b",
    "./a",
    "a/",
    ".",
    "",
    "a\\b",
    "a\0b",
    "manifest.json",
    "provenance.json",
    "\ud800",
    "a" * 5000,
    "a/" * 3000 + "a",
]


@pytest.mark.parametrize("path", HOSTILE_PATHS, ids=lambda p: ascii(p[:12]))
def test_hostile_output_paths(empty_store, tmp_path, path):
    secret = tmp_path / "evil"
    secret.write_bytes(b"secret")
    record = KeyRecord("train-airl", 1, {}, {})
    sha = "2bb80d537b1da3e38bd30361aa855686bde0eacd7162fef6a25fe97bf527a25b"  # of b"secret"
    id16 = plant(empty_store, Manifest(record, (Output(path, 6, sha),)))
    assert id16 in empty_store.ids()
    assert empty_store.problems(id16)
    with pytest.raises(IntegrityError):
        empty_store.find(record.key)
    assert secret.read_bytes() == b"secret"
    assert id16 not in empty_store.ids()


@pytest.mark.parametrize("path", [None, 5, ["a"], {"a": 1}, True, b"a"])
def test_output_paths_other_than_text_are_refused(path):
    with pytest.raises(ValueError, match="not allowed"):
        check_output_path(path)


def test_a_declared_size_that_is_wrong_is_named(empty_store):
    record = KeyRecord("train-airl", 1, {}, {})
    id16 = plant(empty_store, Manifest(record, (Output("reward.pt", 10**18, "0" * 64),)))
    (empty_store.root / id16 / "reward.pt").write_bytes(b"x")
    assert "1000000000000000000" in " ".join(empty_store.problems(id16))


def test_huge_manifest_is_not_parsed(tmp_path):
    with open(tmp_path / "manifest.json", "wb") as file:
        file.truncate(1 << 40)  # sparse: a terabyte that costs nothing to make
    with pytest.raises(IntegrityError, match="larger than"):
        read_manifest(tmp_path)


def test_deep_nesting_at_any_depth(empty_store, tmp_path):
    """Parser, checker and encoder have different limits: none may raise anything else."""
    for depth in [*range(1, 850, 50), *range(850, 1000, 3), 1050, 1100, 100_000]:
        nested = b"[" * depth + b"]" * depth
        (tmp_path / "manifest.json").write_bytes(
            b'{"schema":1,"stage":"s","stage_version":1,"inputs":{},"outputs":[],'
            b'"parameters":{"x":' + nested + b"}}"
        )
        (tmp_path / "provenance.json").write_bytes(b'{"schema":1,"record":{"x":' + nested + b"}}")
        with contextlib.suppress(IntegrityError):
            assert isinstance(read_manifest(tmp_path), Manifest)
        with pytest.raises(IntegrityError):
            read_provenance(tmp_path, "0" * 64)


def test_newer_schema_is_named_and_left_where_it_is(empty_store, victim):
    """It is not damaged: the newer version that wrote it can read it."""

    def bump(data: bytes) -> bytes:
        return json.dumps({**json.loads(data), "schema": 2, "new": 1}).encode()

    rewrite(victim.directory / "manifest.json", bump)
    for read in (
        lambda: empty_store.find(victim.manifest.record.key),
        lambda: empty_store.resolve(victim.id),
    ):
        with pytest.raises(IntegrityError, match="schema 2, newer") as caught:
            read()
        assert "upgrade" in caught.value.hint
    found = empty_store.verify([victim.id]).damaged[victim.id]
    assert found.newer and found.place is None and "newer" in " ".join(found.problems)
    assert victim.id in empty_store.ids()
    assert (empty_store.root / ".keys" / victim.manifest.record.key).exists()


@pytest.mark.parametrize(
    "field, value",
    [
        ("schema", 0),
        ("schema", True),
        ("schema", "1"),
        ("schema", None),
        ("schema", 1.0),
        ("stage", 1),
        ("stage", None),
        ("stage_version", "1"),
        ("stage_version", True),
        ("stage_version", 1.0),
        ("parameters", []),
        ("parameters", None),
        ("inputs", []),
        ("inputs", {"reward": "xyz"}),
        ("inputs", {"reward": "A" * 64}),
        ("inputs", {"reward": "0" * 64 + "\n"}),
        ("inputs", {"reward": 5}),
        ("outputs", {}),
        ("outputs", None),
        ("outputs", [5]),
        ("outputs", ["path"]),
        ("outputs", [["path", "size", "sha256"]]),
        ("outputs", [{}]),
        ("outputs", [{"path": "a", "size": -1, "sha256": "0" * 64}]),
        ("outputs", [{"path": "a", "size": True, "sha256": "0" * 64}]),
        ("outputs", [{"path": "a", "size": 1.0, "sha256": "0" * 64}]),
        ("outputs", [{"path": "a", "size": 1, "sha256": "0" * 63}]),
        ("outputs", [{"path": "a", "size": 1, "sha256": "0" * 64, "more": 1}]),
        ("outputs", [{"path": "a", "size": 1, "sha256": "0" * 64}] * 2),
    ],
)
def test_malformed_fields(victim, tmp_path, field, value):
    good = json.loads((victim.directory / "manifest.json").read_bytes())
    (tmp_path / "manifest.json").write_text(canonical(good))
    read_manifest(tmp_path)
    (tmp_path / "manifest.json").write_text(canonical({**good, field: value}))
    with pytest.raises(IntegrityError, match=r"manifest\.json"):
        read_manifest(tmp_path)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "9" * 5000])
def test_numbers_outside_json(victim, tmp_path, number):
    """json.loads accepts NaN and reads 1e999 as infinity; neither has a canonical encoding."""
    text = (victim.directory / "manifest.json").read_text()
    (tmp_path / "manifest.json").write_text(text.replace("1e-05", number))
    with pytest.raises(IntegrityError):
        read_manifest(tmp_path)


@pytest.fixture(scope="module")
def scratch_directory():
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=300) | st.text(max_size=300).map(lambda t: t.encode("utf-8")))
def test_fuzz_bytes(scratch_directory, data):
    (scratch_directory / "manifest.json").write_bytes(data)
    (scratch_directory / "provenance.json").write_bytes(data)
    with pytest.raises(IntegrityError):
        read_manifest(scratch_directory)
    with pytest.raises(IntegrityError):
        read_provenance(scratch_directory, "0" * 64)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=8,
)
OUTPUTS = st.lists(
    st.fixed_dictionaries(
        {
            "path": st.text(max_size=12) | JSON,
            "size": st.integers(min_value=-1) | JSON,
            "sha256": st.just("0" * 64) | JSON,
        }
    ),
    max_size=3,
)


SOUND = {
    "schema": 1,
    "stage": "train-airl",
    "stage_version": 1,
    "parameters": {"a": [1.5, None]},
    "inputs": {"reward": "0" * 64},
    "outputs": [{"path": "reward.pt", "size": 3, "sha256": "0" * 64}],
}


@settings(max_examples=400, deadline=None)
@example(value=SOUND)
@given(
    value=st.fixed_dictionaries(
        {
            "schema": st.just(1) | JSON,
            "stage": st.just("train-airl") | JSON,
            "stage_version": st.just(1) | JSON,
            "parameters": st.dictionaries(st.text(max_size=4), JSON, max_size=3) | JSON,
            "inputs": st.dictionaries(st.text(max_size=4), st.just("0" * 64) | JSON, max_size=2)
            | JSON,
            "outputs": OUTPUTS | JSON,
        }
    )
)
def test_fuzz_structure(scratch_directory, value):
    """Almost valid manifests are read exactly, or refused."""
    with contextlib.suppress(TypeError, KeyError):
        value["outputs"] = sorted(value["outputs"], key=lambda output: output["path"])
    (scratch_directory / "manifest.json").write_text(canonical(value))
    try:
        manifest = read_manifest(scratch_directory)
    except IntegrityError:
        assert value is not SOUND
        return
    assert json.loads(manifest.encode()) == value
    for output in manifest.outputs:
        inside = os.path.normpath(os.path.join("/store/id", output.path))
        assert inside.startswith("/store/id/")


@settings(max_examples=300, deadline=None)
@example(record={}, artefact="0" * 64, honest=True)
@given(
    record=st.dictionaries(st.text(max_size=8), JSON, max_size=3) | JSON,
    artefact=st.just("0" * 64) | JSON,
    honest=st.booleans(),
)
def test_fuzz_provenance(scratch_directory, record, artefact, honest):
    body = {"schema": 1, "artefact": artefact, "record": record}
    try:
        sha = digest(body) if honest else "0" * 64
    except ValueError:
        sha = "0" * 64
    (scratch_directory / "provenance.json").write_text(canonical({**body, "sha256": sha}))
    try:
        assert read_provenance(scratch_directory, "0" * 64) == record
    except IntegrityError:
        assert not (honest and artefact == "0" * 64 and record == {})
        return
    assert honest and artefact == "0" * 64


# Key pointers and names


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n",
        b"zzz",
        b"\xff\xfe",
        b"../../../../etc",
        b"0" * 16,
        b"0" * 64,
        b"STORE",
        b"x" * 10**6,
    ],
    ids=lambda c: repr(c[:12]),
)
def test_damaged_key_pointer_means_absent_and_is_repaired(empty_store, victim, publish, content):
    key = victim.manifest.record.key
    pointer = empty_store.root / ".keys" / key
    pointer.write_bytes(content)
    assert empty_store.find(key) is None
    assert publish(empty_store, parameters=PARAMETERS).artefact.id == victim.id
    found = empty_store.find(key)
    assert found is not None and found.id == victim.id


def test_pointer_to_another_artefact_is_not_followed(empty_store, victim, publish):
    key = victim.manifest.record.key
    other = bystander(empty_store, victim)
    (empty_store.root / ".keys" / key).write_text(other.id)
    assert empty_store.find(key) is None
    publish(empty_store, parameters=PARAMETERS)
    found = empty_store.find(key)
    assert found is not None and found.id == victim.id
    assert empty_store.find(other.manifest.record.key) == other


@pytest.mark.parametrize("place", [".keys", ".names"])
def test_rubbish_among_pointers_is_ignored(empty_store, victim, place):
    """A directory, a dangling link and another's temporary file where only pointers belong."""
    name = "f" * 64 if place == ".keys" else "rubbish"
    (empty_store.root / place / name).mkdir()
    (empty_store.root / place / ("e" * 64 if place == ".keys" else "dangling")).symlink_to(
        "/nowhere"
    )
    (empty_store.root / place / ".temporary").write_bytes(b"\xff")
    empty_store.set_name("mine", victim)
    assert empty_store.names()["mine"] == victim.id
    flip(0.5)(victim.directory / "reward.pt", victim.directory)
    assert list(empty_store.verify(empty_store.ids()).damaged) == [victim.id]
    assert empty_store.find("f" * 64) is None


# The store's own marker


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b'{"format": 0}', b'{"format": "1"}', b"\xff", b"{}"]
)
def test_damaged_store_marker(empty_store, content):
    (empty_store.root / "STORE").write_bytes(content)
    with pytest.raises(IntegrityError, match="STORE") as caught:
        Store(empty_store.root)
    assert caught.value.hint


def test_newer_store_is_refused(empty_store):
    (empty_store.root / "STORE").write_bytes(b'{"format": 2, "more": []}')
    with pytest.raises(IntegrityError, match="format 2, newer than the supported 1") as caught:
        Store(empty_store.root)
    assert "upgrade" in caught.value.hint


@pytest.mark.parametrize("name", ["notes.txt", ".git", ".bashrc"])
def test_a_directory_with_other_files_is_refused(tmp_path, name):
    """Only the files that an interrupted create() leaves are accepted."""
    (tmp_path / name).mkdir()
    with pytest.raises(UsageError, match="not a store"):
        Store(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]
