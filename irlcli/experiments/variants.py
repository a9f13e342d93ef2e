"""Variants of the config, for tables that compare them instead of methods."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import msgspec

from irlcli.configs import Config
from irlcli.configs.load import field_of, overridden
from irlcli.errors import UsageError, suggest
from irlcli.methods import METHODS, fields
from irlcli.report.agents import BASELINES
from irlcli.report.parameters import Variant

# What a variant may change: experts and demonstrations are the same for all.
SECTIONS = ("airl", "transfer")
_NAME = r"[a-z0-9]+([ -][a-z0-9]+)*"
_LONGEST = 40

# The config of an environment under a method's flags; without a method, under none.
ConfigOf = Callable[[str, str | None], Config]
# The config under flags such as ``airl.penalty``, and under overrides as ``--set`` takes them.
Overridable = Callable[[str, Mapping[str, Any] | None, Sequence[str]], Config]


def read_variants(
    field: str, value: Mapping[str, Sequence[str]], base: str | None
) -> tuple[Variant, ...]:
    """The variants in a table's ``field``, that called ``base`` first.

    Raises:
        UsageError: fewer than two; a name that is no variant's; an unknown field or value, or a
            field that no variant may change; two variants with equal overrides; an unknown base.
    """
    if len(value) < 2:
        raise UsageError(
            f"{field} has fewer than two variants",
            f'write [{field}] with lines such as "no ceiling" = ["transfer.ceiling=none"]',
        )
    found: dict[str, tuple[Variant, dict[str, Any]]] = {}
    for name, overrides in value.items():
        variant = _variant(f"{field}.{name!r}", name, overrides)
        try:
            changed = _changed(variant.overrides)
        except UsageError as error:
            message = error.message.removeprefix("--set ")
            raise UsageError(f"{field}.{name!r}: {message}", error.hint) from None
        for other, (earlier, same) in found.items():
            if step_name(variant) == step_name(earlier):
                raise UsageError(
                    f"{field}: {name!r} and {other!r} are one name in steps", "rename one of them"
                )
            if changed == same:
                raise UsageError(
                    f"{field}: {name!r} and {other!r} have the same overrides", "omit one of them"
                )
        found[name] = variant, changed
    if base is None:
        raise UsageError(
            f"{field.rpartition('.')[0]}.base is missing", f"one of: {', '.join(found)}"
        )
    if base not in found:
        raise UsageError(
            f"{field.rpartition('.')[0]}.base: {base!r} is not a variant",
            suggest(base, found),
        )
    variants = [variant for variant, _ in found.values()]
    return tuple(sorted(variants, key=lambda variant: variant.name != base))


def _variant(field: str, name: str, overrides: Sequence[str]) -> Variant:
    taken = (*METHODS, *BASELINES)
    if not re.fullmatch(_NAME, name) or len(name) > _LONGEST or name in taken:
        raise UsageError(
            f"{field} cannot be the name of a variant",
            f"up to {_LONGEST} lowercase letters, digits, single spaces and '-', and not "
            f"{', '.join(taken)}",
        )
    return Variant(name, tuple(overrides))


def _changed(overrides: Sequence[str]) -> dict[str, Any]:
    """The fields that a variant changes, with their values."""
    values = overridden(overrides)
    of_methods = fields(next(iter(METHODS)), "airl")
    for dotted in values:
        if dotted.partition(".")[0] not in SECTIONS:
            raise UsageError(
                f"a variant cannot change {dotted}",
                f"it changes fields of: {', '.join(SECTIONS)}",
            )
        if dotted in of_methods:
            raise UsageError(
                f"a variant cannot change {dotted}, which the method sets", "name another method"
            )
    return values


def step_name(variant: Variant) -> str:
    """The variant's name as a part of the names of steps."""
    return variant.name.replace(" ", "-")


def loaded(load: Overridable, overrides: Sequence[str] = ()) -> ConfigOf:
    """The configs under ``overrides``, each loaded once."""

    @cache
    def config_of(env: str, method: str | None) -> Config:
        return load(env, None if method is None else fields(method, "airl"), overrides)

    return config_of


def config_under(variant: Variant, load: Overridable) -> ConfigOf:
    """The configs under ``variant``.

    Challengers learn as ``[transfer.ppo]`` says. Still, what a variant changes in ``transfer``
    leaves reward learning alone: such variants share the rewards of the base.
    """
    whole = loaded(load, variant.overrides)
    learning = loaded(load, [o for o in variant.overrides if field_of(o).startswith("airl.")])

    @cache
    def config_of(env: str, method: str | None) -> Config:
        config, learned = whole(env, method), learning(env, method)
        interventions = {
            knob: msgspec.structs.replace(listed, airl=learned.interventions[knob].airl)
            for knob, listed in config.interventions.items()
        }
        return msgspec.structs.replace(config, airl=learned.airl, interventions=interventions)

    return config_of
