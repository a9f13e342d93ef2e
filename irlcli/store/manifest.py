"""The two JSON files of an artefact.

``manifest.json`` contains the key record and the outputs; the artefact's id is their digest.
``provenance.json`` contains what may differ between equal runs (command line, versions, timings);
it carries its own checksum and the artefact's id.
"""

import errno
import json
import os
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from irlcli.errors import IntegrityError, NewerFormat
from irlcli.store.digest import digest, file_digest, is_sha256
from irlcli.store.durable import open_plainly

SCHEMA = 1
MANIFEST = "manifest.json"
PROVENANCE = "provenance.json"
# Far larger than real files; anything larger is an accident or an attack.
MAX_JSON_BYTES = 16 << 20
# A canonical manifest indents each level by a space. Real parameters have fewer than ten levels;
# far more would exhaust the stack of whoever hashes them.
_TOO_DEEP = b"\n" + b" " * 100
# Every file system allows this, so checking a path never fails because of its length.
_MAX_PATH_BYTES = 200
# Of opening a path that is absent, below a file, a link, a socket, or a directory.
_NO_FILE = (errno.ENOENT, errno.ENOTDIR, errno.ELOOP, errno.ENXIO, errno.EISDIR)


class KeyRecord(NamedTuple):
    """Everything that determines a result. ``inputs`` maps roles to the sha256 of the content."""

    stage: str
    stage_version: int
    parameters: dict[str, Any]
    inputs: dict[str, str]

    @property
    def key(self) -> str:
        """sha256 of the record, 64 hexadecimal digits."""
        return digest(self.as_json())

    def as_json(self) -> dict[str, Any]:
        return {
            "schema": SCHEMA,
            "stage": self.stage,
            "stage_version": self.stage_version,
            "parameters": self.parameters,
            "inputs": self.inputs,
        }


class Output(NamedTuple):
    """One file of an artefact: path inside it (POSIX), size in bytes, sha256."""

    path: str
    size: int
    sha256: str


class Manifest(NamedTuple):
    """A key record and the outputs of its run."""

    record: KeyRecord
    outputs: tuple[Output, ...]

    @property
    def content(self) -> str:
        """sha256 of the outputs alone: the input of stages that read the whole artefact."""
        return content_digest(self.outputs)

    @property
    def size(self) -> int:
        """Bytes of all outputs."""
        return sum(output.size for output in self.outputs)

    @property
    def id(self) -> str:
        """sha256 of key record and outputs."""
        return digest({"record": self.record.as_json(), "outputs": _as_json(self.outputs)})

    def encode(self) -> bytes:
        """The bytes of ``manifest.json``."""
        value = {**self.record.as_json(), "outputs": _as_json(self.outputs)}
        return json.dumps(value, sort_keys=True, indent=1, allow_nan=False).encode() + b"\n"


def _as_json(outputs: Iterable[Output]) -> list[dict[str, Any]]:
    return [
        {"path": o.path, "size": o.size, "sha256": o.sha256}
        for o in sorted(outputs, key=lambda o: o.path)
    ]


def content_digest(outputs: Iterable[Output]) -> str:
    """sha256 of a set of files, independent of their directory."""
    return digest(_as_json(outputs))


def directory_outputs(directory: Path) -> tuple[Output, ...]:
    """The files below ``directory`` as outputs, without manifest and provenance.

    Raises:
        OSError: a file cannot be read.
        ValueError: there is something other than plain files.
    """
    found = []
    for path in sorted(p for p in directory.rglob("*") if p.is_symlink() or not p.is_dir()):
        if not stat.S_ISREG(path.lstat().st_mode):
            raise ValueError(f"{path} is not a plain file")
        name = path.relative_to(directory).as_posix()
        if name not in (MANIFEST, PROVENANCE):
            output = Output(check_output_path(name), path.stat().st_size, file_digest(path))
            found.append(output)
    return tuple(found)


def read_json(path: Path) -> Any:
    """A JSON document of at most 16 MiB from a regular file.

    Raises:
        IntegrityError: missing, not a regular file, too large, not JSON, or nested too deeply.
    """
    return _parse_json(path, _read(path))


def _read(path: Path) -> bytes:
    """The bytes of a regular file of at most 16 MiB.

    Raises:
        IntegrityError: missing, not a regular file, too large, or unreadable.
    """
    try:
        with open(path, "rb", buffering=0, opener=open_plainly) as file:
            information = os.fstat(file.fileno())
            if not stat.S_ISREG(information.st_mode):
                raise IntegrityError(f"{path} is missing or not a regular file")
            if information.st_size > MAX_JSON_BYTES:
                raise IntegrityError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB")
            return file.read()
    except OSError as error:
        if error.errno in _NO_FILE:
            raise IntegrityError(f"{path} is missing or not a regular file") from None
        raise IntegrityError(f"{path} cannot be read ({error.strerror})") from None


def _parse_json(path: Path, data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise IntegrityError(f"{path} is not valid JSON ({error})") from None


def read_manifest(directory: Path) -> Manifest:
    """The manifest of the artefact in ``directory``, every field checked.

    Raises:
        IntegrityError: unreadable, malformed, or altered in any byte.
        NewerFormat: the schema is newer than this version supports.
    """
    path = directory / MANIFEST
    data = _read(path)
    if _TOO_DEEP in data:
        raise IntegrityError(f"{path} is nested too deeply")
    value = _parse_json(path, data)
    schema = value.get("schema") if isinstance(value, dict) else None
    if type(schema) is int and schema > SCHEMA:
        raise NewerFormat(str(path), schema, SCHEMA)
    try:
        manifest = _parse_manifest(value)
        # Encoding refuses NaN, which JSON's parser takes.
        canonical = manifest.encode() == data
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise IntegrityError(f"{path} is malformed ({error})") from None
    if not canonical:
        raise IntegrityError(f"{path} was altered: it is not in canonical form")
    return manifest


def _parse_manifest(value: Any) -> Manifest:
    expected = {"schema", "stage", "stage_version", "parameters", "inputs", "outputs"}
    if not isinstance(value, dict) or set(value) != expected:
        raise ValueError(f"its keys are not {', '.join(sorted(expected))}")
    if type(value["schema"]) is not int or value["schema"] != SCHEMA:
        raise ValueError(f"schema {value['schema']!r} is unknown")
    if not isinstance(value["stage"], str) or type(value["stage_version"]) is not int:
        raise ValueError("stage or stage_version has the wrong type")
    if not value["stage"].isprintable():
        raise ValueError("stage contains unprintable characters")
    if not isinstance(value["parameters"], dict) or not isinstance(value["inputs"], dict):
        raise ValueError("parameters or inputs is not an object")
    for role, sha in value["inputs"].items():
        if not is_sha256(sha):
            raise ValueError(f"input {role!r} is not a sha256")
    outputs = []
    if not isinstance(value["outputs"], list):
        raise ValueError("outputs is not a list")
    for item in value["outputs"]:
        if set(item) != {"path", "size", "sha256"}:
            raise ValueError("the keys of an output are not path, size, sha256")
        if type(item["size"]) is not int or item["size"] < 0:
            raise ValueError(f"output {item['path']!r} has no size")
        if not is_sha256(item["sha256"]):
            raise ValueError(f"output {item['path']!r} has no sha256")
        outputs.append(Output(check_output_path(item["path"]), item["size"], item["sha256"]))
    if len({o.path for o in outputs}) != len(outputs):
        raise ValueError("an output path appears twice")
    record = KeyRecord(value["stage"], value["stage_version"], value["parameters"], value["inputs"])
    return Manifest(record, tuple(outputs))


def check_output_path(path: Any) -> str:
    """``path``, if it stays inside an artefact and is not its manifest or provenance.

    Raises:
        ValueError: empty, absolute, too long, with ``..``, a backslash or unprintable
            characters, or reserved.
    """
    if not isinstance(path, str) or not path or "\\" in path or "\0" in path:
        raise ValueError(f"output path {path!r} is not allowed")
    if len(path.encode("utf-8", "replace")) > _MAX_PATH_BYTES or not path.isprintable():
        raise ValueError(
            f"output path {path[:40]!r} is too long or contains unprintable characters"
        )
    if not {"", ".", ".."}.isdisjoint(path.split("/")):
        raise ValueError(f"output path {path!r} is not allowed")
    if path in (MANIFEST, PROVENANCE):
        raise ValueError(f"output path {path!r} is reserved")
    return path


def encode_provenance(artefact_id: str, record: dict[str, Any]) -> bytes:
    """The bytes of ``provenance.json``: a record, the artefact's id, and a checksum of both."""
    body = {"schema": SCHEMA, "artefact": artefact_id, "record": record}
    value = {**body, "sha256": digest(body)}
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False).encode() + b"\n"


def read_provenance(directory: Path, artefact_id: str) -> dict[str, Any]:
    """The provenance record of the artefact ``artefact_id`` in ``directory``.

    Raises:
        IntegrityError: unreadable, altered, of another form, or written for another artefact.
    """
    path = directory / PROVENANCE
    data = _read(path)
    value = _parse_json(path, data)
    if not isinstance(value, dict) or not isinstance(value.get("record"), dict):
        raise IntegrityError(f"{path} is malformed")
    try:
        sound = data == encode_provenance(value["artefact"], value["record"])
    except (KeyError, TypeError, ValueError, RecursionError):
        sound = False
    if not sound:
        raise IntegrityError(f"{path} was altered: its checksum does not match")
    if value["artefact"] != artefact_id:
        raise IntegrityError(f"{path} belongs to another artefact")
    if wrong := _malformed(value["record"]):
        raise IntegrityError(f"{path} is malformed: {wrong} has another form")
    return value["record"]


# Of a provenance record, what many commands read; a described environment is checked where it is used. Each
# field may be absent, or null.
_FORMS: dict[str, type | tuple[type, ...]] = {
    "command": list,
    "git": dict,
    "attempts": list,
    "libraries": dict,
    "inputs": dict,
    "seconds": (int, float),
    "resumed": int,
}


def _malformed(record: Mapping[str, Any]) -> str | None:
    """The first field of ``record`` that is not as a runner writes it."""
    for name, kind in _FORMS.items():
        if not _is_of(record.get(name), kind):
            return name
    if not all(isinstance(word, str) for word in record.get("command") or ()):
        return "command"
    if not all(isinstance(place, str) for place in (record.get("inputs") or {}).values()):
        return "inputs"
    if not _is_code(record.get("git") or {}):
        return "git"
    return None if all(map(_is_code, record.get("attempts") or ())) else "attempts"


def _is_code(state: Any) -> bool:
    return isinstance(state, dict) and all(_is_of(state.get(n), str) for n in ("commit", "dirty"))


def _is_of(value: Any, kind: type | tuple[type, ...]) -> bool:
    return value is None or isinstance(value, kind)
