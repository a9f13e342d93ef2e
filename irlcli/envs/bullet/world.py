"""A Bullet world: the physics client, the ground, time and the camera."""

from __future__ import annotations

import ctypes
import os
import weakref

import numpy as np
import pybullet_data

from irlcli.envs.bullet.body import Vector
from irlcli.envs.bullet.engine import pybullet

TIME_STEP = 0.0165
SUBSTEPS = 4
GRAVITY = 9.8


def has_display() -> bool:
    """Whether an X server answers. Without one, Bullet's window would end the whole process."""
    if not os.environ.get("DISPLAY"):
        return False
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return False
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(ctypes.c_void_p(display))
    return bool(display)


class World:
    """One Bullet physics client.

    Args:
        render_mode: ``None``, ``"rgb_array"`` (software renderer) or ``"human"`` (a window).
        gravity: acceleration, m/s^2.
        substeps: solver steps per time step.
        ground: whether the world has a floor (friction 0.8, restitution 0.5).

    Raises:
        ValueError: the render mode is unknown.
        RuntimeError: the render mode is ``"human"`` and no display answers.
    """

    def __init__(
        self,
        render_mode: str | None,
        gravity: Vector = (0.0, 0.0, -GRAVITY),
        substeps: int = SUBSTEPS,
        ground: bool = True,
    ):
        if render_mode not in (None, "rgb_array", "human"):
            raise ValueError(
                f"render_mode must be None, 'rgb_array' or 'human', not {render_mode!r}"
            )
        if render_mode == "human" and not has_display():
            raise RuntimeError(
                "render_mode='human' needs a display, but none answers; use 'rgb_array'"
            )
        mode = pybullet.GUI if render_mode == "human" else pybullet.DIRECT
        self.client: int = pybullet.connect(mode)
        # A client has 28 MiB, which Bullet keeps until it is told to disconnect.
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self.client)
        self._disconnect.atexit = False
        self._gravity = gravity
        self._substeps = substeps
        self._ground = ground

    def clear(self) -> None:
        """Remove everything except the ground, and restore the physics parameters.

        Contacts, warm starts and the tree of the broad phase survive a change of pose. An
        episode is therefore a function of its seed only if its world is built anew.
        """
        client = self.client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setGravity(*self._gravity, physicsClientId=client)
        pybullet.setDefaultContactERP(0.9, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=5,
            numSubSteps=self._substeps,
            physicsClientId=client,
        )
        if self._ground:
            path = os.path.join(pybullet_data.getDataPath(), "plane_stadium.sdf")
            for body in pybullet.loadSDF(path, physicsClientId=client):
                pybullet.changeDynamics(
                    body, -1, lateralFriction=0.8, restitution=0.5, physicsClientId=client
                )

    def step(self) -> None:
        """Advance one time step."""
        pybullet.stepSimulation(self.client)

    def look_at(self, target: Vector, camera: tuple[float, float]) -> None:
        """Point the window's camera at ``target``; ``camera`` is as for :meth:`image`."""
        distance, pitch = camera
        pybullet.resetDebugVisualizerCamera(
            distance, 0.0, pitch, target, physicsClientId=self.client
        )

    def image(self, target: Vector, camera: tuple[float, float]) -> np.ndarray:
        """A picture of ``target`` [240, 320, 3] uint8, in which x points to the right.

        ``camera`` is its distance from ``target`` and its pitch in degrees; a negative pitch
        looks down.
        """
        distance, pitch = camera
        view = pybullet.computeViewMatrixFromYawPitchRoll(target, distance, 0.0, pitch, 0.0, 2)
        projection = pybullet.computeProjectionMatrixFOV(60.0, 320 / 240, 0.01, 100.0)
        _, _, pixels, _, _ = pybullet.getCameraImage(
            320,
            240,
            view,
            projection,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        return np.array(pixels, dtype=np.uint8).reshape(240, 320, 4)[:, :, :3]

    def close(self) -> None:
        """Disconnect from Bullet; a second call does nothing."""
        self._disconnect()
        self.client = -1
