"""Invariance penalties, one small file each. Importing this loads no torch.

A penalty of adversarial learners is a function ``discriminator(logits, f, risks, options)`` of
tensors to a scalar tensor, differentiable in the discriminator's weights:

- ``logits`` [E, 2, B]: discriminator logits of E risks; label 0 is the policy, 1 the expert;
- ``f`` [E, 2, B]: their learned part, f = logits + log pi(a|s);
- ``risks`` [E]: the cross-entropy of each risk;
- ``options``: :class:`PenaltyOptions`.

A penalty of MaxEnt IRL is a function ``occupancy(phi, gap)`` of arrays to a value [R, E] and its
gradient by phi [R, E, S]; see :mod:`irlcli.penalties.irmv1`.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

from irlcli.errors import UsageError, suggest


class PenaltyOptions(NamedTuple):
    """How a penalty of adversarial learners is estimated (see ``AIRLConfig``)."""

    scaling: str = "logit"
    unbiased: bool = True


class Penalty(NamedTuple):
    """Where a penalty's functions are, and which learners it is for."""

    module: str
    learners: tuple[str, ...]


# Name to module, one line each.
PENALTIES: dict[str, Penalty] = {
    "none": Penalty("irlcli.penalties.none", ("airl", "maxent")),
    "irmv1": Penalty("irlcli.penalties.irmv1", ("airl", "maxent")),
    "closed-form": Penalty("irlcli.penalties.closed_form", ("maxent",)),
}


def check_penalty(name: str, learner: str) -> None:
    """Refuse a penalty that ``learner`` (``airl`` or ``maxent``) does not have.

    Raises:
        UsageError: unknown, or for other learners only; the hint lists those there are.
    """
    offered = sorted(n for n, penalty in PENALTIES.items() if learner in penalty.learners)
    if name not in PENALTIES:
        raise UsageError(f"unknown penalty {name!r}", suggest(name, offered))
    if name not in offered:
        raise UsageError(
            f"{learner} has no penalty {name!r}", f"{learner} has: {', '.join(offered)}"
        )


def discriminator_penalty(name: str) -> Callable[..., Any]:
    """The function ``discriminator`` of a penalty of adversarial learners."""
    return import_module(PENALTIES[name].module).discriminator


def occupancy_penalty(name: str) -> Callable[..., Any]:
    """The function ``occupancy`` of a penalty of MaxEnt IRL."""
    return import_module(PENALTIES[name].module).occupancy
