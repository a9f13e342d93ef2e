"""Tensor files: rewards, policies and stage checkpoints.

Each is what ``torch.save`` writes for plain tensors, numbers and strings, and is read with
``weights_only=True``: no code in a file is ever run. Equal contents give equal bytes, because
they are written through a buffer. Rewards and policies describe themselves: a file copied out
of the store is enough to use it.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch

from irlcli.errors import IntegrityError, NewerFormat, UsageError
from irlcli.interventions import parse_setting
from irlcli.irl.networks import RewardModel
from irlcli.rl import Policy, load_policy

SCHEMA = 1
# The networks here have tens of thousands of parameters; a larger file is not one of ours.
_MAX_BYTES = 256 << 20


def to_bytes(value: Any) -> bytes:
    """``value`` (tensors, numbers, strings in dicts and lists) as the bytes of a tensor file."""
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def from_bytes(data: bytes) -> Any:
    """The value that :func:`to_bytes` wrote."""
    return torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")


def save(path: Path, kind: str, description: dict[str, Any], state: dict[str, Any]) -> None:
    """Write a tensor file of ``kind`` (``reward`` or ``policy``) that describes itself."""
    text = json.dumps(description, sort_keys=True, allow_nan=False)
    path.write_bytes(
        to_bytes({"kind": kind, "schema": SCHEMA, "description": text, "state": state})
    )


def load(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """(description, state) of the tensor file ``path``, which must be of ``kind``.

    Raises:
        UsageError: it is a tensor file of another kind.
        IntegrityError: not a tensor file, damaged, of a newer schema, or one that would run code.
    """
    value = _read(path)
    if not isinstance(value, dict) or not {"kind", "schema", "description", "state"} <= set(value):
        raise IntegrityError(
            f"{path} is no file of irlcli", f"a {kind} comes from a training stage"
        )
    if value["kind"] != kind:
        raise UsageError(f"{path} is a {value['kind']}, not a {kind}", f"name a {kind} file")
    if type(value["schema"]) is not int:
        raise IntegrityError(f"{path} has no schema", f"a {kind} comes from a training stage")
    if value["schema"] > SCHEMA:
        raise NewerFormat(str(path), value["schema"], SCHEMA)
    try:
        description = json.loads(value["description"])
    except (TypeError, ValueError):
        raise IntegrityError(f"{path} has no readable description") from None
    if not isinstance(description, dict) or not isinstance(value["state"], dict):
        raise IntegrityError(f"{path} is malformed")
    return description, value["state"]


def _read(path: Path) -> Any:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise IntegrityError(f"{path} is larger than {_MAX_BYTES >> 20} MiB")
        with zipfile.ZipFile(path) as archive:
            # Stored entries only, as torch.save writes them: nothing can unpack to more.
            if sum(entry.file_size for entry in archive.infolist()) > _MAX_BYTES:
                raise IntegrityError(f"{path} declares more than {_MAX_BYTES >> 20} MiB")
        return torch.load(path, weights_only=True, map_location="cpu")
    except pickle.UnpicklingError:
        raise IntegrityError(
            f"{path} holds more than tensors and was refused: loading it could run code",
            "a file of irlcli holds tensors only; do not trust where this one came from",
        ) from None
    except (zipfile.BadZipFile, RuntimeError, EOFError, ValueError, KeyError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise IntegrityError(f"{path} is not a tensor file ({reason})") from None
    except OSError as error:
        raise IntegrityError(f"{path} cannot be read ({error.strerror})") from None


def load_policy_file(path: Path) -> tuple[Policy, dict[str, Any]]:
    """A policy and its description.

    Raises:
        UsageError, IntegrityError: as :func:`load`; also tensors that do not fit the description.
    """
    description, state = load(path, "policy")
    try:
        setting = parse_setting(description["env"], description["settings"][0])
        return load_policy(description["network"], state, setting), description
    except (LookupError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise _misfit(path, error) from None


def load_reward_file(path: Path) -> tuple[RewardModel, dict[str, Any]]:
    """A reward model, frozen, and its description.

    Raises:
        UsageError, IntegrityError: as :func:`load`; also tensors that do not fit the description.
    """
    description, state = load(path, "reward")
    try:
        model = RewardModel(**description["network"])
        model.load_state_dict(state)
    except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise _misfit(path, error) from None
    return model.requires_grad_(False).eval(), description


def _misfit(path: Path, error: Exception) -> IntegrityError:
    reason = (str(error) or type(error).__name__).splitlines()[0]
    return IntegrityError(f"{path}: its tensors do not fit its description ({reason})")
