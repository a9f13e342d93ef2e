"""Registration of the environments with gymnasium, and their construction from a setting.

Gymnasium 1 has no plugin entry points. Import this module to register the environments; then
``gymnasium.make("irlcli/LunarLander-v0", bounce=0.5)`` works.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import gymnasium
import numpy as np

from irlcli.envs.registry import ENVIRONMENTS, environment
from irlcli.interventions import Setting, env_kwargs


def register() -> None:
    """Register every environment with gymnasium; a second call changes nothing."""
    for spec in ENVIRONMENTS.values():
        if spec.gym_id not in gymnasium.registry:
            gymnasium.register(
                spec.gym_id,
                entry_point=spec.entry_point,
                max_episode_steps=spec.max_episode_steps,
            )


def make(env: str, setting: Setting, render_mode: str | None = None) -> gymnasium.Env:
    """Make the environment of one setting, without gymnasium's wrappers and time limit.

    Raises:
        UsageError: the environment is unknown, or does not have one of the interventions.
    """
    # Environments that were added since this module was imported.
    register()
    return gymnasium.make(
        environment(env).gym_id, render_mode=render_mode, **env_kwargs(env, setting)
    ).unwrapped


register()


def transition_reward(env: str) -> Callable[..., np.ndarray] | None:
    """The true reward [B] as a function of (s, a, s'); None where it depends on more than that."""
    name = environment(env).transition_reward
    if name is None:
        return None
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)
