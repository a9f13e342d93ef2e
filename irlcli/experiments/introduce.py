"""Environments from outside the package, as the artefacts made in them describe them.

An artefact's key holds what its environment is, and its provenance the whole description. Commands
that begin with an artefact know its environment from there; its module must be importable.
"""

from __future__ import annotations

from typing import Any

import msgspec

from irlcli.envs import registry
from irlcli.envs.spec import Code, EnvironmentSpec
from irlcli.errors import IntegrityError, UsageError
from irlcli.stages.base import EnvironmentKey, OwnKey, Request, key_of
from irlcli.store import Artefact


class _Made(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a stage's parameters that says where it worked."""

    environment: EnvironmentKey | None = None


def introduce(artefact: Artefact) -> None:
    """Register the environment that ``artefact`` was made in.

    An environment that the user named by its file stays.

    Raises:
        IntegrityError: the artefact holds no description of it, or one that its key contradicts.
        UsageError: an artefact before this one was made in another environment of this name.
    """
    try:
        made = msgspec.convert(artefact.manifest.record.parameters, _Made).environment
    except msgspec.ValidationError:
        # What needs the environment reports it.
        return
    if made is None or made.own is None:
        return
    if not registry.is_known(made.name):
        registry.introduce(_described(artefact, made, made.own))
        return
    known = registry.environment(made.name)
    from_artefact = known.own is not None and known.own.directory is None
    if from_artefact and not _is_made_in(known, made, made.own):
        assert known.own is not None
        raise UsageError(
            f"artefact {artefact.id} was made in another version of {made.name!r} than {known.own.source}",
            "name artefacts of one and the same environment",
        )


def described(request: Request) -> Any | None:
    """What :func:`introduce` reads: the description of the environment that ``request`` works in.

    None for a built-in environment.
    """
    made = getattr(request.parameters, "environment", None)
    spec = registry.environment(made.name) if isinstance(made, EnvironmentKey) else None
    return None if spec is None or spec.own is None else spec.own.document


def other_description(request: Request, artefact: Artefact) -> str:
    """The name of the environment that ``artefact`` describes otherwise than ``request``, if any.

    Both have one key: they differ in the budgets of later stages, for example.
    """
    document = described(request)
    recorded = artefact.provenance().get("environment") if document is not None else None
    differs = recorded is not None and recorded != document
    return request.parameters.environment.name if differs else ""


def _described(artefact: Artefact, made: EnvironmentKey, own: OwnKey) -> EnvironmentSpec:
    from irlcli.envs.own import from_document

    source = f"artefact {artefact.id}"
    document: Any = artefact.provenance().get("environment")
    if not isinstance(document, dict):
        raise IntegrityError(
            f"{source} does not describe its environment {made.name!r}", "name its file with --env"
        )
    code = Code(own.sha256, own.distribution, own.version)
    try:
        spec = from_document(document, source, None, code)
    except UsageError as error:
        raise IntegrityError(
            f"{error.message} (its description of the environment)", "name its file with --env"
        ) from None
    if not _is_made_in(spec, made, own):
        raise IntegrityError(
            f"{source}: its provenance describes another environment than its key",
            "name the environment's file with --env",
        )
    return spec


def _is_made_in(spec: EnvironmentSpec, made: EnvironmentKey, own: OwnKey) -> bool:
    """Whether ``spec`` is the environment that the key of an artefact holds."""
    if not own.knobs.keys() <= spec.knobs.keys():
        return False
    return key_of(spec, own.knobs) == msgspec.structs.replace(made, physics=spec.physics)
