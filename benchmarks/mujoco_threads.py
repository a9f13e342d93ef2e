"""What stepping 16 MuJoCo worlds by threads in one call costs, against one world after the other.

    python -m benchmarks.mujoco_threads [ROUNDS]

Only the simulation is timed, which is what threads can share: MuJoCo releases Python's lock. The
ways are: one world after the other; two threads of Python; and MuJoCo's own ``rollout``, with two
threads. Rounds alternate, so that other load affects all alike. *Clock* and *CPU* are the medians of
the ratios to the first way in the same round. *Same bytes*: whether the states equal those of the
first way to the last bit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import mujoco
import numpy as np
from mujoco import rollout

from irlcli.envs.registration import make
from irlcli.interventions import parse_setting

WORLDS, STEPS, THREADS = 16, 50, 2
_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
Step = Callable[[list, np.ndarray], None]


def one_after_the_other(robots: list, controls: np.ndarray) -> None:
    """Step every world in this thread."""
    for robot, control in zip(robots, controls, strict=True):
        robot.data.ctrl[:] = control
        mujoco.mj_step(robot.model, robot.data, nstep=robot.frame_skip)


def by_threads(pool: ThreadPoolExecutor) -> Step:
    """Step an equal share of the worlds in each of Python's threads."""

    def step(robots: list, controls: np.ndarray) -> None:
        shares = [
            pool.submit(one_after_the_other, robots[k::THREADS], controls[k::THREADS])
            for k in range(THREADS)
        ]
        for share in shares:
            share.result()

    return step


def by_rollout(pool: rollout.Rollout, scratch: list) -> Step:
    """Step all worlds by one call of MuJoCo, and write the states back."""

    def step(robots: list, controls: np.ndarray) -> None:
        first = robots[0]
        states = np.empty((len(robots), mujoco.mj_stateSize(first.model, _STATE)))
        for robot, state in zip(robots, states, strict=True):
            mujoco.mj_getState(robot.model, robot.data, state, _STATE)
        held = np.repeat(controls[:, None], first.frame_skip, axis=1)
        warm = np.stack([robot.data.qacc_warmstart for robot in robots])
        models = [robot.model for robot in robots]
        ends, _ = pool.rollout(models, scratch, states, held, initial_warmstart=warm)
        for robot, path in zip(robots, ends, strict=True):
            mujoco.mj_setState(robot.model, robot.data, path[-1], _STATE)

    return step


def run(robots: list, controls: np.ndarray, step: Step) -> tuple[float, float, np.ndarray]:
    """Seconds by the clock and of CPU, and the final positions, of one episode in every world."""
    for seed, robot in enumerate(robots):
        robot.reset(seed=seed)
    clock, cpu = time.perf_counter(), time.process_time()
    for row in controls:
        step(robots, row)
    spent = time.perf_counter() - clock, time.process_time() - cpu
    return *spent, np.stack([robot.data.qpos for robot in robots])


def main(rounds: int) -> None:
    """Print a line for each robot and way."""
    print(f"{WORLDS} worlds, {STEPS} steps, {THREADS} threads, {rounds} rounds")
    for name in ("mujoco-half-cheetah", "mujoco-hopper", "mujoco-ant", "mujoco-humanoid"):
        robots = [make(name, parse_setting(name, "default")) for _ in range(WORLDS)]
        space = robots[0].action_space
        assert isinstance(space, gymnasium.spaces.Box)
        shape = (STEPS, WORLDS, *space.shape)
        controls = np.random.default_rng(0).uniform(space.low, space.high, shape)
        scratch = [mujoco.MjData(robots[0].get_wrapper_attr("model")) for _ in range(THREADS)]
        with ThreadPoolExecutor(THREADS) as threads, rollout.Rollout(nthread=THREADS) as pool:
            ways = {
                "one after the other": one_after_the_other,
                "threads of Python": by_threads(threads),
                "mujoco.rollout": by_rollout(pool, scratch),
            }
            rows = [[run(robots, controls, step) for step in ways.values()] for _ in range(rounds)]
        for way, samples in zip(ways, zip(*rows, strict=True), strict=True):
            ratios = [
                np.median(
                    [sample[k] / row[0][k] for sample, row in zip(samples, rows, strict=True)]
                )
                for k in (0, 1)
            ]
            same = all(np.array_equal(sample[2], rows[0][0][2]) for sample in samples)
            step = 1e6 * np.median([sample[0] for sample in samples]) / STEPS
            print(
                f"{name:20s} {way:20s} {step:6.0f} us  clock {ratios[0]:.2f}  CPU {ratios[1]:.2f}  "
                f"same bytes: {'yes' if same else 'no'}",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rounds", type=int, nargs="?", default=15)
    main(parser.parse_args().rounds)
