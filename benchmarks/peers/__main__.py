"""Run and compare: ``python -m benchmarks.peers``, by ``make bench-peers``, which takes hours.

Every run is a process of its own that records its checks in ``OUT/records``. What is finished is not
repeated, so the same command continues after an interruption; an unfinished run begins again.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NoReturn

import pandas as pd

from benchmarks.peers.results import read_run, write
from benchmarks.peers.tasks import METHODS, ROWS, Task, chosen, tasks
from irlcli.configs import load_config
from irlcli.errors import IrlError, StageFailed, UsageError
from irlcli.experiments.provenance import git_state
from irlcli.experiments.references import demonstrations
from irlcli.interventions import parse_settings
from irlcli.store import Store
from irlcli.store.lease import Patience
from irlcli.store.lock import locked

_ROOT = Path(__file__).parents[2]
_ZOO = _ROOT / "zoo"
# What a run is told about its demonstrations: their id, and where they are here.
_FOUND = ("demonstrations", "dataset", "demos")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message, "--help lists the options")


def main() -> None:
    """Run what is missing, and write the tables and the picture."""
    try:
        _run(_options())
    except IrlError as error:
        print(f"error: {error.message} ({error.hint})", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        # At once, without what waits in the pool. Runs whose parent is gone stop at their next check.
        os._exit(130)


def _options() -> argparse.Namespace:
    parser = _Parser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("--rows", help=f"of: {', '.join(ROWS)}")
    parser.add_argument("--methods", help=f"of: {', '.join(METHODS)}")
    # Not 0: the published experts are our train-expert with seed 0.
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--limit", type=float, default=1800, help="CPU seconds of a run (1800)")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (1)")
    parser.add_argument("--out", type=Path, default=Path("results/peers"), metavar="DIR")
    parser.add_argument(
        "--peers-python",
        type=Path,
        default=_ROOT / ".venv-peers/bin/python",
        help="the Python that has imitation (.venv-peers/bin/python)",
    )
    parser.add_argument("--report", action="store_true", help="run nothing")
    options = parser.parse_args()
    options.rows = chosen(options.rows, ROWS, "--rows")
    options.methods = chosen(options.methods, list(METHODS), "--methods")
    try:
        options.seeds = [int(seed) for seed in options.seeds.split(",")]
    except ValueError:
        parser.error(f"--seeds: {options.seeds!r} is not a list of whole numbers, as in 1,2,3")
    if min(options.seeds) < 0 or options.limit <= 0 or options.jobs < 1:
        parser.error("--seeds must be at least 0, --limit above 0, --jobs at least 1")
    return options


def _run(options: argparse.Namespace) -> None:
    runs = options.out / "runs"
    for directory in (runs, options.out / "records"):
        directory.mkdir(parents=True, exist_ok=True)
    # Two processes would delete each other's unfinished runs.
    alone = locked(runs / ".lock", Patience(f"the runs in {runs}"))
    with nullcontext() if options.report else alone:
        _run_in(runs, options)


def _run_in(runs: Path, options: argparse.Namespace) -> None:
    settings = {}
    for row in options.rows:
        env, knob = row.split(".")
        values = ",".join(load_config(env).interventions[knob].id)
        settings[row] = [str(setting) for setting in parse_settings(env, f"{knob}={values}")]
    wanted = tasks(settings, options.methods, options.seeds)
    records = options.out / "records"
    files = {task: records / f"{task.name}.jsonl" for task in wanted}
    failed: list[str] = []
    if not options.report:
        about = {row: _demonstrations(row, runs) for row in options.rows}
        missing = [
            task
            for task in wanted
            if not enough(files[task], task, about[task.row]["demonstrations"], options.limit)
        ]
        theirs = any(METHODS[task.method].module == "theirs" for task in missing)
        if theirs and not options.peers_python.is_file():
            raise UsageError(f"{options.peers_python} does not exist", "make bench-peers makes it")
        for leftover in records.glob("*.part"):
            leftover.unlink()
        about_all = {"commit": _commit(), "machine": _machine(), "limit": options.limit}
        print(f"{len(missing)} of {len(wanted)} runs are missing", file=sys.stderr)

        def execute(task: Task) -> str | None:
            found = about[task.row]
            values = task._asdict() | about_all | {name: found[name] for name in _FOUND}
            values["targets"] = [found["returns"][text] for text in task.settings]
            values["file"] = str(files[task].absolute())
            return _execute(task, values, runs, options.peers_python)

        pool = ThreadPoolExecutor(options.jobs)
        failed = [name for name in pool.map(execute, missing) if name]
    found = [read_run(path) for path in files.values() if path.exists()]
    if found:
        command = shlex.join(["python", "-m", "benchmarks.peers", *sys.argv[1:]])
        write(options.out, found, len(wanted), command)
        print(options.out / "README.md")
    if failed:
        raise StageFailed(
            f"{len(failed)} runs failed: {', '.join(failed)}", f"their logs are in {runs}"
        )
    if not found:
        raise StageFailed("no run has finished", "omit --report to run what is missing")


def enough(path: Path, task: Task, demonstrations: str, limit: float) -> bool:
    """Whether ``task`` is finished on these demonstrations, and not by a lower limit than ``limit``."""
    if not path.exists():
        return False
    run = read_run(path)
    same = run.task == task and run.about["demonstrations"] == demonstrations
    return same and (run.end != "limit" or run.about["limit"] >= limit)


def _execute(task: Task, run: dict[str, Any], runs: Path, peers: Path) -> str | None:
    """Run ``task`` in a process of its own; its name if that failed."""
    method = METHODS[task.method]
    python = sys.executable if method.module == "ours" else str(peers.absolute())
    command = [python, "-m", f"benchmarks.peers.{method.module}", json.dumps(run)]
    variables = {"PYTHONPATH": str(_ROOT), "OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"}
    with open(runs / f"{task.name}.log", "w") as log:
        done = subprocess.run(
            command, stdout=log, stderr=subprocess.STDOUT, env={**os.environ, **variables}
        )
    print(f"{'done' if done.returncode == 0 else 'FAILED'}: {task.name}", file=sys.stderr)
    return None if done.returncode == 0 else task.name


def _demonstrations(row: str, directory: Path) -> dict[str, Any]:
    """The shipped demonstrations: as artefact, as Parquet file, and their mean return by setting."""
    source, _, _ = demonstrations(Store(_ZOO), row)
    file = (directory / f"{row}.{source.path.name}.parquet").absolute()
    if not file.exists():
        export = ["export", "demos", row, "--store", str(_ZOO), "--to", f"parquet:{file}"]
        subprocess.run(
            [sys.executable, "-m", "irlcli", *export], check=True, stdout=subprocess.DEVNULL
        )
    frame = pd.read_parquet(file, columns=["episode", "setting", "reward"])
    returns = frame.groupby(["setting", "episode"])["reward"].sum().groupby("setting").mean()
    return {
        "demonstrations": source.path.name,
        "dataset": str(source.path),
        "demos": str(file),
        "returns": returns.to_dict(),
    }


def _commit() -> str:
    state = git_state(_ROOT / "irlcli")
    return f"{(state['commit'] or 'unknown')[:10]}{' with changes' if state['dirty'] else ''}"


def _machine() -> str:
    names = [
        line.partition(": ")[2]
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    return f"{os.cpu_count()} cores, {names[0] if names else 'unknown'}"


if __name__ == "__main__":
    main()
