"""Several processes, and several versions of the program, on one store."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

from irlcli.errors import Busy, IntegrityError, NotFound
from irlcli.store import Index, KeyRecord, Store, garbage, integrity, read
from irlcli.store import artefact as artefact_module
from irlcli.store import publish as publishing
from irlcli.store.layout import Layout

DAY = 86400.0


def to_newer_schema(directory: Path) -> None:
    """A manifest as a later version might write it: only contents are still named by sha256."""
    path = directory / "manifest.json"
    path.chmod(0o644)
    old = json.loads(path.read_bytes())
    path.write_text(json.dumps({"schema": 2, "made_from": list(old["inputs"].values())}))


@pytest.fixture
def mixed(empty_store, publish):
    """expert -> demos (named, of a newer schema), and an unrelated one; all a year old."""
    expert = publish(empty_store, {"f": b"expert"}, parameters={"of": "expert"}).artefact
    inputs = {"expert": expert.output("f").sha256}
    demos = publish(empty_store, {"f": b"demos"}, parameters={"of": "demos"}, inputs=inputs)
    lonely = publish(empty_store, {"f": b"lonely"}, parameters={"of": "lonely"}).artefact
    empty_store.set_name("best", demos.artefact)
    to_newer_schema(demos.artefact.directory)
    for artefact in (expert, demos.artefact, lonely):
        os.utime(artefact.directory, (time.time() - 365 * DAY,) * 2)
    return expert.id, demos.artefact.id, lonely.id


def test_artefacts_of_a_newer_schema_are_skipped_with_a_warning(irl, empty_store, mixed):
    expert, newer, lonely = mixed
    root = empty_store.root
    for arguments in (["ls"], ["gc", "--grace-days", "0"], ["lineage", lonely], ["verify"]):
        result = irl(*arguments, "--store", root)
        assert result.code == 0, result.err
        warnings = [line for line in result.err.splitlines() if line.startswith("warning: ")]
        assert len(warnings) == 1 and newer in warnings[0] and "upgrade" in warnings[0]
        assert newer not in result.out and "damaged" not in result.err
    assert irl("verify", "--store", root).out == "2 artefacts verified\n"
    assert irl("show", newer, "--store", root).code == 4
    listed = json.loads(irl("ls", "--json", "--store", root).out)
    assert listed["newer"] == [newer]
    assert {a["id"] for a in listed["artefacts"]} == {expert, lonely}
    checked = json.loads(irl("verify", "--json", "--store", root).out)
    assert (checked["checked"], checked["newer"], checked["damaged"]) == (2, [newer], {})
    assert list((root / ".quarantine").iterdir()) == []


def test_gc_keeps_artefacts_of_a_newer_schema_and_their_inputs(irl, empty_store, mixed):
    expert, newer, _ = mixed
    result = irl("gc", "--delete", "--grace-days", "0", "--store", empty_store.root)
    assert result.code == 0, result.err
    assert set(empty_store.ids()) == {expert, newer}
    (empty_store.root / ".names" / "best").unlink()  # neither does it need a name
    with pytest.warns(UserWarning, match="schema 2"):
        assert empty_store.collect(0.0) == ([], [])


def test_verify_reports_damage_as_json(irl, empty_store, publish):
    artefact = publish(empty_store).artefact
    sound = publish(empty_store, parameters={"seed": 1}).artefact
    path = artefact.directory / "reward.pt"
    path.chmod(0o644)
    path.write_bytes(b"x" * path.stat().st_size)
    result = irl("verify", "--json", "--store", empty_store.root)
    assert result.code == 4
    said = json.loads(result.out)
    assert (said["kind"], said["exit_code"], said["checked"]) == ("error", 4, 2)
    assert list(said["damaged"]) == [artefact.id] and sound.id not in result.out
    damage = said["damaged"][artefact.id]
    assert "reward.pt" in damage["problems"][0] and "differs" in damage["problems"][0]
    assert damage["command"] == f"irl train-airl --store {empty_store.root}"
    assert Path(damage["quarantine"], "reward.pt").exists()


def test_verify_reports_missing_artefacts(irl, empty_store, publish):
    """Those that names point to, and the inputs of named artefacts; no others."""
    chain = []
    for name in ("expert", "demos", "reward"):
        inputs, places = {}, {}
        if chain:
            output = chain[-1].manifest.outputs[0]
            inputs = {"input": output.sha256}
            places = {"input": f"{chain[-1].id}/{output.path}"}
        files, parameters = {name: name.encode()}, {"of": name}
        made = publish(empty_store, files, parameters=parameters, inputs=inputs, places=places)
        chain.append(made.artefact)
    expert, demos, reward = chain
    foreign = {"inputs": {"input": "0" * 64}, "places": {"input": "elsewhere/reward.pt"}}
    other = publish(empty_store, parameters={"of": "a file"}, **foreign).artefact
    for name, artefact in (("kept", reward), ("other", other), ("demos", demos)):
        empty_store.set_name(name, artefact)
    sound = irl("verify", "--store", empty_store.root)
    assert (sound.code, sound.out, sound.err) == (0, "4 artefacts verified\n", "")
    # What another process published while the artefacts were read is not missing.
    assert empty_store.missing(Index({reward.id: reward}, {})) == {}
    shutil.rmtree(demos.directory)
    result = irl("verify", "--json", "--store", empty_store.root)
    said = json.loads(result.out)
    assert (result.code, said["exit_code"], said["checked"]) == (4, 4, 3)
    assert said["missing"] == {demos.id: {"names": ["demos"], "made": [reward.id], "command": None}}
    line = f"{demos.id} is missing: the name 'demos' points to it; {reward.id} was made from it"
    result = irl("verify", "--store", empty_store.root)
    assert result.err.splitlines()[0] == line
    assert "error: 1 of 3 names point to nothing: demos" in result.err
    collected = irl("gc", "--grace-days", "0", "--store", empty_store.root)
    assert collected.out.startswith(expert.id)
    assert line in collected.err
    # Computed again with other bytes, it has its name again; the reward's input stays missing.
    again = publish(empty_store, {"demos": b"other"}, parameters={"of": "again"}).artefact
    empty_store.set_name("demos", again)
    result = irl("verify", "--json", "--store", empty_store.root)
    assert result.code == 0
    lost = {"names": [], "made": [reward.id], "command": None}
    assert json.loads(result.out)["missing"] == {demos.id: lost}
    assert f"warning: {demos.id} is missing: {reward.id} was made from it" in result.err
    # Without a name that needs it, it is not missing.
    (empty_store.root / ".names" / "kept").unlink()
    result = irl("verify", "--json", "--store", empty_store.root)
    assert (result.code, json.loads(result.out)["missing"]) == (0, {})


def test_what_was_quarantined_is_missing_with_the_command_that_makes_it(irl, empty_store, publish):
    made = publish(empty_store).artefact
    empty_store.set_name("best", made)
    (made.directory / "reward.pt").chmod(0o644)
    (made.directory / "reward.pt").write_bytes(b"other")
    assert "1 of 1 artefacts was damaged" in irl("verify", "--store", empty_store.root).err
    result = irl("verify", "--store", empty_store.root)
    assert result.code == 4
    assert "irl train-airl" in result.err
    assert ".quarantine" in result.err


@pytest.mark.parametrize("place", ["/0123456789abcdef/file", "0123456789abcdef", "", None])
def test_an_input_from_no_artefact_leads_to_nothing_missing(irl, empty_store, publish, place):
    places = {} if place is None else {"input": place}
    made = publish(empty_store, inputs={"input": "0" * 64}, places=places).artefact
    empty_store.set_name("odd", made)
    for command in ("verify", "gc"):
        assert irl(command, "--store", empty_store.root).code == 0


def test_gc_works_although_a_provenance_is_damaged(irl, empty_store, publish):
    made = publish(empty_store, inputs={"input": "0" * 64}).artefact
    empty_store.set_name("damaged", made)
    path = made.directory / "provenance.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b"train-airl", b"train-arli"))
    assert irl("gc", "--store", empty_store.root).code == 0
    assert irl("verify", "--store", empty_store.root).code == 4


def test_an_input_of_a_newer_schema_is_not_missing(irl, empty_store, publish, mixed):
    _, newer, _ = mixed
    made = publish(
        empty_store,
        parameters={"of": "newer"},
        inputs={"input": "1" * 64},
        places={"input": f"{newer}/reward.pt"},
    ).artefact
    for name, id16 in (("made", made.id), ("best", newer)):
        (empty_store.root / ".names" / name).write_text(f"{id16}\n")
    result = irl("verify", "--json", "--store", empty_store.root)
    assert (result.code, json.loads(result.out)["missing"]) == (0, {})


def manifests_read(monkeypatch) -> list[str]:
    read = []
    original = artefact_module.read_manifest

    def counting(directory):
        read.append(directory.name)
        return original(directory)

    monkeypatch.setattr(artefact_module, "read_manifest", counting)
    return read


@pytest.mark.parametrize("text", ["ls", "gc", "gc --delete", "lineage REF"])
def test_each_manifest_is_read_once(irl, empty_store, publish, monkeypatch, text):
    """Twice for the artefact that is named on the command line."""
    parent = None
    for seed in range(12):
        inputs = {} if parent is None else {"reward": parent.output("f").sha256}
        files = {"f": b"%d" % seed}
        parent = publish(empty_store, files, parameters={"seed": seed}, inputs=inputs).artefact
    empty_store.set_name("last", parent)
    read = manifests_read(monkeypatch)
    arguments = [parent.id if word == "REF" else word for word in text.split()]
    result = irl(*arguments, "--store", empty_store.root)
    assert result.code == 0, result.err
    named = [parent.id] if "REF" in text else []
    assert sorted(read) == sorted([*empty_store.ids(), *named])


@pytest.mark.parametrize("seed", range(6))
def test_lineage_ends_where_content_leads_back(irl, empty_store, publish, seed):
    """Whichever of the two ids sorts first."""
    first = publish(empty_store, {"f": b"same"}, parameters={"seed": seed}).artefact
    inputs = {"reward": first.output("f").sha256}
    second = publish(
        empty_store, {"f": b"same", "g": b"x"}, parameters={"seed": seed}, inputs=inputs
    ).artefact
    result = irl("lineage", second.id, "--json", "--store", empty_store.root)
    assert result.code == 0, result.err
    (parent,) = json.loads(result.out)["inputs"]
    assert parent["from"]["id"] == first.id


# Claims


def before_the_next_repair(monkeypatch, act) -> None:
    """Call ``act`` once, just before a process takes the lock under which it repairs."""
    original = integrity.repairing

    def put(function) -> None:
        for module in (integrity, publishing):
            monkeypatch.setattr(module, "repairing", function)

    def interrupted(layout):
        put(original)
        act()
        return original(layout)

    put(interrupted)


RECORD = KeyRecord("train-airl", 1, {"seed": 0}, {})


def staged(store: Store, name: str, data: bytes) -> Path:
    output = store.root / ".work" / RECORD.key / name
    output.mkdir(parents=True)
    (output / "f").write_bytes(data)
    return output


def test_a_claim_of_a_missing_artefact_is_replaced_but_never_a_valid_one(empty_store, monkeypatch):
    """Another process makes a valid claim just before the stale one is removed."""
    store = empty_store
    pointer = store.root / ".keys" / RECORD.key
    pointer.write_text("0" * 16)
    output = staged(store, "slow", b"slow")
    rival = None

    def make_a_valid_claim() -> None:
        nonlocal rival
        rival = Store(store.root).publish(RECORD, staged(store, "fast", b"fast"), {})

    before_the_next_repair(monkeypatch, make_a_valid_claim)
    slow = store.publish(RECORD, output, {})
    assert rival is not None and rival.diverged is None
    assert slow.diverged == rival.artefact
    assert store.find(RECORD.key) == rival.artefact
    assert len(store.ids()) == 2


def test_a_damaged_holder_gives_up_its_claim(empty_store):
    """The new result is published instead of being lost to an error."""
    store = empty_store
    holder = store.publish(RECORD, staged(store, "one", b"one"), {}).artefact
    (holder.directory / "f").unlink()
    second = store.publish(RECORD, staged(store, "two", b"two"), {})
    assert second.diverged is None
    assert store.find(RECORD.key) == second.artefact
    assert len(list((store.root / ".quarantine").iterdir())) == 1


def test_what_was_repaired_meanwhile_is_not_set_aside(empty_store, publish, monkeypatch):
    """Another process replaces the damaged artefact just before it is moved."""
    store = empty_store
    artefact = publish(store).artefact
    path = artefact.directory / "reward.pt"
    path.chmod(0o644)
    path.write_bytes(b"x" * path.stat().st_size)

    def repair() -> None:
        Store(store.root).verify([artefact.id])
        publish(Store(store.root))

    before_the_next_repair(monkeypatch, repair)
    with pytest.raises(Busy, match="repaired"):
        store.open(artefact, "reward.pt")
    assert store.ids() == [artefact.id] and store.verify([artefact.id]).damaged == {}


def test_a_removed_artefact_is_missing_not_damaged(empty_store, publish):
    artefact = publish(empty_store).artefact
    while empty_store.ids():
        empty_store.collect(0.0)
    with pytest.raises(NotFound, match="missing"):
        empty_store.open(artefact, "reward.pt")
    with pytest.raises(NotFound, match="missing"):
        read.get(Layout(empty_store.root), artefact.id)
    assert empty_store.find(artefact.manifest.record.key) is None


# Collection


def test_a_dry_run_survives_what_disappears_meanwhile(empty_store, publish, monkeypatch):
    artefact = publish(empty_store).artefact
    with empty_store.working_on("0" * 64, wait=False) as scratch:
        scratch.save(b"state")
    original = garbage._older

    def vanishing(path, limit):
        if path.name == artefact.id:
            path.chmod(0o755)
            path.rename(empty_store.root / ".quarantine" / "x")
        else:
            scratch.clear()
        return original(path, limit)

    monkeypatch.setattr(garbage, "_older", vanishing)
    assert empty_store.garbage(-1.0) == []
    assert empty_store.stale_work(-1.0) == []


@pytest.mark.parametrize("text", ["name {id} kept", "ls", "show {id}", "HIT --name kept"])
def test_nothing_is_collected_while_a_command_uses_it(irl, store_copy, monkeypatch, text):
    """gc tries to run just before the command ends."""
    from irlcli.cli import console

    store = Store(store_copy.path)
    for name in (store_copy.path / ".names").iterdir():
        name.unlink()
    if text.startswith("HIT"):
        text = f"transfer --reward {store_copy.airl} --ood 1.5x --profile smoke --name kept"
    asked = []
    original = console._write

    def collecting(line, stream):
        if stream is sys.stdout:
            with pytest.raises(Busy):
                store.collect(0.0)
            asked.append(line)
        original(line, stream)

    set_name = Store.set_name

    def naming(self, name, artefact):
        with pytest.raises(Busy):
            store.collect(0.0)
        set_name(self, name, artefact)

    monkeypatch.setattr(console, "_write", collecting)
    monkeypatch.setattr(Store, "set_name", naming)
    line = text.format(id=store_copy.transfer).split()
    result = irl(*line, "--store", store_copy.path)
    assert result.code == 0, result.err
    assert asked and store_copy.transfer in store.ids()
    if "kept" in text:
        store.collect(0.0)
        assert store_copy.transfer in store.ids() and store_copy.expert in store.ids()


def test_a_command_waits_for_gc_to_end(irl, empty_store, publish):
    artefact = publish(empty_store).artefact
    ready, done = os.pipe()
    pid = os.fork()
    if pid == 0:
        from irlcli.store.lease import Patience
        from irlcli.store.lock import exclusive

        with exclusive(empty_store.root / ".locks" / "gc", Patience()):
            os.write(done, b"x")
            time.sleep(1.0)
        os._exit(0)
    os.read(ready, 1)
    try:
        result = irl("show", artefact.id, "--store", empty_store.root)
    finally:
        os.waitpid(pid, 0)
    assert result.code == 0
    assert f"WAIT the store: process {pid}" in result.err


def test_leftovers_of_killed_processes_are_removed(empty_store, publish):
    """Temporary files of every kind, of a process that was killed while it wrote them."""
    key = "0" * 64
    pid = os.fork()
    if pid == 0:
        from irlcli.store import durable

        def killed(*_):
            os.kill(os.getpid(), signal.SIGKILL)

        artefact = publish(empty_store).artefact
        with empty_store.working_on(key, wait=False) as place:
            place.save(b"first")
            place.new_output()
            durable.os.replace = killed
            place.save(b"second")
        empty_store.set_name("best", artefact)
    assert os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL
    work = empty_store.root / ".work" / key
    assert len(list(work.iterdir())) == 3
    with empty_store.working_on(key, wait=False) as place:
        assert place.load() == b"first"
        output = place.new_output()
        assert sorted(p.name for p in work.iterdir()) == sorted(["checkpoint", output.name])
        output.rmdir()
        place.clear()
    assert not work.exists()


def test_integrity_errors_of_a_store_without_its_empty_directories(empty_store, publish):
    """Some copying programs leave out empty directories."""
    artefact = publish(empty_store).artefact
    (empty_store.root / ".quarantine").rmdir()
    (artefact.directory / "reward.pt").unlink()
    with pytest.raises(IntegrityError, match="damaged"):
        Store(empty_store.root).find(artefact.manifest.record.key)
    assert len(list((empty_store.root / ".quarantine").iterdir())) == 1


@pytest.mark.parametrize(
    "module, call",
    [
        (artefact_module, "file_digest"),
        (integrity, "read_provenance"),
        (integrity, "entries"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_verify_survives_what_disappears_while_it_is_read(
    empty_store, publish, monkeypatch, module, call
):
    """An artefact that another process collects meanwhile is not damaged."""
    artefact = publish(empty_store).artefact
    original = getattr(module, call)

    def vanishing(*arguments):
        if artefact.directory.exists():
            artefact.directory.chmod(0o755)
            artefact.directory.rename(empty_store.root / ".work" / "x")
        return original(*arguments)

    monkeypatch.setattr(module, call, vanishing)
    assert empty_store.verify([artefact.id]).damaged == {}
    assert list((empty_store.root / ".quarantine").iterdir()) == []
