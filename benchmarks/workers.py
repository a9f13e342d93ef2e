"""How much faster two worker processes step 16 Ants than one, with random actions.

    python -m benchmarks.workers [ROUNDS]

Rounds with one and with two workers alternate, so that other load affects both alike. *By the
clock* is the median ratio of neighbouring rounds; it needs two idle cores. *By CPU time* does not:
every round takes the same steps, and the least CPU time of each step over the rounds, for the parent
and for each worker, is closest to an idle machine's. The parent sleeps while workers step, so a step
takes as long as the parent and its slowest worker together. Under heavy load even that is too high,
because caches are cold after waking.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from functools import partial

import numpy as np

from irlcli.envs.registration import make
from irlcli.envs.workers import WorkerWorlds
from irlcli.interventions import parse_setting

WORLDS, STEPS, ROUNDS = 16, 200, 11


def cpu_seconds(pid: int) -> float:
    """CPU time that a sleeping process has used; Linux counts it in nanoseconds."""
    with open(f"/proc/{pid}/schedstat") as schedstat:
        return int(schedstat.read().split()[0]) * 1e-9


def times(worlds: WorkerWorlds, pids: Sequence[int]) -> np.ndarray:
    """Seconds of each step [T, 2 + workers]: clock, parent's CPU, CPU of each worker of ``pids``."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, WORLDS, 8))
    worlds.reset(range(WORLDS))
    rows = []
    before = np.array([cpu_seconds(pid) for pid in pids])
    for action in actions:
        start, start_cpu = time.perf_counter(), time.process_time()
        worlds.step(action)
        own = time.perf_counter() - start, time.process_time() - start_cpu
        after = np.array([cpu_seconds(pid) for pid in pids])
        rows.append([*own, *(after - before)])
        before = after
    return np.array(rows)


def main(rounds: int) -> None:
    """Print a line for each number of workers, and the ratios."""
    factories = [partial(make, "ant", parse_setting("ant", "default"))] * WORLDS
    teams: dict[WorkerWorlds, list[int]] = {}
    for workers in (1, 2):
        others = {process.pid for process in multiprocessing.active_children()}
        team = WorkerWorlds(factories, STEPS + 1, workers)
        pids = {process.pid for process in multiprocessing.active_children()} - others
        teams[team] = [pid for pid in pids if pid is not None]
    rows = [[times(*team) for team in teams.items()] for _ in range(rounds)]
    measured = [np.array(samples) for samples in zip(*rows, strict=True)]
    for team in teams:
        team.close()
    print(f"{WORLDS} Ants, random actions, {rounds} rounds of the same {STEPS} steps")
    print("ms a step  clock  parent's CPU  slowest worker's CPU")
    steps = []
    for workers, samples in enumerate(measured, 1):
        least = samples.min(axis=0)
        parent, slowest = least[:, 1].mean(), least[:, 2:].max(axis=1).mean()
        steps.append(parent + slowest)
        clock = np.median(samples[:, :, 0].mean(axis=1))
        label = "1 worker" if workers == 1 else f"{workers} workers"
        print(f"{label:9s}{1e3 * clock:7.2f}{1e3 * parent:14.3f}{1e3 * slowest:22.3f}")
    clocks = [samples[:, :, 0].sum(axis=1) for samples in measured]
    print(
        f"two workers: {np.median(clocks[0] / clocks[1]):.2f} times as fast by the clock, "
        f"{steps[0] / steps[1]:.2f} times by CPU time"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rounds", type=int, nargs="?", default=ROUNDS)
    main(parser.parse_args().rounds)
