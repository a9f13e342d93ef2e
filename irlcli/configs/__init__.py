"""Hyperparameters: their schema, which of them matter, and how they are loaded."""

from irlcli.configs.load import PROFILES, check_profile, load_config
from irlcli.configs.schema import (
    AIRLConfig,
    AssessmentConfig,
    ChallengerConfig,
    CloneConfig,
    Config,
    DemonstrationConfig,
    EvaluationConfig,
    ExpertConfig,
    Figure2Config,
    FromStudentConfig,
    GridworldConfig,
    InterventionConfig,
    MaxEntConfig,
    PPOConfig,
    SACConfig,
    TransferConfig,
)

__all__ = [
    "PROFILES",
    "AIRLConfig",
    "AssessmentConfig",
    "CloneConfig",
    "ChallengerConfig",
    "Config",
    "DemonstrationConfig",
    "EvaluationConfig",
    "ExpertConfig",
    "Figure2Config",
    "FromStudentConfig",
    "GridworldConfig",
    "InterventionConfig",
    "MaxEntConfig",
    "PPOConfig",
    "SACConfig",
    "TransferConfig",
    "check_profile",
    "load_config",
]
