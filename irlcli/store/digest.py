"""Canonical JSON and sha256 digests, from which keys and ids are computed."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

_DIGITS = frozenset("0123456789abcdef")


def canonical_json(value: Any) -> bytes:
    """The canonical encoding of ``value``: sorted keys, no spaces, ASCII.

    Raises:
        ValueError: NaN or infinity anywhere (NaN equals nothing, so a key with it never matches).
        TypeError: anything but dict with string keys, list, tuple, str, int, float, bool, None.
    """
    _check(value, "$")
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False
    ).encode("ascii")


def _check(value: Any, where: str) -> None:
    kind = type(value)
    if value is None or kind in (bool, int, str):
        return
    if kind is float:
        if not math.isfinite(value):
            raise ValueError(f"{where} is {value}, which cannot be part of a key")
    elif kind in (list, tuple):
        for i, item in enumerate(value):
            _check(item, f"{where}[{i}]")
    elif kind is dict:
        for key, item in value.items():
            if type(key) is not str:
                raise TypeError(f"{where} has the key {key!r}, which is not a string")
            _check(item, f"{where}.{key}")
    else:
        raise TypeError(f"{where} is a {type(value).__name__}, which has no canonical encoding")


def digest(value: Any) -> str:
    """sha256 of ``canonical_json(value)``, 64 hexadecimal digits."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def is_hexadecimal(text: str) -> bool:
    """Whether ``text`` has only the digits of digests. Cheaper than compiling an expression."""
    return _DIGITS.issuperset(text)


def is_sha256(value: Any) -> bool:
    """Whether ``value`` is a digest: 64 hexadecimal digits."""
    return isinstance(value, str) and len(value) == 64 and is_hexadecimal(value)


def file_digest(path: Path | str) -> str:
    """sha256 of a file's bytes.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
