"""The PyBullet Ant with the interventions of the paper's Sec. 5.2 and Table 2.

Observation, reward and physics equal those of pybullet-gym's AntMuJoCoEnv, except that the 84
observation entries that are always zero are omitted.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np

from irlcli.envs.bullet.body import FROM_TO_MARGIN, Capsule, Link, Vector, box_inertia, single
from irlcli.envs.bullet.engine import pybullet
from irlcli.envs.bullet.episode import RobotEnv
from irlcli.envs.bullet.robot import Robot
from irlcli.envs.bullet.walker import Walker
from irlcli.envs.bullet.world import SUBSTEPS, TIME_STEP, World

_RADIUS = single(0.08)
_FIXED = _UPPER = single(0.2)
_LOWER = single(0.4)
_START_HEIGHT = 0.75
# 40, 30 and 100 degrees in the single-precision radians of Bullet's importer.
_HIP = 0.6981317400932312
_ANKLE = (0.5235987901687622, 1.7453292608261108)
# For each leg, in the original's order: x and y of its direction, the ankle's axis, and the
# sign of the ankle's range.
_LEGS = (
    (1.0, 1.0, (-1.0, 1.0, 0.0), 1.0),
    (-1.0, 1.0, (1.0, 1.0, 0.0), -1.0),
    (-1.0, -1.0, (-1.0, 1.0, 0.0), -1.0),
    (1.0, -1.0, (1.0, 1.0, 0.0), 1.0),
)
# For each joint: the middle of its range, and the distance from it beyond which the original
# counts the joint as at its limit.
_RANGES = tuple(
    (sign * 0.5 * (low + high), 0.99 * 0.5 * (high - low))
    for *_, sign in _LEGS
    for low, high in ((-_HIP, _HIP), _ANKLE)
)
# The original measures progress at the mean position of its 20 links, its torso and the floor.
_PARTS = 22


def _segment(x: float, y: float, length: float) -> tuple[Capsule, float, Vector]:
    """A leg's capsule from the origin to ``length * (x, y)``, with its mass and inertia."""
    capsule = Capsule((0.0, 0.0, 0.0), (x * length, y * length, 0.0), _RADIUS)
    thickness = 2.0 * (_RADIUS + FROM_TO_MARGIN)
    width = length + thickness
    return capsule, capsule.mass, box_inertia(capsule.mass, (width, width, thickness))


def _joints_at_limit(angles: list[float]) -> int:
    """The number of the 8 joints that are at or beyond a limit."""
    return sum(
        [
            abs(angle - middle) > tolerance
            for angle, (middle, tolerance) in zip(angles, _RANGES, strict=True)
        ]
    )


def morphology(leg_length: float = 1.0) -> tuple[Link, list[Link]]:
    """The Ant's base and its 8 links, in the original's joint order.

    The torso and the four capsules fixed to it form one body, so 8 links replace the
    original's 20. ``leg_length`` multiplies both moving segments of the two hind legs. Their
    masses are proportional to their volumes.
    """
    torso = Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.25)
    mass = torso.mass
    moments = np.full(3, 0.4 * torso.mass * torso.radius**2)
    shapes = [torso]
    links: list[Link] = []
    for x, y, axis, sign in _LEGS:
        scale = leg_length if y < 0 else 1.0
        fixed, fixed_mass, fixed_inertia = _segment(x, y, _FIXED)
        shapes.append(fixed)
        mass += fixed_mass
        # Parallel axis theorem. The products of inertia of the four capsules cancel.
        square = fixed.center[0] ** 2
        moments += np.array(fixed_inertia) + fixed_mass * np.array([square, square, 2 * square])
        for parent, anchor, length, joint_axis, limits in (
            (-1, _FIXED, _UPPER * scale, (0.0, 0.0, 1.0), (-_HIP, _HIP)),
            (
                len(links),
                _UPPER * scale,
                _LOWER * scale,
                axis,
                _ANKLE if sign > 0 else (-_ANKLE[1], -_ANKLE[0]),
            ),
        ):
            capsule, capsule_mass, inertia = _segment(x, y, length)
            links.append(
                Link(
                    mass=capsule_mass,
                    inertia=inertia,
                    shapes=(capsule,),
                    center=capsule.center,
                    parent=parent,
                    anchor=(x * anchor, y * anchor, 0.0),
                    axis=joint_axis,
                    limits=limits,
                )
            )
    return Link(mass, (moments[0], moments[1], moments[2]), tuple(shapes)), links


class Ant(RobotEnv):
    """A four-legged robot that walks toward a goal 1 km away.

    Observation [27] float32: height and orientation quaternion (x, y, z, w) of the torso, 8
    joint angles, linear and angular velocity of the torso in world axes, 8 joint speeds. With
    ``goal_y`` or ``direction``, the unit vector to the goal [2] follows. Action [8]: torques of
    hip and ankle of each leg in units of 250 N m, clipped to [-1, 1].

    The reward is the sum of the terms in ``info``: ``alive`` (always 1), ``progress`` (m/s
    toward the goal) and ``joints_at_limit`` (-0.1 per joint). An episode never terminates; see
    :class:`irlcli.envs.bullet.episode.RobotEnv` for the one case in which it is truncated.

    Args:
        mass, friction, goal_y, direction: see :class:`irlcli.envs.bullet.walker.Walker`.
        leg_length: multiplier of the two moving segments of each hind leg, in [0.2, 5].
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.

    Raises:
        ValueError: a value is outside its range.
        RuntimeError: the render mode is ``"human"`` and no display answers.
    """

    start_range = (0.1,) * 8
    torques = np.full(8, 250.0)
    camera = 5.0, -50.0

    def __init__(
        self,
        mass: float = 1.0,
        friction: Sequence[float] = (1.5, 0.0, 0.0),
        leg_length: float = 1.0,
        goal_y: float | None = None,
        direction: float | Sequence[float] | None = None,
        render_mode: str | None = None,
    ):
        self._walker = Walker(mass, friction, leg_length, goal_y, direction)
        # What each leg adds to the sum of its links' positions, except for the hip: 2.5 upper
        # segments (its middle once, its end twice) and half a lower one. A complex number
        # represents the leg's direction in the torso's plane.
        self._legs = []
        for x, y, _, sign in _LEGS:
            scale = self._walker.leg_length if y < 0 else 1.0
            leg = scale * complex(x, y)
            drop = -0.5 * math.sqrt(2.0) * _LOWER * scale * sign
            self._legs.append((2.5 * _UPPER * leg, 0.5 * _LOWER * leg, drop))
        super().__init__(World(render_mode), 27 + 2 * self._walker.goal.observed, render_mode)

    def _place(self, positions: np.ndarray) -> Robot:
        self._goal = self._walker.goal.draw(self.np_random)
        self._tail = self._walker.goal.observation(self._goal)
        start = (0.0, 0.0, _START_HEIGHT)
        robot = self._walker.create(self._world.client, morphology, start)
        if self.render_mode is not None:
            robot.paint((0.8, 0.5, 0.3, 1.0))
        robot.place(positions)
        return robot

    def _reward(
        self, action: np.ndarray, observation: np.ndarray, gain: float
    ) -> tuple[float, dict[str, float]]:
        at_limit = -0.1 * _joints_at_limit(self._angles)
        return 1.0 + gain + at_limit, {"alive": 1.0, "progress": gain, "joints_at_limit": at_limit}

    def _focus(self) -> Vector:
        return self._position

    def _observe(self) -> tuple[np.ndarray, float]:
        """The observation, and minus the distance to the goal divided by the time step."""
        client, body = self._robot.client, self._robot.body
        self._position, orientation = pybullet.getBasePositionAndOrientation(body, client)
        linear, angular = pybullet.getBaseVelocity(body, client)
        angles, speeds = self._robot.states()
        self._angles = angles
        values = [
            self._position[2],
            *orientation,
            *angles,
            *linear,
            *angular,
            *speeds,
            *self._tail,
        ]
        observation = np.fromiter(values, np.float32, len(values))
        x, y = self._mean_position(orientation, linear, angular, angles, speeds)
        distance = math.hypot(self._goal[0] - x, self._goal[1] - y)
        return observation, -distance / TIME_STEP

    def _mean_position(
        self,
        orientation: Sequence[float],
        linear: Sequence[float],
        angular: Sequence[float],
        angles: list[float],
        speeds: list[float],
    ) -> tuple[float, float]:
        """x and y of the mean over the original's 20 links, its torso and the floor.

        The original reads the links' positions, but not the torso's, from Bullet's cache, which
        is one substep old. The positions of the four hips cancel in the sum. The legs' share is
        computed in closed form, which is cheaper than a call of Bullet.
        """
        lag = TIME_STEP / SUBSTEPS
        plane, height = 0j, 0.0
        for leg, (upper, lower, drop) in enumerate(self._legs):
            hip = angles[2 * leg] - lag * speeds[2 * leg]
            ankle = angles[2 * leg + 1] - lag * speeds[2 * leg + 1]
            plane += (upper + lower * math.cos(ankle)) * cmath.rect(1.0, hip)
            height += drop * math.sin(ankle)
        rate = math.hypot(*angular)
        half = 0.5 * lag * rate
        scale = -math.sin(half) / rate if rate > 0.0 else 0.0
        a, b, c, w = scale * angular[0], scale * angular[1], scale * angular[2], math.cos(half)
        i, j, k, r = orientation
        # The torso's quaternion, one substep ago.
        i, j, k, r = (
            w * i + a * r + b * k - c * j,
            w * j - a * k + b * r + c * i,
            w * k + a * j - b * i + c * r,
            w * r - a * i - b * j - c * k,
        )
        x = (
            (1.0 - 2.0 * (j * j + k * k)) * plane.real
            + 2.0 * (i * j - k * r) * plane.imag
            + 2.0 * (i * k + j * r) * height
        )
        y = (
            2.0 * (i * j + k * r) * plane.real
            + (1.0 - 2.0 * (i * i + k * k)) * plane.imag
            + 2.0 * (j * k - i * r) * height
        )
        return (
            (21.0 * self._position[0] - 20.0 * lag * linear[0] + x) / _PARTS,
            (21.0 * self._position[1] - 20.0 * lag * linear[1] + y) / _PARTS,
        )
