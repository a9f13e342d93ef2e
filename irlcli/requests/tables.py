"""``plan`` and ``run``: a chosen part of a table of ``settings/experiments.toml``."""

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from irlcli.configs.documents import read_toml
from irlcli.configs.load import in_profile
from irlcli.envs.spaces import check_spaces
from irlcli.errors import IntegrityError, UsageError, suggest
from irlcli.interventions import listed_settings
from irlcli.methods import METHODS
from irlcli.requests import arguments
from irlcli.requests.session import StageSession, check_path

if TYPE_CHECKING:
    from irlcli.experiments.plan import Plan
    from irlcli.experiments.status import Step
    from irlcli.experiments.tables import Table

# In a name, which may have 100 characters in all.
_LONGEST_PART = 50


class TableChoice(NamedTuple):
    """The options that choose a part of a table."""

    table: str
    seeds: str | None = None
    methods: str | None = None
    rows: str | None = None
    choose_penalty: str | None = None
    until: str | None = None
    only: str | None = None
    tag: str | None = None
    file: Path | None = None

    def row_names(self) -> list[str] | None:
        """What ``--rows`` lists. Only commas separate, because a path may contain spaces."""
        if self.rows is None:
            return None
        return [arguments.row(word.strip()) for word in self.rows.split(",") if word.strip()]

    def report_name(self, tag: str) -> str:
        """The name of the report on this choice: ``standard.table1-ant-erm-irm-seeds-0-1``, say."""
        words = [*sorted(self.row_names() or ()), *sorted(_words(self.methods or ""))]
        words += ["seeds", *sorted(_words(self.seeds))] if self.seeds else []
        part = "-".join(words)
        if len(part) > _LONGEST_PART:
            part = hashlib.sha256(part.encode()).hexdigest()[:8]
        return f"{tag}.{self.table}" + (f"-{part}" if part else "")

    def words(self) -> list[str]:
        """The options that make the same choice of rows and runs on another command line."""
        listed = {
            "--seeds": self.seeds,
            "--methods": self.methods,
            "--rows": self.rows,
            "--choose-penalty": self.choose_penalty,
            "--experiments": self.file,
        }
        return [
            word for o, value in listed.items() if value is not None for word in (o, str(value))
        ]


def needs_tag(session: StageSession, choice: TableChoice) -> bool:
    """Whether results need names of their own: their configs are not those of the profile."""
    other = session.file or session.overrides or choice.choose_penalty is not None
    return choice.tag is None and bool(other)


def check_tag(session: StageSession, choice: TableChoice, table: "Table") -> None:
    """Refuse names that are those of other results.

    Raises:
        UsageError: a tag is missing, see :func:`needs_tag`; or ``table``, of another file, has steps
            whose names are those of a shipped table with another lambda or other overrides.
    """
    from irlcli.experiments.tables import check_names, load_tables

    if needs_tag(session, choice):
        raise UsageError(
            "results with --settings, --set or --choose-penalty need names of their own",
            "add --tag NAME",
        )
    if choice.file is not None and choice.tag is None:
        shipped = load_tables()
        try:
            _check_settings(table, shipped.get(table.name))
            check_names([*shipped.values(), table])
        except UsageError as error:
            raise UsageError(error.message, f"add --tag NAME, or {error.hint}") from None


def _check_settings(table: "Table", shipped: "Table | None") -> None:
    """Refuse settings that differ from those of the ``shipped`` table of the same name."""
    if shipped is None or table.settings is None or shipped.settings is None:
        return
    if table.settings.read_bytes() != shipped.settings.read_bytes():
        raise UsageError(
            f"{table.name!r} has other settings than the shipped table of that name, so different "
            "results would have one name",
            "rename the table",
        )


def open_plan(session: StageSession, choice: TableChoice, others: Iterable[str] = ()) -> "Plan":
    """The plan of the chosen part of a table. The table's settings file becomes the session's.

    ``others`` are what the command takes in place of a table.

    Raises:
        UsageError: an unknown table, row, method, phase or step, a lambda that the table lists
            itself, or another bad or contradictory option.
    """
    from irlcli.experiments.plan import Plan, Selection
    from irlcli.experiments.rows import PHASES
    from irlcli.experiments.tables import load_table, narrowed

    if choice.only is not None and choice.until is not None:
        raise UsageError("--only takes no --until", "omit --until: --only names one step")
    if choice.file is not None:
        check_path(choice.file, "--experiments")
    table = load_table(choice.table, choice.file, others)
    table = narrowed(
        table,
        None if choice.methods is None else _words(choice.methods),
        None if choice.seeds is None else arguments.seeds(",".join(_words(choice.seeds))),
        choice.row_names(),
    )
    until = PHASES[-1] if choice.until is None else choice.until
    if until not in PHASES:
        raise UsageError(f"unknown --until {until!r}", suggest(until, PHASES))
    candidates = _candidates(session, choice, table)
    tag = _tag(table, session.profile) if choice.tag is None else choice.tag
    try:
        session.store.check_name(f"{tag}.{table.name}")
    except UsageError as error:
        raise UsageError(f"--tag {tag!r} cannot begin a name", error.hint) from None
    session.table_file = table.settings
    named = "NAME" if needs_tag(session, choice) else choice.tag
    tag_words = [] if named is None else ["--tag", named]
    listing = session.suggestion("plan", choice.table, *choice.words(), *tag_words)
    selection = Selection(tag, candidates, until, choice.only, listing)
    plan = Plan(table, selection, session.config, session.runner().lookup())
    _check_weights(session, table)
    if choice.only is None and not candidates and not arguments.weights_set(session.overrides):
        requests = [task.request for task in plan.tasks.values()]
        learned = [r.parameters.airl for r in requests if r.stage.name == "train-airl"]
        for penalty, weight in sorted({(airl.penalty, airl.penalty_weight) for airl in learned}):
            arguments.warn_of_scale(
                session.console, penalty, weight, "penalty_weights in a table of --experiments"
            )
    if choice.only is None and session.asked:
        # The processes that make one step each would repeat it. Later phases may read what the
        # first ones do not.
        every = selection._replace(until=PHASES[-1])
        whole = plan if every == selection else Plan(table, every, session.config, plan.lookup)
        session.warn_of_unread([task.request for task in whole.tasks.values()], table.name)
    for name in (*plan.tasks, choice.report_name(tag)):
        session.store.check_name(name)
    return plan


def check_worlds(plan: "Plan") -> None:
    """Refuse rows whose settings have different spaces: experts may be trained for hours first.

    Raises:
        UsageError: see :func:`irlcli.envs.spaces.check_spaces`.
    """
    for row in plan.table.rows if plan.table.kind == "comparison" else ():
        listed = plan.config(row.env).interventions[row.knob]
        check_spaces(row.env, listed_settings(row.env, row.knob, [*listed.id, *listed.ood]))


def _candidates(
    session: StageSession, choice: TableChoice, table: "Table"
) -> Sequence[float] | Literal["own"]:
    """The values of lambda that ``--choose-penalty`` lists for ``table``; none without the option.

    Raises:
        UsageError: the table has no lambda to choose, or a value is bad.
    """
    if choice.choose_penalty is None:
        return ()
    if table.kind != "comparison" or table.variants:
        hint = f"set airl.penalty_weight in [{table.name}.variants]" if table.variants else ""
        raise UsageError(f"{table.name} takes no --choose-penalty", hint or "omit --choose-penalty")
    if all(METHODS[name].penalty == "none" for name in table.methods):
        weighed = ", ".join(name for name, m in METHODS.items() if m.penalty != "none")
        raise UsageError(
            f"--choose-penalty: no method of {', '.join(table.methods)} has a penalty to weigh",
            f"add one to --methods: {weighed}",
        )
    arguments.check_chosen(session.overrides)
    return arguments.weights(choice.choose_penalty)


def _tag(table: "Table", profile: str) -> str:
    """What all names begin with: a table with settings of its own shares none with the others."""
    if table.settings is None:
        return profile
    return table.name if profile == "standard" else f"{table.name}-{profile}"


def _check_weights(session: StageSession, table: "Table") -> None:
    """Refuse a lambda for all methods where the table lists one for some of them."""
    listed = [method for method in table.methods if method in table.penalty_weights]
    given = arguments.weights_set(session.overrides)
    if session.file is not None:
        knobs = {row.knob for row in table.rows}
        for source, values in in_profile(
            str(session.file), read_toml(session.file), session.profile
        ):
            given += [f"{field} in {source}" for field in _weights_in(values, knobs)]
    if listed and given:
        raise UsageError(
            f"{given[-1]} does not apply to {', '.join(listed)}: {table.name} lists their lambda",
            "omit them from --methods, or change the table with --experiments",
        )


def _weights_in(tree: Mapping[str, Any], knobs: Set[str]) -> Iterator[str]:
    """The fields of a valid settings file that set lambda, for all interventions or for one of ``knobs``."""
    section, _, field = arguments.PENALTY_WEIGHT.partition(".")
    if field in tree.get(section, {}):
        yield arguments.PENALTY_WEIGHT
    for knob, listed in tree.get("interventions", {}).items():
        if knob in knobs and field in listed.get(section, {}):
            yield f"interventions.{knob}.{arguments.PENALTY_WEIGHT}"


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[,\s]+", text) if word]


def steps_of(plan: "Plan", warn: Callable[[str], None]) -> list[dict[str, Any]]:
    """A document for each step of ``plan``.

    ``other_versions`` says how the libraries that made an existing artefact differ from those
    present. ``warn`` receives a line for each artefact whose provenance is damaged.
    """
    documents = []
    for name in plan.tasks:
        step = plan.step(name)
        documents.append(
            {
                "name": name,
                "key": step.key,
                "status": step.status,
                "request": step.label,
                "why": step.why,
                "needs": list(plan.needs[name]),
                "other_versions": _other_versions(step, warn),
            }
        )
    return documents


def warn_of_damage(plan: "Plan", warn: Callable[[str], None]) -> None:
    """Tell ``warn`` of artefacts whose provenance is damaged: the report would fail, after all steps."""
    for name in plan.tasks:
        _other_versions(plan.step(name), warn)


def warn_of_lost_results(plan: "Plan", warn: Callable[[str], None]) -> None:
    """Tell ``warn`` of damaged artefacts: a report counts them as missing."""
    for name in plan.tasks:
        step = plan.step(name)
        if step.damaged:
            warn(f"{name} is damaged: {step.why}")


def _other_versions(step: "Step", warn: Callable[[str], None]) -> list[str]:
    from irlcli.experiments import provenance

    if step.artefact is None:
        return []
    try:
        return provenance.other_versions(step.artefact.provenance())
    except IntegrityError as error:
        if step.status == "FOUND":
            # It was read in a temporary directory if the store is behind a URL.
            what = f"the provenance of {step.artefact.id} {step.why} is damaged"
            warn(f"{what} (remove the artefact there, then compute or push it again)")
        else:
            warn(f"{error.message} ({error.hint})")
        return []
