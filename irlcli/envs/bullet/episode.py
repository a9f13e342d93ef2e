"""The frame of an episode, which all robots share."""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np

from irlcli.envs.bullet.world import TIME_STEP, Robot, Vector, World, has_display

_NOT_FINITE = "the state of the world is not finite"


class RobotEnv(gymnasium.Env, abc.ABC):
    """One robot in a world of its own; no episode terminates.

    A world whose state is no longer finite truncates the episode at its last finite
    observation, pays nothing, and says so in ``info["error"]``.

    Args:
        world: where the robot lives; closed with the environment.
        observations: size of an observation.
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": round(1.0 / TIME_STEP),
    }
    #: Start positions are drawn uniformly from this far on either side of zero.
    start_range: ClassVar[Sequence[float]]
    #: Torques [A] of an action of ones.
    torques: ClassVar[np.ndarray]
    #: Distance of the camera from what it looks at, and its pitch in degrees.
    camera: ClassVar[tuple[float, float]]

    def __init__(self, world: World, observations: int, render_mode: str | None):
        self._world = world
        self.render_mode = render_mode
        if not has_display():
            # Gymnasium's checker tries every mode that is offered.
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self.torques.shape, np.float32)

    @abc.abstractmethod
    def _place(self, positions: np.ndarray) -> Robot:
        """Draw what else an episode draws; the robot at ``positions``, in the empty world."""

    @abc.abstractmethod
    def _observe(self) -> tuple[np.ndarray, float]:
        """The observation, and the potential that progress is a gain of."""

    @abc.abstractmethod
    def _reward(
        self, action: np.ndarray, observation: np.ndarray, gain: float
    ) -> tuple[float, dict[str, float]]:
        """The reward of a step that gained this much potential, and its terms."""

    @abc.abstractmethod
    def _focus(self) -> Vector:
        """Where the camera looks."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; ``options["joint_positions"]`` replaces the drawn start.

        Raises:
            ValueError: another option, another shape, or a number that is not finite.
        """
        super().reset(seed=seed)
        positions = _start_positions(options, len(self.start_range))
        if positions is None:
            positions = self.np_random.uniform(np.negative(self.start_range), self.start_range)
        self._world.clear()
        self._robot = self._place(positions)
        self._observation, self._potential = self._observe()
        return self._observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance 0.0165 s.

        Raises:
            ValueError: an action of another shape, or not finite.
        """
        action = _clipped(action, self.torques.shape)
        self._robot.drive(self.torques * action)
        self._world.step()
        observation, potential = self._observe()
        if not (math.isfinite(potential) and _is_finite(observation)):
            return self._observation, 0.0, False, True, {"error": _NOT_FINITE}
        reward, info = self._reward(action, observation, potential - self._potential)
        self._observation = observation
        self._potential = potential
        if self.render_mode == "human":
            self._world.look_at(self._focus(), self.camera)
        return observation, reward, False, False, info

    def render(self) -> np.ndarray | None:
        """A picture of the robot [240, 320, 3] uint8; ``None`` unless ``"rgb_array"``."""
        if self.render_mode != "rgb_array":
            return None
        return self._world.image(self._focus(), self.camera)

    def close(self) -> None:
        """Disconnect from Bullet."""
        self._world.close()


def _is_finite(array: np.ndarray) -> bool:
    """Whether every number of a vector is finite (and far below overflow)."""
    # One product of the vector with itself is much cheaper than ``np.isfinite(...).all()``.
    return math.isfinite(array.dot(array))


def _clipped(action: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """``action`` of ``shape`` as float64, clipped to the actuators' range [-1, 1].

    Raises:
        ValueError: another shape, or a number that is not finite.
    """
    action = np.asarray(action, dtype=np.float64)
    if action.shape != shape:
        raise ValueError(f"action must have shape {shape}, not {action.shape}")
    if not _is_finite(action):
        raise ValueError(f"action must be finite, not {action.tolist()}")
    return np.minimum(np.maximum(action, -1.0), 1.0)


def _start_positions(options: dict | None, size: int) -> np.ndarray | None:
    """``options["joint_positions"]`` [size] of a reset, or ``None`` where not given.

    Raises:
        ValueError: another option, another shape, or a number that is not finite.
    """
    if not options:
        return None
    if set(options) != {"joint_positions"}:
        raise ValueError(f"the only reset option is 'joint_positions', not {sorted(options)}")
    positions = np.asarray(options["joint_positions"], dtype=np.float64)
    if positions.shape != (size,) or not np.isfinite(positions).all():
        raise ValueError(f"joint_positions must be {size} finite numbers, not {positions.tolist()}")
    return positions
