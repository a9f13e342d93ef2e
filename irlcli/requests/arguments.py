"""Text of options as settings, counts and numbers."""

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from irlcli.configs.fields import MAX_COUNT, NonNegative
from irlcli.configs.load import field_of
from irlcli.envs.registry import environment, resolve
from irlcli.errors import UsageError, suggest
from irlcli.interventions import (
    Setting,
    check_distinct,
    check_observed,
    examples_of,
    knob_of,
    listed_settings,
    overlap,
    parse_setting,
    parse_settings,
)

if TYPE_CHECKING:
    from irlcli.configs import AIRLConfig, Config, MaxEntConfig
    from irlcli.data.descriptions import Policy, Reward
    from irlcli.experiments.runner import RunConsole
    from irlcli.stages.base import Source
    from irlcli.store import Store

PENALTY_WEIGHT = "airl.penalty_weight"


class Where(NamedTuple):
    """``--ood`` or ``--intervention`` as given, and the texts of ``--setting``."""

    text: str | None
    kind: Literal["id", "ood"]
    several: Sequence[str]

    @property
    def given(self) -> bool:
        """Whether any setting is named."""
        return self.text is not None or bool(self.several)

    def settings(
        self, env: str, config: "Config", origin: "Reward | Policy | None" = None
    ) -> list[Setting]:
        """The named settings.

        Raises:
            UsageError: malformed, named twice, or with other observations than ``origin``'s.
        """
        settings = [parse_setting(env, text) for text in self.several]
        if self.text is not None:
            option = "--ood" if self.kind == "ood" else "--intervention"
            named = named_settings(env, config, self.text, self.kind, option, origin)
            settings = [*named, *settings]
        if origin is not None:
            check_observed(env, origin.settings, settings)
        check_distinct("the command", settings)
        return settings

    def check_ordered(self, what: str) -> None:
        """Refuse options whose settings have no order among them, where ``what`` needs one.

        Raises:
            UsageError: ``--intervention`` and ``--setting`` are both given.
        """
        if self.text is not None and self.several:
            raise UsageError(
                f"{what} follow the order of the settings, but there is no order between "
                "--intervention and --setting",
                "name all settings with --setting only, in that order",
            )


def where(ood: str | None, intervention: str | None, several: Sequence[str]) -> Where:
    """The settings that the options name.

    Raises:
        UsageError: ``--ood`` and ``--intervention`` are both given.
    """
    if ood is not None and intervention is not None:
        raise UsageError("--ood and --intervention both name settings", "give one of them")
    return Where(intervention, "id", several) if ood is None else Where(ood, "ood", several)


def named_settings(
    env: str,
    config: "Config",
    text: str,
    kind: Literal["id", "ood"],
    option: str,
    origin: "Reward | Policy | None" = None,
) -> Sequence[Setting]:
    """The settings that ``text``, the value of ``option``, names.

    ``knob=3x,4x``. A knob alone stands for its values in the settings file, those of ``kind``.
    ``3x,4x`` alone are values of the knob that ``origin`` was trained with.

    Raises:
        UsageError: malformed or empty.
    """
    if "=" in text:
        return parse_settings(env, text)
    if text in config.interventions:
        values = getattr(config.interventions[text], kind)
        if not values:
            raise UsageError(
                f"the settings file lists no {kind.upper()} values of {text!r}",
                f"write {text}=VALUE,VALUE",
            )
        return listed_settings(env, text, values)
    if origin is None and not text.strip(" ,"):
        raise UsageError(f"{option} is empty", f"write {option} KNOB=VALUE,VALUE")
    if origin is None and not text[:1].isalpha():
        raise UsageError(
            f"{text!r} names no knob of {env}",
            f"write KNOB={text}; {env} has: {', '.join(sorted(environment(env).knobs))}",
        )
    if origin is None or text in environment(env).knobs:
        knob_of(env, text)
        raise UsageError(
            f"the settings of {env} list no values of {text!r}", f"write {text}=VALUE,VALUE"
        )
    knobs = {knob for other in origin.settings for knob in parse_setting(env, other).knobs}
    if len(knobs) != 1:
        hint = "write KNOB=VALUE, or --setting KNOB=VALUE,KNOB=VALUE"
        raise UsageError(f"{text!r} names no intervention", hint)
    (knob,) = knobs
    if text[:1].isalpha():
        raise UsageError(
            f"{text!r} is no value of {knob} and no knob of {env}",
            f"write a value like {examples_of(environment(env).knobs[knob])}"
            f"{_listed(config, knob, kind)}; or KNOB=VALUE, {suggest(text, environment(env).knobs)}",
        )
    try:
        return parse_settings(env, f"{knob}={text}")
    except UsageError as error:
        raise UsageError(error.message, error.hint + _listed(config, knob, kind)) from None


def warn_of_seen(
    console: "RunConsole", settings: Sequence[Setting], origin: "Reward | Policy", ref: str
) -> None:
    """Warn of each ``--ood`` setting that ``origin``, which ``ref`` names, has seen."""
    trained = [parse_setting(origin.env, text) for text in origin.settings]
    selected = origin.selected_in
    for setting in settings:
        if setting in trained:
            console.warn(f"{setting} is not held out: {ref!r} was trained in it")
        elif seen := [other for other in trained if overlap(setting, other)]:
            console.warn(f"{setting} is not held out: {ref!r} was trained in {seen[0]}")
        elif selected and overlap(setting, parse_setting(origin.env, selected)):
            console.warn(f"{setting} is not held out: it selected the round of {ref!r}")


def _listed(config: "Config", knob: str, kind: Literal["id", "ood"]) -> str:
    """The values of a knob in the settings file, as the end of a hint."""
    known = config.interventions.get(knob)
    values = () if known is None else getattr(known, kind)
    what = "held-out" if kind == "ood" else "training"
    return f"; {what} values in the settings file: {', '.join(values)}" if values else ""


def experts(
    store: "Store", env: str, texts: Sequence[str]
) -> tuple[dict[Setting, "Source"], dict[Setting, "Source"]]:
    """``--expert SETTING=EXPERT``, repeated: experts, and statistics of ``EXPERT.zip+STATISTICS``.

    Raises:
        UsageError: malformed, a setting with two experts, or a policy of another environment or of
            other observations.
        NotFound: no such file or artefact.
    """
    from irlcli.experiments.references import expert, normaliser

    found: dict[Setting, Source] = {}
    normalisers: dict[Setting, Source] = {}
    for text in texts:
        setting, ref = _expert(env, text)
        if setting in found:
            raise UsageError(
                f"--expert names two experts of {setting}", "name one for each setting"
            )
        model, plus, statistics = ref.partition(".zip+")
        if plus:
            ref, normalisers[setting] = f"{model}.zip", normaliser(statistics)
        found[setting] = expert(store, env, setting, ref)
    return found, normalisers


def _expert(env: str, text: str) -> tuple[Setting, str]:
    """The setting, and the file or reference. Both may contain ``=``."""
    first: UsageError | None = None
    for at in reversed([i for i, letter in enumerate(text) if letter == "="]):
        try:
            return parse_setting(env, text[:at]), text[at + 1 :]
        except UsageError as error:
            first = first or error
    raise UsageError(
        f"--expert {text!r}: {first.message if first else 'it names no setting'}",
        "write KNOB=VALUE=FILE, for example mass=1x=expert.zip",
    )


def env_name(ref: str | None) -> str | None:
    """Registers the environment that ``--env`` names; returns its name.

    Raises:
        UsageError, NotFound: no such environment, or a malformed file.
    """
    return None if ref is None else resolve(ref).name


def row(text: str) -> str:
    """A word of ``--rows``, with an environment's name in place of its file.

    ``cart.toml.mass`` becomes ``cart.mass``. The table says which rows it has.

    Raises:
        UsageError, NotFound: a file that does not exist or is malformed.
    """
    file = re.fullmatch(r"(.*\.toml)(\.[^/.]+)?", text)
    return text if file is None else resolve(file[1]).name + (file[2] or "")


def check_scorer(learned: str, policy: str, env: str) -> None:
    """Refuse to score ``policy``, which acts in ``env``, by a reward ``learned`` in another environment.

    Raises:
        UsageError: names both environments.
    """
    if learned != env:
        raise UsageError(
            f"{policy!r} is a policy of {env}, but the reward is one of {learned}",
            "name a reward of the policy's environment",
        )


def check_env(ref: str, learned: str, wanted: str | None) -> None:
    """Refuse ``--env`` if it is not the environment that ``ref`` belongs to.

    Raises:
        UsageError: another environment.
    """
    if wanted is not None and wanted != learned:
        hint = "omit --env"
        if environment(wanted).own is not None:
            hint += (
                "; a copy of an environment's file is a new environment unless both set the same name "
                "in [env]"
            )
        raise UsageError(f"{ref!r} belongs to {learned}, not to {wanted}", hint)


def counts(text: str) -> tuple[int, ...]:
    """``--episodes``: ``10``, or ``1,3,10`` for three settings.

    Raises:
        UsageError: not a list of whole numbers.
    """
    try:
        return _whole_numbers(text)
    except ValueError:
        raise UsageError(
            f"--episodes {text!r} is not a list of counts", "write 10, or 1,3,10 for three settings"
        ) from None


def seeds(text: str) -> tuple[int, ...]:
    """``--seeds``: ``0,1,2,3,4``.

    Raises:
        UsageError: not a list of whole numbers from 0 to :data:`MAX_COUNT`.
    """
    try:
        numbers = _whole_numbers(text)
    except ValueError:
        raise UsageError(
            f"--seeds {text!r} is not a list of seeds", f"write {_list_of(text)}"
        ) from None
    if min(numbers) < 0 or max(numbers) > MAX_COUNT:
        raise UsageError(f"--seeds {text!r} is out of range", f"seeds are from 0 to {MAX_COUNT}")
    return numbers


def _whole_numbers(text: str) -> tuple[int, ...]:
    """Whole numbers between commas.

    Raises:
        ValueError: anything else, also what int() takes besides digits: ``1_000``, ``+1``.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(re.fullmatch("0|-?[1-9][0-9]*", part) for part in parts):
        raise ValueError(text)
    return tuple(map(int, parts))


def _list_of(text: str) -> str:
    """The list that somebody meant who wrote ``0-2``, ``0..2`` or ``0:2``; otherwise an example."""
    found = re.fullmatch(r"\s*(\d{1,9})\s*(?:-|\.\.+|:)\s*(\d{1,9})\s*", text)
    if not found or int(found[1]) >= int(found[2]):
        return "0,1,2,3,4"
    first, last = int(found[1]), int(found[2])
    if last - first < 10:
        return ",".join(str(seed) for seed in range(first, last + 1))
    return f"{first},{first + 1}, and so on to {last}"


def weights(text: str) -> list[float] | Literal["own"]:
    """``--choose-penalty``: ``0.1,1,10``, or ``own`` for those of each penalty.

    Raises:
        UsageError: not a list of finite numbers from 0 up.
    """
    if text == "own":
        return "own"
    try:
        parts = [part.strip() for part in text.split(",")]
        return msgspec.convert(parts, list[NonNegative], strict=False)
    except msgspec.ValidationError:
        raise UsageError(
            f"--choose-penalty {text!r} is not a list of numbers from 0 up",
            "write 0.1,1,10, or own for those of each penalty",
        ) from None


def weights_set(overrides: Sequence[str]) -> list[str]:
    """The ``--set`` options that set lambda of AIRL."""
    return [f"--set {item}" for item in overrides if field_of(item) == PENALTY_WEIGHT]


def check_chosen(overrides: Sequence[str], penalty_weight: float | None = None) -> None:
    """Refuse a lambda that is given beside ``--choose-penalty``, which would replace it.

    Raises:
        UsageError: names both.
    """
    given = weights_set(overrides)
    given += [] if penalty_weight is None else ["--penalty-weight"]
    if given:
        raise UsageError(f"{given[-1]} and --choose-penalty both set lambda", "give one of them")


def method_fields(
    learner: Literal["airl", "maxent"],
    method: str | None,
    grouping: str | None,
    penalty: str | None,
) -> dict[str, Any]:
    """Config fields of ``--method``, and of ``--grouping`` and ``--penalty``, which override it.

    Raises:
        UsageError: an unknown method, or a method or a penalty that the learner does not have.
    """
    from irlcli.methods import METHODS, fields
    from irlcli.penalties import check_penalty, maxent_methods

    if method is not None and learner == "maxent":
        offered = maxent_methods()
        if method not in METHODS:
            raise UsageError(f"unknown method {method!r}", suggest(method, offered))
        if method not in offered:
            raise UsageError(
                f"MaxEnt IRL has no method {method!r}", f"it has: {', '.join(offered)}"
            )
    found = fields(method, learner) if method is not None else {}
    if grouping is not None:
        found[f"{learner}.grouping"] = grouping
    if penalty is not None:
        check_penalty(penalty, learner)
        found[f"{learner}.penalty"] = penalty
    return found


def check_weighted(
    name: str, methods: Iterable[str], penalty: str, penalty_weight: float | None
) -> None:
    """Refuse ``--penalty-weight`` for a method without a penalty; ``methods`` are the learner's.

    Raises:
        UsageError: the weight would have no effect.
    """
    if penalty_weight is not None and penalty == "none":
        from irlcli.methods import METHODS

        penalised = [method for method in methods if METHODS[method].penalty != "none"]
        raise UsageError(
            f"--penalty-weight {penalty_weight:g}: {name} has no penalty",
            f"omit --penalty-weight; methods with a penalty: {', '.join(penalised)}",
        )


def warn_of_weight(console: "RunConsole", name: str, config: "AIRLConfig | MaxEntConfig") -> None:
    """Warn if lambda is 0, which turns off the penalty that ``name`` is called after."""
    if config.penalty != "none" and config.penalty_weight == 0:
        console.warn(f"lambda is 0: {name} learns without its penalty, {config.penalty}")


def warn_of_several(
    console: "RunConsole", config: "Config", section: str, settings: Sequence[Setting]
) -> None:
    """Warn if several knobs in ``settings`` have a ``section`` of their own: none of them applies."""
    knobs = config.knobs_with(section, settings)
    if len(knobs) > 1:
        console.warn(
            f"{' and '.join(knobs)} each have their own [{section}], and these cannot be combined: the "
            f"environment's [{section}] is used; change that one with --set or --settings"
        )


def warn_of_scale(console: "RunConsole", penalty: str, weight: float, setter: str) -> None:
    """Warn if AIRL's lambda, meant for another penalty, does not suit ``penalty``.

    Lambda means another thing in each penalty, and settings files hold one value. ``setter`` is what
    sets it for this penalty alone.
    """
    from irlcli.penalties import PENALTIES

    suited = PENALTIES[penalty].candidates
    own = suited != PENALTIES["irmv1"].candidates
    if own and weight > 0 and not suited[0] <= weight <= suited[-1]:
        console.warn(
            f"lambda {weight:g} is outside the range of {penalty}, {suited[0]:g} to {suited[-1]:g}: "
            f"set it by {setter}, or choose it with --choose-penalty own"
        )
