"""The PyBullet HalfCheetah with the interventions of the paper's Sec. 5.2 and Table 2.

Observation and physics equal those of pybullet-gym's HalfCheetahMuJoCoEnv. The reward is also
equal as long as the goal is straight ahead.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from irlcli.envs.bullet.body import FROM_TO_MARGIN, Capsule, Link, Vector, box_inertia, single
from irlcli.envs.bullet.engine import pybullet
from irlcli.envs.bullet.episode import RobotEnv
from irlcli.envs.bullet.robot import Robot
from irlcli.envs.bullet.walker import Walker
from irlcli.envs.bullet.world import SUBSTEPS, TIME_STEP, World

_RADIUS = single(0.046)
_START_HEIGHT = single(0.7)
_TORSO_LINK = 2


class _Segment(NamedTuple):
    """A segment of a leg in the plane of motion, in which x is forward and z is up.

    ``middle`` is the capsule's midpoint, and ``angle`` its rotation about y. If ``mass`` is
    ``None``, the mass follows from the capsule's volume.
    """

    parent: int
    anchor: tuple[float, float]
    middle: tuple[float, float]
    angle: float
    half_length: float
    limits: tuple[float, float]
    mass: float | None = None


# Thigh, shin and foot of the back leg, then of the front leg. Their links are 3 to 8; links 0
# and 1 slide the torso, which is link 2, along x and z.
_SEGMENTS = (
    _Segment(2, (-0.5, 0.0), (0.1, -0.13), -3.8, 0.145, (-0.52, 1.05)),
    _Segment(3, (0.16, -0.25), (-0.14, -0.07), -2.03, 0.15, (-0.785, 0.785)),
    _Segment(4, (-0.28, -0.14), (0.03, -0.097), -0.27, 0.094, (-0.4, 0.785), 10.0),
    _Segment(2, (0.5, 0.0), (-0.07, -0.12), 0.52, 0.133, (-1.5, 0.8)),
    _Segment(6, (-0.14, -0.24), (0.065, -0.09), -0.6, 0.106, (-1.2, 1.1)),
    _Segment(7, (0.13, -0.18), (0.045, -0.07), -0.6, 0.07, (-3.1, -0.3), 10.0),
)


def _capsule(x: float, z: float, angle: float, half_length: float) -> Capsule:
    """A capsule in the plane of motion, rotated by ``angle`` from z about y."""
    dx, dz = half_length * math.sin(angle), half_length * math.cos(angle)
    return Capsule((x - dx, 0.0, z - dz), (x + dx, 0.0, z + dz), _RADIUS)


def _bounds(capsule: Capsule) -> np.ndarray:
    """Lower and upper corner [2, 3] of Bullet's bounding box.

    Bullet encloses the capsule in a box along its axis, and that box in an upright one.
    """
    half = 0.5 * (np.array(capsule.end) - np.array(capsule.start))
    half_length = np.linalg.norm(half)
    sine, cosine = np.abs(half[[0, 2]]) / half_length
    reach = half_length + _RADIUS
    extent = np.array([cosine * _RADIUS + sine * reach, _RADIUS, sine * _RADIUS + cosine * reach])
    middle = np.array(capsule.center)
    return np.stack([middle - extent, middle + extent])


def morphology(leg_length: float = 1.0) -> tuple[Link, list[Link]]:
    """The HalfCheetah's fixed base and its 9 links, which replace the original's 16.

    ``leg_length`` multiplies every length of both legs except the capsules' radius. The feet
    keep their 10 kg; the other masses are proportional to their volumes. The start height keeps
    the original's distance between the lowest point and the ground.
    """
    massless = Link(0.0, (0.0, 0.0, 0.0))
    height = _START_HEIGHT + (leg_length - 1.0) * _leg_height()
    torso = (
        _capsule(0.0, 0.0, math.pi / 2.0, single(0.5)),
        _capsule(single(0.6), single(0.1), single(0.87), single(0.15)),
    )
    margin = FROM_TO_MARGIN * np.array([[-1.0], [1.0]])
    lower, upper = zip(_bounds(torso[0]) + margin, _bounds(torso[1]), strict=True)
    torso_mass = torso[0].mass + torso[1].mass
    torso_extents = np.max(upper, axis=0) - np.min(lower, axis=0)
    links = [
        dataclasses.replace(
            massless,
            joint=pybullet.JOINT_PRISMATIC,
            anchor=(0.0, 0.0, height),
            axis=(1.0, 0.0, 0.0),
        ),
        dataclasses.replace(massless, joint=pybullet.JOINT_PRISMATIC, parent=0),
        Link(
            torso_mass,
            box_inertia(torso_mass, torso_extents),
            torso,
            parent=1,
            axis=(0.0, 1.0, 0.0),
        ),
    ]
    for segment in _SEGMENTS:
        capsule = _capsule(
            leg_length * single(segment.middle[0]),
            leg_length * single(segment.middle[1]),
            single(segment.angle),
            leg_length * single(segment.half_length),
        )
        lower_corner, upper_corner = _bounds(capsule)
        mass = capsule.mass if segment.mass is None else segment.mass
        # The hips belong to the torso, so their positions on it do not scale.
        scale = 1.0 if segment.parent == _TORSO_LINK else leg_length
        links.append(
            Link(
                mass,
                box_inertia(mass, upper_corner - lower_corner),
                (capsule,),
                parent=segment.parent,
                anchor=(scale * single(segment.anchor[0]), 0.0, scale * single(segment.anchor[1])),
                axis=(0.0, 1.0, 0.0),
                limits=(single(segment.limits[0]), single(segment.limits[1])),
            )
        )
    return massless, links


def _leg_height() -> float:
    """Distance from the hips down to the lowest capsule axis, with all joints at zero."""
    lowest = []
    for hip in (0, 3):
        height = 0.0
        for segment in _SEGMENTS[hip : hip + 3]:
            height += segment.anchor[1] if segment.parent != _TORSO_LINK else 0.0
            capsule = _capsule(*segment.middle, segment.angle, segment.half_length)
            lowest.append(height + min(capsule.start[2], capsule.end[2]))
    return -min(lowest)


class HalfCheetah(RobotEnv):
    """A two-legged robot that runs in a vertical plane.

    Observation [17] float32: height (relative to the start) and pitch of the torso, 6 joint
    angles, then the speeds of forward motion, height, pitch and the 6 joints. With ``goal_y`` or
    ``direction``, the unit vector to the goal [2] follows. Action [6]: torques of thigh, shin
    and foot of the back leg, then of the front leg, in units of 120, 90, 60, 140, 60 and 30 N m,
    clipped to [-1, 1].

    The reward is the sum of the terms in ``info``. ``progress`` is the velocity (m/s) along the
    direction of the goal; in the plane this is the forward velocity times the cosine of that
    direction. ``control`` is -0.1 times the squared norm of the clipped action. An episode never
    terminates; see :class:`irlcli.envs.bullet.episode.RobotEnv` for the one case in which it is
    truncated.

    Args:
        mass, friction, goal_y, direction: see :class:`irlcli.envs.bullet.walker.Walker`.
        leg_length: multiplier of the lengths of both legs, in [0.2, 5].
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.

    Raises:
        ValueError: a value is outside its range.
        RuntimeError: the render mode is ``"human"`` and no display answers.
    """

    start_range = (0.1,) * 9
    torques = np.array([120.0, 90.0, 60.0, 140.0, 60.0, 30.0])
    camera = 3.0, -15.0

    def __init__(
        self,
        mass: float = 1.0,
        friction: Sequence[float] = (0.8, 0.0, 0.0),
        leg_length: float = 1.0,
        goal_y: float | None = None,
        direction: float | Sequence[float] | None = None,
        render_mode: str | None = None,
    ):
        self._walker = Walker(mass, friction, leg_length, goal_y, direction)
        super().__init__(World(render_mode), 17 + 2 * self._walker.goal.observed, render_mode)

    def _place(self, positions: np.ndarray) -> Robot:
        goal = self._walker.goal.draw(self.np_random)
        self._cosine = goal[0] / math.hypot(*goal)
        self._tail = self._walker.goal.observation(goal)
        start = (0.0, 0.0, 0.0)
        # The first three joints move the torso: forward, up and in pitch.
        robot = self._walker.create(self._world.client, morphology, start, passive_joints=3)
        if self.render_mode is not None:
            robot.paint((0.8, 0.6, 0.4, 1.0))
        robot.place(positions)
        return robot

    def _reward(
        self, action: np.ndarray, observation: np.ndarray, gain: float
    ) -> tuple[float, dict[str, float]]:
        progress = self._cosine * gain / TIME_STEP
        control = -0.1 * float(action @ action)
        return progress + control, {"progress": progress, "control": control}

    def _observe(self) -> tuple[np.ndarray, float]:
        """The observation, and the torso's forward position."""
        positions, speeds = self._robot.states()
        values = [*positions[1:], *speeds, *self._tail]
        observation = np.fromiter(values, np.float32, len(values))
        # The original reads the position from Bullet's cache, which is one substep old.
        return observation, positions[0] - speeds[0] * TIME_STEP / SUBSTEPS

    def _focus(self) -> Vector:
        body, client = self._robot.body, self._world.client
        return pybullet.getLinkState(body, _TORSO_LINK, physicsClientId=client)[0]
