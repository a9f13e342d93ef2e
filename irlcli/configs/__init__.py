"""Hyperparameters: their schema, which of them matter, and how they are loaded."""

from irlcli.configs.exact import (
    ControlConfig,
    CuedLabelsConfig,
    CuedMapsConfig,
    Figure2Config,
    GridworldConfig,
    MaxEntConfig,
)
from irlcli.configs.load import PROFILES, check_profile, file_without_profile, load_config
from irlcli.configs.schema import (
    AIRLConfig,
    ChallengerConfig,
    Config,
    EvaluationConfig,
    ExpertConfig,
    InterventionConfig,
    PPOConfig,
    SACConfig,
    TransferConfig,
)

__all__ = [
    "PROFILES",
    "AIRLConfig",
    "ChallengerConfig",
    "Config",
    "ControlConfig",
    "CuedLabelsConfig",
    "CuedMapsConfig",
    "EvaluationConfig",
    "ExpertConfig",
    "Figure2Config",
    "GridworldConfig",
    "InterventionConfig",
    "MaxEntConfig",
    "PPOConfig",
    "SACConfig",
    "TransferConfig",
    "check_profile",
    "file_without_profile",
    "load_config",
]
