"""Ant's and HalfCheetah's arguments, checked, and the robot that they make."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from irlcli.envs.arguments import require
from irlcli.envs.bullet.body import Link, Vector, create_body, single
from irlcli.envs.bullet.goal import Goal
from irlcli.envs.bullet.knobs import LEG_LENGTH, WALKER_KNOBS
from irlcli.envs.bullet.robot import Robot

Morphology = Callable[[float], tuple[Link, list[Link]]]


class Walker:
    """A walking robot's interventions, checked when it is constructed.

    Args:
        mass: multiplier of every link's mass and inertia, in [0.1, 10].
        friction: tangential, torsional and rolling coefficient of every link, each in [0, 10].
            Bullet multiplies the coefficients of two touching bodies; the floor's is 0.8.
        leg_length: multiplier of leg lengths, in [0.2, 5]; the robot decides which legs.
        goal_y, direction: see :class:`irlcli.envs.bullet.goal.Goal`.

    Raises:
        ValueError: a value is outside its range.
    """

    def __init__(
        self,
        mass: float,
        friction: Sequence[float],
        leg_length: float,
        goal_y: float | None,
        direction: float | Sequence[float] | None,
    ):
        self.mass = require(WALKER_KNOBS["mass"], mass)
        self.friction = _friction(friction)
        self.leg_length = require(LEG_LENGTH, leg_length)
        self.goal = Goal(goal_y, direction)

    def create(
        self,
        client: int,
        morphology: Morphology,
        position: Vector,
        passive_joints: int = 0,
    ) -> Robot:
        """Create the intervened robot in Bullet.

        Args:
            client: Bullet's client id.
            morphology: base and links, as a function of ``leg_length``.
            position: position of the base.
            passive_joints: number of leading joints that no torque acts on.
        """
        base, links = morphology(self.leg_length)
        body = create_body(client, base, links, position)
        joints = list(range(len(links)))
        robot = Robot(client, body, joints, joints[passive_joints:])
        robot.set_friction(self.friction)
        if self.mass != 1.0:
            robot.scale_mass(self.mass)
        return robot


def _friction(friction: Sequence[float]) -> Vector:
    """The tangential, torsional and rolling coefficient in the importer's precision.

    Raises:
        ValueError: ``friction`` is not three numbers within the knob's bounds.
    """
    if np.shape(friction) != (3,):
        raise ValueError(
            f"friction must be three numbers (tangential, torsional, rolling), not {friction!r}"
        )
    kinds = ("tangential", "torsional", "rolling")
    tangential, torsional, rolling = (
        single(require(WALKER_KNOBS["friction"]._replace(argument=f"friction ({kind})"), value))
        for kind, value in zip(kinds, friction, strict=True)
    )
    return tangential, torsional, rolling
