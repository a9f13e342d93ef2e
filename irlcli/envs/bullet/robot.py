"""A robot in a Bullet world: joint states, torques, masses and frictions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from irlcli.envs.bullet.engine import pybullet


class Robot:
    """A body whose joints are read, and driven by torques, with one Bullet call each.

    Args:
        client: Bullet's client id.
        body: Bullet's body id.
        joints: indices of the joints that are read. The motors of all joints are switched off.
        driven: indices of the joints that torques act on.
    """

    def __init__(self, client: int, body: int, joints: Sequence[int], driven: Sequence[int]):
        self.client = client
        self.body = body
        self.joints = list(joints)
        self._driven = list(driven)
        every = list(range(pybullet.getNumJoints(body, physicsClientId=client)))
        pybullet.setJointMotorControlArray(
            body,
            every,
            pybullet.VELOCITY_CONTROL,
            forces=[0.0] * len(every),
            physicsClientId=client,
        )

    def place(self, positions: Iterable[float]) -> None:
        """Move the joints in ``joints`` to these positions, at zero speed."""
        for joint, position in zip(self.joints, positions, strict=True):
            pybullet.resetJointState(self.body, joint, position, 0.0, physicsClientId=self.client)

    def states(self) -> tuple[list[float], list[float]]:
        """Positions and speeds of the joints in ``joints``."""
        states = pybullet.getJointStates(self.body, self.joints, self.client)
        return [state[0] for state in states], [state[1] for state in states]

    def drive(self, torques: np.ndarray) -> None:
        """Apply one torque to each driven joint during the next time step."""
        pybullet.setJointMotorControlArray(
            self.body,
            self._driven,
            pybullet.TORQUE_CONTROL,
            forces=torques.tolist(),
            physicsClientId=self.client,
        )

    def set_friction(self, friction: tuple[float, float, float]) -> None:
        """Set tangential, torsional and rolling friction of every link."""
        for link in self._links():
            pybullet.changeDynamics(
                self.body,
                link,
                lateralFriction=friction[0],
                spinningFriction=friction[1],
                rollingFriction=friction[2],
                physicsClientId=self.client,
            )

    def scale_mass(self, factor: float) -> None:
        """Multiply mass and inertia of every link."""
        for link in self._links():
            mass, _, inertia, *_ = pybullet.getDynamicsInfo(
                self.body, link, physicsClientId=self.client
            )
            if mass > 0.0:
                pybullet.changeDynamics(
                    self.body,
                    link,
                    mass=mass * factor,
                    localInertiaDiagonal=[factor * moment for moment in inertia],
                    physicsClientId=self.client,
                )

    def paint(self, color: tuple[float, float, float, float]) -> None:
        """Set the colour of every link (red, green, blue, opacity)."""
        for link in self._links():
            pybullet.changeVisualShape(
                self.body, link, rgbaColor=color, physicsClientId=self.client
            )

    def _links(self) -> range:
        """Indices of all links; Bullet gives the base the index -1."""
        return range(-1, pybullet.getNumJoints(self.body, physicsClientId=self.client))
