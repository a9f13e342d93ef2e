"""Gymnasium's MuJoCo robots with changed bodies, through MuJoCo's model specification.

A robot's XML file is read, changed and compiled. Nothing is changed where a multiplier is 1, so the
model is then that of Gymnasium, to the last bit.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np


def _ignore(message: str) -> None:
    """Nothing: what matters is reported as an error of the episode."""


# By default MuJoCo appends its warnings to MUJOCO_LOG.TXT in the current directory.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_ignore)


class Changes(NamedTuple):
    """The multipliers of an intervened robot.

    Attributes:
        mass: of the mass and inertia of every body. The rotors' inertia (armature) stays.
        friction: of every friction coefficient of robot and floor. Two touching bodies have the
            larger coefficient of both.
        gravity: of 9.81 m/s^2.
        leg_length: of every length of the legs but their thickness.
        actuator_strength: of every motor's torque.
        joint_limit: of every joint's range. A range that contains the starting pose is scaled about
            that pose, any other about its end that is nearer to it.
    """

    mass: float = 1.0
    friction: float = 1.0
    gravity: float = 1.0
    leg_length: float = 1.0
    actuator_strength: float = 1.0
    joint_limit: float = 1.0


def intervened(path: str, legs: Sequence[str], changes: Changes) -> tuple[mujoco.MjModel, float]:
    """The model of a robot, and how far its torso starts above the original's [m].

    Longer legs weigh more: a leg keeps its density, and every other body its mass. The torso starts
    as much higher as the legs reach lower, so that no leg begins in the floor.

    Args:
        path: XML file of the robot; its root body is called torso.
        legs: names of the bodies at which its legs begin, which turn about the hips.
        changes: multipliers.
    """
    with warnings.catch_warnings():
        # MuJoCo 4 warns of an attribute of half_cheetah.xml.
        warnings.simplefilter("ignore")
        spec = mujoco.MjSpec.from_file(path)
        rise = _change(spec, legs, changes)
        return spec.compile(), rise


def _change(spec: Any, legs: Sequence[str], changes: Changes) -> float:
    """Change the specification, and return how far the torso was lifted."""
    rise = 0.0
    if changes.mass != 1.0 or changes.leg_length != 1.0:
        _scale_mass(spec, changes.mass)
    if changes.leg_length != 1.0:
        rise = _stretch_legs(spec, legs, changes.leg_length)
    if changes.friction != 1.0:
        for geom in spec.geoms:
            geom.friction = geom.friction * changes.friction
    if changes.gravity != 1.0:
        spec.option.gravity = spec.option.gravity * changes.gravity
    if changes.actuator_strength != 1.0:
        for actuator in spec.actuators:
            actuator.gear = actuator.gear * changes.actuator_strength
    if changes.joint_limit != 1.0:
        for joint in spec.joints:
            start = np.clip(0.0, *joint.range)
            joint.range = start + changes.joint_limit * (joint.range - start)
    return rise


def _scale_mass(spec: Any, factor: float) -> None:
    """Multiply every mass, and fix the densities, where the file fixes the sum of the masses."""
    total = spec.compiler.settotalmass
    if total > 0.0:
        spec.compiler.settotalmass = -1.0
        factor *= total / float(np.sum(spec.compile().body_mass))
    for geom in spec.geoms:
        geom.density *= factor


def _stretch_legs(spec: Any, legs: Sequence[str], factor: float) -> float:
    """Multiply the lengths of the legs, and lift the torso by what is returned."""
    before = _lowest(spec.compile())
    for name in legs:
        _stretch(spec.body(name), factor)
    rise = before - _lowest(spec.compile())
    torso = spec.body("torso")
    torso.pos = torso.pos + np.array([0.0, 0.0, rise])
    for joint in torso.joints:
        # Of a robot whose vertical coordinate is a height, and not the distance from the start.
        if joint.ref != 0.0:
            joint.ref += rise
    return rise


def _stretch(body: Any, factor: float) -> None:
    """Multiply the lengths of a body and of all that hang from it; their thickness stays."""
    for joint in body.joints:
        joint.pos = joint.pos * factor
    for geom in body.geoms:
        geom.pos = geom.pos * factor
        if not math.isnan(geom.fromto[0]):
            geom.fromto = geom.fromto * factor
        elif geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE:
            geom.size = geom.size * np.array([1.0, factor, 1.0])
    for child in body.bodies:
        child.pos = child.pos * factor
        _stretch(child, factor)


def _lowest(model: mujoco.MjModel) -> float:
    """Height of the robot's lowest point [m], in the allowed pose that is nearest to the start."""
    data = mujoco.MjData(model)
    limited = model.jnt_limited.astype(bool)
    where = model.jnt_qposadr[limited]
    data.qpos[where] = np.clip(data.qpos[where], *model.jnt_range[limited].T)
    mujoco.mj_kinematics(model, data)
    # Robots consist of capsules and of balls, whose half length is 0.
    own = model.geom_bodyid > 0
    drop = np.abs(data.geom_xmat[own, 8]) * model.geom_size[own, 1] + model.geom_size[own, 0]
    return float(np.min(data.geom_xpos[own, 2] - drop))
