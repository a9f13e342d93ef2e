"""What ``irl run table1`` and ``make table1`` cost when everything is there.

Artefacts are written without training, each with the outputs that later steps read, and a report
of the size of a real one. CPU seconds of whole processes, start-up included, the median of three.
Run with ``python -m benchmarks.idle``; by ``make bench``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import tempfile
from pathlib import Path

from benchmarks.cluster import fill, record_of, write_artefact
from benchmarks.sharing import IRL
from irlcli.configs import load_config
from irlcli.experiments import report
from irlcli.experiments.plan import Plan, Selection
from irlcli.experiments.status import Lookup
from irlcli.experiments.tables import load_table
from irlcli.store import Store

TABLE, PROFILE = "table1", "standard"
REPEATS = 3


def main() -> None:
    """Print a line for each command."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as directory:
        store = Store(Path(directory) / "runs")
        store.create()
        plan = Plan(load_table(TABLE), Selection(PROFILE), load, Lookup(store))
        fill(plan, store)
        add_report(plan, store)
        print(f"{len(plan.tasks)} steps, all there{'':21}{'CPU s':>8}")
        words = [TABLE, "--store", str(store.root)]
        measure(f"irl plan {TABLE}", [*IRL, "plan", *words])
        measure(f"irl run {TABLE}", [*IRL, "run", *words, "--out", f"{directory}/results"])
        places = [f"STORE={store.root}", "FROM=", f"RESULTS={directory}/results"]
        measure(f"make {TABLE}", ["make", f"IRL={' '.join(IRL)}", "READY=", *places, TABLE])


def load(env, flags, overrides):
    """The config of ``env``, as ``irl run`` loads it."""
    return load_config(env, PROFILE, (), overrides, flags)


def add_report(plan: Plan, store: Store) -> None:
    """Write the report's artefact: a table of all cells, which the command prints."""
    plan.lookup.forget_missing()
    request = report.request(plan, f"irl report {TABLE} --profile {PROFILE}")
    columns = ["row", "agent", "measure", "seed", "run"]
    rows = [[c.row, c.agent, c.measure, str(c.seed), c.run] for c in request.parameters.cells]
    table = {"title": "All", "columns": columns, "rows": rows, "note": ""}
    document = json.dumps({"tables": [table], "caveats": ["None of it was computed."]})
    name = f"{PROFILE}.{TABLE}"
    files = {f"{TABLE}.json": document.encode()}
    write_artefact(store, name, record_of(plan, request), files)


def measure(label: str, command: list[str]) -> None:
    """Print the CPU seconds of ``command``."""
    seconds = [cpu_seconds(command) for _ in range(REPEATS)]
    print(f"{label:40}{statistics.median(seconds):8.2f}", flush=True)


def cpu_seconds(command: list[str]) -> float:
    """User and system time of a process and what it started."""
    before = os.times()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = os.times()
    return (
        after.children_user - before.children_user + after.children_system - before.children_system
    )


if __name__ == "__main__":
    main()
