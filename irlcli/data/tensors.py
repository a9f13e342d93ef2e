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
import pickletools
import stat
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import torch
from msgspec import Struct

from irlcli.data import descriptions
from irlcli.errors import IntegrityError, NewerFormat, UsageError
from irlcli.interventions import parse_setting
from irlcli.learners.reward_model import RewardModel
from irlcli.rl.policy import Policy, load_policy

SCHEMA = 1
# The networks here have tens of thousands of parameters; a larger file is not one of ours.
_MAX_BYTES = 256 << 20
_MAX_PICKLE_BYTES = 4 << 20
# The only globals that plain tensors, numbers, strings, dicts and lists need.
_STORAGES = (
    *("FloatStorage", "DoubleStorage", "LongStorage", "IntStorage", "BoolStorage"),
    "ByteStorage",
)
_GLOBALS = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    *(f"torch {name}" for name in _STORAGES),
}
_FORMS = {
    "reward": descriptions.Reward,
    "tabular-reward": descriptions.TabularReward,
    "policy": descriptions.Policy,
}


# What a crafted archive makes zipfile, pickletools and torch raise. Not MemoryError: a machine
# that is short of memory says nothing about a file.
_MALFORMED = (
    *(ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError),
    *(AssertionError, EOFError, zipfile.BadZipFile, struct.error),
)


class RefusedCode(ValueError):
    """A tensor file names something that loading it would call."""


def to_bytes(value: Any) -> bytes:
    """``value`` (tensors, numbers, strings in dicts and lists) as the bytes of a tensor file."""
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def byte_tensor(data: bytes) -> torch.Tensor:
    """``data`` as a tensor [len(data)] uint8."""
    return torch.frombuffer(bytearray(data), dtype=torch.uint8)


def from_bytes(data: bytes) -> Any:
    """The value that :func:`to_bytes` wrote.

    Raises:
        ValueError: any other bytes (:class:`RefusedCode` for those that would run code).
    """
    try:
        if data[:4] != b"PK\x03\x04":
            # Torch would read anything else as a bare pickle.
            raise ValueError("it is no zip archive")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            # As torch.save writes them: so nothing unpacks to more than was read.
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("its entries are compressed")
            if sum(entry.file_size for entry in archive.infolist()) > len(data):
                raise ValueError("it declares more than it holds")
            (name,) = (n for n in archive.namelist() if n.split("/", 1)[-1] == "data.pkl")
            if archive.getinfo(name).file_size > _MAX_PICKLE_BYTES:
                raise ValueError(f"its index is larger than {_MAX_PICKLE_BYTES >> 20} MiB")
            _check_globals(archive.read(name))
        return torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
    except RefusedCode:
        raise
    except pickle.UnpicklingError as error:
        raise RefusedCode(str(error).splitlines()[0]) from None
    except _MALFORMED as error:
        raise ValueError((str(error) or type(error).__name__).splitlines()[0][:200]) from None


def restore(data: bytes | None, names: set[str], warn: Callable[[str], None]) -> Any:
    """The state in a stage's checkpoint, a dict of ``names``.

    None for no checkpoint, and with a warning for one that cannot be used.
    """
    if data is None:
        return None
    try:
        state = from_bytes(data)
        if not isinstance(state, dict) or set(state) != names:
            raise ValueError("it is of another stage")
        return state
    except ValueError as error:
        warn(f"the checkpoint cannot be used ({error}): starting over")
        return None


@contextmanager
def fitting(directory: Path, *errors: type[Exception]) -> Iterator[None]:
    """Name the scratch ``directory`` whose checkpoint holds a state that raises ``errors``.

    Raises:
        IntegrityError: a state that somebody made, or another version of the program.
    """
    try:
        yield
    except errors as error:
        raise IntegrityError(
            f"the checkpoint in {directory} does not fit its stage ({type(error).__name__})",
            "remove that directory, then run the same command again to start over",
        ) from None


def _check_globals(data: bytes) -> None:
    """Refuse a pickle with other globals than ours: ``weights_only`` allows some that allocate."""
    for opcode, argument, _ in pickletools.genops(data):
        named = opcode.name in ("GLOBAL", "INST")
        if (named and argument not in _GLOBALS) or opcode.name == "STACK_GLOBAL":
            raise RefusedCode(f"it names {str(argument)[:80]!r}")


def save(path: Path, kind: str, description: Struct, state: dict[str, Any]) -> None:
    """Write a tensor file of ``kind`` (a key of ``_FORMS``) that describes itself."""
    text = msgspec.json.encode(description, order="sorted").decode()
    path.write_bytes(
        to_bytes({"kind": kind, "schema": SCHEMA, "description": text, "state": state})
    )


def load(path: Path, kind: str) -> tuple[Any, dict[str, Any]]:
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
        if isinstance(value["kind"], str) and value["kind"] in _FORMS:
            raise UsageError(f"{path} is a {value['kind']}, not a {kind}", f"name a {kind} file")
        raise IntegrityError(f"{path} is of no known kind", f"a {kind} comes from a training stage")
    if type(value["schema"]) is not int:
        raise IntegrityError(f"{path} has no schema", f"a {kind} comes from a training stage")
    if value["schema"] > SCHEMA:
        raise NewerFormat(str(path), value["schema"], SCHEMA)
    try:
        text = value["description"]
        description = json.loads(text) if isinstance(text, str) else None
    except (ValueError, RecursionError):
        description = None
    if not isinstance(description, dict) or not isinstance(value["state"], dict):
        raise IntegrityError(f"{path} has no readable description")
    return descriptions.parse(description, _FORMS[kind], path), value["state"]


def _read(path: Path) -> Any:
    try:
        information = path.stat()
        if not stat.S_ISREG(information.st_mode):
            # Opening a named pipe would wait for a writer that never comes.
            raise IntegrityError(f"{path} is not a plain file")
        if information.st_size > _MAX_BYTES:
            raise IntegrityError(f"{path} is larger than {_MAX_BYTES >> 20} MiB")
        return from_bytes(path.read_bytes())
    except RefusedCode as error:
        raise IntegrityError(
            f"{path} holds more than tensors and was refused: loading it could run code ({error})",
            "a file of irlcli holds tensors only; do not trust where this one came from",
        ) from None
    except ValueError as error:
        raise IntegrityError(f"{path} is not a tensor file ({error})") from None
    except OSError as error:
        raise IntegrityError(f"{path} cannot be read ({error.strerror})") from None


def load_policy_file(path: Path) -> tuple[Policy, descriptions.Policy]:
    """A policy and its description.

    Raises:
        UsageError, IntegrityError: as :func:`load`; also tensors that do not fit the description.
    """
    description, state = load(path, "policy")
    try:
        setting = parse_setting(description.env, description.settings[0])
        policy = load_policy(description.env, setting, description.network, state)
        return policy, description
    except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise _misfit(path, error) from None


def load_reward_file(path: Path) -> tuple[RewardModel, descriptions.Reward]:
    """A reward model, frozen, and its description.

    Raises:
        UsageError, IntegrityError: as :func:`load`; also tensors that do not fit the description.
    """
    description, state = load(path, "reward")
    try:
        model = RewardModel(**msgspec.structs.asdict(description.network))
        model.load_state_dict(state)
    except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
        raise _misfit(path, error) from None
    if not all(bool(torch.isfinite(tensor).all()) for tensor in model.state_dict().values()):
        raise IntegrityError(f"{path} holds numbers that are not finite")
    return model.requires_grad_(False).eval(), description


def _misfit(path: Path, error: Exception) -> IntegrityError:
    reason = (str(error) or type(error).__name__).splitlines()[0]
    return IntegrityError(f"{path}: its tensors do not fit its description ({reason})")
