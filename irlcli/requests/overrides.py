"""Warnings about ``--set``: fields that no stage reads, and values that something replaced."""

from collections.abc import Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import msgspec

from irlcli.configs.load import field_of, overridden
from irlcli.configs.schema import UNSET_MEANS
from irlcli.stages.base import From, Request

# A policy that begins as the student holds these values under the fields that they replace.
_OF_STUDENTS = "transfer.from_student."


def behind(request: Request) -> Iterator[Request]:
    """``request`` and all that make its inputs."""
    yield request
    for source in request.inputs.values():
        if isinstance(source, From):
            yield from behind(source.request)


def replaced(overrides: Sequence[str], requests: Iterable[Request]) -> Iterator[str]:
    """A warning for each override without effect: requests have its field, with another value.

    Fields that cannot change a result have one value in every key
    (:mod:`irlcli.configs.relevance`).
    """
    if not overrides:
        return
    made = list(requests)
    parameters = [_by_section(request) for request in made]
    for item, (field, value) in zip(overrides, overridden(overrides).items(), strict=True):
        if field.startswith(_OF_STUDENTS):
            retrained = [request for request in made if request.stage.name == "transfer"]
            if retrained and not any("start" in request.inputs for request in retrained):
                yield f"--set {item} has no effect: no policy begins as the student"
            continue
        held = {_held(field, each) for each in parameters} - {None}
        if held and _shown(field, value) not in held:
            values = " or ".join(sorted(text for text in held if text))
            yield (
                f"--set {item} counts as {values} here: the method, the environment or another option "
                "decides it, or the two values mean the same"
            )


def unread(overrides: Sequence[str], requests: Iterable[Request]) -> Iterator[str]:
    """The overrides whose field none of ``requests`` reads; none if a stage does not say."""
    read = set[str]()
    for request in requests:
        if request.stage.reads is None:
            return
        read.update(request.stage.reads)
    for item in overrides:
        field = field_of(item)
        if not any(f"{field}.".startswith(f"{part}.") for part in read):
            yield item


def _by_section(request: Request) -> Any:
    """The parameters of ``request``, under the names that a config has for them."""
    match request.stage.name:
        case "train-expert":
            return SimpleNamespace(expert=request.parameters)
        case "train-airl":
            # Challengers learn with the PPO of retrained policies, and these with that of experts.
            airl = request.parameters.airl
            ppo = SimpleNamespace(ppo=airl.challenger.ppo)
            return SimpleNamespace(airl=airl, transfer=ppo, expert=ppo)
        case "transfer":
            transfer = request.parameters.transfer
            return SimpleNamespace(transfer=transfer, expert=SimpleNamespace(ppo=transfer.ppo))
        case "sweep-maxent":
            # What the sweep varies is at its default here.
            return SimpleNamespace(maxent=request.parameters.shared)
    return request.parameters


def _held(field: str, parameters: Any) -> str | None:
    """The value of ``field`` in a request's parameters; None if they have no such field."""
    value = parameters
    for name in field.split("."):
        if not hasattr(value, name):
            return None
        value = getattr(value, name)
    return _shown(field, value)


def _shown(field: str, value: Any) -> str:
    if value is msgspec.UNSET:
        value = UNSET_MEANS.get(field.rpartition(".")[2], "unset")
    if value is None:
        return "none"
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
