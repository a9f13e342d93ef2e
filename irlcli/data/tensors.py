"""Tensor files: rewards, policies and the states in checkpoints.

``torch.save`` writes them from tensors, numbers and strings; ``torch.load(weights_only=True)``
reads them, so no code in a file is ever run (docs/threat-model.md). They are written through a
buffer, so equal contents are equal bytes. Rewards and policies carry a description: a file
copied out of the store can be used on its own.
"""

from __future__ import annotations

import io
import json
import pickle
import re
import stat
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import torch
from msgspec import Struct

from irlcli.data import descriptions
from irlcli.errors import IntegrityError, IrlError, NewerFormat, UsageError, first_line
from irlcli.interventions import parse_setting
from irlcli.learners.reward_model import RewardModule, build

if TYPE_CHECKING:
    from irlcli.rl.policy import Policy

SCHEMA = 1
# The networks here have tens of thousands of parameters.
_MAX_BYTES = 256 << 20
_KINDS: dict[str, Any] = {
    "reward": descriptions.Reward,
    "tabular-reward": descriptions.TabularReward,
    "policy": descriptions.Policy,
}
# What building a network from a description and tensors that do not fit it raises.
_MISFIT = (KeyError, RuntimeError, TypeError, ValueError, AttributeError)


class RefusedCode(ValueError):
    """Loading a tensor file would call a function that plain tensors do not need."""


def to_bytes(value: Any) -> bytes:
    """``value`` (tensors, numbers, strings in dicts and lists) as the bytes of a tensor file."""
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def json_tensor(value: Any) -> torch.Tensor:
    """The JSON of ``value`` in one uint8 tensor.

    So the number of tensors in a checkpoint does not grow with the rounds.
    """
    return torch.frombuffer(bytearray(json.dumps(value).encode()), dtype=torch.uint8)


def json_value(tensor: torch.Tensor) -> Any:
    """What :func:`json_tensor` holds."""
    return json.loads(tensor.numpy().tobytes())


def from_bytes(data: bytes) -> Any:
    """The value that :func:`to_bytes` wrote.

    Raises:
        RefusedCode: loading would call other functions than tensors need.
        ValueError: any other bytes.
    """
    try:
        if not data.startswith(b"PK\x03\x04"):
            # Torch would try its formats from before 2020.
            raise ValueError("torch.save did not write it")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            # torch.save does not compress. Torch would unpack a zip bomb.
            if sum(entry.file_size for entry in archive.infolist()) > len(data):
                raise ValueError("its entries are larger than the file")
            # Torch does not compare checksums.
            if (damaged := archive.testzip()) is not None:
                raise ValueError(f"its entry {damaged!r} does not match its checksum")
        with warnings.catch_warnings(action="ignore"):
            # Torch warns of some malformed files before it refuses them.
            return torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        function = re.search(r"GLOBAL (\S+)", str(error))
        if function:
            raise RefusedCode(f"it names {function[1][:80]!r}") from None
        raise ValueError("its pickle is malformed") from None
    except zipfile.BadZipFile:
        raise ValueError("it is damaged or cut short") from None
    except MemoryError:
        # The machine may be short of memory: that proves nothing about the file.
        raise
    except Exception as error:
        if _out_of_memory(error):
            raise MemoryError(first_line(error)[:200]) from None
        # A crafted archive makes zipfile and torch raise almost anything.
        raise ValueError(first_line(error).partition(". ")[0][:200]) from None


def restore(data: bytes | None, names: set[str], discard: Callable[[str], None]) -> Any:
    """The state in a stage's checkpoint, a dict with exactly the keys ``names``.

    Returns None if there is no checkpoint. If it cannot be used, calls ``discard`` with the reason
    and returns None.
    """
    if data is None:
        return None
    try:
        state = from_bytes(data)
        if not isinstance(state, dict) or set(state) != names:
            raise ValueError("another stage wrote it")
        return state
    except ValueError as error:
        discard(str(error))
        return None


@contextmanager
def fitting(directory: Path) -> Iterator[None]:
    """Restore the checkpoint in the scratch ``directory``; an error means that it does not fit.

    Raises:
        IntegrityError: instead of any other error. A crafted state can make torch raise anything.
        MemoryError, IrlError: as raised; they prove nothing about the checkpoint.
    """
    try:
        yield
    except (MemoryError, IrlError):
        raise
    except Exception as error:
        if _out_of_memory(error):
            raise MemoryError(first_line(error)[:200]) from error
        raise IntegrityError(
            f"the checkpoint in {directory} does not fit its stage ({type(error).__name__})",
            "remove that directory, then run the same command again to start over",
        ) from error


def _out_of_memory(error: Exception) -> bool:
    """Whether ``error`` is how torch reports that memory is short."""
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def save(path: Path, kind: str, description: Struct, state: dict[str, Any]) -> None:
    """Write a tensor file of ``kind`` (reward, tabular-reward or policy) with its description."""
    text = msgspec.json.encode(description, order="sorted").decode()
    path.write_bytes(
        to_bytes({"kind": kind, "schema": SCHEMA, "description": text, "state": state})
    )


def load(path: Path, kind: str) -> tuple[Any, dict[str, Any]]:
    """(description, state) of the tensor file ``path``, which must be of ``kind``.

    Raises:
        UsageError: a tensor file of another kind.
        IntegrityError: not a tensor file, damaged, of a newer schema, or one that would run code.
    """
    value = _read(path)
    hint = f"training stages write {kind} files"
    if not isinstance(value, dict) or not {"kind", "schema", "description", "state"} <= set(value):
        raise IntegrityError(f"{path} was not written by irlcli", hint)
    found = value["kind"]
    if not isinstance(found, str) or found not in _KINDS:
        raise IntegrityError(f"{path} is of an unknown kind", hint)
    if found != kind:
        raise UsageError(f"{path} is a {found}, not a {kind}", f"name a {kind} file")
    if type(value["schema"]) is not int:
        raise IntegrityError(f"{path} has no schema version", hint)
    if value["schema"] > SCHEMA:
        raise NewerFormat(str(path), value["schema"], SCHEMA)
    try:
        description = json.loads(value["description"])
    except (TypeError, ValueError, RecursionError):
        description = None
    if not isinstance(description, dict) or not isinstance(value["state"], dict):
        raise IntegrityError(f"{path} has no readable description")
    return descriptions.parse(description, _KINDS[kind], path), value["state"]


def _read(path: Path) -> Any:
    try:
        information = path.stat()
        if not stat.S_ISREG(information.st_mode):
            # Opening a named pipe would wait for a writer forever.
            raise IntegrityError(f"{path} is not a regular file")
        if information.st_size > _MAX_BYTES:
            raise IntegrityError(f"{path} is larger than {_MAX_BYTES >> 20} MiB")
        return from_bytes(path.read_bytes())
    except RefusedCode as error:
        raise IntegrityError(
            f"{path} was refused: loading it could run code ({error})",
            "files of irlcli hold tensors only; do not trust the source of this one",
        ) from None
    except ValueError as error:
        raise IntegrityError(
            f"{path} is not a file of a reward or a policy ({error})",
            "name a reward.pt or policy.pt, or the artefact of `irl train-airl` or `irl transfer`",
        ) from None
    except OSError as error:
        raise IntegrityError(f"{path} cannot be read ({error.strerror})") from None


def load_policy_file(path: Path) -> tuple[Policy, descriptions.Policy]:
    """A policy and its description.

    Raises:
        UsageError, IntegrityError: as :func:`load`; also tensors that do not fit the description
            or are not finite.
    """
    # Stable-baselines3 takes half a second to import, and gridworlds do not need it.
    from irlcli.rl.policy import load_policy

    description, state = load(path, "policy")
    try:
        setting = parse_setting(description.env, description.settings[0])
        policy = load_policy(description.env, setting, description.network, state)
    except _MISFIT as error:
        raise _misfit(path, error) from None
    _check_finite(path, policy.state_dict())
    return policy, description


def load_reward_file(path: Path) -> tuple[RewardModule, descriptions.Reward]:
    """A reward model or the mean of several, frozen, and its description.

    Raises:
        UsageError, IntegrityError: as :func:`load`; also tensors that do not fit the description
            or are not finite.
    """
    description, state = load(path, "reward")
    try:
        model = build(**msgspec.structs.asdict(description.network))
        model.load_state_dict(state)
    except _MISFIT as error:
        raise _misfit(path, error) from None
    _check_finite(path, model.state_dict())
    return model.requires_grad_(False).eval(), description


def _check_finite(path: Path, state: dict[str, torch.Tensor]) -> None:
    for name, tensor in state.items():
        if not bool(torch.isfinite(tensor).all()):
            raise IntegrityError(f"{path}: {name} holds numbers that are not finite")


def _misfit(path: Path, error: Exception) -> IntegrityError:
    return IntegrityError(
        f"{path}: its tensors do not fit its description ({first_line(error)[:200]})"
    )
