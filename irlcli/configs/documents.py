"""TOML documents, read and converted with errors that name the file or the field."""

import re
import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec

from irlcli.errors import NotFound, UsageError, suggest

# A deep dotted key takes tomllib the square of its length: 12 s for 32 KB.
_MAX_TOML_BYTES = 64 << 10
_MAX_TOML_LINE = 2000
Form = TypeVar("Form", bound=msgspec.Struct)
_KINDS = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "null": "none",
    "array": "a list",
    "object": "a table",
}
_BOUNDS = {">=": "of at least", ">": "above", "<=": "of at most", "<": "below"}


def read_toml(path: Path, option: str = "--settings") -> dict[str, Any]:
    """The TOML document in ``path``, which ``option`` named.

    Raises:
        NotFound: no such file.
        UsageError: not a plain file, too large, malformed or unreadable.
    """
    try:
        information = path.stat()
        if not stat.S_ISREG(information.st_mode) and not stat.S_ISDIR(information.st_mode):
            # Opening a named pipe would wait for a writer that never comes.
            raise UsageError(f"{path} is not a plain file", f"name a TOML file with {option}")
        if information.st_size > _MAX_TOML_BYTES:
            raise ValueError(f"it is larger than {_MAX_TOML_BYTES >> 10} KiB")
        return parse_toml(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        syntax = isinstance(error, tomllib.TOMLDecodeError)
        quotes = (
            'text is in quotes ("0.5x"), and each [section] may appear only once; '
            if syntax
            else ""
        )
        raise UsageError(
            f"{path} is not valid TOML: {error}", f"{quotes}see settings/ for examples"
        ) from None
    except FileNotFoundError:
        raise NotFound(f"there is no file {path}", f"name a TOML file with {option}") from None
    except OSError as error:
        raise UsageError(
            f"{path} cannot be read: {error.strerror}", f"name a TOML file with {option}"
        ) from None


def parse_toml(text: str) -> dict[str, Any]:
    """The TOML document ``text``.

    Raises:
        ValueError: malformed, or a line is too long.
    """
    if max(map(len, text.splitlines()), default=0) > _MAX_TOML_LINE:
        raise ValueError(f"a line is longer than {_MAX_TOML_LINE} characters")
    return tomllib.loads(text)


def converted(value: Any, form: type[Form], where: str, examples: str) -> Form:
    """``value``, the table ``where`` of a document, as a ``form``.

    Raises:
        UsageError: no table, or an unknown, missing or wrong field; names it. For a wrong one the
            hint names ``examples``.
    """
    fields = form.__struct_fields__
    if not isinstance(value, Mapping):
        raise UsageError(
            f"{where}: expected a table, found {value!r}",
            f"write [{where}], or put the line below the [NAME] that it belongs to",
        )
    for name in value:
        if name not in fields:
            raise UsageError(f"unknown field {f'{where}.{name}'!r}", suggest(name, fields))
    try:
        return msgspec.convert(value, form)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at ")
        field = with_key(value, form, place.strip("`").removeprefix("$").lstrip("."))
        missing = re.search(r"missing required field `(\w+)`", message)
        if missing:
            raise UsageError(f"{where}.{missing[1]} is missing", f"write it in [{where}]") from None
        raise UsageError(
            f"{where}{f'.{field}' if field else ''}: {of_types(message)}",
            _choices(form, field) or f"see {examples}",
        ) from None


def _choices(form: type[Any], field: str) -> str:
    """The choices of a field that has some, else empty."""
    kinds = {f.name: f.type for f in msgspec.structs.fields(form)}
    members = get_args(kinds.get(field))
    choices = next((get_args(m) for m in members if get_origin(m) is Literal), ())
    return f"one of: {', '.join(choices)}" if choices else ""


def with_key(value: Mapping[str, Any], form: type[Form], field: str) -> str:
    """``field`` of an error with the key of its dictionary, for which msgspec writes ``[...]``."""
    name, inside, rest = field.partition("[...]")
    for key in value[name] if inside else ():
        try:
            msgspec.convert({name: {key: value[name][key]}}, form)
        except msgspec.ValidationError:
            return f"{name}.{key}{rest}"
    return field


def of_types(message: str) -> str:
    """msgspec's message about a value's type or range, in the words of a settings file."""
    bound = re.match("Expected `(int|float)` (>=|>|<=|<) (.+)$", message)
    if bound is not None:
        kind, sign, number = bound.groups()
        return f"expected {_KINDS[kind]} {_BOUNDS[sign]} {number.removesuffix('.0')}"
    found = re.match("Expected `([^`]+)`, got `([^`]+)`$", message)
    if found is None:
        return message.replace("Invalid enum value", "unknown value")
    expected, got = (
        " or ".join(_KINDS.get(kind, kind) for kind in kinds.split(" | "))
        for kinds in found.groups()
    )
    if found.groups() == ("int", "float"):
        got = "one with a point or an exponent"
    return f"expected {expected}, found {got}"
