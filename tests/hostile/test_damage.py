"""Damaged stores: every altered file is found, and lost artefacts are made again bit for bit."""

import os
import shutil
from pathlib import Path

import pytest
from chains import CHAIN, GRIDWORLD, SMOKE, run_many

from irlcli.errors import IntegrityError
from irlcli.store import Store

# The artefacts of the smoke store.
FIELDS = ("expert", "demos", "airl", "transfer", "evaluation")


def flip(path: Path, other: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0x04
    path.write_bytes(data)


DAMAGE = {
    "a bit flipped": flip,
    "cut": lambda path, other: os.truncate(path, path.stat().st_size * 2 // 3),
    "emptied": lambda path, other: os.truncate(path, 0),
    "deleted": lambda path, other: path.unlink(),
    "replaced by another": lambda path, other: path.write_bytes(other),
}


def files_of(directory: Path) -> list[Path]:
    return sorted(p for p in directory.rglob("*") if p.is_file())


@pytest.mark.parametrize("field", FIELDS)
def test_damage_of_any_file_is_found_on_read_and_by_verify(store_copy, field):
    """Each file of each artefact, manifest and provenance included, with each kind of damage."""
    store, id16 = Store(store_copy.path), getattr(store_copy, field)
    sound = store_copy.path.parent / "sound"
    shutil.copytree(store_copy.path / id16, sound)
    foreign = next(store.root / i for i in store.ids() if i != id16)
    key, found = store.resolve(id16).artefact.manifest.record.key, files_of(sound)
    assert {"manifest.json", "provenance.json"} < {p.name for p in found}
    for file in found:
        name = file.relative_to(sound)
        same = foreign / name if (foreign / name).exists() else foreign / "manifest.json"
        for kind, damage in DAMAGE.items():
            for reading in (False, True):
                place = store.root / id16
                place.chmod(0o755)
                (place / name).chmod(0o644)
                damage(place / name, same.read_bytes())
                if reading:
                    with pytest.raises(IntegrityError) as caught:
                        artefact = store.resolve(id16).artefact
                        artefact.provenance()
                        for output in artefact.manifest.outputs:
                            store.open(artefact, output.path)
                    assert id16 in caught.value.message, (name, kind)
                if not reading or place.exists():  # reading altered provenance quarantines nothing
                    assert list(store.verify([id16]).damaged) == [id16], (name, kind)
                assert not place.exists()
                assert not (store.root / ".keys" / key).exists()
                (moved,) = (store.root / ".quarantine").iterdir()
                shutil.rmtree(moved)
                shutil.copytree(sound, place)
                (store.root / ".keys" / key).write_text(id16)
    assert store.verify([id16]).damaged == {}


def test_damaged_artefacts_are_made_again_with_the_same_ids_in_another_environment(
    store_copy, maze_store, tmp_path
):
    """Determinism and repair in one test, because a second full chain is expensive.

    The second computation differs in string hashes, locale, time zone, umask, directory, store
    path, number of threads and number of worker processes.
    """
    place = tmp_path / "another größe" / "of store"
    shutil.copytree(store_copy.path, place, symlinks=True)
    shutil.copytree(maze_store, tmp_path / "mazes", symlinks=True)
    stores = [Store(place), Store(tmp_path / "mazes")]
    before = [
        {n: (store.root / n / "manifest.json").read_bytes() for n in store.ids()}
        for store in stores
    ]
    assert [len(manifests) for manifests in before] == [6, 2]
    for store in stores:
        for id16 in store.ids():
            victim = files_of(store.root / id16)[-1]
            victim.chmod(0o644)
            flip(victim, b"")
        assert set(store.verify(store.ids()).damaged) == set(before[stores.index(store)])
    environment = {
        **{k: v for k, v in os.environ.items() if not k.startswith(("LC_", "LANG", "IRL_"))},
        **{"PYTHONHASHSEED": "12345", "LC_ALL": "C", "TZ": "Asia/Kathmandu"},
        **{"OMP_NUM_THREADS": "2", "COLUMNS": "20", "TERM": "dumb"},
    }
    lines = [[*line, *SMOKE, "--workers", "2", "--store", place] for line in CHAIN]
    lines += [[*line, *SMOKE, "--store", tmp_path / "mazes"] for line in GRIDWORLD]
    results, _ = run_many(
        lines, env=environment, cwd=tmp_path, preexec_fn=lambda: os.umask(0o077) and None
    )
    assert [code for code, _, _ in results] == [0] * len(lines), results
    for store, manifests in zip(stores, before, strict=True):
        assert {
            n: (store.root / n / "manifest.json").read_bytes() for n in store.ids()
        } == manifests
        assert store.verify(store.ids()).damaged == {}
