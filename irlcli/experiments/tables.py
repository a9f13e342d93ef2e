"""The tables and figures of ``settings/experiments.toml``: rows, methods, seeds and measures."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
from msgspec import UNSET, UnsetType

from irlcli.configs.documents import converted, read_toml
from irlcli.configs.fields import Count, NonNegative, NonNegativeCount
from irlcli.configs.load import PROFILES, load_config, settings_directory
from irlcli.envs.announced import announced
from irlcli.envs.registry import ENVIRONMENTS, environment, is_known, resolve
from irlcli.envs.spec import EnvironmentSpec
from irlcli.errors import NotFound, UsageError, closest, suggest
from irlcli.experiments.variants import read_variants, step_name
from irlcli.interventions import knob_of
from irlcli.methods import METHODS
from irlcli.report.agents import RETRAINED
from irlcli.report.parameters import ASSESS, CUE, PARTS, Variant, has_held_out

Kind = Literal["comparison", "experts", "figure2", "control"]
Measure = Literal["transfer", "from-student", "zero-shot", "transfer-id", "id", "assess", "cue"]
MEASURES: tuple[Measure, ...] = get_args(Measure)
_NAME = r"[a-z][a-z0-9-]{0,30}"
_DEFAULTS = "defaults"
# What `irl report` writes without a table, and its title.
REPORTS = {
    "returns": "True returns of evaluations",
    "table2": "Table 2: the values of the interventions",
}
_EXAMPLES = "settings/experiments.toml"
# What every comparison lists, or a file's defaults.
_COMPARING = ("rows", "methods", "seeds", "measures")
# What a method has that learns no reward.
_OF_A_POLICY: tuple[Measure, ...] = ("zero-shot", "id")


class Row(msgspec.Struct, frozen=True):
    """One row of a table: an environment and the knob that is intervened on."""

    env: str
    knob: str

    def __str__(self) -> str:
        return f"{self.env}.{self.knob}"

    @property
    def name(self) -> str:
        """``ENV KNOB``, as reports have it."""
        return f"{self.env} {self.knob}"


class _Listed(msgspec.Struct, frozen=True, kw_only=True):
    """A table as a file lists it, see :class:`Table`. :func:`_comparison` checks its lists."""

    title: str | UnsetType = UNSET
    kind: str = "comparison"
    rows: tuple[str, ...] | UnsetType = UNSET
    methods: tuple[str, ...] | UnsetType = UNSET
    seeds: tuple[NonNegativeCount, ...] | UnsetType = UNSET
    measures: tuple[str, ...] | UnsetType = UNSET
    retrainings: Count | UnsetType = UNSET
    variants: dict[str, tuple[str, ...]] | UnsetType = UNSET
    base: str | UnsetType = UNSET
    penalty_weights: dict[str, NonNegative] | UnsetType = UNSET
    settings: str | UnsetType = UNSET


class _Defaults(msgspec.Struct, frozen=True, kw_only=True):
    """What a file's tables have unless they list their own."""

    methods: tuple[str, ...] | UnsetType = UNSET
    seeds: tuple[NonNegativeCount, ...] | UnsetType = UNSET


class Table(msgspec.Struct, frozen=True, kw_only=True):
    """One table or figure.

    Attributes:
        name: as in ``irl run NAME``.
        kind: a ``comparison`` of methods has rows, methods, seeds and measures. A file lists none
            of them for the other kinds: ``experts`` has a row for every intervention in
            ``settings/`` or of one chosen environment, ``figure2`` is about the gridworld,
            ``control`` about the exact controls.
        retrainings: of each reward, for every measure of a retrained policy.
        variants: of the config; the table then compares them instead of methods, and has one
            method. The others are compared with the first, which a file names as ``base``.
        penalty_weights: lambda of some of the methods, by name, in place of
            ``airl.penalty_weight``: it means another thing in each penalty.
        settings: a TOML file laid over the profile.
    """

    name: str
    title: str
    kind: Kind = "comparison"
    rows: tuple[Row, ...] = ()
    methods: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()
    measures: tuple[Measure, ...] = ()
    retrainings: int = 1
    variants: tuple[Variant, ...] = ()
    penalty_weights: Mapping[str, float] = {}
    settings: Path | None = None

    @property
    def compared(self) -> tuple[str, ...]:
        """The names of what the table compares: its variants, or its methods."""
        return tuple(variant.name for variant in self.variants) or self.methods


def default_file() -> Path:
    """``settings/experiments.toml``."""
    return settings_directory() / "experiments.toml"


def load_tables(path: Path | None = None) -> dict[str, Table]:
    """All tables of the file ``path``, by name. None is the default file.

    Raises:
        UsageError: not TOML; an unknown field, kind, environment, knob, method or measure; a
            missing field. The message names the file and the field.
        NotFound: this file or a row's does not exist.
    """
    path = path or default_file()
    try:
        tree = read_toml(path, "--experiments")
    except UsageError as error:
        raise UsageError(error.message, f"see {default_file()} for an example") from None
    try:
        defaults = converted(tree.pop(_DEFAULTS, {}), _Defaults, _DEFAULTS, _EXAMPLES)
        tables = {name: _table(name, value, defaults, path.parent) for name, value in tree.items()}
        check_names(tables.values())
        return tables
    except (UsageError, NotFound) as error:
        raise type(error)(f"{path}: {error.message}", error.hint) from None


def check_names(tables: Iterable[Table]) -> None:
    """Refuse two tables whose steps have one name and another config.

    Tables without settings of their own share the names of equal rows and methods. A table with
    settings shares them only with a table of the same name in another file.

    Raises:
        UsageError: names both tables.
    """
    first: dict[tuple[str, Row, str], tuple[str, Any]] = {}
    for table in tables:
        scope = "" if table.settings is None else table.name
        for row in table.rows:
            for name, config, differs, hint in _identified(table):
                other, same = first.setdefault((scope, row, name), (table.name, config))
                if same != config:
                    than = "the shipped table of that name" if other == table.name else repr(other)
                    instead = (
                        "rename the table" if scope else f"write settings = FILE in [{table.name}]"
                    )
                    raise UsageError(
                        f"{table.name!r} has {name} in {row} with {differs} than {than}, so "
                        "different results would have one name",
                        f"{instead}, or {hint}",
                    )


def _identified(table: Table) -> Iterator[tuple[str, Any, str, str]]:
    """Parts of the names of steps: what their results depend on, the difference in words, a hint."""
    names: dict[str, Any] = {m: table.penalty_weights.get(m) for m in table.methods}
    words = "another lambda", "omit penalty_weights"
    if table.variants:
        names = {f"{step_name(v)}.{m}": v.overrides for v in table.variants for m in table.methods}
        words = "other overrides", "rename the variant"
    retrained = {measure for measure in RETRAINED if measure in table.measures}
    bank = has_held_out(table.measures), retrained, table.retrainings if retrained else 0
    for name, config in names.items():
        yield name, config, *words
        if ASSESS in table.measures:
            yield f"{name}.assess", bank, "a bank of other policies", "list the same measures"


def load_table(name: str, path: Path | None = None, others: Iterable[str] = ()) -> Table:
    """The table called ``name``; ``others`` are what the command takes in place of a table.

    Raises:
        UsageError: no table has that name; or as :func:`load_tables`.
    """
    tables = load_tables(path)
    if name in REPORTS:
        raise UsageError(f"{name} has no steps", f"`irl report {name}` prints it")
    if name not in tables:
        own = "" if path is not None else "; `--experiments FILE` reads tables of your own"
        raise UsageError(f"unknown table {name!r}", suggest(name, [*others, *tables]) + own)
    table = tables[name]
    if table.kind == "experts":
        return msgspec.structs.replace(table, rows=_rows_of(*ENVIRONMENTS.values()))
    return table


def narrowed(
    table: Table,
    methods: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    rows: Sequence[str] | None = None,
) -> Table:
    """``table`` with other methods and seeds, and only some of its rows.

    Args:
        table: as the file has it.
        methods: instead of the table's.
        seeds: instead of the table's.
        rows: environments, for all their rows, and single rows such as ``ant.friction``. The
            experts' table has rows of every environment that can be named, also of one's own.

    Raises:
        UsageError: an unknown or repeated method, seed or row, an empty list, a table of a kind
            without them, or measures that a method does not have.
    """
    given = {"--methods": methods, "--seeds": seeds}
    if table.kind != "comparison":
        given |= {"--rows": rows} if table.kind in ("figure2", "control") else {}
        for option, value in given.items():
            if value is not None:
                raise UsageError(f"{table.name} takes no {option}", f"omit {option}")
    changes: dict[str, Any] = {}
    if methods is not None:
        _check_list("--methods", methods, METHODS)
        _check_rewards("--methods", methods, table.measures)
        if table.variants:
            _check_single("--methods", methods)
        changes["methods"] = tuple(methods)
    if seeds is not None:
        _check_list("--seeds", seeds)
        changes["seeds"] = tuple(seeds)
    if rows is not None:
        offered = table.rows
        if table.kind == "experts":
            own = {name.partition(".")[0] for name in rows} - {*ENVIRONMENTS}
            offered += _rows_of(
                *(environment(env) for env in sorted(own) if is_known(env) or env in announced())
            )
        names = {name: None for row in offered for name in (row.env, str(row))}
        _check_list("--rows", rows, names)
        changes["rows"] = tuple(row for row in offered if {row.env, str(row)} & set(rows))
    return msgspec.structs.replace(table, **changes)


def _rows_of(*environments: EnvironmentSpec) -> tuple[Row, ...]:
    """Every intervention that the settings list, and that has experts of its own."""
    return tuple(
        Row(env.name, knob)
        for env in environments
        if not env.tabular
        for knob in load_config(env.name).interventions
        if env.knobs[knob].cue is None
    )


def _table(name: str, value: Any, defaults: _Defaults, directory: Path) -> Table:
    if not re.fullmatch(_NAME, name):
        raise UsageError(
            f"{name!r} cannot be the name of a table",
            "a lowercase letter, then up to 30 lowercase letters, digits and '-'",
        )
    if name in REPORTS:
        raise UsageError(f"{name!r} is a report of its own", "give the table another name")
    if name in PARTS:
        raise UsageError(
            f"{name!r} is a file of every table's report", "give the table another name"
        )
    listed = converted(value, _Listed, name, _EXAMPLES)
    title = name if listed.title is UNSET else listed.title
    if not title.isprintable():
        raise UsageError(
            f"{name}.title: {title!r} has control characters", "write one line of text"
        )
    settings = None if listed.settings is UNSET else directory / listed.settings
    if settings is not None and not settings.is_file():
        raise UsageError(
            f"{name}.settings: {settings} is not a file",
            f"name a file; relative paths begin in {directory}",
        )
    profiled = next((p for p in PROFILES if f"-{name}".endswith(f"-{p}")), None)
    if settings is not None and profiled is not None:
        raise UsageError(
            f"{name!r} cannot be the name of a table with settings of its own: its results would have "
            f"the names of those of --profile {profiled}",
            "give the table another name",
        )
    kind = _one_of(f"{name}.kind", listed.kind, get_args(Kind))
    table = Table(name=name, title=title, kind=kind, settings=settings)
    if kind != "comparison":
        for field in (*_COMPARING, "retrainings", "variants", "base", "penalty_weights"):
            if getattr(listed, field) is not UNSET:
                raise UsageError(f"{name}.{field}: kind {kind!r} has no {field}", f"omit {field}")
        return table
    given = {f: v for f, v in msgspec.structs.asdict(listed).items() if v is not UNSET}
    filled = msgspec.structs.replace(listed, **(msgspec.structs.asdict(defaults) | given))
    for field in _COMPARING:
        if getattr(filled, field) is UNSET:
            fields = ", ".join(_Listed.__struct_fields__)
            raise UsageError(f"{name}.{field} is missing", f"fields: {fields}")
    return msgspec.structs.replace(table, **_comparison(name, filled, directory))


def _comparison(name: str, filled: _Listed, directory: Path) -> dict[str, Any]:
    """The fields of a table that compares methods or variants."""
    methods, seeds, measures = filled.methods or (), filled.seeds or (), filled.measures or ()
    _check_list(f"{name}.measures", measures, MEASURES)
    rows = [_row(f"{name}.rows", text, directory, measures) for text in filled.rows or ()]
    _check_list(f"{name}.rows", rows)
    _check_list(f"{name}.methods", methods, METHODS)
    _check_rewards(f"{name}.methods", methods, measures)
    if set(measures) <= {ASSESS, CUE}:
        raise UsageError(
            f"{name}.measures: {' and '.join(measures)} alone fills no cell of a table",
            "add transfer, zero-shot or id",
        )
    _check_list(f"{name}.seeds", seeds)
    weights = filled.penalty_weights or {}
    penalised = [method for method in METHODS if METHODS[method].penalty != "none"]
    for method in weights:
        _one_of(f"{name}.penalty_weights", method, penalised)
        if method not in methods:
            raise UsageError(
                f"{name}.penalty_weights: {method} is not among the methods of {name}",
                f"omit it, or add {method} to {name}.methods",
            )
    if (filled.retrainings or 1) > 1 and not {*RETRAINED} & {*measures}:
        raise UsageError(
            f"{name}.retrainings: {', '.join(measures)} retrains no policy", "omit retrainings"
        )
    return {
        "rows": tuple(rows),
        "methods": methods,
        "seeds": seeds,
        "measures": measures,
        "retrainings": filled.retrainings or 1,
        "variants": _variants(name, filled, methods, measures),
        "penalty_weights": weights,
    }


def _variants(
    name: str, filled: _Listed, methods: Sequence[str], measures: Sequence[str]
) -> tuple[Variant, ...]:
    if filled.variants is UNSET:
        if filled.base is not UNSET:
            raise UsageError(
                f"{name}.base: {name} has no variants", f"add [{name}.variants], or omit base"
            )
        return ()
    variants = read_variants(f"{name}.variants", filled.variants, filled.base or None)
    _check_single(f"{name}.methods", methods)
    if "transfer-id" not in measures:
        raise UsageError(
            f"{name}.measures: variants are compared by policies retrained in distribution",
            "add transfer-id",
        )
    if filled.penalty_weights is not UNSET:
        raise UsageError(
            f"{name}.penalty_weights: a table of variants has one method",
            f"omit it, and write airl.penalty_weight=VALUE in {name}.variants",
        )
    return variants


def _row(field: str, text: str, directory: Path, measures: Sequence[str]) -> Row:
    """A row such as ``ant.mass``, or ``hopper.toml.mass`` with a file beside the table's."""
    env, dot, knob = text.rpartition(".") if ".toml." in text else text.partition(".")
    if not dot:
        raise UsageError(
            f"{field}: {text!r} names no intervention", f"write {text}.KNOB: `irl envs show {text}`"
        )
    try:
        spec = resolve(str(directory / env)) if env.endswith(".toml") else _named(env, text)
        has_cue = knob_of(spec.name, knob).cue is not None
    except (UsageError, NotFound) as error:
        raise type(error)(f"{field}: {error.message}", error.hint) from None
    if CUE in measures and not has_cue:
        raise UsageError(
            f"{field}: {text!r} has no cue to measure",
            "list rows of cue-strength only, or omit the measure cue",
        )
    return Row(spec.name, knob)


def _named(env: str, text: str) -> EnvironmentSpec:
    """The environment called ``env``, of which the row ``text`` is."""
    try:
        spec = environment(env)
        if not spec.tabular:
            return spec
    except UsageError:
        pass
    fit = [e for e in ENVIRONMENTS.values() if not e.tabular]
    close = closest(text, [f"{e.name}.{k}" for e in fit for k in sorted(e.knobs)])
    hint = f"did you mean {close!r}? " if close else ""
    raise UsageError(
        f"{text!r} names no environment that rows can be of",
        f"{hint}write ENVIRONMENT.INTERVENTION, with one of: {', '.join(e.name for e in fit)}, or "
        "a TOML file that describes one",
    )


def _check_list(field: str, values: Sequence[Any], known: Mapping | Sequence | None = None) -> None:
    """Refuse an empty list, unknown values and repetitions."""
    if not values:
        raise UsageError(f"{field}: the list is empty", "name at least one")
    for i, value in enumerate(values):
        if known is not None:
            _one_of(field, value, list(known))
        if value in values[:i]:
            raise UsageError(f"{field}: {value} appears twice", "name each once")


def _check_single(field: str, methods: Sequence[str]) -> None:
    if len(methods) > 1:
        raise UsageError(f"{field}: variants are compared within one method", "name one method")


def _check_rewards(field: str, methods: Sequence[str], measures: Sequence[str]) -> None:
    """Refuse measures of a reward for a method that learns none."""
    refused = [measure for measure in measures if measure not in _OF_A_POLICY]
    for name in methods:
        if refused and not METHODS[name].learns_reward:
            raise UsageError(
                f"{field}: {name} learns no reward, so it has no {', '.join(refused)}",
                f"{name} has: {', '.join(_OF_A_POLICY)}; use a table of these, or omit {name}",
            )


def _one_of(field: str, value: Any, known: Sequence[str]) -> Any:
    if value not in known:
        raise UsageError(f"{field}: unknown {value!r}", suggest(str(value), known))
    return value
