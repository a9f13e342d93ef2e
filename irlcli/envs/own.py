"""Environments from outside the package, described by a TOML file (docs/own-environments.md).

The file has the form of ``settings/ENV.toml``, and says besides what the environment is and what its
knobs are. What is read here is complete: it travels with every result, so that later commands need
the environment's module only.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args

import msgspec
from msgspec import Meta, Struct

from irlcli.configs.documents import converted, read_toml
from irlcli.configs.fields import MAX_FLOAT, Finite
from irlcli.configs.load import CONTROL, check_profile
from irlcli.configs.schema import Config
from irlcli.envs.code import code_of
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.envs.spec import Code, EnvironmentSpec, Form, Knob, Own
from irlcli.errors import NotFound, UsageError, suggest

_NAME = r"[A-Za-z][A-Za-z0-9_-]{0,39}"
_MODULE = r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*"
# Version of how such environments are stepped (irlcli.envs.adapted, irlcli.rl.rollout); part of
# every key.
_PHYSICS = 3
_EXAMPLES = "docs/own-environments.md"
# The column ``t`` of demonstrations is int32.
_Steps = Annotated[int, Meta(ge=1, le=2**31 - 1)]


class _Env(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """``[env]``; see docs/own-environments.md."""

    id: str | None = None
    entry_point: str | None = None
    name: str | None = None
    max_episode_steps: _Steps | None = None
    actions: Literal["discrete", "continuous"] | None = None
    arguments: dict[str, Any] = {}
    files: tuple[str, ...] = ()
    symmetries: bool = False


class _Knob(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """``[knobs.NAME]``: fields of :class:`irlcli.envs.spec.Knob`."""

    argument: str
    forms: Annotated[tuple[str, ...], Meta(min_length=1)]
    low: Finite
    high: Finite
    description: str = ""
    whole: bool = False
    observed: bool = False

    def described(self, name: str) -> Knob:
        """The knob called ``name``."""
        return Knob(
            argument=self.argument,
            forms=cast(tuple[Form, ...], self.forms),
            low=self.low,
            high=self.high,
            description=self.description or name,
            whole=self.whole,
            observed=f"what {name} adds" if self.observed else "",
        )


def read_environment(path: Path) -> EnvironmentSpec:
    """The environment that the TOML file ``path`` describes.

    Without ``max_episode_steps`` or ``actions`` in the file, the environment is made once to find
    them out. Otherwise nothing is imported.

    Raises:
        NotFound: no such file, or its module cannot be imported.
        UsageError: malformed, an unknown field, a value of a wrong type, a bad name or range, or
            actions that no policy here has.
    """
    if not path.exists():
        raise NotFound(f"there is no file {path}", "name a TOML file that describes an environment")
    return from_document(read_toml(path, "--env"), str(path), path.resolve())


def from_document(
    document: Mapping[str, Any], source: str, file: Path | None, code: Code | None = None
) -> EnvironmentSpec:
    """The environment that ``document``, which was read from ``source``, describes.

    Args:
        document: the TOML document.
        source: where it was read, for messages.
        file: the TOML file; None if the document was read from an artefact.
        code: what the environment's code must be; None: what it is now.

    Raises:
        NotFound, UsageError: as :func:`read_environment`.
    """
    try:
        env, knobs = _checked(document)
        name = env.name or (file.stem if file is not None else "")
        _check_name(name)
        if file is not None:
            _check_files_named(env.arguments, file.parent)
    except UsageError as error:
        raise UsageError(f"{source}: {error.message}", error.hint) from None
    directory = None if file is None else file.parent
    module = module_of(env.id, env.entry_point)
    spec = EnvironmentSpec(
        name=name,
        entry_point=env.entry_point or "",
        gym_id=env.id or "",
        max_episode_steps=env.max_episode_steps or 1,
        knobs={knob: k.described(knob) for knob, k in knobs.items()},
        discrete_actions=env.actions == "discrete",
        # In the environment's module, whose code is in the key.
        symmetries=f"{module}:symmetries" if env.symmetries else None,
        physics=_PHYSICS,
        own=Own(
            id=env.id,
            arguments=env.arguments,
            code=code or code_of(module, env.files, directory, source),
            files=env.files,
            document={},
            source=source,
            directory=directory,
        ),
    )
    if env.max_episode_steps is None or env.actions is None:
        if file is None:
            raise UsageError(
                f"{source}: its environment has no time limit or no actions",
                "make the artefact again, which records both",
            )
        from irlcli.envs.registration import observed_of

        steps, discrete = observed_of(spec)
        steps = env.max_episode_steps or steps
        if steps is None:
            raise UsageError(
                f"{source}: env.max_episode_steps is missing: {name} has no time limit of its own",
                "add max_episode_steps = 1000 to [env]",
            )
        spec = spec._replace(max_episode_steps=steps, discrete_actions=discrete)
    complete = msgspec.structs.replace(
        env,
        name=name,
        max_episode_steps=spec.max_episode_steps,
        actions="discrete" if spec.discrete_actions else "continuous",
    )
    assert spec.own is not None
    try:
        whole = {**document, "env": msgspec.to_builtins(complete)}
        whole = json.loads(json.dumps(whole, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{source}: {error}", "numbers, text, true, false, lists and tables"
        ) from None
    return spec._replace(own=spec.own._replace(document=whole))


def _check_files_named(value: Any, directory: Path) -> None:
    """Refuse the name of a file in ``env.arguments``.

    Its content would be in no key, and the name means another file in another working directory.
    """
    match value:
        case str() if any(letter in value for letter in "./"):
            if any(path.is_file() for path in (Path(value), directory / value)):
                raise UsageError(
                    f"env.arguments names the file {value}, whose content would be in no key",
                    "open it in the environment's module, beside __file__, and list it in env.files",
                )
        case dict() | list():
            for inner in value.values() if isinstance(value, dict) else value:
                _check_files_named(inner, directory)


def module_of(gym_id: str | None, entry_point: str | None) -> str:
    """The module that defines an environment: Gymnasium's own, if its id names none."""
    module, colon, _ = (entry_point or gym_id or "").partition(":")
    return module if colon else "gymnasium"


def _checked(document: Mapping[str, Any]) -> tuple[_Env, dict[str, _Knob]]:
    sections = ("env", "knobs", "profiles", *Config.__struct_fields__)
    for section in document:
        if section not in sections:
            raise UsageError(f"unknown section {section!r}", suggest(section, sections))
    for profile in _table(document, "profiles"):
        check_profile(profile, f"profiles.{profile}")
    if "env" not in document:
        raise UsageError("the section [env] is missing", 'write [env] with id = "module:EnvId"')
    env = converted(_table(document, "env"), _Env, "env", _EXAMPLES)
    if (env.id is None) == (env.entry_point is None):
        raise UsageError(
            "env.id and env.entry_point both name the environment"
            if env.id
            else "env.id is missing",
            'write id = "module:EnvId", or entry_point = "module:Class"',
        )
    text = env.entry_point or env.id or ""
    module, colon, rest = text.partition(":")
    if (colon or env.entry_point) and not (re.fullmatch(_MODULE, module) and rest):
        field = "entry_point" if env.entry_point else "id"
        raise UsageError(
            f"env.{field}: {text!r} names no module and environment",
            'write id = "module:EnvId", or entry_point = "module:Class"',
        )
    _check_arguments(env.arguments, "env.arguments")
    knobs = {}
    for name, value in _table(document, "knobs").items():
        knobs[name] = _knob(name, value)
        if knobs[name].argument in env.arguments:
            raise UsageError(
                f"knobs.{name}: env.arguments also sets {knobs[name].argument}", "omit one of them"
            )
    return env, knobs


def _knob(name: str, value: Any) -> _Knob:
    if not re.fullmatch(_NAME, name) or name == "default":
        raise UsageError(
            f"knobs.{name!r} cannot be the name of a knob",
            "up to 40 letters, digits, '-' and '_', a letter first",
        )
    knob = converted(value, _Knob, f"knobs.{name}", _EXAMPLES)
    for form in knob.forms:
        if form not in get_args(Form):
            raise UsageError(
                f"knobs.{name}.forms: unknown form {form!r}", suggest(form, get_args(Form))
            )
    if not knob.argument.isidentifier():
        raise UsageError(
            f"knobs.{name}.argument: {knob.argument!r} is not a keyword argument",
            "name an argument of the environment's constructor",
        )
    if not knob.low <= knob.high:
        raise UsageError(
            f"knobs.{name}: low = {knob.low:g} is above high = {knob.high:g}", "swap them"
        )
    for bound in ("low", "high"):
        if knob.whole and not getattr(knob, bound).is_integer():
            raise UsageError(
                f"knobs.{name}: whole = true, but {bound} = {getattr(knob, bound):g}",
                "write whole numbers as bounds",
            )
    return knob


def _check_name(name: str) -> None:
    if not re.fullmatch(_NAME, name):
        raise UsageError(
            f"{name!r} cannot be the name of an environment",
            "write name = ... in [env]: up to 40 letters, digits, '-' and '_', a letter first",
        )
    if name in ENVIRONMENTS or name == CONTROL:
        raise UsageError(
            f"{name!r} is the name of another environment",
            "rename the file, or write name = ... in [env]",
        )


def _check_arguments(value: Any, where: str) -> None:
    """Refuse what is no JSON: arguments are part of keys."""
    match value:
        case dict():
            for name, inner in value.items():
                _check_arguments(inner, f"{where}.{name}")
        case list():
            for inner in value:
                _check_arguments(inner, where)
        case bool() | str():
            pass
        case int() | float() if math.isfinite(value) and abs(value) <= MAX_FLOAT:
            pass
        case _:
            raise UsageError(
                f"{where}: {value!r} is not allowed", "numbers, text, true, false, lists and tables"
            )


def _table(document: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    value = document.get(name, {})
    if not isinstance(value, Mapping):
        raise UsageError(f"{name}: expected a table, found {value!r}", f"write [{name}]")
    return value


def check_code(spec: EnvironmentSpec) -> None:
    """Refuse an environment whose code is no longer, or not here, what it was when it was read.

    Raises:
        NotFound: its module cannot be imported.
        UsageError: other code.
    """
    own = spec.own
    assert own is not None
    module = module_of(own.id, spec.entry_point)
    now = code_of(module, own.files, own.directory, own.source)
    if now == own.code:
        return
    if own.directory is not None:
        raise UsageError(
            f"{own.source}: {module} changed since the file was read", "run the same command again"
        )
    raise UsageError(
        f"the code of {module} is not what {own.source} was made with: that was {_described(own.code)}, "
        f"this is {_described(now)}",
        "name the environment's file with --env to use it as it is now",
    )


def _described(code: Code) -> str:
    version = "" if code.version is None else f"{code.distribution} {code.version}"
    content = "" if code.sha256 is None else f"sha256 {code.sha256[:12]}"
    return " ".join(part for part in (version, content) if part)
