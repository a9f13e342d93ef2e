"""Reinforcement learning: the only package that knows stable-baselines3.

Importing it loads neither torch nor stable-baselines3.
"""

from typing import Any

from irlcli.errors import imported

# Name to module and class, one line each. A class takes (worlds, config, total_steps, seed, purpose)
# and, for --start student, ``keep_moments``; it is a :class:`irlcli.rl.loop.Trainer`. All but SAC are
# configured by ``transfer.ppo``.
ALGORITHMS = {
    "ppo": "irlcli.rl.ppo:PPOTrainer",
    "sac": "irlcli.rl.sac:SACTrainer",
}


def algorithm(name: str) -> Any:
    """The trainer class called ``name``, one of :data:`ALGORITHMS`.

    Raises:
        StageFailed: its module cannot be imported.
    """
    return imported(f"algorithm {name!r}", ALGORITHMS[name])
