"""Gymnasium environments with interventions, and vectorised stepping over them.

Importing this package registers every environment of :data:`irlcli.interventions.ENVIRONMENTS`
with gymnasium, so ``gymnasium.make("irlcli/LunarLander-v0", bounce=0.5)`` works.
"""

from __future__ import annotations

import gymnasium

from irlcli.interventions import ENVIRONMENTS, Setting, env_kwargs, environment

_ENTRY_POINTS = {
    "lunar-lander": "irlcli.envs.lunar_lander:LunarLander",
    "ant": "irlcli.envs.bullet.ant:Ant",
    "half-cheetah": "irlcli.envs.bullet.half_cheetah:HalfCheetah",
    "reacher": "irlcli.envs.bullet.reacher:Reacher",
    "gridworld": "irlcli.envs.gridworld:Gridworld",
}

for _name, _entry_point in _ENTRY_POINTS.items():
    if ENVIRONMENTS[_name].gym_id not in gymnasium.registry:
        gymnasium.register(
            ENVIRONMENTS[_name].gym_id,
            entry_point=_entry_point,
            max_episode_steps=ENVIRONMENTS[_name].max_episode_steps,
        )


def make(env: str, setting: Setting, render_mode: str | None = None) -> gymnasium.Env:
    """The bare environment of one setting, without gymnasium's wrappers or time limit.

    Raises:
        UsageError: unknown environment, or an intervention it does not have.
    """
    return gymnasium.make(
        environment(env).gym_id, render_mode=render_mode, **env_kwargs(env, setting)
    ).unwrapped
