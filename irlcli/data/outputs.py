"""Output files that several stages write."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pyarrow as pa

from irlcli.configs import PPOConfig, SACConfig
from irlcli.data import descriptions, tensors
from irlcli.data.parquet import write_table

if TYPE_CHECKING:
    from irlcli.rl.policy import Policy


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as JSON with sorted keys.

    Raises:
        ValueError: a number is not finite.
    """
    path.write_text(json.dumps(value, sort_keys=True, indent=1, allow_nan=False) + "\n")


def write_csv(path: Path, frame: Any) -> None:
    """Write a pandas ``frame`` as CSV with six significant digits."""
    frame.to_csv(path, index=False, float_format="%.6g", lineterminator="\n")


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write ``rows``, which have the same columns, as Parquet."""
    write_table(pa.Table.from_pylist(list(rows)), path)


def write_policy(
    directory: Path, policy: Policy, config: PPOConfig | SACConfig, **origin: Any
) -> None:
    """Write ``policy.pt`` and its description ``policy.json``, which is readable without torch.

    ``origin`` holds the fields of :class:`descriptions.Policy` other than ``network``.
    """
    from irlcli.rl.policy import describe

    description = descriptions.Policy(network=describe(config), **origin)
    tensors.save(directory / "policy.pt", "policy", description, policy.state_dict())
    write_json(directory / "policy.json", msgspec.to_builtins(description))


def write_reward(directory: Path, learner: Any, **origin: Any) -> None:
    """Write ``reward.pt`` and its description ``reward.json``, which is readable without torch.

    ``learner`` has ``network``, ``scale``, ``quantiles`` and ``deployed``; ``origin`` holds the other
    fields of :class:`descriptions.Reward`.
    """
    description = descriptions.Reward(
        network=learner.network, scale=learner.scale, quantiles=learner.quantiles, **origin
    )
    tensors.save(directory / "reward.pt", "reward", description, learner.deployed.state_dict())
    write_json(directory / "reward.json", msgspec.to_builtins(description))
