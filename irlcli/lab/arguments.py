"""Python values as the texts of options, and errors about options as errors about arguments."""

from __future__ import annotations

import functools
import inspect
import json
import numbers
import operator
import os
import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypedDict, TypeVar

from irlcli.configs.fields import MAX_COUNT
from irlcli.configs.load import field_of
from irlcli.errors import IrlError, UsageError, file_failure, first_line, suggest
from irlcli.requests.in_python import in_python

Overrides = Mapping[str, Any] | Sequence[str]

_P = ParamSpec("_P")
_R = TypeVar("_R")


class Configs(TypedDict, total=False):
    """What one call overrides of its lab's configs.

    Attributes:
        profile, settings: instead of the lab's.
        set: after the lab's, which it replaces where both set a field.
    """

    profile: str
    settings: str | Path | None
    set: Overrides


# What an annotation of an argument allows, and its name in an error. A bool is no number.
_FORMS: dict[str, tuple[str, tuple[type, ...]]] = {
    "str": ("text", (str,)),
    "Path": ("a path", (os.PathLike,)),
    "bool": ("True or False", (bool,)),
    "int": ("a whole number", (numbers.Integral,)),
    "float": ("a number", (numbers.Real,)),
    "None": ("None", (type(None),)),
    "Sequence": ("a list", (Sequence,)),
    "Mapping": ("a dict", (Mapping,)),
    "Ref": ("an artefact, or its name, id or path", (str, os.PathLike)),
    "Overrides": ("a dict or a list", (Sequence, Mapping)),
}


_CONFIGS: Mapping[str, Any] = Configs.__annotations__


def plainly(method: Callable[_P, _R]) -> Callable[_P, _R]:
    """``method`` with errors that name arguments instead of options, and show no inner frames."""
    signature = inspect.signature(method)
    known = {*signature.parameters} - {"self"}
    forms = {p.name: _forms(str(p.annotation)) for p in signature.parameters.values()}
    if "configs" in known:
        known = {*known, *_CONFIGS} - {"configs"}
        forms |= {name: _forms(kind.__forward_arg__) for name, kind in _CONFIGS.items()}
    shown = method.__qualname__.removesuffix(".__init__").rpartition(".")[2]

    @functools.wraps(method)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        # ``**configs`` would take any name.
        for name in kwargs.keys() - known:
            raise UsageError(f"{shown} has no argument {name!r}", suggest(name, known))
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise UsageError(f"{shown}: {error}", f"write {shown}{_shape(signature)}") from None
        configs = given.pop("configs", {})
        for name, value in (given | configs).items():
            _check_form(name, value, forms[name])
        try:
            return method(*args, **kwargs)
        except IrlError as error:
            error.message, error.hint = in_python(error.message), in_python(error.hint)
            raise error.with_traceback(None) from None
        except OSError as error:
            failed = file_failure(error)
            failed.hint = in_python(failed.hint)
            raise failed from None

    return call


def _shape(signature: inspect.Signature) -> str:
    """``(env, *, seed=0)``: the arguments without their annotations."""
    plain = [
        p.replace(annotation=p.empty) for p in signature.parameters.values() if p.name != "self"
    ]
    return str(inspect.Signature(plain))


def _forms(annotation: str) -> list[str]:
    """The names in ``annotation`` if all of them are known; none of another class."""
    names = [part.partition("[")[0] for part in re.sub(r"\[.*?\]+", "[]", annotation).split(" | ")]
    return names if _FORMS.keys() >= {*names} else []


def _check_form(name: str, value: Any, forms: Sequence[str]) -> None:
    allowed = tuple(kind for form in forms for kind in _FORMS[form][1])
    if not forms or (
        isinstance(value, allowed) and ("bool" in forms or not isinstance(value, bool))
    ):
        return
    words = " or ".join(_FORMS[form][0] for form in forms if form != "None")
    quoted = "str" in forms and isinstance(value, int | float)
    hint = f'write {name}="{value}"' if quoted else f"give {words}"
    raise UsageError(f"{name} {reprlib.repr(value)} is not {words}", hint)


def words(command: str, options: Mapping[str, Any], *arguments: str) -> list[str]:
    """The command line equivalent to a call with ``options``."""
    words = ["irl", command, *arguments]
    for name, value in options.items():
        option = "--" + name.replace("_", "-")
        if isinstance(value, bool):
            # The only option that has both.
            no = ["--no-state-only"] if name == "state_only" else []
            words += [option] if value else no
        elif isinstance(value, list):
            words += [word for item in value for word in (option, item)]
        elif value is not None:
            words += [option, str(value)]
    return words


def overrides(given: Overrides) -> list[str]:
    """As for ``--set``: each ``FIELD=VALUE``.

    Raises:
        UsageError: something else than text, or a list of something else than numbers and text.
    """
    if isinstance(given, Mapping):
        try:
            return [f"{field}={_toml(value)}" for field, value in given.items()]
        except TypeError as error:
            # From JSON, of an element in a list.
            raise UsageError(
                f"set: {first_line(error)}", "give numbers, text or lists of them"
            ) from None
    return texts("set", given)


def merged(first: Sequence[str], later: Sequence[str]) -> list[str]:
    """Both lists of ``FIELD=VALUE``, without those of ``first`` whose field ``later`` sets too."""
    fields = {field_of(item) for item in later}
    return [*(item for item in first if field_of(item) not in fields), *later]


def _toml(value: Any) -> str:
    # What NumPy holds, as Python's own values.
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_element, value))}]"
    return "none" if value is None else str(value)


def _element(value: Any) -> str:
    """``value`` in a list of TOML. What NumPy holds is Python's own values."""
    return json.dumps(value.tolist() if hasattr(value, "tolist") else value)


def texts(name: str, given: Any) -> list[str]:
    """One text, or several, as a list.

    Raises:
        UsageError: something else than text.
    """
    for item in (items := listed(given)):
        _check_form(name, item, ["str"])
    return items


def listed(given: Any) -> list[Any]:
    """One value, or several, as a list."""
    return [given] if isinstance(given, str | os.PathLike) else list(given)


def joined(given: Any) -> str | None:
    """One value, or several, as the options with commas take them."""
    if given is None:
        return None
    several = isinstance(given, Sequence) and not isinstance(given, str)
    return ",".join(map(text_of, given if several else [given]))


def text_of(given: Any) -> str:
    """A path, a number or text as an option takes it."""
    return os.fspath(given) if isinstance(given, os.PathLike) else str(given)


def fixed(place: Any) -> str:
    """A path that does not depend on the working directory; a URL as it is."""
    text = text_of(place)
    return text if "://" in text else os.path.abspath(text)


def number(name: str, given: float | None) -> float | None:
    """``given`` as a float.

    Raises:
        UsageError: an integer that no float can hold.
    """
    try:
        return None if given is None else float(given)
    except OverflowError:
        raise UsageError(f"{name} is too large for a float", f"write {name}=1.0") from None


def whole(name: str, given: int, least: int = 0) -> int:
    """``given`` as an int.

    Raises:
        UsageError: less than ``least``, or more than options accept.
    """
    number = operator.index(given)
    if number < least:
        raise UsageError(f"{name} {number} is less than {least}", f"write {name}={least} or more")
    if number > MAX_COUNT:
        raise UsageError(f"{name} is more than {MAX_COUNT}", f"write {name}={MAX_COUNT} or less")
    return number
