"""Import and export of demonstrations, against pyarrow's bare write of the file that is imported.

Each part runs in processes of its own, which report their CPU seconds, the least of three, and how
far memory grew above what it was after the imports. All parts run for a tenth of the steps, too:
memory must not follow. An import includes hashing and publishing.
Run with ``python -m benchmarks.data``; by ``make bench``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from irlcli.data.exchange.transitions import write_transitions
from irlcli.data.steps import PIECE, Steps, nowhere
from irlcli.data.streaming import read_stream
from irlcli.envs.registration import make
from irlcli.experiments.recordings import recorded
from irlcli.experiments.runner import Runner
from irlcli.interventions import parse_settings
from irlcli.stages import import_demonstrations
from irlcli.store import Store

ENV = "half-cheetah"
SETTINGS = parse_settings(ENV, "leg-length=0.7,1.3")
BUDGET = 3.0
# In the order in which they run: what is imported must have been exported.
PARTS = ("bare write", "import", "export parquet", "export minari", "import minari")


def main() -> None:
    """Print CPU seconds, their ratio to the bare write, and the growth of memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--length", type=int, default=1000, help="steps of an episode")
    parser.add_argument("--part", choices=PARTS)
    parser.add_argument("--directory", type=Path)
    arguments = parser.parse_args()
    if arguments.part:
        print(json.dumps(measured(arguments.part, arguments.directory)))
        return
    counts = [arguments.steps // 10, arguments.steps]
    found: dict[int, dict[str, Any]] = {n: {part: {} for part in PARTS} for n in counts}
    for steps in counts:
        with tempfile.TemporaryDirectory() as directory:
            write_source(Path(directory) / "source.parquet", steps, arguments.length)
            os.environ["MINARI_DATASETS_PATH"] = str(Path(directory) / "minari")
            for part in PARTS:
                runs = [in_a_process(part, directory) for _ in range(3)]
                found[steps][part] = min(runs, key=lambda run: run["seconds"])
    few, many = counts
    print(f"{many:,} steps in episodes of {arguments.length}, D = 17, A = 6")
    print(f"{'part':16}{'CPU s':>8}{'x bare write':>14}{'MiB':>8}{f'MiB, {few:,}':>14}")
    bare = found[many]["bare write"]["seconds"]
    for part in PARTS:
        at, small = found[many][part], found[few][part]
        ratio = at["seconds"] / bare
        late = "  over budget" if ratio > BUDGET else ""
        print(
            f"{part:16}{at['seconds']:8.2f}{ratio:14.2f}{at['MiB']:8.0f}{small['MiB']:14.0f}{late}"
        )


def in_a_process(part: str, directory: str) -> dict[str, float]:
    """What :func:`measured` finds in a fresh process."""
    words = ["--part", part, "--directory", directory]
    command = [sys.executable, "-m", "benchmarks.data", *words]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout)


def write_source(path: Path, steps: int, length: int) -> None:
    """Random transitions in one file, each setting half of the episodes."""
    rng = np.random.default_rng(0)

    def parts():
        episodes = max(1, PIECE // length)
        for begin in range(0, steps // length, episodes):
            count = min(episodes, steps // length - begin)
            observations = rng.normal(size=(count, length + 1, 17)).astype(np.float32)
            last = np.tile(np.arange(length) == length - 1, count)
            yield Steps(
                first=np.tile(np.arange(length) == 0, count),
                settings=np.repeat((begin + np.arange(count)) % 2, length),
                observations=observations[:, :-1].reshape(-1, 17),
                actions=rng.normal(size=(count * length, 6)).astype(np.float32),
                rewards=rng.normal(size=count * length),
                next_observations=observations[:, 1:].reshape(-1, 17),
                terminated=last & False,
                truncated=last,
                seeds=np.zeros(count * length, dtype=np.int64),
                place=nowhere,
            )

    write_transitions(path, ENV, [str(s) for s in SETTINGS], parts())


def measured(part: str, directory: Path) -> dict[str, float]:
    """CPU seconds [s] and growth of memory [MiB] of one part in this process."""
    prepared = prepare(part, directory)
    before, start = _memory(), time.process_time()
    prepared()
    return {"seconds": time.process_time() - start, "MiB": _memory() - before}


def _memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def prepare(part: str, directory: Path):
    """What is to be measured, with everything imported that it needs."""
    source, out = directory / "source.parquet", directory / "out.parquet"
    if part == "bare write":
        table = pq.read_table(source)
        return lambda: pq.write_table(table, out, compression="zstd")
    with make(ENV, SETTINGS[0]):
        pass
    if "minari" in part:
        import h5py  # noqa: F401
        import minari.data_collector.episode_buffer
        import minari.dataset.minari_storage  # noqa: F401
    store = Store(directory / "runs")
    if part.startswith("import"):
        shutil.rmtree(store.root, ignore_errors=True)
        import pandas  # noqa: F401, pyarrow imports it with its first array

        import irlcli.data.exchange.minari
        import irlcli.data.outputs
        import irlcli.rl.worlds  # noqa: F401

        name = str(source) if part == "import" else "minari:bench/demos-v0"

        def import_() -> None:
            form, sources = recorded([name])
            Runner(store).run(import_demonstrations.request(form, sources, ENV, SETTINGS))

        return import_
    (artefact,) = store.index().artefacts.values()
    texts, steps = read_stream(artefact.directory)
    if part == "export parquet":
        out.unlink(missing_ok=True)
        return lambda: write_transitions(out, ENV, texts, steps)
    from irlcli.data.exchange.minari import write_minari

    data = directory / "minari" / "bench" / "demos-v0" / "data"
    shutil.rmtree(data.parent, ignore_errors=True)
    data.parent.mkdir(parents=True)
    with make(ENV, SETTINGS[0]) as world:
        spaces = world.observation_space, world.action_space
    return lambda: write_minari(data, "bench/demos-v0", ENV, SETTINGS, steps, spaces)


if __name__ == "__main__":
    main()
