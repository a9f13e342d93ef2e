"""The original robots, loaded from the MJCF files of ``pybullet_data``."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator

import pybullet_data

from irlcli.envs.bullet.body import SELF_COLLISION
from irlcli.envs.bullet.engine import pybullet

# glibc's number for the ``mallopt`` parameter of this name.
_M_PERTURB = -6


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
