"""The PyBullet Reacher with the gravity intervention of the paper's Sec. 5.2 and Table 2.

Observation, reward and physics equal those of pybullet-gym's ReacherBulletEnv, except that the
original has no gravity.
"""

from __future__ import annotations

import math

import numpy as np

from irlcli.envs.arguments import require
from irlcli.envs.bullet.body import (
    FROM_TO_MARGIN,
    Capsule,
    Link,
    Vector,
    box_inertia,
    create_body,
    single,
)
from irlcli.envs.bullet.engine import pybullet
from irlcli.envs.bullet.episode import RobotEnv
from irlcli.envs.bullet.robot import Robot
from irlcli.envs.bullet.world import GRAVITY, TIME_STEP, World
from irlcli.envs.reacher.spec import SPEC
from irlcli.envs.spec import Knob

_RADIUS = single(0.01)
_BALL_RADIUS = 0.01
_HEIGHT = single(0.01)
_UPPER = single(0.1)
_FINGERTIP = single(0.11)
_ELBOW_LIMIT = 3.0
# No setting changes it.
_TILT = Knob("tilt", ("absolute",), 0.0, 90.0, "tilt of the table, in degrees")


def morphology() -> tuple[Link, list[Link]]:
    """The Reacher's fixed base and its 2 links, which replace the original's 5.

    The fingertip's ball and the lower arm form one body.
    """
    arm = Capsule((0.0, 0.0, 0.0), (_UPPER, 0.0, 0.0), _RADIUS)
    thickness = 2.0 * (_RADIUS + FROM_TO_MARGIN)
    inertia = box_inertia(arm.mass, (_UPPER + thickness, thickness, thickness))
    ball = Capsule((_FINGERTIP, 0.0, 0.0), (_FINGERTIP, 0.0, 0.0), _BALL_RADIUS)
    mass = arm.mass + ball.mass
    center = (arm.mass * arm.center[0] + ball.mass * _FINGERTIP) / mass
    # Parallel axis theorem. Both centres of mass lie on x, so only the moments about y and z
    # grow.
    offset = arm.mass * (arm.center[0] - center) ** 2 + ball.mass * (_FINGERTIP - center) ** 2
    own = 0.4 * ball.mass * _BALL_RADIUS**2
    lower = (inertia[0] + own, inertia[1] + own + offset, inertia[2] + own + offset)
    links = [
        Link(arm.mass, inertia, (arm,), arm.center, anchor=(0.0, 0.0, _HEIGHT)),
        Link(
            mass,
            lower,
            (arm, ball),
            (center, 0.0, 0.0),
            parent=0,
            anchor=(_UPPER, 0.0, 0.0),
            limits=(-_ELBOW_LIMIT, _ELBOW_LIMIT),
        ),
    ]
    return Link(0.0, (0.0, 0.0, 0.0)), links


class Reacher(RobotEnv):
    """A two-link arm on a tilted table that moves its fingertip to a target.

    Observation [9] float32: target x and y, fingertip minus target x and y, cosine and sine of
    the shoulder's angle, the shoulder's speed / 10, the elbow's angle / 3, the elbow's speed /
    10. Action [2]: torques of shoulder and elbow in units of 0.05 N m, clipped to [-1, 1].

    The reward is the sum of the terms in ``info``: ``progress`` (100 times the decrease of the
    distance to the target), ``control`` (work and stall cost of the clipped action) and
    ``stuck`` (-0.1 while the elbow is at its limit). An episode never terminates; see
    :class:`irlcli.envs.bullet.episode.RobotEnv` for the one case in which it is truncated.

    On a level table, gravity acts along the joints' axes and turns neither joint: all settings
    would be bit-identical. On a table tilted by ``tilt``, a share sin(tilt) of gravity acts
    along -y. At 5 degrees the motors can hold the stretched arm against up to 7.3 times gravity;
    on a vertical table they could not even hold it against 1 times gravity.

    Args:
        gravity: multiplier of 9.8 m/s^2, in [0, 20]. The original has none.
        tilt: tilt of the table, degrees in [0, 90].
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.

    Raises:
        ValueError: a value is outside its range.
        RuntimeError: the render mode is ``"human"`` and no display answers.
    """

    start_range = (3.14, 3.14, 0.27, 0.27)
    torques = np.full(2, 0.05)
    camera = 0.55, -65.0

    def __init__(
        self,
        gravity: float = 1.0,
        tilt: float = 5.0,
        render_mode: str | None = None,
    ):
        self.gravity = require(SPEC.knobs["gravity"], gravity)
        self.tilt = require(_TILT, tilt)
        strength, angle = self.gravity * GRAVITY, math.radians(self.tilt)
        pull = 0.0, -strength * math.sin(angle), -strength * math.cos(angle)
        world = World(render_mode, pull, substeps=1, ground=False)
        super().__init__(world, 9, render_mode)

    def _place(self, positions: np.ndarray) -> Robot:
        self._target = float(positions[2]), float(positions[3])
        client = self._world.client
        arm = create_body(client, *morphology(), (0.0, 0.0, 0.0))
        for link in range(2):
            # The original's arm does not collide with anything.
            pybullet.setCollisionFilterGroupMask(arm, link, 0, 0, physicsClientId=client)
        robot = Robot(client, arm, (0, 1), (0, 1))
        if self.render_mode is not None:
            robot.paint((0.0, 0.4, 0.6, 1.0))
            pybullet.createMultiBody(
                0.0,
                baseVisualShapeIndex=pybullet.createVisualShape(
                    pybullet.GEOM_SPHERE,
                    radius=0.009,
                    rgbaColor=(0.9, 0.2, 0.2, 1.0),
                    physicsClientId=client,
                ),
                basePosition=(*self._target, _HEIGHT),
                physicsClientId=client,
            )
        robot.place(positions[:2])
        return robot

    def _reward(
        self, action: np.ndarray, observation: np.ndarray, gain: float
    ) -> tuple[float, dict[str, float]]:
        first, second = np.abs(action).tolist()
        first_speed, elbow, second_speed = np.abs(observation[6:]).tolist()
        control = -0.1 * (first * first_speed + second * second_speed) - 0.01 * (first + second)
        stuck = -0.1 if abs(elbow - 1.0) < 0.01 else 0.0
        return gain + control + stuck, {"progress": gain, "control": control, "stuck": stuck}

    def _focus(self) -> Vector:
        return 0.0, 0.0, 0.0

    def _observe(self) -> tuple[np.ndarray, float]:
        """The observation, and -100 times the fingertip's distance to the target."""
        (shoulder, elbow), (shoulder_speed, elbow_speed) = self._robot.states()
        # The original reads link positions from Bullet's cache, which is one step old.
        upper = shoulder - TIME_STEP * shoulder_speed
        lower = upper + elbow - TIME_STEP * elbow_speed
        x = _UPPER * math.cos(upper) + _FINGERTIP * math.cos(lower) - self._target[0]
        y = _UPPER * math.sin(upper) + _FINGERTIP * math.sin(lower) - self._target[1]
        observation = np.array(
            [
                *self._target,
                x,
                y,
                math.cos(shoulder),
                math.sin(shoulder),
                0.1 * shoulder_speed,
                elbow / _ELBOW_LIMIT,
                0.1 * elbow_speed,
            ],
            dtype=np.float32,
        )
        return observation, -100.0 * math.hypot(x, y)


def transition_reward(
    observations: np.ndarray, actions: np.ndarray, next_observations: np.ndarray
) -> np.ndarray:
    """The true reward [B] of steps from ``observations`` to ``next_observations`` [B, 9].

    It is that of :meth:`Reacher.step`, up to the observations' single precision.
    """
    before, after = (np.linalg.norm(o[:, 2:4], axis=1) for o in (observations, next_observations))
    effort = np.abs(np.clip(actions, -1.0, 1.0))
    work = (effort * np.abs(next_observations[:, [6, 8]])).sum(1)
    stuck = np.abs(np.abs(next_observations[:, 7]) - 1.0) < 0.01
    return 100.0 * (before - after) - 0.1 * work - 0.01 * effort.sum(1) - 0.1 * stuck
