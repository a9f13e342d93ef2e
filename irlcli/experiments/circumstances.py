"""The parameters behind an evaluation. Only evaluations with equal ones share a line of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from irlcli.store import Artefact, Index

_KNOBS = "environment.own.knobs."


def circumstances(artefact: Artefact, index: Index) -> dict[str, Any]:
    """The parameters behind an evaluation that all its seeds share, by ``STAGE.FIELD``.

    They exclude the seeds of training, and a lambda that was chosen for each seed. The seed of the
    evaluation is included: other start states are another measurement. An input from outside the
    store contributes only its content. The names for a reward other than the policy's own begin
    with ``reward.``.
    """
    found: dict[str, Any] = {}
    pending, seen = [(artefact, "")], set[tuple[str, str]]()
    while pending:
        at, prefix = pending.pop()
        # In a crafted store an artefact may be made from itself.
        if (at.id, prefix) in seen:
            continue
        seen.add((at.id, prefix))
        record = at.manifest.record
        for name, value in flat(record.parameters):
            chosen = name == "airl.penalty_weight" and "penalty choice" in record.inputs
            # The knobs of one's own environment follow from the settings, too.
            of_settings = name in ("settings", "setting") or name.startswith(_KNOBS)
            unshared = of_settings or (name == "seed" and at is not artefact)
            if not unshared and not chosen:
                found[f"{prefix}{record.stage}.{name}"] = value
        for role in ("policy", "reward", "demonstrations"):
            measures = record.stage == "evaluate" and role == "reward"
            sha = record.inputs.get(role)
            if sha is None or (measures and by_own_reward(at, index)):
                continue
            makers = index.holders(sha)
            if role == "demonstrations":
                found[f"{prefix}{record.stage}.{role}"] = makers[0].id if makers else sha
            elif makers:
                pending.append((makers[0], "reward." if measures else prefix))
    return found


def by_own_reward(evaluation: Artefact, index: Index) -> bool:
    """Whether the policy was trained on the reward that the evaluation scored it by."""
    inputs = evaluation.manifest.record.inputs
    if "reward" not in inputs or "policy" not in inputs:
        return False
    return any(
        inputs["reward"]
        in (
            maker.manifest.record.inputs.get("reward"),
            *(output.sha256 for output in maker.manifest.outputs),
        )
        for maker in index.holders(inputs["policy"])
    )


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested parameters, by dotted name."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", list(value) if isinstance(value, tuple | list) else value
