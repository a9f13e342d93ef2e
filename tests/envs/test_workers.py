"""Worker processes give the same results as one process, and their failures are reported."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from mujoco_robots import HalfCheetah

from irlcli.envs.vector import VectorWorlds
from irlcli.envs.workers import WorkerFailed, WorkerWorlds
from irlcli.errors import StageFailed
from irlcli.experiments.signals import STOPPING

SEEDS = [3, 1, 4]
FACTORIES = [
    HalfCheetah,
    partial(HalfCheetah, mass=2.0),
    partial(HalfCheetah, leg_length=1.3),
]


class Fragile(gymnasium.Env):
    """Counts its steps; raises an error, or kills its process, at a given step."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, fail_at: int = -1, die_at: int = -1):
        self.fail_at = fail_at
        self.die_at = die_at

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == self.fail_at:
            raise ArithmeticError("the sums do not add up")
        if self.steps == self.die_at:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.full(1, self.steps, dtype=np.float32), float(action), False, False, {}


def test_a_script_without_a_guard_runs_once(tmp_path):
    """A worker that ran it, too, would wait for the store that its parent holds."""
    script = tmp_path / "script.py"
    script.write_text(
        "from functools import partial\n"
        "import gymnasium\n"
        "from irlcli.envs.workers import WorkerWorlds\n"
        "print('once', flush=True)\n"
        "made = [partial(gymnasium.make, 'CartPole-v1')] * 2\n"
        "worlds = WorkerWorlds(made, 10, workers=2)\n"
        "print(worlds.reset([0, 1]).shape, __file__ is not None)\n"
        "worlds.close()\n"
    )
    line = [sys.executable, script]
    done = subprocess.run(line, capture_output=True, text=True, timeout=200)
    assert done.stdout.splitlines() == ["once", "(2, 4) True"], done.stderr


def alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for_death(pids: list[int], seconds: float = 10.0) -> bool:
    deadline = time.monotonic() + seconds
    while any(alive(pid) for pid in pids):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def roll_out(worlds, steps: int = 12) -> list:
    random = np.random.default_rng(0)
    out = [worlds.reset(SEEDS)]
    for _ in range(steps):
        actions = random.normal(size=(3, 6)) * 0.5
        observations, rewards, ended = worlds.step(actions.astype(np.float32))
        assert observations.dtype == np.float32
        assert rewards.dtype == np.float64
        out += [observations, rewards]
        for end in ended:
            assert end.length == 5
            out += [end.world, end.final_observation, end.terminated, end.episode_return]
    worlds.close()
    return out


def test_results_do_not_depend_on_the_number_of_workers():
    expected = roll_out(VectorWorlds([make() for make in FACTORIES], max_episode_steps=5))
    for workers in (1, 2, 3):
        actual = roll_out(WorkerWorlds(FACTORIES, max_episode_steps=5, workers=workers))
        assert len(actual) == len(expected)
        for a, b in zip(actual, expected, strict=True):
            np.testing.assert_array_equal(a, b)


class Smooth(gymnasium.Env):
    """Computes in its action's type, and keeps its last action."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.last = np.zeros(6, dtype=np.float32)
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        change = np.sum((action - self.last) ** 2)
        self.last = action
        return np.zeros(1, dtype=np.float32), float(change), False, False, {}


def test_environments_get_actions_of_the_same_type_and_may_keep_them():
    expected = roll_out(VectorWorlds([Smooth() for _ in range(3)], max_episode_steps=5))
    actual = roll_out(WorkerWorlds([Smooth] * 3, max_episode_steps=5, workers=2))
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_has_the_environments_spaces_and_number():
    worlds = WorkerWorlds(FACTORIES, max_episode_steps=5, workers=1)
    assert len(worlds) == 3
    assert worlds.observation_space.shape == (17,)
    assert worlds.action_space.shape == (6,)
    worlds.close()
    worlds.close()


def test_steps_discrete_actions():
    worlds = WorkerWorlds([Fragile, Fragile], max_episode_steps=100, workers=2)
    worlds.reset([0, 0])
    observations, rewards, ended = worlds.step(np.array([0, 1]))
    assert observations.tolist() == [[1.0], [1.0]]
    assert rewards.tolist() == [0.0, 1.0]
    assert ended == []
    worlds.close()


def test_an_environments_error_names_the_worker_and_its_worlds():
    worlds = WorkerWorlds(
        [Fragile, Fragile, partial(Fragile, fail_at=2)], max_episode_steps=100, workers=2
    )
    pids = [process.pid for process in multiprocessing.active_children()]
    worlds.reset([0, 0, 0])
    worlds.step(np.zeros(3, dtype=np.int64))
    message = r"worker 0 \(worlds 0, 2\): ArithmeticError: the sums do not add up"
    with pytest.raises(WorkerFailed, match=message) as failed:
        worlds.step(np.zeros(3, dtype=np.int64))
    # With --debug: the line in the environment's own file.
    assert "raise ArithmeticError" in str(failed.value.__cause__)
    assert wait_for_death(pids)
    with pytest.raises(WorkerFailed, match="closed"):
        worlds.step(np.zeros(3, dtype=np.int64))


class Refusing(Fragile):
    """An environment whose error has a hint of its own."""

    def step(self, action):
        raise StageFailed("it has no floor", "give it a floor")


def test_the_hint_of_an_environments_error_is_kept():
    worlds = WorkerWorlds([Refusing, Refusing], max_episode_steps=100, workers=2)
    worlds.reset([0, 0])
    with pytest.raises(WorkerFailed) as failed:
        worlds.step(np.zeros(2, dtype=np.int64))
    assert failed.value.message == "worker 0 (world 0): it has no floor"
    assert failed.value.hint == "give it a floor"


def refused():
    raise ValueError("m must be at most 1.5")


def test_a_world_that_cannot_be_made_is_named_however_late_it_is_asked():
    before = {process.pid for process in multiprocessing.active_children()}
    worlds = WorkerWorlds([Fragile, refused], max_episode_steps=100, workers=2)
    made = [p for p in multiprocessing.active_children() if p.pid not in before]
    # Its workers are started in order, and the second one ends at once.
    assert wait_for_death([max(process.pid for process in made)])
    with pytest.raises(WorkerFailed, match=r"worker 1 \(world 1\): ValueError: m must be at most"):
        worlds.reset([0, 0])


class Late(Fragile):
    """Fails after the parent has ended its workers."""

    def step(self, action):
        time.sleep(0.3)
        raise ArithmeticError("the sums do not add up")

    def close(self):
        raise ArithmeticError("it does not close")


def test_workers_that_fail_together_print_nothing(capfd):
    worlds = WorkerWorlds([partial(Fragile, fail_at=1), Late], max_episode_steps=100, workers=2)
    worlds.reset([0, 0])
    with pytest.raises(WorkerFailed, match="worker 0"):
        worlds.step(np.zeros(2, dtype=np.int64))
    assert capfd.readouterr().err == ""


def test_a_dead_worker_is_reported_and_the_others_are_ended():
    worlds = WorkerWorlds([Fragile, partial(Fragile, die_at=2)], max_episode_steps=100, workers=2)
    pids = [process.pid for process in multiprocessing.active_children()]
    worlds.reset([0, 0])
    worlds.step(np.zeros(2, dtype=np.int64))
    with pytest.raises(WorkerFailed, match=r"worker 1 \(world 1\) died: signal 9"):
        worlds.step(np.zeros(2, dtype=np.int64))
    assert wait_for_death(pids)


PARENT = """
import multiprocessing, sys, time
sys.path.insert(0, {here!r})
import numpy as np
from test_workers import Fragile
from irlcli.envs.workers import WorkerWorlds

if __name__ == "__main__":
    worlds = WorkerWorlds([Fragile] * 2, max_episode_steps=100, workers=2)
    worlds.reset([0, 0])
    print(*[process.pid for process in multiprocessing.active_children()], flush=True)
    # A limit, because the test itself may be killed.
    end = time.monotonic() + {seconds}
    while time.monotonic() < end:
        worlds.step(np.zeros(2, dtype=np.int64))
"""


@pytest.mark.parametrize("stop", STOPPING)
def test_a_signal_to_the_whole_group_leaves_the_workers_to_the_parent(stop):
    worlds = WorkerWorlds([Fragile] * 2, max_episode_steps=100, workers=2)
    try:
        worlds.reset([0, 0])
        for process in multiprocessing.active_children():
            os.kill(process.pid, stop)
        worlds.step(np.zeros(2, dtype=np.int64))
    finally:
        worlds.close()


@pytest.mark.parametrize("stop", [None, signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_its_parent(stop, tmp_path):
    here = Path(__file__).parent
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(here=str(here), seconds=0 if stop is None else 120))
    parent = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(here.parents[1]), *sys.path])},
        start_new_session=True,
    )
    pids = [int(pid) for pid in parent.stdout.readline().split()]
    assert len(pids) == 2
    assert stop is None or all(alive(pid) for pid in pids)
    if stop is None:
        pass  # it ends by itself, without closing its worlds
    elif stop == signal.SIGINT:
        os.killpg(parent.pid, stop)  # as Ctrl-C in a terminal does
    else:
        os.kill(parent.pid, stop)
    parent.wait(timeout=120)
    assert wait_for_death(pids)
    assert "Process" not in parent.stderr.read()
    parent.stdout.close()
    parent.stderr.close()
