"""The PyBullet Ant with the interventions of the paper's Sec. 5.2 and Table 2.

Observation, reward and physics are those of pybullet-gym's AntMuJoCoEnv, without the 84
observation entries that are always zero.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

import numpy as np

from irlcli.envs.bullet.engine import pybullet
from irlcli.envs.bullet.episode import RobotEnv
from irlcli.envs.bullet.world import (
    FROM_TO_MARGIN,
    SUBSTEPS,
    TIME_STEP,
    Capsule,
    Goal,
    Link,
    Robot,
    Vector,
    World,
    box_inertia,
    moving_joints,
    require,
    require_friction,
    require_model,
    single,
)

_RADIUS = single(0.08)
_FIXED = _UPPER = single(0.2)
_LOWER = single(0.4)
_START_HEIGHT = 0.75
# The importer's single-precision radians of 40, 30 and 100 degrees.
_HIP = 0.6981317400932312
_ANKLE = (0.5235987901687622, 1.7453292608261108)
# Legs in the original's order: x and y of the leg's direction, the ankle's axis, its sign.
_LEGS = (
    (1.0, 1.0, (-1.0, 1.0, 0.0), 1.0),
    (-1.0, 1.0, (1.0, 1.0, 0.0), -1.0),
    (-1.0, -1.0, (-1.0, 1.0, 0.0), -1.0),
    (1.0, -1.0, (1.0, 1.0, 0.0), 1.0),
)
# Middle of each joint's range, and how far from it the original calls a joint at its limit.
_RANGES = tuple(
    (sign * 0.5 * (low + high), 0.99 * 0.5 * (high - low))
    for *_, sign in _LEGS
    for low, high in ((-_HIP, _HIP), _ANKLE)
)
# The original measures progress at the mean of its 20 links, its torso and the floor.
_PARTS = 22


def _segment(x: float, y: float, length: float) -> tuple[Capsule, float, tuple]:
    """A leg's capsule from the origin to ``length * (x, y)``, its mass and inertia."""
    capsule = Capsule((0.0, 0.0, 0.0), (x * length, y * length, 0.0), _RADIUS)
    thickness = 2.0 * (_RADIUS + FROM_TO_MARGIN)
    width = length + thickness
    return capsule, capsule.mass, box_inertia(capsule.mass, (width, width, thickness))


def _joints_at_limit(angles: list[float]) -> int:
    """How many of the 8 joints are at a limit, or beyond it."""
    return sum(
        [
            abs(angle - middle) > tolerance
            for angle, (middle, tolerance) in zip(angles, _RANGES, strict=True)
        ]
    )


def morphology(leg_length: float = 1.0) -> tuple[Link, list[Link]]:
    """The Ant's base and its 8 links, in the original's joint order.

    The torso and the four capsules fixed to it are one body: 8 links where the original has
    20. ``leg_length`` multiplies both moving segments of the two hind legs, whose masses
    follow their volume.
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
        # Parallel axes; the products of inertia of the four capsules cancel.
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
    """A four-legged walker, pulled toward a goal 1 km away.

    Observation [27] float32: height and orientation quaternion (x, y, z, w) of the torso, 8
    joint angles, linear and angular velocity of the torso in world axes, 8 joint speeds; then
    the unit vector to the goal [2] where ``goal_y`` or ``direction`` is given. Action [8]:
    torques of hip and ankle of each leg in units of 250 N m, clipped to [-1, 1].

    The reward is the sum of the terms in ``info``: ``alive`` (always 1), ``progress`` (m/s
    toward the goal) and ``joints_at_limit`` (-0.1 per joint). An episode never terminates.
    A world whose state is no longer finite truncates the episode at its last finite
    observation, pays nothing, and says so in ``info["error"]``.

    Args:
        mass: multiplier of every link's mass and inertia, in [0.1, 10].
        friction: tangential, torsional and rolling coefficient of every link, in [0, 10];
            Bullet multiplies the coefficients of two touching bodies, and the floor's is 0.8.
        leg_length: multiplier of the hind legs' two moving segments, in [0.2, 5].
        goal_y, direction: see :class:`irlcli.envs.bullet.world.Goal`.
        full_observation: the original's [111] numbers, of which 84 are always zero.
        model: ``"merged"`` or ``"original"`` (20 links; its legs cannot change).
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.

    Raises:
        ValueError: a value outside the range given.
        RuntimeError: ``"human"`` without a display.
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
        full_observation: bool = False,
        model: str = "merged",
        render_mode: str | None = None,
    ):
        self.mass = require("mass", mass, 0.1, 10.0)
        self.friction = require_friction(friction)
        self.leg_length = require("leg_length", leg_length, 0.2, 5.0)
        self.model = require_model(model, self.leg_length)
        self.goal = Goal(goal_y, direction)
        self._zeros = [0.0] * 84 if full_observation else []
        # What each leg adds to the sum of the links' positions, hips aside: 2.5 upper segments
        # (its middle once, its end twice) and half a lower one. A leg's direction in the
        # torso's plane is a complex number.
        self._legs = []
        for x, y, _, sign in _LEGS:
            scale = self.leg_length if y < 0 else 1.0
            direction = scale * complex(x, y)
            drop = -0.5 * math.sqrt(2.0) * _LOWER * scale * sign
            self._legs.append((2.5 * _UPPER * direction, 0.5 * _LOWER * direction, drop))
        size = 27 + len(self._zeros) + 2 * self.goal.observed
        super().__init__(World(render_mode), size, render_mode)

    def _place(self, positions: np.ndarray) -> Robot:
        self._goal = self.goal.draw(self.np_random)
        self._tail = self._zeros + self.goal.observation(self._goal)
        client = self._world.client
        if self.model == "original":
            (body,) = self._world.load("ant.xml", pybullet.MJCF_COLORS_FROM_FILE)
            joints = moving_joints(client, body)
        else:
            body = self._world.build(*morphology(self.leg_length), (0.0, 0.0, _START_HEIGHT))
            joints = list(range(8))
        robot = Robot(client, body, joints, joints)
        robot.set_friction(self.friction)
        if self.mass != 1.0:
            robot.scale_mass(self.mass)
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
        """The observation, and minus the distance to go over the time step."""
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

        The original takes the links' positions from Bullet's cache, which is one substep old,
        but not the torso's. The four hips' positions cancel in the sum, so what is left of it
        is the legs', in closed form: cheaper than asking Bullet.
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
        # The torso's quaternion one substep ago.
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
