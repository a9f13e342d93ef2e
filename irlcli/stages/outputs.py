"""Files that several stages write."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from irlcli import checkpoints
from irlcli.dataset import write_table
from irlcli.rl import Policy
from irlcli.settings import PPOSettings


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON with sorted keys."""
    path.write_text(json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n")


def shown(true_return: float, progress: float) -> str:
    """A true return as progress shows it, with the environment's progress if that is measured."""
    measured = "" if math.isnan(progress) else f" progress {progress:.0f}"
    return f"return {true_return:.0f}{measured}"


def write_metrics(directory: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the per-round metrics as ``metrics.parquet``, one row per round and setting."""
    write_table(pa.Table.from_pylist(list(rows)), directory / "metrics.parquet")


def write_policy(
    directory: Path, policy: Policy, ppo: PPOSettings, description: Mapping[str, Any]
) -> None:
    """Write ``policy.pt`` and, for readers without torch, its description ``policy.json``."""
    full = {**description, "network": Policy.describe(description["env"], ppo)}
    checkpoints.save(directory / "policy.pt", "policy", full, policy.state_dict())
    write_json(directory / "policy.json", full)
