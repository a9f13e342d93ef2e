"""What a report prints of its artefacts' provenance, and which similar runs it leaves out."""

from collections.abc import Iterable, Mapping
from typing import Any

from irlcli import labels
from irlcli.experiments.circumstances import flat
from irlcli.methods import method_name
from irlcli.report.parameters import Code, Others, Run
from irlcli.store import Artefact, KeyRecord, digest
from irlcli.store.artefact import stored_inputs

_Subject = tuple[Any, ...]
# With other inputs, an artefact of these stages is about something else.
_BY_INPUTS = ("transfer", "evaluate", "record", "assess", "measure-cue")


def runs(
    artefacts: Iterable[Artefact],
) -> tuple[dict[str, Run], dict[str, dict[str, str | None]]]:
    """The provenance of each artefact by id, and the sets of library versions that occur."""
    found, libraries = {}, {}
    for artefact in sorted(artefacts, key=lambda a: a.id):
        origin = artefact.provenance()
        git = origin.get("git") or {}
        versions = dict(origin.get("libraries") or {})
        # The commit tells which irlcli it was.
        versions.pop("irlcli", None)
        name = digest(versions)[:8]
        libraries[name] = versions
        record = artefact.manifest.record
        found[artefact.id] = Run(
            stage=record.stage,
            about=labels.describe(record),
            code=tuple(dict.fromkeys(_code(state) for state in origin.get("attempts") or [git])),
            libraries=name,
            seconds=origin.get("seconds"),
            resumed=origin.get("resumed"),
            inputs=tuple(sorted(set(stored_inputs(origin, record.inputs)))),
        )
    return found, libraries


def _code(state: Mapping[str, Any]) -> Code:
    return Code(commit=state.get("commit"), dirty=state.get("dirty"))


def left_out(
    artefacts: Iterable[Artefact], wanted: Iterable[KeyRecord], used: set[str]
) -> list[Others]:
    """Artefacts on the same subject as a ``wanted`` one, but with other parameters or inputs.

    They are grouped by how they differ from the most similar wanted one.
    ``used`` are the ids of those that the report does use.
    """
    # Digests, because the values in a foreign artefact may not be hashable.
    expected: dict[str, list[KeyRecord]] = {}
    for record in wanted:
        expected.setdefault(digest(_subject(record)), []).append(record)
    groups: dict[tuple[str, str, str], list[str]] = {}
    for artefact in artefacts:
        record = artefact.manifest.record
        candidates = expected.get(digest(_subject(record)), [])
        if not candidates or artefact.id in used:
            continue
        sought = min(candidates, key=lambda other: len(_differing(record, other)))
        group = record.stage, _subject_text(record), _difference(record, sought)
        groups.setdefault(group, []).append(artefact.id)
    return [
        Others(stage=stage, about=about, why=why, ids=tuple(ids))
        for (stage, about, why), ids in sorted(groups.items())
    ]


def _subject(record: KeyRecord) -> _Subject:
    """What an artefact is about. A report never mixes two that differ in anything else."""
    parameters = record.parameters
    settings = parameters.get("settings", parameters.get("setting"))
    return (
        record.stage,
        labels.environment_of(parameters),
        tuple(settings) if isinstance(settings, list | tuple) else settings,
        _method(parameters),
        parameters.get("agent"),
        parameters.get("noise"),
        # The seed of an evaluation is a parameter like another. Those of other stages tell
        # repetitions apart.
        parameters.get("seed") if record.stage != "evaluate" else None,
        tuple(sorted(record.inputs.values())) if record.stage in _BY_INPUTS else None,
    )


def _subject_text(record: KeyRecord) -> str:
    _, env, settings, method, agent, *_ = _subject(record)
    texts = [settings] if isinstance(settings, str) else list(settings or ())
    return " ".join(str(t) for t in (env, *texts, method, agent) if t and t != "policy")


def _method(parameters: Mapping[str, Any]) -> str | None:
    learner = parameters.get("airl")
    if not isinstance(learner, dict):
        return None
    return method_name(learner)


def _difference(found: KeyRecord, sought: KeyRecord) -> str:
    if found.stage_version != sought.stage_version:
        return f"version {found.stage_version} of the stage instead of {sought.stage_version}"
    here, there = dict(flat(found.parameters)), dict(flat(sought.parameters))
    names = _differing(found, sought)
    roles = sorted(found.inputs.keys() | sought.inputs.keys())
    others = [role for role in roles if found.inputs.get(role) != sought.inputs.get(role)]
    # Inputs first: parameters may be many.
    parts = [f"another input ({', '.join(others)})"] if others else []
    parts += [f"{n} {here.get(n, 'unset')} instead of {there.get(n, 'unset')}" for n in names]
    return ", ".join(parts[:4]) + (f" and {len(parts) - 4} more" if len(parts) > 4 else "")


def _differing(found: KeyRecord, sought: KeyRecord) -> list[str]:
    """The parameters in which two artefacts differ."""
    here, there = dict(flat(found.parameters)), dict(flat(sought.parameters))
    return sorted(n for n in here | there if here.get(n) != there.get(n))
