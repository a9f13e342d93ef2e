"""Files that several stages write."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa

from irlcli import checkpoints, descriptions
from irlcli.dataset import write_table
from irlcli.rl import Policy
from irlcli.settings import PPOSettings
from irlcli.stages import Job
from irlcli.trajectories import Trajectory


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON with sorted keys."""
    path.write_text(json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n")


def warn_of_errors(job: Job, setting: str, trajectories: Sequence[Trajectory]) -> None:
    """Name the episodes that could not go on."""
    for k, trajectory in enumerate(trajectories):
        if trajectory.error is not None:
            job.console.warn(f"{setting}, episode {k}: {trajectory.error}; it ended there")


def shown(true_return: float, progress: float | None) -> str:
    """A true return for the person who waits, with the environment's progress if it has one."""
    measured = "" if progress is None or math.isnan(progress) else f" progress {progress:.0f}"
    return f"return {true_return:.0f}{measured}"


def write_metrics(directory: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the per-round metrics as ``metrics.parquet``, one row per round and setting."""
    write_table(pa.Table.from_pylist(list(rows)), directory / "metrics.parquet")


def write_policy(
    directory: Path, policy: Policy, ppo: PPOSettings, env: str, **origin: Any
) -> None:
    """Write ``policy.pt`` and, for readers without torch, its description ``policy.json``.

    ``origin`` are the fields of ``descriptions.Policy`` besides the environment and the network.
    """
    network = Policy.describe(env, ppo)
    description = descriptions.Policy(env=env, network=network, **origin)
    checkpoints.save(directory / "policy.pt", "policy", description, policy.state_dict())
    write_json(directory / "policy.json", msgspec.to_builtins(description))
