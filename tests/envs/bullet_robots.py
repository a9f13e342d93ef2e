"""Helpers shared by the tests of the PyBullet robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pybullet = pytest.importorskip("pybullet", reason="PyBullet has no wheels for this Python")

from irlcli.envs.ant.env import Ant  # noqa: E402
from irlcli.envs.half_cheetah.env import HalfCheetah  # noqa: E402
from irlcli.envs.reacher.env import Reacher  # noqa: E402

ROBOTS = {"ant": Ant, "half_cheetah": HalfCheetah, "reacher": Reacher}


def trace(name: str) -> dict[str, np.ndarray]:
    """A trace recorded from pybullet-gym's environment (pybullet 3.2.7)."""
    with np.load(Path(__file__).parent / "traces" / f"pybullet_gym_{name}.npz") as arrays:
        return dict(arrays)


def replay(env, recorded: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Observations [T+1, D] and rewards [T] of a trace's actions, from the trace's start."""
    start = recorded["initial_joint_positions"]
    observations = [env.reset(seed=0, options={"joint_positions": start})[0]]
    rewards = []
    for action in recorded["actions"]:
        observation, reward, *_ = env.step(action)
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(rewards)


def body(env) -> tuple[int, int]:
    """Bullet's body id and client id of an environment's robot."""
    return env._robot.body, env._robot.client


def total_mass(env) -> float:
    """Total mass of all links, as reported by Bullet."""
    robot, client = body(env)
    links = range(-1, pybullet.getNumJoints(robot, physicsClientId=client))
    return sum(pybullet.getDynamicsInfo(robot, i, physicsClientId=client)[0] for i in links)
