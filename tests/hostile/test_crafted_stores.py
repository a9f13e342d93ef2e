"""Stores that somebody else wrote: planted checkpoints, links that lead out, false summaries."""

import hashlib
import json
import os
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from chains import CHAIN, GRIDWORLD, SMOKE, assert_refused

from irlcli.data.tensors import restore, to_bytes
from irlcli.experiments import provenance
from irlcli.experiments.circumstances import circumstances
from irlcli.experiments.facts import left_out
from irlcli.store import KeyRecord, Store
from irlcli.store.durable import machine, remove


def test_checkpoints_of_another_stage_are_not_used():
    reasons = []
    names = {"round", "rows"}
    assert restore(to_bytes({"round": 1, "rows": "[]"}), names, reasons.append)["round"] == 1
    assert restore(None, names, reasons.append) is None and not reasons
    for value in ([], {}, {"round": 1}, {"round": 1, "rows": "", "more": 0}, "text", torch.ones(2)):
        assert restore(to_bytes(value), names, reasons.append) is None
    assert len(reasons) == 6 and all(reasons)


def test_a_shortage_of_memory_does_not_discard_a_checkpoint(monkeypatch):
    """Torch reports it as a RuntimeError."""

    def load(*args, **kwargs):
        raise RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. can't allocate memory")

    data, reasons = to_bytes({"round": 1}), []
    monkeypatch.setattr(torch, "load", load)
    with pytest.raises(MemoryError):
        restore(data, {"round"}, reasons.append)
    assert not reasons


def unmade(store: Store, ref: str) -> str:
    """The key of ``ref``, whose artefact is removed from ``store``."""
    made = store.resolve(ref).artefact
    key = made.manifest.record.key
    (store.root / ".keys" / key).unlink()
    remove(made.directory)
    return key


def save_checkpoint(store: Store, key: str, state: dict, attempts=()) -> None:
    """Save ``state`` as the checkpoint for ``key``, with a valid header."""
    header = provenance.Header(
        schema=provenance.SCHEMA,
        libraries=provenance.libraries(),
        attempts=attempts,
    )
    with store.working_on(key, wait=False) as scratch:
        scratch.save(header.encode(to_bytes(state)))


def test_a_discarded_checkpoint_is_no_attempt(irl, store_copy):
    store = Store(store_copy.path)
    key = unmade(store, store_copy.transfer)
    attempts = (provenance.Clock().attempt(),)
    save_checkpoint(store, key, {"other": torch.ones(1)}, attempts)
    done = irl(*CHAIN[2], *SMOKE, "--store", store.root)
    assert done.code == 0 and "starting over" in done.err
    assert store.resolve(store_copy.transfer).artefact.provenance()["resumed"] == 0


def changed(state: dict, path: str, value) -> dict:
    """A copy of ``state`` with ``value`` at ``path``, e.g. ``training.rounds_done``."""
    if not path:
        return value
    first, _, rest = path.partition(".")
    return {**state, first: changed(state[first], rest, value)}


def test_the_state_that_the_planted_ones_differ_from_is_resumed(irl, store_copy, transfer_state):
    store = Store(store_copy.path)
    key = unmade(store, store_copy.transfer)
    save_checkpoint(store, key, transfer_state, (provenance.Clock().attempt(),))
    done = irl(*CHAIN[2], *SMOKE, "--quiet", "--store", store.root)
    assert done.code == 0, done.err
    assert store.resolve(store_copy.transfer).artefact.provenance()["resumed"] == 1


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("training", {}),
        ("training", []),
        ("training.trainer", []),
        ("training.trainer.policy", {}),
        ("training.trainer.optimizer", {"state": {}, "param_groups": []}),
        ("training.trainer.steps", "x"),
        ("training.rounds_done", "x"),
        ("rows", torch.zeros(3, dtype=torch.uint8)),
        ("rows", 7),
    ],
)
def test_a_planted_checkpoint_is_named(irl, store_copy, transfer_state, path, value):
    """Valid tensors, header and checksum around a state that no stage wrote."""
    store = Store(store_copy.path)
    key = unmade(store, store_copy.transfer)
    save_checkpoint(store, key, changed(transfer_state, path, value))
    done = irl(*CHAIN[2], *SMOKE, "--quiet", "--store", store.root)
    assert_refused((done.code, done.out, done.err), 4, key)
    shutil.rmtree(store.root / ".work" / key)
    again = irl(*CHAIN[2], *SMOKE, "--quiet", "--store", store.root)
    assert Path(again.out.strip()).name == store_copy.transfer


@pytest.fixture
def maze_copy(maze_store, tmp_path) -> Store:
    """A copy of the store with a gridworld's chain."""
    path = tmp_path / "runs"
    shutil.copytree(maze_store, path, symlinks=True)
    return Store(path)


def test_the_gridworld_state_that_the_planted_ones_differ_from_is_resumed(
    irl, maze_copy, maxent_state
):
    key = unmade(maze_copy, "maxent")
    attempts = (provenance.Clock().attempt(),)
    save_checkpoint(maze_copy, key, maxent_state, attempts)
    done = irl(*GRIDWORLD[1], *SMOKE, "--quiet", "--store", maze_copy.root)
    assert done.code == 0, done.err
    assert maze_copy.resolve("maxent").artefact.provenance()["resumed"] == 1


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("networks", {}),
        ("networks.weight", torch.zeros(2)),
        ("optimizer", {"state": {}, "param_groups": []}),
        ("records", [1]),
        ("records", "x"),
        ("iterations", "many"),
    ],
)
def test_a_planted_gridworld_checkpoint_is_named(irl, maze_copy, maxent_state, path, value):
    key = unmade(maze_copy, "maxent")
    state = changed(maxent_state, path, value)
    save_checkpoint(maze_copy, key, state)
    done = irl(*GRIDWORLD[1], *SMOKE, "--quiet", "--store", maze_copy.root)
    assert_refused((done.code, done.out, done.err), 4, key)


def outside_checkpoint(store, key, outside):
    (store.root / ".work" / key).mkdir()
    (store.root / ".work" / key / "checkpoint").symlink_to(outside / "precious")


def checkpoint_pipe(store, key, outside):
    (store.root / ".work" / key).mkdir()
    os.mkfifo(store.root / ".work" / key / "checkpoint")


def checkpoint_directory(store, key, outside):
    (store.root / ".work" / key / "checkpoint" / "below").mkdir(parents=True)


def endless_checkpoint(store, key, outside):
    (store.root / ".work" / key).mkdir()
    with open(store.root / ".work" / key / "checkpoint", "wb") as file:
        file.truncate(1 << 40)


def odd_leftovers(store, key, outside):
    node = machine()
    (store.root / ".work" / key).mkdir()
    for pid in ("x", "9" * 40):
        (store.root / ".work" / key / f"out.{pid}.{'0' * 32}.{node}").mkdir()
    # 2 ** 22 is the largest process id of Linux.
    (store.root / ".work" / key / f"out.{2**22 + 1}.{'0' * 32}.{node}").symlink_to(outside)


@pytest.mark.parametrize(
    "plant",
    [
        outside_checkpoint,
        checkpoint_pipe,
        checkpoint_directory,
        endless_checkpoint,
        odd_leftovers,
    ],
)
def test_links_pipes_and_strays_in_the_scratch_directory_are_not_followed(
    irl, store_copy, tmp_path, plant
):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("kept")
    store = Store(store_copy.path)
    key = store.resolve(store_copy.transfer).artefact.manifest.record.key
    (store.root / ".keys" / key).unlink()
    plant(store, key, outside)
    done = irl(*CHAIN[2], *SMOKE, "--store", store.root)
    assert Path(done.out.strip()).name == store_copy.transfer, done.err
    assert ("cannot be used" in done.err) == ("checkpoint" in plant.__name__)
    assert (outside / "precious").read_text() == "kept"


@pytest.mark.parametrize("name", [".keys", ".names", ".work", ".locks", ".quarantine"])
def test_store_directories_that_are_links_are_not_followed(irl, store_copy, tmp_path, name):
    outside = tmp_path / "outside"
    (store_copy.path / name).rename(outside)
    (store_copy.path / name).symlink_to(outside)
    before = sorted(outside.rglob("*"))
    for line in (["gc", "--delete", "--grace-days", "0"], [*CHAIN[2], *SMOKE]):
        done = irl(*line, "--store", store_copy.path)
        assert_refused((done.code, done.out, done.err), 4, f"{name} is a symbolic link")
    assert sorted(outside.rglob("*")) == before


def test_scratch_directories_locks_names_and_claims_that_are_links_are_not_followed(
    irl, store_copy, tmp_path
):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("kept" * 10)
    store = Store(store_copy.path)
    key = store.resolve(store_copy.transfer).artefact.manifest.record.key
    claim, lock, work = (store.root / part / key for part in (".keys", ".locks", ".work"))
    claim.unlink()
    work.symlink_to(outside)
    again = [*CHAIN[2], *SMOKE, "--store", store.root]
    done = irl(*again)
    assert_refused((done.code, done.out, done.err), 4, f"{work} is not a directory")
    assert irl("gc", "--delete", "--grace-days", "0", "--store", store.root).code == 0
    assert not work.is_symlink()
    lock.unlink(missing_ok=True)
    lock.symlink_to(outside / "precious")
    assert irl(*again).code != 0
    lock.unlink()
    for pointer in (claim, store.root / ".names" / "led-out"):
        pointer.symlink_to(outside / "precious")
    assert irl("show", "led-out", "--store", store.root).code == 3
    done = irl(*again)
    assert Path(done.out.strip()).name == store_copy.transfer, done.err
    assert (outside / "precious").read_text() == "kept" * 10


def test_artefacts_and_the_lock_of_gc_that_are_links_are_not_followed(irl, store_copy, tmp_path):
    outside = tmp_path / "outside"
    store = Store(store_copy.path)
    (store.root / store_copy.transfer).rename(outside)
    (store.root / store_copy.transfer).symlink_to(outside)
    for name in store.names():
        (store.root / ".names" / name).unlink()
    before = outside.stat().st_mode, sorted(p.name for p in outside.iterdir())
    done = irl("gc", "--delete", "--grace-days", "0", "--store", store.root)
    assert done.code == 0, done.err
    assert not os.path.lexists(store.root / store_copy.transfer)
    assert (outside.stat().st_mode, sorted(p.name for p in outside.iterdir())) == before
    evil = tmp_path / "evil"
    (evil / ".locks").mkdir(parents=True)
    (evil / ".locks" / "gc").symlink_to(tmp_path / "created")
    assert irl("pull", "--all", "--from", store_copy.path, "--store", evil).code != 0
    assert not (tmp_path / "created").exists()


@pytest.mark.parametrize("number", [10**400, -(10**400), 10**3000])
def test_huge_numbers_in_a_manifest_are_no_obstacle_to_listing(irl, publish, tmp_path, number):
    """A manifest holds any JSON; a config is limited to 2**53."""
    store = Store(tmp_path / "runs")
    ppo = {"n_envs": number, "n_steps": number}
    airl = {"penalty_weight": number, "penalty": "irmv1", "total_steps": 9, "ppo": ppo}
    transfer = {"total_steps": number, "ceiling": number, "restarts": number}
    for stage, config in (("train-airl", {"airl": airl}), ("transfer", {"transfer": transfer})):
        artefact = publish(store, stage=stage, parameters=config).artefact
        for line in (["ls"], ["lineage", artefact.id], ["show", artefact.id]):
            done = irl(*line, "--store", store.root)
            assert done.code == 0, done.err


@pytest.mark.parametrize(
    "origin",
    [
        {"inputs": "abc"},
        {"inputs": {"demonstrations": 3}},
        {"attempts": "abc"},
        {"attempts": ["x"]},
        {"attempts": [{"commit": 1}]},
        {"git": "x"},
        {"git": {"dirty": []}},
        {"libraries": "ab"},
        {"command": "irl"},
        {"command": ["irl", 3]},
        {"seconds": "long"},
        {"resumed": []},
    ],
)
def test_a_provenance_of_another_form_is_named(irl, empty_store, origin):
    """With valid digests."""
    record = KeyRecord("train-airl", 1, {"seed": 0}, {})
    with empty_store.in_use(), empty_store.working_on(record.key, wait=False) as scratch:
        output = scratch.new_output()
        (output / "reward.pt").write_bytes(b"reward")
        made = empty_store.publish(record, output, origin).artefact
    for command in ("lineage", "show"):
        done = irl(command, made.id, "--store", empty_store.root)
        assert_refused((done.code, done.out, done.err), 4, "provenance.json")


@pytest.mark.parametrize(
    "parameters",
    [
        {"agent": ["x"]},
        {"noise": {"a": []}},
        {"settings": [["x"], 3]},
        {"environment": {"name": []}},
        {"airl": {"learner": []}},
        {"setting": {}},
    ],
)
def test_artefacts_of_another_form_have_no_part_in_a_report(empty_store, publish, parameters):
    publish(empty_store, stage="evaluate", parameters=parameters)
    wanted = [KeyRecord("evaluate", 1, {"agent": "idle", "settings": ["mass=2x"]}, {})]
    assert left_out(empty_store.artefacts(), wanted, set()) == []


def test_an_evaluation_of_an_older_version_is_not_called_damaged(irl, empty_store, publish):
    made = publish(empty_store, {"summary.json": b"{}"}, stage="evaluate").artefact
    done = irl("report", "returns", made.id, "--store", empty_store.root)
    assert done.code == 2 and "by version 1 of the stage evaluate" in done.err
    shown = shlex.split(done.err.splitlines()[-1].split("`")[1])[1:]
    assert json.loads(irl(*shown).out)["id"] == made.id


def test_an_evaluation_of_a_newer_version_asks_for_a_newer_program(irl, empty_store, publish):
    made = publish(empty_store, {"summary.json": b"{}"}, stage="evaluate", version=99).artefact
    done = irl("report", "returns", made.id, "--store", empty_store.root)
    assert done.code == 4 and "upgrade irlcli" in done.err


def test_an_evaluation_that_was_made_from_itself_has_its_own_circumstances(empty_store, publish):
    files = {"summary.json": b"{}", "policy.pt": b"policy"}
    inputs = {"policy": hashlib.sha256(b"policy").hexdigest()}
    made = publish(empty_store, files, stage="evaluate", inputs=inputs).artefact
    found = circumstances(made, empty_store.index())
    assert found == {"evaluate.seed": 0}


def planted(store: Store, source: str, name: str, data: bytes) -> None:
    """Replace ``source`` by an artefact with valid digests whose output ``name`` is ``data``."""
    artefact = store.resolve(source).artefact
    record = artefact.manifest.record
    files = {o.path: (artefact.directory / o.path).read_bytes() for o in artefact.manifest.outputs}
    (store.root / ".keys" / record.key).unlink()
    artefact.directory.chmod(0o755)
    shutil.rmtree(artefact.directory)
    with store.working_on(record.key, wait=False) as scratch:
        output = scratch.new_output()
        for path, content in {**files, name: data}.items():
            (output / path).write_bytes(content)
        store.publish(record, output, {"command": ["irl"]})


@pytest.mark.parametrize(
    "data",
    [
        b"{}",
        b"[]",
        b'{"settings":[{}]}',
        b'{"settings":[{"setting":1}]}',
        b'{"settings":{"a":1}}',
        b'{"settings":[{"setting":"x","seen":true,"goal_probability":"high","true_return":null,'
        b'"value_difference":null,"rank_correlation":null,"log_likelihood":0}]}',
    ],
)
@pytest.mark.parametrize(
    ("name", "file", "line"),
    [("mazes", "summary.json", GRIDWORLD[0]), ("maxent", "quality.json", GRIDWORLD[1])],
)
def test_planted_summaries_are_checked(irl, maze_store, tmp_path, name, file, line, data):
    """A hit prints them beside its artefact's path."""
    path = tmp_path / name
    shutil.copytree(maze_store, path, symlinks=True)
    store = Store(path)
    planted(store, store.names()[name], file, data)
    done = irl(*line, *SMOKE, "--quiet", "--store", path)
    assert Path(done.out.strip()).parent == path  # The artefact itself exists.
    assert_refused((done.code, "", done.err), 4, file)
