"""A Bullet world, the robots in it, and the checks that every robot environment shares.

A robot is data: a base and a list of links with exact masses and inertias, so lengths,
masses and frictions are parameters rather than edited XML.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pybullet_data

from irlcli.envs.bullet.engine import pybullet

Vector = tuple[float, float, float]
Friction = tuple[float, float, float]
Model = Literal["merged", "original"]

TIME_STEP = 0.0165
SUBSTEPS = 4
GRAVITY = 9.8
GOAL_DISTANCE = 1000.0

_SELF_COLLISION = (
    pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_ALL_PARENTS
)
_DENSITY = 1000.0
# Bullet widens the bounding box of a capsule that the importer read from end to end by this.
FROM_TO_MARGIN = 0.04
_M_PERTURB = -6


@dataclass(frozen=True)
class Capsule:
    """A capsule between two points of its link's frame; a ball if they are the same."""

    start: Vector
    end: Vector
    radius: float

    @property
    def mass(self) -> float:
        """Mass at the density of water, which is what Bullet's importer gives the originals."""
        area = math.pi * self.radius**2
        return _DENSITY * area * (math.dist(self.start, self.end) + 4.0 / 3.0 * self.radius)

    @property
    def center(self) -> Vector:
        """The point halfway."""
        x, y, z = (0.5 * (a + b) for a, b in zip(self.start, self.end, strict=True))
        return x, y, z


@dataclass(frozen=True)
class Link:
    """A rigid link and the joint that holds it (none for a robot's base).

    Args:
        parent: index of the parent link, -1 for the base.
        anchor: the joint in the parent's frame; it is the origin of this link's frame.
        axis: the joint's axis; Bullet takes it unnormalised.
        limits: lower and upper joint position, or ``None``.
        center: centre of mass in this link's frame.
        inertia: diagonal of the inertia tensor about ``center``.
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
    """``x`` in single precision, which is how Bullet's importer reads lengths."""
    return float(np.float32(x))


def box_inertia(mass: float, extents: Sequence[float]) -> Vector:
    """Inertia of a box of these side lengths.

    Bullet's importer gives a link the inertia of its bounding box, not of its capsules.
    """
    x, y, z = (extent**2 for extent in extents)
    return mass / 12.0 * (y + z), mass / 12.0 * (x + z), mass / 12.0 * (x + y)


def require(name: str, value: float, low: float, high: float) -> float:
    """``value`` as a float.

    Raises:
        ValueError: not a finite number in [low, high].
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high:
        raise ValueError(f"{name} must lie in [{low:g}, {high:g}], not {value!r}")
    return number


def require_friction(friction: Sequence[float]) -> Friction:
    """Tangential, torsional and rolling coefficient, in the importer's single precision.

    Raises:
        ValueError: not three numbers in [0, 10].
    """
    if np.shape(friction) != (3,):
        raise ValueError(
            f"friction must be three numbers (tangential, torsional, rolling), not {friction!r}"
        )
    names = ("friction (tangential)", "friction (torsional)", "friction (rolling)")
    first, second, third = (
        single(require(name, value, 0.0, 10.0)) for name, value in zip(names, friction, strict=True)
    )
    return first, second, third


def require_model(model: str, leg_length: float = 1.0) -> Model:
    """The model's name.

    Raises:
        ValueError: an unknown model, or one whose legs cannot change.
    """
    if model not in ("merged", "original"):
        raise ValueError(f"model must be 'merged' or 'original', not {model!r}")
    if model == "original" and leg_length != 1.0:
        raise ValueError(f"leg_length must be 1 with model='original', not {leg_length!r}")
    return model


class Goal:
    """Where to walk: a point 1 km away, fixed or drawn anew for each episode.

    Args:
        goal_y: the goal is (1000, goal_y), in [-10000, 10000].
        direction: the goal is 1000 m away in this direction, degrees counter-clockwise from x,
            in [-180, 180]; a pair is the range of a uniform draw per episode.

    With neither the goal is (1000, 0) and no part of the observation.

    Raises:
        ValueError: both given, a value out of range, or an empty range.
    """

    def __init__(
        self, goal_y: float | None = None, direction: float | Sequence[float] | None = None
    ):
        if goal_y is not None and direction is not None:
            raise ValueError(
                f"goal_y and direction exclude each other, not {goal_y!r} and {direction!r}"
            )
        self.observed = goal_y is not None or direction is not None
        self._y = 0.0 if goal_y is None else require("goal_y", goal_y, -10000.0, 10000.0)
        self._range: tuple[float, float] | None = None
        if direction is not None:
            ends = (direction, direction) if np.ndim(direction) == 0 else tuple(direction)
            if len(ends) != 2:
                raise ValueError(f"direction must be one angle or a pair, not {direction!r}")
            low, high = (require("direction", end, -180.0, 180.0) for end in ends)
            if low > high:
                raise ValueError(f"direction must be (smaller, larger), not {direction!r}")
            self._range = low, high

    def draw(self, random: np.random.Generator) -> tuple[float, float]:
        """The goal's x and y for one episode."""
        if self._range is None:
            return GOAL_DISTANCE, self._y
        low, high = self._range
        angle = math.radians(low if low == high else random.uniform(low, high))
        return GOAL_DISTANCE * math.cos(angle), GOAL_DISTANCE * math.sin(angle)

    def observation(self, goal: tuple[float, float]) -> list[float]:
        """The unit vector to ``goal``, or nothing where the goal is not observed."""
        norm = math.hypot(*goal)
        return [goal[0] / norm, goal[1] / norm] if self.observed else []


def has_display() -> bool:
    """Whether an X server answers; Bullet's window ends the whole process where none does."""
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


@contextlib.contextmanager
def _zeroed_allocations() -> Iterator[None]:
    """Let glibc's ``malloc`` hand out zeroed memory, in this thread; elsewhere do nothing.

    Bullet's MJCF importer leaves the initial transforms of jointed links uninitialised. They
    shape the broad phase's tree, hence the order in which contacts are solved, hence the
    motion. Zeroed, that order is reproducible in all but rare cases, and is the recorded traces'.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        yield
        return
    libc.malloc.restype = ctypes.c_void_p
    libc.malloc.argtypes = [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    # M_PERTURB does not reach blocks that were freed before and are cached by size.
    cached = [libc.malloc(size) for size in range(24, 4096, 16) for _ in range(64)]
    libc.mallopt(_M_PERTURB, 255)
    try:
        yield
    finally:
        libc.mallopt(_M_PERTURB, 0)
        for block in cached:
            libc.free(block)


class World:
    """One Bullet physics client: ground, gravity, time and camera.

    Args:
        render_mode: ``None``, ``"rgb_array"`` (software renderer) or ``"human"`` (a window).
        gravity: acceleration, m/s^2.
        substeps: solver steps per time step.
        ground: whether there is a floor (friction 0.8, restitution 0.5).

    Raises:
        ValueError: unknown render mode.
        RuntimeError: a window was asked for and there is no display.
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
                "render_mode='human' needs a display and none answers; use 'rgb_array'"
            )
        mode = pybullet.GUI if render_mode == "human" else pybullet.DIRECT
        self.client = pybullet.connect(mode)
        self._gravity = gravity
        self._substeps = substeps
        self._ground = ground

    def clear(self) -> None:
        """Empty the world but for its ground.

        Contacts, warm starts and the broad phase's tree all outlive a change of pose, so an
        episode is a function of its seed alone only in a world built anew.
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
        """Point the window's camera as :meth:`image` does."""
        distance, pitch = camera
        pybullet.resetDebugVisualizerCamera(
            distance, 0.0, pitch, target, physicsClientId=self.client
        )

    def image(self, target: Vector, camera: tuple[float, float]) -> np.ndarray:
        """A picture of ``target``, which moves to the right: [240, 320, 3] uint8.

        ``camera`` is the distance and the pitch in degrees (negative looks down).
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
        """Disconnect; closing twice does nothing."""
        if self.client >= 0:
            pybullet.disconnect(self.client)
            self.client = -1

    def build(self, base: Link, links: Sequence[Link], position: Vector) -> int:
        """A robot from data; its body id. The base is fixed if its mass is zero."""
        client = self.client
        body = pybullet.createMultiBody(
            baseMass=base.mass,
            baseCollisionShapeIndex=self._shape(base.shapes),
            basePosition=position,
            baseInertialFramePosition=base.center,
            linkMasses=[link.mass for link in links],
            linkCollisionShapeIndices=[self._shape(link.shapes) for link in links],
            linkVisualShapeIndices=[-1] * len(links),
            linkPositions=[link.anchor for link in links],
            linkOrientations=[(0.0, 0.0, 0.0, 1.0)] * len(links),
            linkInertialFramePositions=[link.center for link in links],
            linkInertialFrameOrientations=[(0.0, 0.0, 0.0, 1.0)] * len(links),
            linkParentIndices=[link.parent + 1 for link in links],
            linkJointTypes=[link.joint for link in links],
            linkJointAxis=[link.axis for link in links],
            flags=_SELF_COLLISION,
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

    def load(self, file: str, flags: int = 0) -> tuple[int, ...]:
        """The bodies of an MJCF file of ``pybullet_data``."""
        path = os.path.join(pybullet_data.getDataPath(), "mjcf", file)
        with _zeroed_allocations():
            return pybullet.loadMJCF(
                path, flags=_SELF_COLLISION | flags, physicsClientId=self.client
            )

    def _shape(self, shapes: Sequence[Capsule]) -> int:
        """Bullet's id of the compound of ``shapes``, or -1 of none."""
        if not shapes:
            return -1
        lengths = [math.dist(shape.start, shape.end) for shape in shapes]
        return pybullet.createCollisionShapeArray(
            shapeTypes=[
                pybullet.GEOM_CAPSULE if length > 0.0 else pybullet.GEOM_SPHERE
                for length in lengths
            ],
            radii=[shape.radius for shape in shapes],
            lengths=lengths,
            collisionFramePositions=[shape.center for shape in shapes],
            collisionFrameOrientations=[_from_z(shape) for shape in shapes],
            physicsClientId=self.client,
        )


def _from_z(shape: Capsule) -> tuple[float, float, float, float]:
    """The quaternion (x, y, z, w) that turns the z axis onto the capsule's."""
    length = math.dist(shape.start, shape.end)
    if length == 0.0:
        return 0.0, 0.0, 0.0, 1.0
    x, y, z = ((b - a) / length for a, b in zip(shape.start, shape.end, strict=True))
    if z < -0.999999:
        return 1.0, 0.0, 0.0, 0.0
    norm = math.sqrt(2.0 * (1.0 + z))
    return -y / norm, x / norm, 0.0, 0.5 * norm


class Robot:
    """A body whose joints are read, and driven by torques, in one call each.

    Args:
        client: Bullet's client id.
        body: Bullet's body id.
        joints: indices of the joints read; their motors, and all others, are switched off.
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

    def place(self, positions: Sequence[float]) -> None:
        """Set every joint read to a position, at rest."""
        for joint, position in zip(self.joints, positions, strict=True):
            pybullet.resetJointState(self.body, joint, position, 0.0, physicsClientId=self.client)

    def states(self) -> tuple[list[float], list[float]]:
        """Positions and velocities of the joints read."""
        states = pybullet.getJointStates(self.body, self.joints, self.client)
        return [state[0] for state in states], [state[1] for state in states]

    def drive(self, torques: np.ndarray) -> None:
        """Apply torques to the driven joints during the next step."""
        pybullet.setJointMotorControlArray(
            self.body,
            self._driven,
            pybullet.TORQUE_CONTROL,
            forces=torques.tolist(),
            physicsClientId=self.client,
        )

    def set_friction(self, friction: Friction) -> None:
        """Tangential, torsional and rolling friction of every link."""
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
        """Give every link a colour (red, green, blue, opacity)."""
        for link in self._links():
            pybullet.changeVisualShape(
                self.body, link, rgbaColor=color, physicsClientId=self.client
            )

    def _links(self) -> range:
        return range(-1, pybullet.getNumJoints(self.body, physicsClientId=self.client))


def moving_joints(client: int, body: int) -> list[int]:
    """The joints of a loaded MJCF body that are not fixed."""
    return [
        joint
        for joint in range(pybullet.getNumJoints(body, physicsClientId=client))
        if pybullet.getJointInfo(body, joint, physicsClientId=client)[2] != pybullet.JOINT_FIXED
    ]
