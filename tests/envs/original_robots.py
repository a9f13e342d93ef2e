"""The original robots, loaded from the MJCF files of ``pybullet_data``, to compare ours with."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator

import numpy as np
import pybullet_data
from bullet_robots import ROBOTS, pybullet

from irlcli.envs.ant.env import Ant
from irlcli.envs.bullet.body import SELF_COLLISION, Vector
from irlcli.envs.bullet.robot import Robot
from irlcli.envs.half_cheetah.env import HalfCheetah
from irlcli.envs.reacher.env import Reacher

# glibc's number for the ``mallopt`` parameter of this name.
_M_PERTURB = -6


class OriginalAnt(Ant):
    """The Ant with 20 links; its legs cannot change."""

    def _place(self, positions: np.ndarray) -> Robot:
        self._goal = self._walker.goal.draw(self.np_random)
        self._tail = self._walker.goal.observation(self._goal)
        return walker(self, "ant.xml", positions)


class OriginalHalfCheetah(HalfCheetah):
    """The HalfCheetah with 16 links, straight ahead; its legs cannot change."""

    def _place(self, positions: np.ndarray) -> Robot:
        self._cosine, self._tail = 1.0, []
        return walker(self, "half_cheetah.xml", positions, passive_joints=3)

    def _focus(self) -> Vector:
        return pybullet.getLinkState(self._robot.body, 3, physicsClientId=self._world.client)[0]


class OriginalReacher(Reacher):
    """The Reacher with 5 links."""

    def _place(self, positions: np.ndarray) -> Robot:
        self._target = float(positions[2]), float(positions[3])
        client = self._world.client
        *_, arm, target = load_bodies(client, "reacher.xml")
        for joint, position in enumerate(self._target):
            pybullet.resetJointState(target, joint, position, physicsClientId=client)
        robot = Robot(client, arm, (0, 2), (0, 2))
        robot.place(positions[:2])
        return robot


ORIGINALS = {"ant": OriginalAnt, "half_cheetah": OriginalHalfCheetah, "reacher": OriginalReacher}
MODELS = {"merged": ROBOTS, "original": ORIGINALS}


def walker(env, file: str, positions: np.ndarray, passive_joints: int = 0) -> Robot:
    """The robot of an MJCF file at ``positions``, with the friction and mass of ``env``."""
    client = env._world.client
    (body,) = load_bodies(client, file, pybullet.MJCF_COLORS_FROM_FILE)
    joints = moving_joints(client, body)
    robot = Robot(client, body, joints, joints[passive_joints:])
    robot.set_friction(env._walker.friction)
    if env._walker.mass != 1.0:
        robot.scale_mass(env._walker.mass)
    robot.place(positions)
    return robot


def load_bodies(client: int, file: str, flags: int = 0) -> tuple[int, ...]:
    """Load an MJCF file of ``pybullet_data`` and return the ids of its bodies."""
    path = os.path.join(pybullet_data.getDataPath(), "mjcf", file)
    with _zeroed_allocations():
        return pybullet.loadMJCF(path, flags=SELF_COLLISION | flags, physicsClientId=client)


def moving_joints(client: int, body: int) -> list[int]:
    """Indices of the joints of a loaded body that are not fixed."""
    return [
        joint
        for joint in range(pybullet.getNumJoints(body, physicsClientId=client))
        if pybullet.getJointInfo(body, joint, physicsClientId=client)[2] != pybullet.JOINT_FIXED
    ]


@contextlib.contextmanager
def _zeroed_allocations() -> Iterator[None]:
    """Make glibc's ``malloc`` return zeroed memory in this thread; do nothing without glibc.

    Bullet's MJCF importer leaves the initial transforms of jointed links uninitialised. They
    determine the tree of the broad phase, hence the order in which contacts are solved, hence
    the motion. With zeroed memory that order is reproducible in all but rare cases, and equals
    that of the recorded traces.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        yield
        return
    libc.malloc.restype = ctypes.c_void_p
    libc.malloc.argtypes = [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    # M_PERTURB does not affect freed blocks that malloc caches by size, so take those first.
    cached = [libc.malloc(size) for size in range(24, 4096, 16) for _ in range(64)]
    libc.mallopt(_M_PERTURB, 255)
    try:
        yield
    finally:
        libc.mallopt(_M_PERTURB, 0)
        for block in cached:
            libc.free(block)
