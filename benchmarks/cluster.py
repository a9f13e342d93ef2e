"""A table of many runs on a cluster: its plan, its job arrays, its store, and the leases of 200 nodes.

Artefacts are written without training, each with the outputs that later steps read. Lines with CPU
seconds and peak memory are processes of their own, start-up included.
Run with ``python -m benchmarks.cluster --runs 10000``; by ``make bench`` with 1,000 runs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from benchmarks.sharing import IRL, report
from irlcli.configs import load_config
from irlcli.experiments import provenance
from irlcli.experiments.cluster.arrays import job_arrays
from irlcli.experiments.cluster.records import Submitted, new_record
from irlcli.experiments.plan import Plan, Selection
from irlcli.experiments.status import Lookup
from irlcli.experiments.tables import load_table
from irlcli.stages.base import From, Request
from irlcli.store import KeyRecord, Manifest, Output, Store
from irlcli.store.lease import HEARTBEAT_SECONDS, live_reader, read
from irlcli.store.manifest import encode_provenance

METHODS = ["erm", "irm", "irm-shuffled", "erm-balanced", "vrex", "iga", "group-dro", "l2"]
METHODS += ["dropout", "gail"]
ROWS = ("lunar-lander.engine-power", "lunar-lander.bounce")
NODES = 200
# The lock of the step, the reader's file, and the lock that an output is published under.
LEASES = 3
ATTEMPT = provenance.Attempt(
    started="2026-01-01T00:00:00Z", seconds=1.0, commit="0" * 40, dirty=None
)


def main() -> None:
    """Print a line for each measurement."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=1000, help="rewards to learn")
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as directory:
        place = Path(directory)
        file = table_file(place, runs)
        words = ["--experiments", str(file), "--profile", "smoke", "--store", str(place / "runs")]
        store = Store(place / "runs")
        store.create()
        plan = open_plan(file, store)
        steps = len(plan.tasks)
        print(f"{runs:,} runs, {steps:,} steps{'':12}{'wall s':>8}{'CPU s':>8}{'MiB':>6}")
        report("plan, empty store", [*IRL, "plan", "big", *words])
        submit(plan, store)
        fill(plan, store)
        report("plan, full store", [*IRL, "plan", "big", *words])
        report("run, nothing missing", [*IRL, "run", "big", "--until", "returns", *words])
        last = list(plan.tasks)[-1]
        report("run --only, one step", [*IRL, "run", "big", "--only", last, *words])
        report("gc, dry run", [*IRL, "gc", "--store", str(place / "runs")])
        leases(store)


def table_file(place: Path, runs: int) -> Path:
    """A table of two rows, ten methods, and as many seeds as it takes."""
    seeds = runs // (len(METHODS) * len(ROWS))
    path = place / "tables.toml"
    path.write_text(
        f'[big]\ntitle = "Many runs"\nrows = {json.dumps(ROWS)}\n'
        f"methods = {json.dumps(METHODS)}\nseeds = {json.dumps(list(range(seeds)), indent=0)}\n"
        'measures = ["transfer", "zero-shot"]\n'
    )
    return path


def open_plan(file: Path, store: Store) -> Plan:
    def load(env, flags, overrides):
        return load_config(env, "smoke", (), overrides, flags)

    return Plan(load_table("big", file), Selection("smoke"), load, Lookup(store))


def submit(plan: Plan, store: Store) -> None:
    """Group the steps into arrays, and record a job for each."""
    started = time.process_time()
    arrays = job_arrays(plan.needs)
    took = time.process_time() - started
    record = new_record(store, "nowhere")
    for number, array in enumerate(arrays):
        jobs = [
            Submitted(name, plan.identities[name], f"{number}_{i}")
            for i, name in enumerate(array.names)
        ]
        record.add(jobs)
    size = sum(path.stat().st_size for path in record.directory.glob("*.json"))
    print(f"grouped into {len(arrays)} job arrays in {took:.1f} CPU s")
    print(f"the record of the jobs: {size / 2**20:.1f} MiB")


def fill(plan: Plan, store: Store) -> None:
    """Write an artefact for each step."""
    read_later = defaultdict(set)
    for task in plan.tasks.values():
        for source in task.request.inputs.values():
            if isinstance(source, From) and source.output is not None:
                read_later[id(source.request)].add(source.output)
        for learned in task.curves.values():
            read_later[id(learned)].add("metrics.parquet")
    started = time.monotonic()
    for name, task in plan.tasks.items():
        paths = read_later[id(task.request)] or {"summary.json"}
        write_artefact(store, name, record_of(plan, task.request), dict.fromkeys(paths))
    print(f"wrote {len(plan.tasks):,} artefacts in {time.monotonic() - started:.0f} s")


def record_of(plan: Plan, request: Request) -> KeyRecord:
    """What the key of ``request`` is made from."""
    record = plan.lookup.record(request)
    assert record is not None
    return record


def write_artefact(
    store: Store, name: str, record: KeyRecord, files: Mapping[str, bytes | None]
) -> None:
    """Write an artefact without running its stage. A file without content gets the key's."""
    contents = {path: data or record.key.encode() for path, data in sorted(files.items())}
    manifest = Manifest(
        record,
        tuple(
            Output(path, len(data), hashlib.sha256(data).hexdigest())
            for path, data in contents.items()
        ),
    )
    directory = store.root / manifest.id[:16]
    directory.mkdir()
    for path, data in contents.items():
        (directory / path).write_bytes(data)
    origin = provenance.record(["irl", record.stage], 1, (ATTEMPT,))
    (directory / "provenance.json").write_bytes(encode_provenance(manifest.id, origin))
    (directory / "manifest.json").write_bytes(manifest.encode())
    (store.root / ".keys" / record.key).write_text(manifest.id[:16])
    (store.root / ".names" / name).write_text(manifest.id[:16])
    (store.root / ".locks" / record.key).touch()


def leases(store: Store) -> None:
    """What a command's leases cost, and those of many nodes together."""
    count = 200
    started = time.monotonic()
    for _ in range(count):
        with store.in_use(wait=False):
            pass
    reading = (time.monotonic() - started) / count
    started = time.monotonic()
    for k in range(count):
        with store.working_on(hashlib.sha256(b"%d" % k).hexdigest(), wait=False):
            pass
    working = (time.monotonic() - started) / count
    print(
        f"lease to read the store {1000 * reading:.2f} ms, to make an artefact {1000 * working:.2f} ms"
    )
    # Those of other machines: gc may not tell from the process whether they live.
    locks = store.root / ".locks"
    for node in range(NODES):
        lease = {"host": f"node{node}", "process": 1, "token": "x"}
        (locks / f".reader.{node}.1").write_text(json.dumps(lease))
    files = [locks / f".reader.{node}.1" for node in range(NODES)]
    started = time.monotonic()
    for path in files:
        assert read(path) is not None
        os.utime(path)
    beat = (time.monotonic() - started) / NODES
    rate = NODES * LEASES / HEARTBEAT_SECONDS
    print(f"{NODES} nodes: {rate:.0f} heartbeats/s, {1000 * rate * beat:.1f} ms of each second")
    started = time.monotonic()
    assert live_reader(locks, locks_work=True) is not None
    print(f"gc finds that the store is in use in {1000 * (time.monotonic() - started):.0f} ms")


if __name__ == "__main__":
    main()
