"""Configs from TOML files, profiles and ``--set``.

One file per environment in ``settings/``. Precedence, weakest first: the schema's defaults, the
environment's file, its profile, a table's file, ``--settings FILE``, ``--set``, flags. Environment
variables are not read, so equal configs give equal artefacts wherever they run.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import UNSET, Struct, UnsetType

from irlcli.configs.documents import of_types, parse_toml, read_toml, with_key
from irlcli.configs.relevance import check_registered
from irlcli.configs.schema import (
    AIRLConfig,
    Config,
    ExpertConfig,
    InterventionConfig,
    TransferConfig,
)
from irlcli.envs.registry import environment
from irlcli.errors import UsageError, closest, suggest
from irlcli.interventions import Setting, knob_of, listed_settings, overlap

PROFILES = ("smoke", "standard", "paper")

# Above it, a bound only keeps numbers finite: no hint for people.
_MANY = 1e6
# A name besides those of the environments: settings/control.toml has the positive controls.
CONTROL = "control"
_INTERVENTIONS = dict[str, InterventionConfig]
Form = TypeVar("Form")
Layer = tuple[str, Mapping[str, Any]]
Layers = Sequence[Layer]


def check_profile(profile: str, source: str = "") -> None:
    """Refuse an unknown profile, which ``source`` names.

    Raises:
        UsageError: not one of :data:`PROFILES`.
    """
    if profile not in PROFILES:
        where = f"{source}: " if source else ""
        raise UsageError(f"{where}unknown profile {profile!r}", suggest(profile, PROFILES))


def load_config(
    env: str,
    profile: str = "standard",
    files: Sequence[Path] = (),
    overrides: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
) -> Config:
    """The config of ``env``.

    Args:
        env: environment whose file in ``settings/`` is read, or :data:`CONTROL`.
        profile: ``smoke``, ``standard`` or ``paper``.
        files: TOML files of the same form, laid over the profile one after the other. A file's
            own section for the profile, ``[profiles.smoke]`` say, is laid over the rest of it.
        overrides: ``airl.penalty_weight=30``, each typed by its field.
        flags: dotted field to value; None is left out.

    Raises:
        NotFound: one of ``files`` does not exist.
        UsageError: unknown environment, profile, field or value; malformed or unreadable TOML; a
            field that ``overrides`` and ``flags`` set to different values.
    """
    known = None if env == CONTROL else environment(env).own
    check_profile(profile)
    if known is None:
        own = str(settings_directory() / f"{env}.toml")
        tree = read_toml(Path(own))
    else:
        own, tree = known.source, known.settings
    layers = in_profile(own, tree, profile)
    for file in files:
        layers += in_profile(str(file), read_toml(file), profile)
    given = [(item, *_override(item)) for item in overrides]
    _check_set_once(given, flags or {})
    layers += [(f"--set {item!r}", _nest(dotted, value)) for item, dotted, value in given]
    layers += [
        (f"--{dotted.rpartition('.')[2].replace('_', '-')}", _nest(dotted, value))
        for dotted, value in (flags or {}).items()
        if value is not None
    ]
    return _stack(env, layers)


def _check_set_once(overrides: Sequence[tuple[str, str, Any]], flags: Mapping[str, Any]) -> None:
    """Refuse an override whose field a flag sets to another value: it would be ignored."""
    for item, dotted, value in overrides:
        if flags.get(dotted) not in (None, value):
            raise UsageError(
                f"--set {item!r}: the method or another option sets {dotted} to {flags[dotted]!r}",
                f"omit --set {dotted}, or choose another method or value",
            )


def file_without_profile(env: str, profile: str) -> str:
    """The TOML file of an environment of one's own that has no section for ``profile``; else empty.

    ``standard``, the default, needs none.
    """
    own = None if env == CONTROL else environment(env).own
    if own is None or profile == "standard" or profile in own.settings.get("profiles", {}):
        return ""
    return own.source


def unseen_settings(env: str, config: Config) -> list[Setting]:
    """Every OOD setting that the settings file lists."""
    return [
        setting
        for knob, values in config.interventions.items()
        for setting in listed_settings(env, knob, values.ood)
    ]


def in_profile(source: str, tree: Mapping[str, Any], profile: str) -> list[Layer]:
    """A document's values, and over them those of its section for ``profile``.

    Raises:
        UsageError: ``[profiles]`` is no table of tables, or names an unknown profile.
    """
    profiles = tree.get("profiles", {})
    tables = {"profiles": profiles}
    if isinstance(profiles, Mapping):
        tables |= {f"profiles.{name}": part for name, part in profiles.items()}
        for name in profiles:
            check_profile(name, source)
    for where, part in tables.items():
        if not isinstance(part, Mapping):
            raise UsageError(
                f"{source}: {where}: expected a table, found {part!r}",
                "write [profiles.smoke.airl], for example",
            )
    plain = {name: part for name, part in tree.items() if name != "profiles"}
    return [(source, plain), (f"{source}, profile {profile}", profiles.get(profile, {}))]


def _stack(env: str, layers: Layers) -> Config:
    """The config of ``layers`` of (source, values); later layers win."""
    checked: list[Layer] = []
    tree: dict[str, Any] = {}
    for source, values in layers:
        if tree and not values:
            # The standard profile is usually empty, and every command comes through here.
            continue
        try:
            values = _checked(values, Config)
            checked.append((source, values))
            tree = _merge(tree, values)
            config = _convert(env, tree)
        except UsageError as error:
            raise UsageError(f"{source}: {error.message}", error.hint) from None
    interventions = {
        knob: _with_sections(knob, intervention, checked)
        for knob, intervention in config.interventions.items()
    }
    return msgspec.structs.replace(
        config,
        interventions=interventions,
        airl=_airl(checked),
        transfer=_as(TransferConfig, _transfer(checked)),
    )


def _with_sections(knob: str, listed: InterventionConfig, layers: Layers) -> InterventionConfig:
    """``listed`` with the whole config of each section that the knob has different."""
    whole: dict[str, Any] = {"episodes": _episodes(knob, layers)}
    if listed.expert is not None:
        whole["expert"] = _as(ExpertConfig, _section("expert", layers, knob))
    if listed.transfer is not None or listed.expert is not None:
        whole["transfer"] = _as(TransferConfig, _transfer(layers, knob))
    if listed.airl is not None or "transfer" in whole:
        whole["airl"] = _airl(layers, knob)
    return msgspec.structs.replace(listed, **whole)


def _episodes(knob: str, layers: Layers) -> tuple[int, ...]:
    """The knob's own counts of demonstrations, unless a later layer has one for all knobs."""
    counts: Sequence[int] = ()
    for _, values in layers:
        if "episodes" in values.get("demonstrations", {}):
            counts = ()
        counts = values.get("interventions", {}).get(knob, {}).get("episodes", counts)
    return tuple(counts)


def _airl(layers: Layers, knob: str | None = None) -> AIRLConfig:
    """Challengers learn as retrained policies do, unless ``[airl.challenger.ppo]`` differs."""
    airl, transfer = _section("airl", layers, knob), _transfer(layers, knob)
    own = airl.get("challenger", {}).get("ppo", {})
    ppo = _merge(transfer.get("ppo", {}), own)
    return _as(AIRLConfig, _merge(airl, {"challenger": {"ppo": ppo}}))


def _transfer(layers: Layers, knob: str | None = None) -> dict[str, Any]:
    """Retrained policies learn as experts do, unless ``[transfer.ppo]`` differs."""
    ppo = _section("expert", layers, knob).get("ppo", {})
    return _merge({"ppo": ppo}, _section("transfer", layers, knob))


def _section(section: str, layers: Layers, knob: str | None) -> dict[str, Any]:
    """``[section]`` of all layers, with ``knob``'s own overrides.

    In each layer the knob's own table wins over ``[section]``; a later layer wins over both.
    """
    tree: dict[str, Any] = {}
    for _, values in layers:
        tree = _merge(tree, values.get(section, {}))
        if knob is not None:
            tree = _merge(tree, values.get("interventions", {}).get(knob, {}).get(section, {}))
    return tree


def overridden(items: Sequence[str]) -> dict[str, Any]:
    """The fields that ``items`` change, each as for ``--set``, and their typed values.

    Raises:
        UsageError: an unknown field, a value that is not of its field's type or in no registry, or
            a field that appears twice.
    """
    tree: dict[str, Any] = {}
    values: dict[str, Any] = {}
    for item in items:
        dotted, value = _override(item)
        if dotted in values:
            raise UsageError(f"{dotted} appears twice", "name each field once")
        tree = _merge(tree, _nest(dotted, value))
        values[dotted] = value
    check_registered(_as(Config, tree))
    return values


def field_of(item: str) -> str:
    """The field that ``item``, ``FIELD=VALUE`` as for ``--set``, names."""
    return item.partition("=")[0].strip()


def settings_directory() -> Path:
    """``settings/`` of the checkout, or its copy inside an installed package."""
    packaged = Path(__file__).parent.parent / "settings_files"
    return packaged if packaged.is_dir() else Path(__file__).parent.parent.parent / "settings"


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the values of ``over``, UNSET included: it also unsets what is merged later."""
    merged = dict(base)
    for name, value in over.items():
        if isinstance(value, Mapping):
            inner = merged.get(name)
            merged[name] = _merge(inner if isinstance(inner, Mapping) else {}, value)
        else:
            merged[name] = value
    return merged


def _as(form: type[Form], tree: Mapping[str, Any]) -> Form:
    """A merged ``tree`` as a ``form``."""
    return msgspec.convert(_set_fields(tree), form)


def _set_fields(tree: Mapping[str, Any]) -> dict[str, Any]:
    """``tree`` without the fields that are UNSET."""
    return {
        name: _set_fields(value) if isinstance(value, Mapping) else value
        for name, value in tree.items()
        if value is not UNSET
    }


def _nest(dotted: str, value: Any) -> dict[str, Any]:
    for name in reversed(dotted.split(".")):
        value = {name: value}
    return value


def _convert(env: str, tree: Mapping[str, Any]) -> Config:
    for knob in tree.get("interventions", {}):
        knob_of(env, knob)
    try:
        config = _as(Config, tree)
    except msgspec.ValidationError as error:
        message, _, where = str(error).partition(" - at ")
        field = with_key(tree, Config, where.strip("`").removeprefix("$."))
        raise UsageError(f"{field}: {of_types(message)}", _field_hint(field)) from None
    check_registered(config)
    for knob, values in config.interventions.items():
        trained, unseen = (listed_settings(env, knob, part) for part in (values.id, values.ood))
        if len(values.episodes) not in (0, 1, len(trained)):
            raise UsageError(
                f"interventions.{knob}.episodes: {len(values.episodes)} episode counts for "
                f"{len(trained)} settings",
                "write one count for all, or one for each value of id",
            )
        if both := [str(s) for s in unseen if any(overlap(s, other) for other in trained)]:
            raise UsageError(
                f"interventions.{knob}: {', '.join(both)} is both trained in (id) and held out (ood)",
                "hold out settings that nothing is trained in",
            )
    return config


def _checked(tree: Any, kind: Any, path: tuple[str, ...] = ()) -> dict[str, Any]:
    """``tree`` with None or unset for "none" where a field of ``kind`` may be: TOML has no null.

    Refuses unknown names, and values where tables belong: msgspec's messages name neither.
    """
    if kind == _INTERVENTIONS:
        fields = dict.fromkeys(tree, InterventionConfig) if isinstance(tree, Mapping) else {}
        inside = "[interventions.KNOB] with id and ood"
    else:
        # Not msgspec.structs.fields, which evaluates the annotations anew: a hit comes through here.
        fields = {name: kind.__annotations__[name] for name in kind.__struct_fields__}
        inside = f"[{'.'.join(path)}] with some of: {', '.join(fields)}"
    if not isinstance(tree, Mapping):
        raise UsageError(f"{'.'.join(path)}: expected a table, found {tree!r}", f"write {inside}")
    found = {}
    for name, value in tree.items():
        if name not in fields:
            where = ".".join((*path, str(name)))
            raise UsageError(f"unknown field {where!r}", suggest(str(name), fields))
        if inner := _table(fields[name]):
            value = _checked(value, inner, (*path, name))
        elif value == "none" and (nothing := _nothing(fields[name])):
            (value,) = nothing
        found[name] = value
    return found


def _nothing(field: Any) -> tuple[Any, ...]:
    """What "none" means in a field of this annotation: None, or unset; empty if it is a value."""
    kinds = get_args(field)
    return (None,) if type(None) in kinds else (UNSET,) if UnsetType in kinds else ()


def _table(field: Any) -> Any:
    """The kind of a TOML table that a field of this annotation is; None for another field."""
    for kind in (field, *get_args(field)):
        if kind == _INTERVENTIONS or (isinstance(kind, type) and issubclass(kind, Struct)):
            return kind
    return None


def _override(item: str) -> tuple[str, Any]:
    """The field that ``item``, ``FIELD=VALUE``, names, and its typed value."""
    dotted, equals, text = item.partition("=")
    dotted = dotted.strip()
    path = dotted.split(".")
    if not equals:
        raise UsageError(f"--set {item!r} has no '='", f"write --set {dotted}=VALUE")
    kind: Any = Config
    for i, name in enumerate(path):
        if not (isinstance(kind, type) and issubclass(kind, Struct)):
            parent = ".".join(path[:i])
            raise UsageError(
                f"--set {item!r}: {parent} has no fields", f"write --set {parent}=VALUE"
            )
        fields = {f.name: f.type for f in msgspec.structs.fields(kind)}
        if name not in fields:
            near = [f"{home}.{name}" for home in _homes(name)] if len(path) == 1 else []
            if (close := closest(name, fields)) and not near:
                near = [".".join((*path[:i], close, *path[i + 1 :]))]
            hint = f"did you mean {' or '.join(near)}?" if near else suggest(name, fields)
            raise UsageError(f"--set {item!r}: unknown field {dotted!r}", hint)
        kind = fields[name]
        if kind == _INTERVENTIONS:
            raise UsageError(
                f"--set {item!r}: --set does not change interventions",
                "use --intervention or --ood; for a table write [interventions.KNOB] in a file for "
                "--settings",
            )
    if isinstance(kind, type) and issubclass(kind, Struct):
        names = ", ".join(f"{dotted}.{f.name}" for f in msgspec.structs.fields(kind))
        raise UsageError(f"--set {item!r} names a group of fields", f"one of: {names}")
    return dotted, _typed(text.strip(), kind, dotted)


def _homes(name: str) -> list[str]:
    """The groups that have a field ``name``."""
    return [
        f.name
        for f in msgspec.structs.fields(Config)
        if isinstance(f.type, type) and issubclass(f.type, Struct)
        if name in f.type.__struct_fields__
    ]


def _typed(text: str, kind: Any, field: str) -> Any:
    if text == "none" and (nothing := _nothing(kind)):
        return nothing[0]
    try:
        value = parse_toml(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text
    try:
        return msgspec.to_builtins(msgspec.convert(value, kind))
    except (msgspec.ValidationError, UnicodeEncodeError) as error:
        # Arguments may hold bytes that are no text.
        raise UsageError(
            f"--set {field}={text}: {of_types(str(error).partition(' - at ')[0])}",
            _field_hint(field),
        ) from None


def _field_hint(field: str) -> str:
    """What a field takes: its choices, its range, or an example."""
    value, kind = Config(), Config
    for name in field.split("."):
        name = name.partition("[")[0]
        if not isinstance(value, Struct) or not hasattr(value, name):
            return "see settings/ for examples"
        (kind,) = (f.type for f in msgspec.structs.fields(value) if f.name == name)
        value = getattr(value, name)
    unset = value is UNSET
    otherwise = ", or none" if _nothing(kind) else ""
    for member in get_args(kind) if otherwise else (kind,):
        if get_origin(member) is Literal:
            return f"one of: {', '.join(get_args(member))}"
        for meta in getattr(member, "__metadata__", ()):
            if meta.ge is not None and meta.le is not None and meta.le < _MANY:
                bounds = (
                    f"{meta.description or 'a number'} from {meta.ge:g} to {meta.le:g}{otherwise}"
                )
                known = value is not None and not unset
                return f"{bounds}, for example {_shown(value)}" if known else bounds
    if unset:
        for member in get_args(kind):
            if member is bool:
                return "write true, false or none"
            if int in get_args(member):
                return f"write a whole number from {member.__metadata__[0].ge}, or none"
    if unset or value is None:
        return "write a value, or none"
    return f"for example {_shown(value)}"


def _shown(value: Any) -> str:
    return msgspec.json.encode(value).decode()
