"""Helpers shared by the tests of the MuJoCo robots."""

from __future__ import annotations

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install '.[mujoco]'")

from irlcli.envs.mujoco.env import Ant, HalfCheetah, Hopper, Humanoid, Walker2d  # noqa: E402

ROBOTS = {
    "Ant": Ant,
    "HalfCheetah": HalfCheetah,
    "Hopper": Hopper,
    "Walker2d": Walker2d,
    "Humanoid": Humanoid,
}


def actions(env, count: int, seed: int = 0) -> np.ndarray:
    """Random actions [count, A] in the motors' range."""
    space = env.action_space
    return np.random.default_rng(seed).uniform(space.low, space.high, (count, *space.shape))


def roll(env, seed: int, steps: int = 60) -> np.ndarray:
    """Observations [steps + 1, D] under random actions; episodes that end start again."""
    path = [env.reset(seed=seed)[0]]
    for action in actions(env, steps, seed):
        observation, _, terminated, truncated, _ = env.step(action)
        path.append(env.reset()[0] if terminated or truncated else observation)
    return np.array(path)


def mass(env) -> float:
    """The robot's mass [kg]."""
    return float(np.sum(env.model.body_mass))


def posed(env):
    """The robot in the starting pose, at rest, as far as the joints' ranges allow it."""
    env.reset(seed=0)
    model, data = env.model, env.data
    data.qpos[:], data.qvel[:] = model.qpos0, 0.0
    limited = model.jnt_limited.astype(bool)
    where = model.jnt_qposadr[limited]
    data.qpos[where] = np.clip(data.qpos[where], *model.jnt_range[limited].T)
    mujoco.mj_forward(model, data)
    return env


def lowest(env) -> float:
    """The height of the robot's lowest point [m]; robots consist of capsules and balls."""
    model, data = env.model, env.data
    heights = []
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom]:
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
            half = model.geom_size[geom, 1] * abs(axis[2])
            heights.append(data.geom_xpos[geom, 2] - half - model.geom_size[geom, 0])
    return min(heights)
