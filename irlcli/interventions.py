"""Interventions: ``leg-length=1x,2x`` as typed settings.

A *setting* is one intervened environment instance (paper Sec. 4.1); a *knob* is the mechanism
intervened on. Planning needs names, allowed values and keyword arguments only, so nothing here
imports an environment.

Grammar, per comma-separated value: ``2x`` multiplies the default, ``0.5`` is absolute,
``1.5:0.1:0.1`` is a triple, ``-10..0`` is drawn uniformly per episode. One setting may change
several knobs: ``friction=0.5,mass=2x``.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from irlcli.envs.registry import ENVIRONMENTS, environment
from irlcli.envs.spec import Cue, Form, Knob
from irlcli.errors import UsageError, suggest

# Longer texts in a file of demonstrations are refused.
MAX_SETTING_LENGTH = 400
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
# Compiled on use: every command imports this module.
_FORMS: dict[Form, str] = {
    "multiplier": rf"({_NUMBER})x",
    "absolute": rf"({_NUMBER})",
    "triple": rf"({_NUMBER}):({_NUMBER}):({_NUMBER})",
    "range": rf"({_NUMBER})\.\.({_NUMBER})",
}
_EXAMPLES: dict[Form, str] = {
    "multiplier": "2x",
    "absolute": "0.5",
    "triple": "1.5:0.1:0.1",
    "range": "-10..0",
}


class Value(NamedTuple):
    """One intervention value: its form and its one, two or three numbers."""

    form: Form
    numbers: tuple[float, ...]

    def __str__(self) -> str:
        text = [_format(x) for x in self.numbers]
        match self.form:
            case "multiplier":
                return f"{text[0]}x"
            case "triple":
                return ":".join(text)
            case "range":
                return "..".join(text)
            case _:
                return text[0]

    @property
    def argument(self) -> float | tuple[float, ...]:
        """What the environment's keyword argument receives."""
        return self.numbers[0] if len(self.numbers) == 1 else self.numbers


_UNCHANGED = Value("multiplier", (1.0,))


class Setting(NamedTuple):
    """One intervened environment instance, e.g. ``engine-power=1.25x``; no change is the default.

    ``changes`` are pairs of a knob and its value, by the knobs' names: settings that are written in
    another order are equal.
    """

    changes: tuple[tuple[str, Value], ...] = ()

    def __str__(self) -> str:
        return ",".join(f"{knob}={value}" for knob, value in self.changes) or "default"

    @property
    def knobs(self) -> tuple[str, ...]:
        """The names of the changed knobs."""
        return tuple(knob for knob, _ in self.changes)


def _format(x: float) -> str:
    """Shortest text that reads back as ``x``; 2.0 is ``2``, and -0.0 is ``0``."""
    x = x + 0.0
    return str(int(x)) if x.is_integer() and abs(x) < 1e15 else repr(x)


def check_tabular(env: str, stage: str, wanted: bool) -> None:
    """Refuse an environment that ``stage`` does not work on.

    Raises:
        UsageError: unknown; or whether it is tabular differs from ``wanted``.
    """
    if environment(env).tabular == wanted:
        return
    fit = ", ".join(e.name for e in ENVIRONMENTS.values() if e.tabular == wanted)
    raise UsageError(
        f"{stage} does not work on {env}, which {'is not' if wanted else 'is'} a tabular environment",
        f"{stage} works on {fit}; use `irl {'train-airl' if wanted else 'train-maxent'}` for {env}",
    )


def check_observed(env: str, trained: Sequence[str], wanted: Sequence[Setting]) -> None:
    """Refuse settings whose observations differ from those of the settings ``trained`` in.

    Raises:
        UsageError: a goal or a cue is observed in some of them and not in others.
    """
    known, own = environment(env).knobs, environment(env).own is not None

    def added(setting: Setting) -> list[str]:
        return sorted({known[knob].observed for knob in setting.knobs} - {""})

    learned = added(parse_setting(env, trained[0])) if trained else []
    for setting in wanted:
        if added(setting) != learned:
            fit = [
                " or ".join(name for name, knob in known.items() if knob.observed == what)
                for what in learned or [""]
            ]
            raise UsageError(
                f"{env} {setting} and {', '.join(trained)} have different observations: the first "
                f"are {_observations(added(setting))}, the second {_observations(learned)}",
                (
                    f"name a setting of {', together with '.join(fit)}"
                    if all(fit)
                    else "name the setting default"
                )
                + "; or omit `observed` of a knob if all settings have what it adds" * own,
            )


def _observations(added: Sequence[str]) -> str:
    return " and ".join(["the state", *added]) if added else "the state alone"


def knob_of(env: str, knob: str) -> Knob:
    """The knob ``knob`` of environment ``env``.

    Raises:
        UsageError: the environment has no such knob; the hint names one that has.
    """
    knobs = environment(env).knobs
    if knob in knobs:
        return knobs[knob]
    others = sorted(e.name for e in ENVIRONMENTS.values() if knob in e.knobs)
    if others:
        hint = f"{knob!r} belongs to {', '.join(others)}; {env} has: {', '.join(sorted(knobs))}"
    else:
        hint = suggest(knob, knobs)
    raise UsageError(f"{env} has no intervention {knob!r}", hint)


def examples_of(knob: Knob) -> str:
    """A value in each form that ``knob`` allows: ``2x or 0.5``."""
    if knob.whole:
        return _format(knob.high)
    return " or ".join(_EXAMPLES[form] for form in knob.forms)


def _allowed(knob: Knob) -> str:
    """The range of a knob: ``must be 0 or 1``, ``must be 0, 1, 2 or 3``, ``must be between 0.1 and 8``."""
    times = "x" if "absolute" not in knob.forms and "multiplier" in knob.forms else ""
    low, high = _format(knob.low) + times, _format(knob.high) + times
    if not knob.whole:
        return f"must be between {low} and {high}"
    if not knob.high - knob.low < 10:
        return f"must be a whole number from {low} to {high}"
    *others, last = [str(n) for n in range(int(knob.low), int(knob.high) + 1)]
    return f"must be {', '.join(others)} or {last}" if others else f"must be {last}"


def parse_value(env: str, knob: str, text: str) -> Value:
    """One value of a knob, checked against the forms and the range that the knob allows.

    Raises:
        UsageError: not a number of an allowed form, not finite, or out of range.
    """
    spec = knob_of(env, knob)
    examples = examples_of(spec)
    for form, pattern in _FORMS.items():
        match = re.fullmatch(pattern, text.strip())
        if match is None:
            continue
        if form not in spec.forms:
            if form == "absolute" and "multiplier" in spec.forms:
                examples = f"{text.strip()}x"
            raise UsageError(
                f"{knob}={text.strip()!r} is of the form {form}: {env} takes {knob} as "
                f"{' or '.join(spec.forms)}",
                f"write it like {knob}={examples}",
            )
        numbers = tuple(float(group) + 0.0 for group in match.groups())
        if form == "range" and numbers[0] > numbers[1]:
            raise UsageError(
                f"{knob}={text.strip()!r}: the range is empty",
                f"write the smaller end first: {_format(numbers[1])}..{_format(numbers[0])}",
            )
        if spec.whole and not all(x.is_integer() for x in numbers):
            raise UsageError(
                f"{knob}={text.strip()!r} is not a whole number",
                f"{knob} ({spec.description}) {_allowed(spec)}",
            )
        for x in numbers:
            if not spec.low <= x <= spec.high:
                raise UsageError(
                    f"{knob}={text.strip()!r} is out of range",
                    f"{knob} ({spec.description}) {_allowed(spec)}",
                )
        return Value(form, numbers)
    raise UsageError(
        f"{knob}={text.strip()!r} is not an intervention value", f"write it like {knob}={examples}"
    )


def parse_settings(env: str, text: str) -> tuple[Setting, ...]:
    """``"leg-length=1x,2x"`` as one setting per value, in the order written.

    Raises:
        UsageError: malformed text, unknown knob, bad or repeated value.
    """
    knob, equals, values = text.partition("=")
    knob = knob.strip()
    if not equals or not knob or not values.strip():
        names = sorted(environment(env).knobs)
        raise UsageError(
            f"{text!r} is not an intervention",
            f"write KNOB=VALUE,VALUE; {env} has: {', '.join(names)}",
        )
    knob_of(env, knob)
    for part in values.split(",")[1:]:
        if "=" in part:
            other = part.partition("=")[0].strip()
            knob_of(env, other)
            if other == knob:
                raise UsageError(
                    f"{text!r} names {knob} twice",
                    f"write the knob once, then its values: {knob}=VALUE,VALUE",
                )
            raise UsageError(
                f"{text!r} gives values of two knobs, {knob} and {other}",
                "to change both in one setting, write --setting "
                f"{knob}={values.split(',')[0].strip()},{part.strip()}",
            )
    settings = [Setting(((knob, parse_value(env, knob, part)),)) for part in values.split(",")]
    check_distinct(repr(text), settings)
    return tuple(settings)


def listed_settings(env: str, knob: str, values: Sequence[str]) -> tuple[Setting, ...]:
    """A setting for each of the ``values`` that a settings file lists for ``knob``.

    Raises:
        UsageError: as :func:`parse_settings`.
    """
    return parse_settings(env, f"{knob}={','.join(values)}") if values else ()


def check_distinct(where: str, settings: Sequence[Setting]) -> None:
    """Refuse settings that change the same knobs to the same values, as ``default`` and ``mass=1x`` do.

    Only the environment knows whether an absolute value is the default: ``bounce=0`` and
    ``default`` are accepted.

    Raises:
        UsageError: naming ``where`` and the setting that appears twice.
    """
    for i, setting in enumerate(settings):
        for other in settings[:i]:
            if same(setting, other):
                again = f", once as {setting}" if setting != other else ""
                raise UsageError(
                    f"{where} names {other} twice{again}",
                    "name each setting once",
                )


def _numbers(value: Value) -> tuple[float, ...]:
    form, numbers = value
    return numbers[:1] if form == "range" and numbers[0] == numbers[1] else numbers


def same(one: Setting, other: Setting) -> bool:
    """Whether two settings change the same knobs to the same values: 10 is 10..10."""
    return covers(one, other) and covers(other, one)


def covers(wide: Setting, narrow: Setting) -> bool:
    """Whether ``narrow`` only has knob values of ``wide``, as -5 and -5..0 are of -10..0."""
    return _agree(wide, narrow, _covers)


def _agree(one: Setting, other: Setting, values: Callable[[Value, Value], bool]) -> bool:
    """Whether ``values`` holds for each knob; one that a setting does not name is multiplied by 1."""
    a, b = dict(one.changes), dict(other.changes)
    # HalfCheetah's leg-length=1 is leg-length=1x, but not known to be the default.
    return all(
        values(a[knob], b[knob]) if knob in a and knob in b else {**a, **b}[knob] == _UNCHANGED
        for knob in {**a, **b}
    )


def _covers(wide: Value, narrow: Value) -> bool:
    if wide.form != "range":
        return _numbers(wide) == _numbers(narrow)
    low, high = wide.numbers
    return all(low <= number <= high for number in _numbers(narrow))


def overlap(one: Setting, other: Setting) -> bool:
    """Whether two settings share knob values: for each knob one covers the other, or ranges overlap."""
    return _agree(one, other, _overlap)


def _overlap(one: Value, other: Value) -> bool:
    if _covers(one, other) or _covers(other, one):
        return True
    if one.form != "range" or other.form != "range":
        return False
    return max(one.numbers[0], other.numbers[0]) < min(one.numbers[-1], other.numbers[-1])


def parse_setting(env: str, text: str) -> Setting:
    """The setting written as :class:`Setting` prints itself: ``default`` or ``knob=value,...``.

    Raises:
        UsageError: as :func:`parse_settings`; more than one value of a knob; or knobs that set
            the same argument, or add the same to the observation.
    """
    if text == "default":
        environment(env)
        return Setting()
    if "=" not in text:
        raise UsageError(
            f"{text!r} is not a setting",
            "write KNOB=VALUE, KNOB=VALUE,KNOB=VALUE or default; "
            f"{env} has: {', '.join(sorted(environment(env).knobs))}",
        )
    parts = text.split(",")
    if len(parts) == 1 or not all("=" in part for part in parts):
        settings = parse_settings(env, text)
        if len(settings) != 1:
            raise UsageError(
                f"{text!r} names {len(settings)} settings, but one is needed",
                "name one; several knobs of one setting are KNOB=VALUE,KNOB=VALUE",
            )
        return settings[0]
    changes = sorted(change for part in parts for change in parse_settings(env, part)[0].changes)
    arguments: dict[str, str] = {}
    added: dict[str, str] = {}
    for knob, _ in changes:
        spec = knob_of(env, knob)
        argument = spec.argument
        if argument in arguments:
            both = f"{arguments[argument]} and {knob}" if arguments[argument] != knob else knob
            raise UsageError(
                f"{text!r} sets {argument} twice, by {both}",
                "a setting has one value of each knob; repeat --setting for another setting",
            )
        arguments[argument] = knob
        if spec.observed and added.setdefault(spec.observed, knob) != knob:
            raise UsageError(
                f"{text!r} adds {spec.observed} twice, by {added[spec.observed]} and {knob}",
                "give one of them",
            )
    setting = Setting(tuple(changes))
    if len(str(setting)) > MAX_SETTING_LENGTH:
        raise UsageError(
            f"{str(setting)[:60]!r}... has more than {MAX_SETTING_LENGTH} characters",
            "change fewer knobs",
        )
    return setting


def cue_in(env: str, setting: Setting) -> tuple[Cue, float] | None:
    """The cue in ``setting`` and its strength, if it has one."""
    for knob, value in setting.changes:
        cue = knob_of(env, knob).cue
        if cue is not None:
            return cue, value.numbers[0]
    return None


def without_cue(env: str, setting: Setting) -> Setting:
    """``setting`` without its cue; itself if it has none."""
    found = cue_in(env, setting)
    if found is None:
        return setting
    rest = tuple(c for c in setting.changes if knob_of(env, c[0]).cue is None)
    return Setting(rest) if rest else parse_setting(env, found[0].base)


def env_kwargs(env: str, setting: Setting) -> dict[str, Any]:
    """The keyword arguments that make ``env`` an instance of ``setting``."""
    found = {}
    for knob, value in setting.changes:
        spec = knob_of(env, knob)
        if spec.whole:
            value = Value(value.form, tuple(map(int, value.numbers)))
        found[spec.argument] = value.argument
    return found
