"""Robots as data: rigid links made of capsules, and their creation in Bullet.

Lengths, masses and frictions are thereby parameters of a function, not edits to an XML file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlcli.envs.bullet.engine import pybullet

Vector = tuple[float, float, float]

SELF_COLLISION = (
    pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
)
# Bullet enlarges the bounding box of a capsule by this margin if the MJCF file gives the
# capsule by its end points.
FROM_TO_MARGIN = 0.04
_DENSITY = 1000.0


@dataclass(frozen=True)
class Capsule:
    """A capsule between two points of its link's frame; a ball if the points are equal."""

    start: Vector
    end: Vector
    radius: float

    @property
    def mass(self) -> float:
        """Mass at 1000 kg/m^3, the density that Bullet's importer gives to the originals."""
        area = math.pi * self.radius**2
        return _DENSITY * area * (math.dist(self.start, self.end) + 4.0 / 3.0 * self.radius)

    @property
    def center(self) -> Vector:
        """The midpoint."""
        x, y, z = (0.5 * (a + b) for a, b in zip(self.start, self.end, strict=True))
        return x, y, z


@dataclass(frozen=True)
class Link:
    """A rigid link and the joint that connects it to its parent (a robot's base has none).

    Args:
        mass: mass; zero fixes a base in space.
        inertia: diagonal of the inertia tensor about ``center``.
        shapes: collision shapes, in this link's frame.
        center: centre of mass in this link's frame.
        parent: index of the parent link, -1 for the base.
        anchor: position of the joint in the parent's frame, and origin of this link's frame.
        joint: Bullet's joint type.
        axis: axis of the joint; Bullet accepts it unnormalised.
        limits: lower and upper joint position, or ``None`` for an unlimited joint.
    """

    mass: float
    inertia: Vector
    shapes: tuple[Capsule, ...] = ()
    center: Vector = (0.0, 0.0, 0.0)
    parent: int = -1
    anchor: Vector = (0.0, 0.0, 0.0)
    joint: int = pybullet.JOINT_REVOLUTE
    axis: Vector = (0.0, 0.0, 1.0)
    limits: tuple[float, float] | None = None


def single(x: float) -> float:
    """``x`` rounded to single precision, in which Bullet's importer reads lengths."""
    return float(np.float32(x))


def box_inertia(mass: float, extents: Sequence[float]) -> Vector:
    """Moments of inertia of a box with these side lengths.

    Bullet's importer gives each link the inertia of its bounding box, not of its capsules.
    """
    x, y, z = (extent**2 for extent in extents)
    return mass / 12.0 * (y + z), mass / 12.0 * (x + z), mass / 12.0 * (x + y)


def create_body(client: int, base: Link, links: Sequence[Link], position: Vector) -> int:
    """Create a robot in Bullet and return its body id; a base of zero mass is fixed."""
    body = pybullet.createMultiBody(
        baseMass=base.mass,
        baseCollisionShapeIndex=_collision_shape(client, base.shapes),
        basePosition=position,
        baseInertialFramePosition=base.center,
        linkMasses=[link.mass for link in links],
        linkCollisionShapeIndices=[_collision_shape(client, link.shapes) for link in links],
        linkVisualShapeIndices=[-1] * len(links),
        linkPositions=[link.anchor for link in links],
        linkOrientations=[(0.0, 0.0, 0.0, 1.0)] * len(links),
        linkInertialFramePositions=[link.center for link in links],
        linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)] * len(links),
        # Bullet numbers the parents from the base, which it counts as 0.
        linkParentIndices=[link.parent + 1 for link in links],
        linkJointTypes=[link.joint for link in links],
        linkJointAxis=[link.axis for link in links],
        flags=SELF_COLLISION,
        physicsClientId=client,
    )
    for index, link in enumerate((base, *links), start=-1):
        pybullet.changeDynamics(
            body, index, localInertiaDiagonal=link.inertia, physicsClientId=client
        )
        if link.limits is not None:
            pybullet.changeDynamics(
                body,
                index,
                jointLowerLimit=link.limits[0],
                jointUpperLimit=link.limits[1],
                physicsClientId=client,
            )
    return body


def _collision_shape(client: int, shapes: Sequence[Capsule]) -> int:
    """Bullet's id of the compound of ``shapes``, or -1 if there are none."""
    if not shapes:
        return -1
    lengths = [math.dist(shape.start, shape.end) for shape in shapes]
    return pybullet.createCollisionShapeArray(
        shapeTypes=[
            pybullet.GEOM_CAPSULE if length > 0.0 else pybullet.GEOM_SPHERE for length in lengths
        ],
        radii=[shape.radius for shape in shapes],
        lengths=lengths,
        collisionFramePositions=[shape.center for shape in shapes],
        collisionFrameOrientations=[_rotation_from_z(shape) for shape in shapes],
        physicsClientId=client,
    )


def _rotation_from_z(shape: Capsule) -> tuple[float, float, float, float]:
    """The quaternion (x, y, z, w) that rotates the z axis onto the capsule's axis."""
    length = math.dist(shape.start, shape.end)
    if length == 0.0:
        return 0.0, 0.0, 0.0, 1.0
    x, y, z = ((b - a) / length for a, b in zip(shape.start, shape.end, strict=True))
    if z < -0.999999:
        return 1.0, 0.0, 0.0, 0.0
    norm = math.sqrt(2.0 * (1.0 + z))
    return -y / norm, x / norm, 0.0, 0.5 * norm
