"""LunarLander with interventions on bounce, friction and engine power (paper Table 2).

Physics, observation and reward are those of gymnasium's LunarLander-v3 with discrete actions. An
intervention changes a constant of one instance and does not affect other instances.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.envs.box2d import lunar_lander as original
from gymnasium.utils import EzPickle

from irlcli.envs.arguments import require
from irlcli.envs.lunar_lander.spec import SPEC


def _bind(function: Callable[..., Any], **constants: float) -> types.FunctionType:
    """A copy of ``function`` that sees other values for some of its module's constants.

    Gymnasium keeps the engine's power in a module-level constant, which all LunarLanders of a
    process read. Replacing the globals of one copy of ``step`` changes the constant for one
    environment, without a copy of the code.
    """
    return types.FunctionType(
        function.__code__,
        {**function.__globals__, **constants},
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )


class LunarLander(original.LunarLander):
    """An intervened LunarLander.

    Args:
        bounce: coefficient of restitution of hull and legs, in [0, 1] (original: 0). Box2D
            treats contacts slower than 1 m/s as inelastic, whatever the restitution.
        friction: friction coefficient of the moon, in [0, 10] (original: 0.1). Between two touching
            bodies, Box2D uses sqrt(f1 * f2).
        engine_power: multiplier of the main engine's impulse, in [0.05, 20] (original: 1).
        render_mode: ``None``, ``"human"`` or ``"rgb_array"``.

    Raises:
        ValueError: a value is outside its range.
    """

    def __init__(
        self,
        bounce: float = 0.0,
        friction: float = 0.1,
        engine_power: float = 1.0,
        render_mode: str | None = None,
    ):
        self.bounce = require(SPEC.knobs["bounce"], bounce)
        self.friction = require(SPEC.knobs["friction"], friction)
        self.engine_power = require(SPEC.knobs["engine-power"], engine_power)
        super().__init__(render_mode=render_mode)
        EzPickle.__init__(self, bounce, friction, engine_power, render_mode)
        self._original_step = _bind(
            original.LunarLander.step,
            MAIN_ENGINE_POWER=original.MAIN_ENGINE_POWER * self.engine_power,
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode, and return the observation [8] float32 and an info."""
        observation, info = super().reset(seed=seed, options=options)
        # A contact keeps the coefficients it was created with. The lander starts high above the
        # ground, so no contact exists yet.
        for body in (self.lander, *self.legs):
            for fixture in body.fixtures:
                fixture.restitution = self.bounce
        assert self.moon is not None
        for fixture in self.moon.fixtures:
            fixture.friction = self.friction
        return observation, info

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance 1/50 s.

        Returns the observation [8] float32, the true reward, terminated, truncated and an info.
        """
        return self._original_step(self, action)
