"""An episode of a robot environment: reset, step, render."""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np

from irlcli.envs.arguments import clipped, is_finite
from irlcli.envs.bullet.body import Vector
from irlcli.envs.bullet.robot import Robot
from irlcli.envs.bullet.world import TIME_STEP, World, has_display

_NOT_FINITE = "the state of the world is not finite"


class RobotEnv(gymnasium.Env, abc.ABC):
    """One robot in its own world.

    An episode never terminates. If the world's state becomes infinite or NaN, the episode is
    truncated: the step returns the last finite observation, reward 0 and ``info["error"]``.

    Args:
        world: the robot's world, which :meth:`close` closes.
        observations: number of entries of an observation.
        render_mode: ``None``, ``"rgb_array"`` or ``"human"``.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array"],
        "render_fps": round(1.0 / TIME_STEP),
    }
    #: Start positions are drawn uniformly from +- these values.
    start_range: ClassVar[Sequence[float]]
    #: Torques [A] that an action of ones applies.
    torques: ClassVar[np.ndarray]
    #: The camera's distance from its target, and its pitch in degrees.
    camera: ClassVar[tuple[float, float]]

    def __init__(self, world: World, observations: int, render_mode: str | None):
        self._world = world
        self.render_mode = render_mode
        if not has_display():
            # Gymnasium's checker tries every render mode in the metadata.
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, self.torques.shape, np.float32)
        self._low, self._high = -np.ones(self.torques.shape), np.ones(self.torques.shape)

    @abc.abstractmethod
    def _place(self, positions: np.ndarray) -> Robot:
        """Create the robot at ``positions`` in the empty world, and draw the episode's goal."""

    @abc.abstractmethod
    def _observe(self) -> tuple[np.ndarray, float]:
        """The observation, and the potential whose increase is the progress."""

    @abc.abstractmethod
    def _reward(
        self, action: np.ndarray, observation: np.ndarray, gain: float
    ) -> tuple[float, dict[str, float]]:
        """The reward and its terms, for a step in which the potential grew by ``gain``."""

    @abc.abstractmethod
    def _focus(self) -> Vector:
        """The camera's target."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; ``options["joint_positions"]`` replaces the random start positions.

        Raises:
            ValueError: an unknown option, or positions of a wrong shape or not finite.
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
        """Advance 0.0165 s; ``action`` [A] is clipped to [-1, 1].

        Raises:
            ValueError: an action of a wrong shape, or not finite.
        """
        action = clipped(action, self._low, self._high)
        self._robot.drive(self.torques * action)
        self._world.step()
        observation, potential = self._observe()
        if not (math.isfinite(potential) and is_finite(observation)):
            return self._observation, 0.0, False, True, {"error": _NOT_FINITE}
        reward, info = self._reward(action, observation, potential - self._potential)
        self._observation = observation
        self._potential = potential
        if self.render_mode == "human":
            self._world.look_at(self._focus(), self.camera)
        return observation, reward, False, False, info

    def render(self) -> np.ndarray | None:
        """A picture of the robot [240, 320, 3] uint8 in mode ``"rgb_array"``, else ``None``."""
        if self.render_mode != "rgb_array":
            return None
        return self._world.image(self._focus(), self.camera)

    def close(self) -> None:
        """Disconnect from Bullet."""
        self._world.close()


def _start_positions(options: dict[str, Any] | None, size: int) -> np.ndarray | None:
    """``options["joint_positions"]`` [size] of a reset, or ``None`` without options.

    Raises:
        ValueError: an unknown option, or positions of a wrong shape or not finite.
    """
    if not options:
        return None
    if set(options) != {"joint_positions"}:
        raise ValueError(f"the only reset option is 'joint_positions', not {sorted(options)}")
    positions = np.asarray(options["joint_positions"], dtype=np.float64)
    if positions.shape != (size,) or not np.isfinite(positions).all():
        raise ValueError(f"joint_positions must be {size} finite numbers, not {positions.tolist()}")
    return positions
