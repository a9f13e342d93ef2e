"""Speed of the tractable solver: against a dense one, and against the number of states.

    python benchmarks/maxent.py [--imitation PYTHON]

Prints two tables: the time of a backward and forward pass on a 32x32 grid over 128 steps, beside a
dense solver that computes what HumanCompatibleAI/imitation's ``mce_irl`` does; and the cost per
state up to 256x256. With ``PYTHON``, an interpreter that has ``imitation==1.0.1``, imitation itself
is timed and its results compared. Set ``OMP_NUM_THREADS=1``, so that the dense solvers use one core
as ours always does. Compare the least times: other load can only add to a time.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import logsumexp

from irlcli.envs.gridworld.env import gridworld
from irlcli.learners.soft_values import solve
from irlcli.tabular import dense_transitions, stack

SIZE, HORIZON, RUNS = 32, 128, 20

IMITATION = """
import sys, time, types
import numpy as np
from imitation.algorithms import mce_irl
data = np.load(sys.argv[1])
env = types.SimpleNamespace(
    horizon=int(data["horizon"]), transition_matrix=data["transitions"],
    state_dim=len(data["start"]), action_dim=data["transitions"].shape[1],
    initial_state_dist=data["start"], reward_matrix=data["reward"],
)
times = []
for _ in range(8):
    began = time.perf_counter()
    _, _, policy = mce_irl.mce_partition_fh(env)
    states, _ = mce_irl.mce_occupancy_measures(env, pi=policy)
    times.append(time.perf_counter() - began)
np.savez(sys.argv[2], policy=policy, states=states, times=times)
"""


def dense_solve(transitions, start, reward, horizon):
    """``mce_partition_fh``, ``mce_occupancy_measures``: policy [T, S, A], states [T + 1, S]."""
    n, a, _ = transitions.shape
    values = np.tile(reward[:, None], (1, a))
    policy = np.empty((horizon, n, a))
    for t in reversed(range(horizon)):
        value = logsumexp(values, axis=1)
        policy[t] = np.exp(values - value[:, None])
        values = reward[:, None] + transitions @ value
    states = np.zeros((horizon + 1, n))
    states[0] = start
    for t in range(horizon):
        for action in range(a):
            states[t + 1] += (states[t] * policy[t, :, action]) @ transitions[:, action]
    return policy, states


def best_of(repeats: int, call) -> tuple[float, float]:
    """Least and median seconds of ``call``, after one call to warm up."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times), float(np.median(times))


def compare(imitation: str | None) -> None:
    """The 32x32 grid: seconds per iteration, ratios, and the largest difference of results."""
    mdp = gridworld(SIZE, goal="absorbing")
    settings = stack([mdp])
    rewards = np.random.default_rng(0).normal(size=(RUNS, SIZE**2))
    transitions = np.ascontiguousarray(dense_transitions(mdp).transpose(1, 0, 2))
    # T values of the dense solver are T - 1 moves, because it omits the reward of the last
    # action's outcome. Its policies and states equal ours for a horizon of T - 1.
    matching = solve(settings, rewards[:1], HORIZON - 1)
    # A fit also reuses the memory of its previous iteration.
    one, many = (solve(settings, r, HORIZON) for r in (rewards[:1], rewards))
    ours = best_of(100, lambda: solve(settings, rewards[:1], HORIZON, reuse=one))
    batch = best_of(10, lambda: solve(settings, rewards, HORIZON, reuse=many))
    rows: list[tuple[str, float, float]] = [
        ("one run", *ours),
        (f"each of {RUNS} runs in one call", batch[0] / RUNS, batch[1] / RUNS),
    ]
    references: list[tuple[str, float, float, float]] = []

    def difference(policy, states):
        policies = np.abs(matching.policy[:, :, 0, :, 0].transpose(0, 2, 1) - policy[:-1]).max()
        return max(policies, np.abs(matching.occupancy[0, 0] - states[:HORIZON].sum(0)).max())

    arguments = (transitions, mdp.start, rewards[0], HORIZON)
    references.append(
        (
            "dense solver",
            *best_of(5, lambda: dense_solve(*arguments)),
            difference(*dense_solve(*arguments)),
        )
    )
    if imitation:
        with tempfile.TemporaryDirectory() as folder:
            given, found = Path(folder, "mdp.npz"), Path(folder, "found.npz")
            names = ("transitions", "start", "reward", "horizon")
            np.savez(given, **dict(zip(names, arguments, strict=True)))
            subprocess.run([imitation, "-c", IMITATION, given, found], check=True)
            result = np.load(found)
            times = result["times"][1:]
            references.append(
                (
                    "imitation mce_irl",
                    min(times),
                    float(np.median(times)),
                    difference(result["policy"], result["states"]),
                )
            )
    print(f"{SIZE}x{SIZE} grid, horizon {HORIZON}: seconds of a backward and a forward pass")
    print(f"{'':32s}{'least':>10s}{'median':>10s}  ratios of the least times")
    for name, least, median in rows:
        print(f"{name:32s}{least:10.5f}{median:10.5f}")
    for name, least, median, apart in references:
        ratios = "".join(f"{least / row[1]:8.0f}x" for row in rows)
        print(f"{name:32s}{least:10.5f}{median:10.5f}{ratios}  results differ by {apart:.1e}")


def scale() -> None:
    """Cost against the number of states, at one horizon."""
    print(f"\nhorizon {HORIZON}, one run: seconds, and nanoseconds per state and step")
    for size in (16, 32, 64, 128, 256):
        settings = stack([gridworld(size)])
        reward = np.random.default_rng(0).normal(size=(1, size**2))
        before = solve(settings, reward, HORIZON)
        least, median = best_of(5, partial(solve, settings, reward, HORIZON, reuse=before))
        per = 1e9 * least / (size**2 * HORIZON)
        print(f"{size:4d}x{size:<4d}{size**2:8d} states{least:10.4f}{median:10.4f}{per:8.1f} ns")


def main(arguments: list[str]) -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--imitation", metavar="PYTHON", help="an interpreter with imitation")
    compare(parser.parse_args(arguments).imitation)
    scale()


if __name__ == "__main__":
    main(sys.argv[1:])
