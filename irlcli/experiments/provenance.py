"""Where a result came from: attempts, code, libraries.

The header of a checkpoint carries the attempts from one process to the next.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

import irlcli

SCHEMA = 1
_LIBRARIES = (
    "torch",
    "numpy",
    "scipy",
    "stable-baselines3",
    "gymnasium",
    "Box2D",
    "pybullet",
    "mujoco",
    "pyarrow",
    "msgspec",
    "matplotlib",
)

# Not everyone has them. What was made without one of them does not depend on it.
_OPTIONAL = ("mujoco",)

# Options with a reference; that of `--expert` stands behind its setting. `irl assess` takes it bare.
_REFERRING = ("--demos", "--reward", "--policy", "--expert")

_OF_A_REPOSITORY = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")


class _Schema(msgspec.Struct):
    schema: int


class Attempt(msgspec.Struct, frozen=True, kw_only=True):
    """One process's part in a result: when it started [UTC], how long it ran [s], and its code.

    ``dirty`` is a digest of uncommitted changes; None if there are none, or without git.
    """

    started: str
    seconds: float
    commit: str | None
    dirty: str | None


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """What a checkpoint records about itself."""

    schema: int
    libraries: dict[str, str | None]
    attempts: tuple[Attempt, ...]

    def encode(self, state: bytes) -> bytes:
        """The header and a stage's ``state`` as the bytes of a checkpoint."""
        head = msgspec.json.encode(self)
        return len(head).to_bytes(4, "big") + head + state


def decode(data: bytes) -> tuple[Header, bytes]:
    """The header and the state of a checkpoint that this program can resume.

    Raises:
        ValueError: another schema or other libraries; or not a checkpoint.
    """
    end = 4 + int.from_bytes(data[:4], "big")
    try:
        schema = msgspec.json.decode(data[4:end], type=_Schema).schema
        if schema != SCHEMA:
            raise ValueError(f"it has schema {schema}, the one known here is {SCHEMA}")
        header = msgspec.json.decode(data[4:end], type=Header)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise ValueError("its header is not readable") from None
    # Only reports use matplotlib, and they have no checkpoints.
    others = differing({**header.libraries, "matplotlib": libraries()["matplotlib"]})
    if others:
        shown = ", ".join(text[:80] for text in others[:3])
        raise ValueError(f"it was written with {shown}")
    return header, data[end:]


def differing(recorded: Mapping[str, str | None]) -> list[str]:
    """The libraries whose version differs from the one present, as ``torch 2.6.0 (now 2.13.0)``."""
    present = libraries()
    missing = {
        name for name in _OPTIONAL if recorded.get(name) is None or present.get(name) is None
    }
    return [
        f"{name} {recorded.get(name)} (now {present.get(name)})"
        for name in sorted({*present, *recorded} - missing)
        if recorded.get(name) != present.get(name)
    ]


def other_versions(origin: Mapping[str, Any]) -> list[str]:
    """:func:`differing`, for the provenance record of a result.

    The version of irlcli is left out: a change of its code that alters results raises the stage's
    version, and with it the key.
    """
    recorded = origin.get("libraries") or {}
    return differing({**recorded, "irlcli": libraries()["irlcli"]})


class Clock:
    """The attempt of this process, from its construction on."""

    def __init__(self):
        self._started = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        # The time of day may be set back.
        self._begin = time.monotonic()
        self._git = git_state(Path(irlcli.__file__).parent)

    def attempt(self) -> Attempt:
        """The attempt as it stands."""
        seconds = round(time.monotonic() - self._begin, 3)
        return Attempt(started=self._started, seconds=seconds, **self._git)


@functools.cache
def libraries() -> dict[str, str | None]:
    """Versions of what results are computed with; None for a library that is not installed."""
    # Imported here and below: a hit does not need them, and importing takes longer than a hit.
    import platform

    found = {name: _version(name) for name in _LIBRARIES}
    return {"irlcli": irlcli.__version__, **found, "python": platform.python_version()}


def record(command: list[str], workers: int, attempts: tuple[Attempt, ...]) -> dict[str, Any]:
    """The provenance of a result of ``attempts``, the last of which is the present one."""
    import platform

    last = attempts[-1]
    return {
        "command": command,
        "git": {"commit": last.commit, "dirty": last.dirty},
        "libraries": libraries(),
        "platform": f"{platform.system()} {platform.machine()}",
        "device": "cpu",
        "workers": workers,
        "started": attempts[0].started,
        "seconds": round(sum(a.seconds for a in attempts), 3),
        "attempts": msgspec.to_builtins(attempts),
        "resumed": len(attempts) - 1,
    }


def by_id(command: Sequence[str], resolved: Mapping[str, str]) -> list[str]:
    """``command`` with ids in place of the references that it reads, because names move.

    Args:
        resolved: what each reference named.
    """
    words = []
    for before, word in pairwise(["", *command]):
        option = word.partition("=")[0] if word.startswith("--") else before
        rest, equals, ref = word.rpartition("=")
        bare = "assess" in command[:2] and before != "--name" and word == ref
        known = (option in _REFERRING or bare) and ref in resolved
        words.append(f"{rest}{equals}{resolved[ref]}" if known else word)
    return words


def _version(library: str) -> str | None:
    import importlib.metadata

    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def git_state(package: Path) -> dict[str, str | None]:
    """Commit of the checkout that holds ``package``, and a digest of uncommitted changes.

    The digest covers changes and new files inside the package, but no ignored files.
    """
    import shutil
    import subprocess

    unknown: dict[str, str | None] = {"commit": None, "dirty": None}
    if shutil.which("git") is None:
        return unknown

    # A git hook runs with the variables of its own repository.
    elsewhere = {name: of for name, of in os.environ.items() if name not in _OF_A_REPOSITORY}

    def git(*arguments: str) -> bytes | None:
        done = subprocess.run(
            ["git", "-C", str(package), *arguments],
            capture_output=True,
            env={**elsewhere, "GIT_OPTIONAL_LOCKS": "0"},
        )
        return done.stdout if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    if commit is None or git("ls-files", "--error-unmatch", "__init__.py") is None:
        return unknown
    changes = git("diff", "HEAD", "--", ".")
    new = git("ls-files", "--others", "--exclude-standard", "-z", "--", ".")
    if changes is None or new is None:
        return unknown
    for name in sorted(filter(None, new.split(b"\0"))):
        content = hashlib.sha256(_content(package / os.fsdecode(name))).hexdigest()
        changes += b"new file " + name + b" " + content.encode() + b"\n"
    dirty = hashlib.sha256(changes).hexdigest()[:16] if changes else None
    return {"commit": commit.decode().strip(), "dirty": dirty}


def _content(path: Path) -> bytes:
    """The bytes of a file, the target of a link that leads to none; empty for what cannot be read."""
    # An editor's lock is a link to nothing, and a file may vanish after git listed it.
    for read in (path.read_bytes, lambda: os.fsencode(os.readlink(path))):
        with contextlib.suppress(OSError):
            return read()
    return b""
