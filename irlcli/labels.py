"""Short descriptions that distinguish artefacts of one stage. Listings, plans, lineages and reports use them.

They come from parameters as they are stored. These may have been written by hand, so no form is
assumed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from irlcli.methods import method_name

if TYPE_CHECKING:
    # The command line's console imports this module at every start.
    from irlcli.store import KeyRecord
    from irlcli.store.manifest import Manifest

_MAX_LENGTH = 200
_LARGEST = 2**53
# Section and field of a stage's parameters, and what they count.
_BUDGETS = (
    ("maxent", "iterations", "iterations"),
    ("clone", "epochs", "epochs"),
    ("evaluation", "episodes", "episodes"),
    ("", "episodes", "episodes"),
)


def describe(record: KeyRecord) -> str:
    """Environment, agent, settings, method, retraining and seed of an artefact, where it has them."""
    parameters = record.parameters
    settings = parameters.get("settings")
    parts = [parameters.get(name) for name in ("kind", "problem", "part")]
    parts += [environment_of(parameters), parameters.get("agent")]
    parts += settings if isinstance(settings, list | tuple) else [parameters.get("setting")]
    noise = parameters.get("noise")
    parts += [f"noise {noise}"] if noise else []
    weights = parameters.get("weights")
    if isinstance(weights, list | tuple) and weights:
        parts.append(f"lambda among {', '.join(map(_number, weights))}")
    return _joined([*parts, *_made(record)])


def environment_of(parameters: Mapping[str, Any]) -> Any:
    """The environment's name; version 0.1 called it ``env``."""
    environment = parameters.get("environment")
    return environment.get("name") if isinstance(environment, dict) else parameters.get("env")


def makers(manifests: Iterable[Manifest]) -> dict[str, KeyRecord]:
    """The record of the stage that made each output, by the output's sha256."""
    return {output.sha256: m.record for m in manifests for output in m.outputs}


def origin(record: KeyRecord, makers: Mapping[str, KeyRecord]) -> str:
    """What an evaluation's policy and a retrained policy's reward were made from, if stored.

    For a choice of lambda it is the method. ``makers`` is of :func:`makers`.
    """
    if record.stage == "choose-penalty":
        return _method_of_choice(record, makers)
    parts = []
    measured_by = record.inputs.get("reward") if record.stage == "evaluate" else None
    under = retrained(ceiling=record.parameters.get("ceiling"))
    for role in ("policy", "reward"):
        maker = makers.get(record.inputs.get(role, ""))
        measures = record.stage == "evaluate" and role == "reward"
        if maker is not None and not measures:
            setting = maker.parameters.get("setting") if maker.stage == "train-expert" else None
            parts.append(_joined(["of", maker.stage, setting, *_made(maker)]))
            record = maker
    if measured_by is not None:
        maker = makers.get(measured_by)
        reward = ["a file"] if maker is None else _made(maker)
        parts.append(_joined(["by the reward of", *reward, under]))
    return "".join(f" {part}" for part in parts)


def _method_of_choice(record: KeyRecord, makers: Mapping[str, KeyRecord]) -> str:
    """The method of the students that a choice of lambda compares; empty if none is stored."""
    for sha256 in record.inputs.values():
        measured = makers.get(sha256)
        student = measured and makers.get(measured.inputs.get("policy", ""))
        config = student and student.parameters.get("airl")
        if isinstance(config, dict) and config.get("grouping") is not None:
            return f" for {method_name(config)}"
    return ""


def budget(parameters: Mapping[str, Any]) -> str:
    """How long a stage trains or how much it measures, in which profiles differ; else empty."""
    for config in (parameters.get("airl"), parameters.get("transfer"), parameters):
        if isinstance(config, dict) and _is_count(config.get("total_steps")):
            return f"{steps_of_all_restarts(config):,} steps"
    for section, field, unit in _BUDGETS:
        config = parameters.get(section) if section else parameters
        found = config.get(field) if isinstance(config, dict) else None
        if found is None:
            continue
        counts = found if isinstance(found, list | tuple) else [found]
        if counts and all(map(_is_count, counts)):
            return _joined([", ".join(f"{count:,}" for count in counts), unit])
    return ""


def steps(config: Mapping[str, Any], budget: int | None = None) -> int:
    """Environment steps of a training with ``config``: its budget, rounded up to whole rounds."""
    total: int = config["total_steps"] if budget is None else budget
    trainer = config.get("sac" if config.get("algorithm") == "sac" else "ppo")
    if not isinstance(trainer, dict):
        return total
    sizes = [trainer.get("n_envs"), trainer.get("n_steps"), trainer.get("rollouts_per_round", 1)]
    if not all(isinstance(size, int) and size > 0 for size in sizes):
        return total
    size = math.prod(sizes)
    if not _is_count(size):
        return total
    return -(-total // size) * size


def steps_of_all_restarts(config: Mapping[str, Any]) -> int:
    """Environment steps of a training with ``config`` and of its restarts, if it has any."""
    restarts, each = config.get("restarts"), config.get("restart_steps")
    others = restarts - 1 if isinstance(restarts, int) and _is_count(restarts) else 0
    return steps(config) + others * steps(config, each if _is_count(each) else None)


def learned(config: Mapping[str, Any]) -> str:
    """How a reward was learned: its method, lambda, and what else sets it apart.

    ``config`` is ``airl`` or ``maxent``.
    """
    penalty, dropout = config.get("penalty", "none"), config.get("dropout")
    weight, select = config.get("penalty_weight"), config.get("select", "last")
    challenger, l2 = config.get("challenger"), config.get("l2")
    more = [
        f"selected by {select}" if select != "last" else None,
        "from a clone" if config.get("bc_epochs") else None,
        _averaged(config),
        "to a plateau" if config.get("plateau_rounds") else None,
        "with symmetries" if config.get("symmetries") else None,
        "with a shared absorbing state" if config.get("shared_absorbing") else None,
        _challenged(challenger) if isinstance(challenger, dict) else None,
    ]
    listed = ", ".join(filter(None, more))
    return _joined(
        [
            method_name(config) if config.get("grouping") is not None else None,
            f"lambda {_number(weight)}" if penalty != "none" else None,
            f"l2 {_number(l2)}" if l2 else None,
            f"dropping {_number(dropout)}" if dropout else None,
            f"({listed})" if listed else None,
        ]
    )


def _averaged(config: Mapping[str, Any]) -> str | None:
    if not config.get("averaged_rounds"):
        return None
    weighted = " by learning rate" if config.get("averaged_by") == "learning-rate" else ""
    return f"mean of {config['averaged_rounds']} rounds{weighted}"


def _challenged(challenger: Mapping[str, Any]) -> str | None:
    if not challenger.get("life"):
        return None
    return "with challengers" + (" per setting" if challenger.get("per_setting") else "")


def retrained(
    algorithm: Any = "ppo", ceiling: Any = None, from_student: bool = False, restarts: Any = None
) -> str:
    """How a policy was retrained; empty for PPO, once, from scratch, on a reward without a ceiling."""
    return _joined(
        [
            "from the student" if from_student else None,
            f"by {algorithm}" if algorithm != "ppo" else None,
            f"under ceiling {_number(ceiling)}" if ceiling is not None else None,
            f"best of {restarts}" if restarts else None,
        ]
    )


def retrained_as(record: KeyRecord) -> str:
    """:func:`retrained`, from the record of a transfer; empty for another stage's."""
    config = record.parameters.get("transfer")
    if not isinstance(config, dict):
        return ""
    return retrained(
        config.get("algorithm", "ppo"),
        config.get("ceiling"),
        "start" in record.inputs,
        config.get("restarts"),
    )


def _made(record: KeyRecord) -> list[Any]:
    """Method, retraining and seed of a stage that has them."""
    parameters = record.parameters
    learner = parameters.get("airl") or parameters.get("maxent")
    parts = [learned(learner)] if isinstance(learner, dict) else []
    seed = f"seed {parameters['seed']}" if "seed" in parameters else None
    return [*parts, retrained_as(record), seed]


def weight_text(value: float) -> str:
    """A weight to twelve digits, so that names tell close ones apart."""
    return f"{value:.12g}"


def _number(value: Any) -> str:
    if isinstance(value, int) and not _is_count(value):
        return "?"
    return weight_text(value) if isinstance(value, int | float) else str(value)


def _is_count(value: Any) -> bool:
    """Whether ``value`` is a whole number that a config may hold; a hostile file has any."""
    return isinstance(value, int) and abs(value) <= _LARGEST


def _joined(parts: Sequence[Any]) -> str:
    text = " ".join(str(part) for part in parts if part and part != "policy")
    if not text.isprintable():
        text = "".join(c if c.isprintable() else "?" for c in text)
    return text[:_MAX_LENGTH]


def duration(seconds: float) -> str:
    """``1:02:03`` (hours) or ``2:03`` (minutes)."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
