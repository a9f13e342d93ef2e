"""Five of Gymnasium's MuJoCo robots with interventions on their bodies and their world.

Where nothing is changed, states and rewards equal those of Gymnasium's v5 environments bit for bit, for
actions of double precision.
"""

from __future__ import annotations

import os
from functools import cached_property
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.ant_v5 import AntEnv
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.humanoid_v5 import HumanoidEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv
from gymnasium.spaces import Box
from gymnasium.utils import EzPickle

from irlcli.envs.arguments import clipped, is_finite, require
from irlcli.envs.mujoco.model import Changes, intervened
from irlcli.envs.mujoco.spec import MUJOCO_ROBOTS
from irlcli.errors import StageFailed, first_line

_KNOBS = {knob.argument: knob for spec in MUJOCO_ROBOTS for knob in spec.knobs.values()}
# A robot that moves faster [m/s] is being thrown apart. MuJoCo itself warns only at 1e10.
_FASTEST = 100.0
_UNSTABLE = "the simulation is unstable: a position, speed or acceleration is huge or not a number"
# MuJoCo counts its warnings by kind.
_FIRST = int(mujoco.mjtWarning.mjWARN_BADQPOS)
_LAST = int(mujoco.mjtWarning.mjWARN_BADQACC)


class Robot(MujocoEnv, EzPickle):
    """What the robots have in common; each derives from it and from Gymnasium's environment.

    Observations are Gymnasium's, as float32. Actions are clipped to the motors' range and have
    double precision. ``info["progress"]`` is the distance [m] that the robot moved forward.

    If the simulation becomes unstable, or the robot moves faster than 100 m/s, the episode is
    truncated: the step returns the last observation, reward 0 and ``info["error"]``.

    Args:
        render_mode: ``None``, or one of Gymnasium's, which need OpenGL.
        arguments: multipliers as in :class:`irlcli.envs.mujoco.model.Changes`, and what Gymnasium's
            environment takes, such as ``terminate_when_unhealthy``.

    Raises:
        ValueError: a multiplier is outside its range.
    """

    #: Bodies at which the legs begin that ``leg_length`` changes.
    legs: ClassVar[tuple[str, ...]]
    #: Whether reward or observation depend on contact forces.
    feels: ClassVar[bool] = False
    _ctrl_cost_weight: float

    def __init__(self, render_mode: str | None = None, **arguments: Any):
        options = {name: arguments[name] for name in arguments if name not in Changes._fields}
        self._changes = Changes(
            **{
                name: require(_KNOBS[name], value)
                for name, value in arguments.items()
                if name not in options
            }
        )
        super().__init__(render_mode=render_mode, **options)
        EzPickle.__init__(self, render_mode, **arguments)
        size = self.observation_space.shape
        self.observation_space = Box(-np.inf, np.inf, size, np.float32)
        self._warnings = self.data.warning.number[_FIRST : _LAST + 1]
        assert isinstance(self.action_space, Box)
        self._low = self.action_space.low.astype(np.float64)
        self._high = self.action_space.high.astype(np.float64)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model, self._rise = intervened(self.fullpath, self.legs, self._changes)
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, self.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, self.height)
        return model, mujoco.MjData(model)

    @cached_property
    def dt(self) -> float:
        """The time of a step [s]."""
        return super().dt

    def do_simulation(self, ctrl: np.ndarray, n_frames: int) -> None:
        """Advance ``n_frames`` of MuJoCo's time steps."""
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, nstep=n_frames)
        if self.feels:
            mujoco.mj_rnePostConstraint(self.model, self.data)

    def control_cost(self, action: np.ndarray) -> float:
        """What the action [A] costs."""
        # Cheaper than Gymnasium's ``np.sum``.
        return self._ctrl_cost_weight * np.square(action).sum()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, and return the observation [D] float32 and an info."""
        observation, info = super().reset(seed=seed, options=options)
        self._observation = observation.astype(np.float32)
        return self._observation, info

    def step(  # type: ignore[override]
        self, action: np.ndarray
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance one step; ``action`` [A] is clipped to the motors' range.

        Raises:
            ValueError: an action of a wrong shape, or not finite.
        """
        action = clipped(action, self._low, self._high)
        state, reward, terminated, _, info = super().step(action)
        observation = state.astype(np.float32)
        exploded = abs(info["x_velocity"]) > _FASTEST or not is_finite(observation)
        # With a warning MuJoCo itself starts again from the initial state.
        if exploded or any(self._warnings.tolist()):
            return self._observation, 0.0, False, True, {"error": _UNSTABLE}
        info["progress"] = info["x_velocity"] * self.dt
        self._observation = observation
        return observation, float(reward), bool(terminated), False, info

    def render(self) -> Any:
        """A picture, as Gymnasium draws it; without a display by EGL.

        Raises:
            StageFailed: OpenGL cannot be used.
        """
        if not os.environ.get("DISPLAY"):
            os.environ.setdefault("MUJOCO_GL", "egl")
        try:
            return super().render()
        except Exception as error:
            # OpenGL's bindings raise anything.
            raise StageFailed(
                f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')}: "
                f"{first_line(error)}",
                "set MUJOCO_GL=egl or MUJOCO_GL=osmesa; only pictures need OpenGL",
            ) from None


class Falling(Robot):
    """A robot that is unhealthy outside of a range of heights.

    With other legs the range keeps its ratio to the height at the start.
    """

    #: Index of the height above the floor in ``qpos``.
    z_index: ClassVar[int] = 1
    _healthy_z_range: tuple[float, float]
    _healthy: bool | None = None

    def __init__(self, render_mode: str | None = None, **arguments: Any):
        super().__init__(render_mode, **arguments)
        if self._rise:
            start = float(self.init_qpos[self.z_index])
            low, high = self._healthy_z_range
            ratio = start / (start - self._rise)
            self._healthy_z_range = ratio * low, ratio * high

    def do_simulation(self, ctrl: np.ndarray, n_frames: int) -> None:
        self._healthy = None
        super().do_simulation(ctrl, n_frames)

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Set positions and velocities, as a reset does."""
        self._healthy = None
        super().set_state(qpos, qvel)

    @property
    def is_healthy(self) -> bool:
        """Whether the robot stands. Gymnasium asks twice a step."""
        if self._healthy is None:
            self._healthy = bool(super().is_healthy)  # type: ignore[misc]
        return self._healthy


class Ant(Falling, AntEnv):
    """Gymnasium's Ant-v5; its hind legs can change."""

    legs = ("aux_3", "aux_4")
    feels = True
    z_index = 2


class HalfCheetah(Robot, HalfCheetahEnv):
    """Gymnasium's HalfCheetah-v5, which does not fall."""

    legs = ("bthigh", "fthigh")

    def _get_obs(self) -> np.ndarray:
        if not self._exclude_current_positions_from_observation:
            return super()._get_obs()
        # Without Gymnasium's copies, which this light robot would notice.
        return np.concatenate((self.data.qpos[1:], self.data.qvel))


class Hopper(Falling, HopperEnv):
    """Gymnasium's Hopper-v5."""

    legs = ("thigh",)


class Walker2d(Falling, Walker2dEnv):
    """Gymnasium's Walker2d-v5."""

    legs = ("thigh", "thigh_left")


class Humanoid(Falling, HumanoidEnv):
    """Gymnasium's Humanoid-v5."""

    legs = ("right_thigh", "left_thigh")
    feels = True
    z_index = 2
