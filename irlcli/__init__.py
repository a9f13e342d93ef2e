"""Reproducible experiments on invariant inverse reinforcement learning."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from irlcli.lab.facade import Lab
    from irlcli.rewards import LearnedReward, load_reward
    from irlcli.rl.reward_wrappers import RewardVecEnvWrapper, RewardWrapper

__version__ = "0.2.0"
__all__ = ["Lab", "LearnedReward", "RewardVecEnvWrapper", "RewardWrapper", "load_reward"]

# Loaded when they are first used: every command imports this package.
_WHERE = {
    "Lab": "irlcli.lab.facade",
    "LearnedReward": "irlcli.rewards",
    "load_reward": "irlcli.rewards",
    "RewardWrapper": "irlcli.rl.reward_wrappers",
    "RewardVecEnvWrapper": "irlcli.rl.reward_wrappers",
}


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'irlcli' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
