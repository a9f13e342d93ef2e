"""Attacks, damage and interruptions that reach the program through its own command line.

What an attacker may bring: files, stores, streams and signals. What comes of it: a named error, no
code run, nothing written elsewhere, bounded memory, no hang. Beside test_bad_input.py, which has the
wrong command lines and the hostile tensor files, and store/test_integrity.py.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from irlcli.cli import console
from irlcli.cli import main as cli
from irlcli.data.demonstrations import EPISODES, STEPS
from irlcli.data.tensors import RefusedCode, from_bytes, load_reward_file, restore, to_bytes
from irlcli.errors import IntegrityError, UsageError
from irlcli.experiments import provenance
from irlcli.stages import train_maxent, transfer
from irlcli.stages.base import Stage
from irlcli.store import Store

SMOKE = ["--profile", "smoke"]
LANDER = ["--env", "lunar-lander", "--intervention"]
FIELDS = ("expert", "demos", "airl", "transfer", "evaluation")
CHAIN = [
    ["collect-experts", *LANDER, "engine-power=1x,1.25x", "--name", "demos"],
    ["train-airl", "--demos", "demos", "--method", "irm", "--name", "airl"],
    ["transfer", "--reward", "airl/reward.pt", "--ood", "1.5x", "--name", "moved"],
    ["evaluate", "--policy", "moved", "--ood", "1.5x", "--name", "score"],
]
GRIDWORLD = [
    [
        "collect-experts",
        "--env",
        "gridworld",
        "--intervention",
        "path-group=1,2",
        "--name",
        "mazes",
    ],
    ["train-maxent", "--demos", "mazes", "--method", "irm", "--name", "maxent"],
]
# Runs command lines, given as JSON, one after the other in one process; prints each exit code and
# what it wrote, and the peak of the process's memory [KiB].
MANY = """
import contextlib, io, json, re, sys
from irlcli.cli.main import main
results = []
for line in json.loads(sys.argv[1]):
    out, err, code = io.StringIO(), io.StringIO(), 0
    sys.argv = ["irl", *line]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as stop:
        code = stop.code or 0
    results.append([code, out.getvalue(), err.getvalue()])
peak = int(re.search(r"VmHWM:\\s*(\\d+) kB", open("/proc/self/status").read())[1])
print(json.dumps({"results": results, "peak": peak}))
"""


def run_many(lines, **options):
    """``MANY`` over command lines; [(code, stdout, stderr)] and the peak [KiB]."""
    done = subprocess.run(
        [sys.executable, "-c", MANY, json.dumps([[str(w) for w in line] for line in lines])],
        capture_output=True,
        text=True,
        timeout=600,
        **options,
    )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    return answer["results"], answer["peak"]


@pytest.fixture(scope="session")
def maze_store(tmp_path_factory, run_irl) -> Path:
    """The gridworld's chain at the smoke profile."""
    store = tmp_path_factory.mktemp("mazes") / "runs"
    for line in GRIDWORLD:
        done = run_irl([*line, *SMOKE, "--quiet", "--store", str(store)])
        assert done.code == 0, done.err
    return store


# Damage


def flip(path: Path, other: bytes) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0x04
    path.write_bytes(data)


DAMAGE = {
    "a bit flipped": flip,
    "cut": lambda path, other: os.truncate(path, path.stat().st_size * 2 // 3),
    "emptied": lambda path, other: os.truncate(path, 0),
    "deleted": lambda path, other: path.unlink(),
    "another's": lambda path, other: path.write_bytes(other),
}


def files_of(directory: Path) -> list[Path]:
    return sorted(p for p in directory.rglob("*") if p.is_file())


@pytest.mark.parametrize("field", FIELDS)
def test_damage_of_any_file_is_seen_on_read_and_by_verify(store_copy, field):
    """Every file that the real chain wrote, manifest and provenance included."""
    store, id16 = Store(store_copy.path), getattr(store_copy, field)
    sound = store_copy.path.parent / "sound"
    shutil.copytree(store_copy.path / id16, sound)
    foreign = next(store.root / i for i in store.ids() if i != id16)
    key, found = store.get(id16).manifest.record.key, files_of(sound)
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
                        artefact = store.get(id16)
                        artefact.provenance()
                        for output in artefact.manifest.outputs:
                            store.open(artefact, output.path)
                    assert id16 in caught.value.message, (name, kind)
                if not reading or place.exists():  # altered provenance is refused, not moved
                    assert list(store.verify([id16])) == [id16], (name, kind)
                assert not place.exists()
                assert not (store.root / ".keys" / key).exists()
                (moved,) = (store.root / ".quarantine").iterdir()
                shutil.rmtree(moved)
                shutil.copytree(sound, place)
                (store.root / ".keys" / key).write_text(id16)
    assert store.verify([id16]) == {}


def test_everything_lost_is_recomputed_to_the_same_ids_in_another_environment(
    store_copy, maze_store, tmp_path
):
    """Determinism and repair at once, as a second full chain is dear.

    The second computation has other hashes of strings, locale, time zone, umask, directory, store
    path, number of threads, and two processes that step the environments.
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
        assert set(store.verify(store.ids())) == set(before[stores.index(store)])
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
        assert store.verify(store.ids()) == {}


# Files made by an attacker


def assert_refused(result, code: int, named: str) -> None:
    status, out, err = result
    assert (status, out) == (code, ""), err
    assert "Traceback" not in err and "this is a defect" not in err, err
    lines = err.splitlines()
    (message,) = (line for line in lines if line.startswith("error: "))
    assert named in message and len(message) < 1200, err
    assert lines[-1].startswith("hint: "), err
    assert err.replace("\n", "").isprintable()


def declare_many_rows(directory: Path) -> None:
    """A quarter of a million bytes that stand for 268 million rows."""
    path = directory / STEPS
    table = pa.table({"a": pa.array([0.0]).take(pa.array([0] * (1 << 20)))})
    with pq.ParquetWriter(path, table.schema, compression="zstd") as writer:
        writer.write_table(pa.concat_tables([table] * 16).combine_chunks(), row_group_size=1 << 24)
    for _ in range(4):
        footer, again = pq.read_metadata(path), pq.read_metadata(path)
        footer.append_row_groups(again)
        footer.write_metadata_file(path)
    assert pq.read_metadata(path).num_rows == 1 << 28 and path.stat().st_size < 1 << 20


def long_setting(directory: Path) -> None:
    """A text of 8 MB in a few kilobytes."""
    path = directory / EPISODES
    table = pq.read_table(path)
    column = table.schema.get_field_index("setting")
    texts = pa.array(["a" * (8 << 20)] * len(table))
    pq.write_table(
        table.set_column(column, table.schema.field(column), texts), path, compression="zstd"
    )
    assert path.stat().st_size < 1 << 20


def nested(directory: Path) -> None:
    path = directory / STEPS
    kind = pa.float32()
    for _ in range(40):
        kind = pa.list_(pa.struct([("x", kind)]))
    table = pq.read_table(path)
    column = table.schema.get_field_index("obs")
    pq.write_table(table.set_column(column, "obs", pa.nulls(len(table), kind)), path)


def one_wide_row(directory: Path) -> None:
    """A list of 22 million numbers in one cell."""
    path = directory / EPISODES
    table = pq.read_table(path)
    column = table.schema.get_field_index("intervention")
    values = pa.array(np.zeros(22_000_000))
    offsets = pa.array([0] * len(table) + [len(values)], pa.int32())
    cells = pa.ListArray.from_arrays(offsets, values)
    pq.write_table(
        table.set_column(column, table.schema.field(column).with_nullable(False), cells), path
    )


def pipe_instead(name: str):
    def change(directory: Path) -> None:
        (directory / name).unlink()
        os.mkfifo(directory / name)

    return change


def endless(directory: Path) -> None:
    (directory / EPISODES).unlink()
    (directory / EPISODES).symlink_to("/dev/zero")


def huge(directory: Path) -> None:
    os.truncate(directory / STEPS, 1 << 40)


def aborting_footer(directory: Path) -> None:
    """A histogram of repetition levels with a bin too many: pyarrow 26 aborts where it sees it."""
    data = (directory / EPISODES).read_bytes()
    start = end = data.rindex(b"<)&") + 3
    for _ in range(2):  # the bins, numbers of variable length
        while data[end] & 0x80:
            end += 1
        end += 1
    size = int.from_bytes(data[-8:-4], "little") + 1
    (directory / EPISODES).write_bytes(
        data[: start - 1]
        + b"6"
        + data[start:end]
        + b"\0"
        + data[end:-8]
        + size.to_bytes(4, "little")
        + data[-4:]
    )


def endless_episode(directory: Path) -> None:
    table = pq.read_table(directory / EPISODES)
    lengths = pa.array([1 << 30] * len(table), table.schema.field("length").type)
    changed = table.set_column(table.schema.get_field_index("length"), "length", lengths)
    pq.write_table(changed, directory / EPISODES)


DATASETS = {
    "aborting": aborting_footer,
    "endless-episode": endless_episode,
    "rows": declare_many_rows,
    "text": long_setting,
    "nested": nested,
    "wide": one_wide_row,
    "steps-pipe": pipe_instead(STEPS),
    "episodes-pipe": pipe_instead(EPISODES),
    "endless": endless,
    "huge": huge,
}
TOML = {
    "dotted": ".".join(["a"] * 20_000) + " = 1",
    "tables": "[" + ".".join(["airl"] * 20_000) + "]",
    "inline": "x = " + "{a=" * 600,
    "arrays": "[airl]\nhidden = " + "[" * 1500,
    "integer": "[airl]\ntotal_steps = " + "9" * 1900,
    "hexadecimal": "[airl]\ntotal_steps = 0x" + "f" * 1900,
    "worlds": "[airl.ppo]\nn_envs = 1_000_000_000",
    "date": "[airl]\ntotal_steps = 1979-05-27",
    "escapes": '"\\u001b[2J\\nerror: x" = 1',
    "long name": "a" * 1990 + " = 1",
    "long value": f"[airl]\nmethod = '{'b' * 1900}'",
    "list for a table": "airl = [1]",
    "interventions": "[interventions]\nbounce = 3",
}


def test_hostile_datasets_and_settings_take_bounded_memory(smoke_store, tmp_path):
    """Bombs, pipes and endless files, each refused by name, all in one process of 600 MiB."""
    lines, expected = [], []
    before = sorted(tmp_path.parent.rglob("*"))
    for kind, change in DATASETS.items():
        directory = tmp_path / f"dataset-{kind}"
        directory.mkdir()
        for name in (STEPS, EPISODES):
            shutil.copyfile(smoke_store.path / smoke_store.demos / name, directory / name)
        change(directory)
        lines.append(["train-airl", "--demos", directory])
        expected.append((4, directory.name))
    for kind, text in TOML.items():
        (tmp_path / f"{kind}.toml").write_text(text)
        lines.append(["train-airl", "--demos", "demos", "--settings", tmp_path / f"{kind}.toml"])
        expected.append((2, f"{kind}.toml"))
    os.mkfifo(tmp_path / "pipe.toml")
    with open(tmp_path / "sparse.toml", "wb") as file:
        file.truncate(1 << 40)
    for path in (tmp_path / "pipe.toml", tmp_path / "sparse.toml", Path("/dev/zero")):
        lines.append(["train-airl", "--demos", "demos", "--settings", path])
        expected.append((2, path.name))
    made = sorted(tmp_path.parent.rglob("*"))
    common = ["--dry-run", "--store", smoke_store.path]
    results, peak = run_many([[*line, *common] for line in lines])
    for result, (code, named) in zip(results, expected, strict=True):
        assert_refused(result, code, named)
    assert peak < 600 << 10
    assert sorted(tmp_path.parent.rglob("*")) == made and made != before  # nothing was written


def test_a_tensor_that_claims_a_huge_shape(smoke_store, tmp_path):
    """Four bytes seen as 2**40 numbers: refused for its shape, never copied."""
    data = from_bytes((smoke_store.path / smoke_store.airl / "reward.pt").read_bytes())
    name = next(iter(data["state"]))
    data["state"][name] = torch.zeros(1).expand(1 << 20, 1 << 20)
    (tmp_path / "wide.pt").write_bytes(to_bytes(data))
    with pytest.raises(IntegrityError, match=r"wide\.pt"):
        load_reward_file(tmp_path / "wide.pt")


def test_checkpoints_of_another_stage_are_not_used():
    said = []
    names = {"round", "rows"}
    assert restore(to_bytes({"round": 1, "rows": "[]"}), names, said.append)["round"] == 1
    assert restore(None, names, said.append) is None and not said
    for value in ([], {}, {"round": 1}, {"round": 1, "rows": "", "more": 0}, "text", torch.ones(2)):
        assert restore(to_bytes(value), names, said.append) is None
    assert len(said) == 6 and all("starting over" in text for text in said)
    with pytest.raises(RefusedCode):
        from_bytes(to_bytes({"x": Path("/")}))


def save_checkpoint(store: Store, key: str, stage: Stage, state: dict) -> None:
    """Write ``state`` where ``stage`` at work on ``key`` would find it, as its own."""
    header = provenance.Header(
        schema=provenance.SCHEMA,
        stage=stage.name,
        stage_version=stage.version,
        libraries=provenance.libraries(),
        attempts=(),
    )
    with store.working_on(key, wait=False) as scratch:
        scratch.save(header.encode(to_bytes(state)))


@pytest.mark.parametrize(
    "changes",
    [
        {"trainer": {}},
        {"trainer": []},
        {"rows": torch.zeros(3, dtype=torch.uint8)},
        {"rows": 7},
        {"round": "x"},
        {"trainer": {"policy": {}, "optimizer": {}, "steps": 0}},
    ],
)
def test_a_checkpoint_made_by_somebody_is_named(irl, store_copy, changes):
    """Sound tensors and a sound checksum around a state that no stage wrote."""
    store = Store(store_copy.path)
    key = store.get(store_copy.transfer).manifest.record.key
    (store.root / ".keys" / key).unlink()
    rows = torch.frombuffer(bytearray(b"[]"), dtype=torch.uint8)
    state = {"trainer": {}, "adversary": {}, "selection": {}, "round": 0, "rows": rows, **changes}
    save_checkpoint(store, key, transfer.STAGE, state)
    done = irl(*CHAIN[2], *SMOKE, "--quiet", "--store", store.root)
    assert_refused((done.code, done.out, done.err), 4, key)
    shutil.rmtree(store.root / ".work" / key)
    again = irl(*CHAIN[2], *SMOKE, "--quiet", "--store", store.root)
    assert Path(again.out.strip()).name == store_copy.transfer


@pytest.mark.parametrize(
    "changes",
    [
        {"networks": {}},
        {"optimizer": {"state": {}, "param_groups": []}},
        {"records": []},
        {"records": "x"},
        {"iterations": "many"},
    ],
)
def test_a_gridworld_checkpoint_made_by_somebody_is_named(irl, maze_store, tmp_path, changes):
    path = tmp_path / "runs"
    shutil.copytree(maze_store, path, symlinks=True)
    store = Store(path)
    found = store.get(store.names()["maxent"]).manifest.record
    (store.root / ".keys" / found.key).unlink()
    state = {"iterations": 1, "networks": {}, "optimizer": {}, "records": [], **changes}
    save_checkpoint(store, found.key, train_maxent.STAGE, state)
    done = irl(*GRIDWORLD[1], *SMOKE, "--quiet", "--store", path)
    assert_refused((done.code, done.out, done.err), 4, found.key)


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
    node = os.uname().nodename
    (store.root / ".work" / key).mkdir()
    for pid in ("x", "9" * 40):
        (store.root / ".work" / key / f"out.{pid}.{'0' * 32}.{node}").mkdir()
    # 2 ** 22 is the largest process number there can be.
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
def test_what_lies_in_the_scratch_directory_is_not_followed(irl, store_copy, tmp_path, plant):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("kept")
    store = Store(store_copy.path)
    key = store.get(store_copy.transfer).manifest.record.key
    (store.root / ".keys" / key).unlink()
    plant(store, key, outside)
    done = irl(*CHAIN[2], *SMOKE, "--store", store.root)
    assert Path(done.out.strip()).name == store_copy.transfer, done.err
    assert ("cannot be used" in done.err) == ("checkpoint" in plant.__name__)
    assert (outside / "precious").read_text() == "kept"


@pytest.mark.parametrize("name", [".keys", ".names", ".work", ".locks", ".quarantine"])
def test_a_store_does_not_lead_out_of_itself(irl, store_copy, tmp_path, name):
    outside = tmp_path / "outside"
    (store_copy.path / name).rename(outside)
    (store_copy.path / name).symlink_to(outside)
    before = sorted(outside.rglob("*"))
    for line in (["gc", "--delete", "--grace-days", "0"], [*CHAIN[2], *SMOKE, "--name", "x"]):
        done = irl(*line, "--store", store_copy.path)
        assert_refused((done.code, done.out, done.err), 4, f"{name} is a symbolic link")
    assert sorted(outside.rglob("*")) == before


def test_a_scratch_directory_a_lock_a_name_and_a_claim_that_lead_out(irl, store_copy, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("kept" * 10)
    store = Store(store_copy.path)
    key = store.get(store_copy.transfer).manifest.record.key
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


def planted(store: Store, source: str, name: str, data: bytes) -> None:
    """Put an artefact in ``source``'s place, sound by its digests, that says ``data`` in ``name``."""
    artefact = store.get(source)
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
def test_measures_made_by_somebody_are_checked(irl, maze_store, tmp_path, name, file, line, data):
    """What a hit prints beside its artefact's path."""
    path = tmp_path / name
    shutil.copytree(maze_store, path, symlinks=True)
    store = Store(path)
    planted(store, store.names()[name], file, data)
    done = irl(*line, *SMOKE, "--quiet", "--store", path)
    assert Path(done.out.strip()).parent == path  # the artefact itself is there
    assert_refused((done.code, "", done.err), 4, file)


def test_what_an_artefact_says_does_not_drive_the_terminal(irl, empty_store, publish):
    """Control characters in a parameter and in a command: shown as question marks."""
    made = publish(empty_store, parameters={"env": "\x1b[2J\x9b31m", "setting": "a\nb"}).artefact
    listed = irl("ls", "--store", empty_store.root)
    assert made.id in listed.out and len(listed.out.splitlines()) == 2
    ref = irl("show", "\x1b[2J\u202e\nerror: forged", "--store", empty_store.root)
    assert_refused((ref.code, ref.out, ref.err), 3, "[2J")
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        console.TerminalConsole().warn("a\x1b[2Jb\nerror: forged")
    assert said.getvalue() == "warning: a?[2Jb?error: forged\n"


# Signals and streams


class InterruptingStream(io.StringIO):
    """A stderr that sends SIGINT to its own process once it is told ``trigger``."""

    def __init__(self, trigger: str):
        super().__init__()
        self.trigger = trigger

    def write(self, text: str) -> int:
        if self.trigger and self.trigger in text:
            self.trigger = ""
            signal.raise_signal(signal.SIGINT)
        return super().write(text)


ENDLESS = "9000000000"
INTERRUPTED = {
    "train-expert": (
        [*CHAIN[0], "--seed", "3", "--set", f"expert.total_steps={ENDLESS}"],
        "checkpoint",
    ),
    "train-airl": ([*CHAIN[1], "--set", f"airl.total_steps={ENDLESS}"], "checkpoint"),
    "transfer": ([*CHAIN[2], "--set", f"transfer.total_steps={ENDLESS}"], "checkpoint"),
    "collect-experts": ([*CHAIN[0], "--seed", "3"], "stopped after"),
    "evaluate": (["evaluate", "--policy", "airl", "--ood", "1.7x,1.8x"], "stopped after"),
    "train-maxent": ([*GRIDWORLD[1], "--set", f"maxent.iterations={ENDLESS}"], "checkpoint"),
}


@pytest.mark.parametrize("stage", INTERRUPTED)
def test_ctrl_c_at_every_stage(monkeypatch, irl, store_copy, maze_store, tmp_path, stage):
    """130 and a checkpoint where there are rounds; where there are none the stage is finished."""
    line, said = INTERRUPTED[stage]
    store = store_copy.path
    if stage == "train-maxent":
        store = tmp_path / "mazes"
        shutil.copytree(maze_store, store, symlinks=True)
    line = [*line, *SMOKE, "--store", str(store)]
    stream = InterruptingStream(f"  {stage} ")  # the first report of progress
    out = io.StringIO()
    monkeypatch.setattr(sys, "argv", ["irl", *line])
    with (
        contextlib.redirect_stderr(stream),
        contextlib.redirect_stdout(out),
        pytest.raises(SystemExit) as stop,
    ):
        cli.main()
    err = stream.getvalue()
    assert (stop.value.code, out.getvalue()) == (130, ""), err
    assert "Traceback" not in err and "hint: run the same command again" in err
    (message,) = (text for text in err.splitlines() if text.startswith("error: "))
    assert said in message
    planned = irl(*line, "--dry-run").out
    assert planned.startswith("RESUME" if said == "checkpoint" else "HIT"), planned


IRL = f"{sys.executable} -m irlcli"


@pytest.mark.parametrize(
    ("text", "codes"),
    [
        ("{irl} ls --store {store} | head -0", (0, 141)),
        ("{irl} show airl --store {store} | true", (141,)),
        ("{irl} lineage score --store {store} --json | true", (141,)),
        ("{irl} --help | true", (0, 1, 141)),
        ("{irl} nonsense --json | true", (2,)),
        ("{irl} nonsense 2>&1 >/dev/null | true", (2,)),
        ("{irl} verify --store {store} >&-", (0,)),
        ("{irl} ls --store {store} 2>&-", (0,)),
        ("{irl} nonsense >&- 2>&-", (2,)),
        (
            "{irl} evaluate --policy moved --ood 1.5x --profile smoke --store {store} <&- >&- 2>&-",
            (0,),
        ),
        (
            "{irl} evaluate --policy moved --ood 1.5x --profile smoke --store {store} 2>&1 | true",
            (141,),
        ),
        ("{irl} show airl --store {store} > /dev/full", (1,)),
    ],
)
def test_streams_that_nobody_reads(smoke_store, text, codes):
    """Closed pipes, closed descriptors and a full device: quiet, with a sensible exit code."""
    line = text.format(irl=IRL, store=smoke_store.path)
    done = subprocess.run(
        ["bash", "-c", f"{line}\necho CODE ${{PIPESTATUS[0]}}"], capture_output=True, text=True
    )
    said = done.stdout + done.stderr
    for word in ("Traceback", "Exception ignored", "BrokenPipe", "this is a defect"):
        assert word not in said
    assert int(said.rpartition("CODE ")[2].split()[0]) in codes, said
    if "full" not in text:
        assert done.stderr == ""


def test_paths_that_are_no_text_come_out_as_their_bytes(smoke_store, tmp_path):
    store = os.fsencode(tmp_path) + b"/st\xffre \xc3\xa9"
    shutil.copytree(os.fsencode(smoke_store.path), store, symlinks=True)
    line = [*CHAIN[3], *SMOKE, "--quiet", "--store", store]
    for name in ("UTF-8", "ascii"):
        done = subprocess.run(
            [sys.executable, "-m", "irlcli", *line],
            capture_output=True,
            env={**os.environ, "PYTHONIOENCODING": name},
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout == store + b"/" + smoke_store.evaluation.encode() + b"\n"


# The command line


def test_ls_tells_what_an_artefact_was_learned_by(irl, store_copy):
    """Method and lambda of transfers and evaluations, though their own parameters have neither."""
    listed = irl("ls", "--store", store_copy.path).out
    (transfer,) = (row for row in listed.splitlines() if store_copy.transfer in row)
    (score,) = (row for row in listed.splitlines() if store_copy.evaluation in row)
    made = Store(store_copy.path).get(store_copy.airl).manifest.record.parameters["airl"]
    learned = f"of train-airl irm lambda {made['penalty_weight']:g} seed 0"
    assert learned in transfer
    assert f"of transfer seed 0 {learned}" in score
    shutil.rmtree(store_copy.path / store_copy.airl)
    assert "lambda" not in irl("ls", "--store", store_copy.path).out  # where it is not known


def test_the_label_of_a_transfer_says_how_the_reward_was_learned(irl, store_copy, tmp_path):
    """Else two transfers of one seed share a line and a TensorBoard directory."""
    plan = irl(*CHAIN[2], *SMOKE, "--seed", "9", "--dry-run", "--store", store_copy.path).out
    assert "seed 9 of irm lambda" in plan
    shutil.copy(store_copy.path / store_copy.airl / "reward.pt", tmp_path)
    line = ["transfer", "--reward", tmp_path / "reward.pt", "--ood", "1.5x", "--seed", "9"]
    assert irl(*line, *SMOKE, "--dry-run", "--store", store_copy.path).out == plan


def test_labels_tell_apart_whose_policy_and_which_penalty(irl, store_copy, tmp_path):
    place = ["--dry-run", "--store", store_copy.path]
    line = [
        "evaluate",
        "--expert",
        "--trained-in",
        "engine-power=1x,1.25x",
        "--env",
        "lunar-lander",
    ]
    plan = irl(*line, "--ood", "engine-power=1.5x", *SMOKE, *place).out
    for own in ("1x", "1.25x"):
        assert f"evaluate expert of engine-power={own} in lunar-lander engine-power=1.5x" in plan
    plan = irl("evaluate", "--policy", "airl", "--ood", "1.5x", *SMOKE, *place).out
    assert "evaluate student irm of seed 0 in lunar-lander engine-power=1.5x seed 0" in plan
    store = Store(store_copy.path)
    makers = (a for a in store.artefacts() if a.manifest.record.stage == "train-expert")
    for expert in makers:
        own = expert.manifest.record.parameters["setting"]
        plan = irl("evaluate", "--policy", expert.id, "--ood", "1.5x", *SMOKE, *place).out
        assert f"evaluate expert of {own} in lunar-lander engine-power=1.5x seed 0" in plan


def test_version(irl):
    from importlib.metadata import version

    assert irl("--version") == (0, f"irlcli {version('irlcli')}\n", "")


def test_state_only_can_be_switched_off(irl, smoke_store, tmp_path):
    (tmp_path / "on.toml").write_text("[airl]\nstate_only = true")
    plans = [
        irl(*CHAIN[1], *SMOKE, *flags, "--dry-run", "--store", smoke_store.path).out
        for flags in (
            [],
            ["--settings", tmp_path / "on.toml", "--no-state-only"],
            ["--settings", tmp_path / "on.toml"],
            ["--state-only"],
        )
    ]
    assert plans[0] == plans[1] and plans[0].startswith("HIT")
    assert plans[2] == plans[3] and plans[2].startswith("RUN")


def test_the_seed_of_demonstrations_is_described_as_what_it_is(irl):
    assert "always 0" in " ".join(irl("collect-experts", "--help").out.split())


def test_tensorboard_is_missed_before_the_work(monkeypatch, irl, store_copy, tmp_path):
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "tensorboard" else found(name)
    )
    line = [*CHAIN[1], *SMOKE, "--seed", "8", "--tensorboard", tmp_path / "logs"]
    done = irl(*line, "--store", store_copy.path)
    assert_refused((done.code, done.out, done.err), 2, "tensorboard")
    assert "pip install tensorboard" in done.err and "RUN" not in done.err
    with pytest.raises(UsageError):
        console.TerminalConsole(tensorboard=tmp_path)


WRONG = [
    ("--versoin", 2, "--versoin"),
    ("ls --json=yes", 2, "--json"),
    ("collect-experts --env ''", 2, "--intervention"),
    ("collect-experts --env gridworld --intervention path-group=4", 2, "'4'"),
    ("collect-experts --env gridworld --intervention path-group=1.5", 2, "'1.5'"),
    ("collect-experts --env gridworld --intervention blocked=1x", 2, "'1x'"),
    ("collect-experts --env ant --intervention friction=1:2", 2, "'1:2'"),
    ("collect-experts --env ant --intervention friction=1:2:99", 2, "'1:2:99'"),
    ("collect-experts --env ant --intervention direction=10..-10", 2, "'10..-10'"),
    ("collect-experts --env ant --intervention direction=0..999", 2, "'0..999'"),
    ("collect-experts --env ant --intervention gravity=1x", 2, "'gravity'"),
    ("collect-experts --env reacher --intervention gravity=1", 2, "'1'"),
    ("collect-experts --env reacher --intervention gravity==1x", 2, "'=1x'"),
    ("collect-experts --env reacher --intervention gravity=1xx", 2, "'1xx'"),
    ("collect-experts --env reacher --intervention gravity=2x;3x", 2, "'2x;3x'"),
    (
        "collect-experts --env reacher --intervention gravity=1x --episodes 9999999999999999999",
        2,
        "9,999",
    ),
    (
        "collect-experts --env reacher --intervention gravity=1x --episodes 60000,60000",
        2,
        "2 episode",
    ),
    (
        "collect-experts --env reacher --intervention gravity=1x,2x --episodes 60000,60000",
        2,
        "120,000",
    ),
    ("collect-experts --env reacher --intervention gravity=1x --episodes 1.5", 2, "'1.5'"),
    ("train-maxent --demos demos", 2, "lunar-lander"),
    ("train-maxent --demos airl", 2, "'airl'"),
    ("train-maxent --demos mazes", 3, "'mazes'"),
    ("evaluate --idle --env gridworld --intervention path-group=1", 2, "gridworld"),
    ("evaluate --random --env gridworld --ood blocked", 2, "gridworld"),
    ("evaluate --expert --env gridworld --ood blocked", 2, "gridworld"),
    ("evaluate --policy airl --workers 0", 2, "--workers"),
    ("evaluate --policy airl --workers two", 2, "two"),
    ("evaluate --policy airl --set evaluation.episodes=0", 2, "evaluation.episodes"),
    ("evaluate --policy airl --set evaluation.deterministic=maybe", 2, "evaluation.deterministic"),
    ("train-airl --demos demos --set airl.ppo.n_envs=100000", 2, "n_envs"),
    ("train-airl --demos demos --set airl.ppo.n_steps=100000000", 2, "n_steps"),
    ("train-airl --demos demos --set airl.hidden=[9000]", 2, "airl.hidden"),
    ("train-airl --demos demos --set airl.hidden=[[]]", 2, "airl.hidden"),
    ("train-airl --demos demos --set airl.ppo.use_sde=true", 2, "use_sde"),
    ("train-airl --demos demos --set airl.ppo.gamma=1", 2, "gamma"),
    ("train-airl --demos demos --set =3", 2, "'=3'"),
    ("train-airl --demos demos --set .=3", 2, "'.=3'"),
    ("train-airl --demos demos --state-only --no-state-ony", 2, "--no-state-ony"),
    ("train-airl --demos demos --profile ''", 2, "''"),
    ("train-airl --demos ''", 3, "''"),
    ("transfer --reward airl --ood default=1", 2, "'default'"),
    ("transfer --reward airl --ood x", 2, "'x'"),
    ("transfer --reward score --ood 2x", 3, "reward.pt"),
    ("transfer --reward airl/ --ood engine-power=", 2, "engine-power="),
    ("play moved", 2, "--out"),
    ("play moved --out {tmp}/x.txt", 2, "x.txt"),
    ("play moved --out {tmp}/none/x.gif --steps 1", 2, "x.gif"),
    ("play moved --out {tmp}/x.gif --steps 0", 2, "--steps"),
    ("play moved --out {tmp}/x.gif --ood leg-length=2x", 2, "'leg-length'"),
    ("play airl/reward.pt --out {tmp}/x.gif", 2, "reward.pt"),
    ("play demos --out {tmp}/x.gif", 3, "policy.pt"),
    ("play nothing --out {tmp}/x.gif", 3, "'nothing'"),
    ("report figure2 score", 2, "figure2"),
    ("report figure2 --set figure2.seeds=1", 2, "figure2.seeds"),
    ("report figure2 --set figure2.episodes=[1,2]", 2, "counts"),
    ("report returns airl/policy.pt", 2, "airl/policy.pt"),
    ("name airl ''", 2, "''"),
    ("name airl manifest.json/..", 2, "'manifest.json/..'"),
    ("name airl", 2, "name"),
    ("show airl/manifest.jsn", 3, "manifest.jsn"),
    ("show -- --json", 3, "'--json'"),
    ("verify a b", 2, "b"),
    ("gc --grace-days soon", 2, "soon"),
    ("lineage", 2, "ref"),
]


@pytest.mark.parametrize(("text", "code", "named"), WRONG, ids=[case[0][:70] for case in WRONG])
def test_more_wrong_command_lines(irl, smoke_store, tmp_path, text, code, named):
    import shlex

    words = shlex.split(text.format(tmp=tmp_path))
    at = words.index("--") if "--" in words else len(words)
    profile = SMOKE if words[0] in ("evaluate", "transfer", "train-airl", "collect-experts") else []
    profile = [] if "--profile" in words else profile
    words[at:at] = [*profile, *(["--store", str(smoke_store.path)] if words[0][0] != "-" else [])]
    done = irl(*words)
    if "--json" not in words:
        assert_refused((done.code, done.out, done.err), code, named)
        done = irl(*words[:at], "--json", *words[at:])
    document = json.loads(done.out)
    assert (done.code, document["kind"], document["exit_code"]) == (code, "error", code)
    assert named in document["message"] and document["hint"]
    assert list(tmp_path.iterdir()) == []
