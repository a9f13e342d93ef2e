"""Penalties: terms that are added to the risks, times lambda. One small file each; no torch is loaded.

A penalty of adversarial learners is a function ``discriminator(samples, options)`` of
:class:`Samples` to a scalar tensor, differentiable in the discriminator's weights. A constant is
refused at lambda > 0.

A penalty of MaxEnt IRL is a function ``occupancy(at)`` of :class:`Occupancies` to a value [R, K]
and its gradient with respect to phi [R, K, S].
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec import UNSET, UnsetType

from irlcli.errors import UsageError, imported, suggest
from irlcli.methods import METHODS

if TYPE_CHECKING:
    import numpy as np
    import torch


class Samples(NamedTuple):
    """What a penalty of adversarial learners sees of a minibatch.

    Attributes:
        logits: of the discriminator [E, 2, B]: E risks, label 0 is the policy and 1 the expert.
        f: their learned part [E, 2, B], f = logits + log pi(a|s), or the logits
            themselves where those have no log pi (``airl.logit = "f"``).
        risks: the cross-entropy of each risk [E].
        weights: of the risks in the loss [E]. Only group-dro uses them; to the other penalties all
            risks are equal.
        parameters: what the discriminator learns.
        input_gradient: the mean squared gradient of g by its input, a scalar, computed when called.
    """

    logits: "torch.Tensor"
    f: "torch.Tensor"
    risks: "torch.Tensor"
    weights: "torch.Tensor"
    parameters: "tuple[torch.Tensor, ...]" = ()
    input_gradient: "Callable[[], torch.Tensor] | None" = None


class PenaltyOptions(NamedTuple):
    """How a penalty of adversarial learners is estimated (see ``AIRLConfig``).

    Attributes:
        scaling: ``logit`` or ``reward``.
        unbiased: by half-batches; otherwise by the whole batch.
        weight: lambda, at least 0.
    """

    scaling: str = "logit"
    unbiased: bool = True
    weight: float = 1.0


class Occupancies(NamedTuple):
    """What a penalty of MaxEnt IRL sees of R runs with K risks (see ``irlcli.learners.maxent.Risks``).

    Attributes:
        phi: [R, S], the reward of each state, or of each kind of state.
        gap: [R, K, S], rho_E - rho_pi; a risk's gradient with respect to phi is -gap.
        weights: [R, K], of the risks; a row sums to one. Zero where a run has fewer than K risks.
        risks: [R, K], mean negative log-likelihoods [nats per episode].
        response: computes d gap / dw [R, K, S] at w = 1 for the reward w phi. By symmetry this is
            also (d gap / d phi) phi. It costs a second solution.
        weight: [R], lambda, at least 0.
    """

    phi: "np.ndarray"
    gap: "np.ndarray"
    weights: "np.ndarray"
    risks: "np.ndarray"
    response: "Callable[[], np.ndarray]"
    weight: "np.ndarray"


# The fields of ``[airl]`` that some penalties read.
READABLE = ("penalty_scaling", "penalty_estimate")


class Penalty(NamedTuple):
    """A penalty's module, and what the learners must know of it.

    Attributes:
        module: its path.
        learners: ``airl`` if it has a function ``discriminator``, ``maxent`` if ``occupancy``.
        compares: whether it compares risks with each other, so that it needs at least two.
        reads: which of ``airl.penalty_scaling`` and ``airl.penalty_estimate`` can change it.
        candidates: values of lambda to choose from, the same number for each penalty, each on the
            penalty's own scale.
        bounded: whether lambda times the penalty is bounded for any lambda, so that the loss is not
            divided by lambda.
        additive: whether it reads ``Samples.parameters`` or ``input_gradient``. The penalty of several
            networks at once must then be the sum of each one's: the controls train them so.
        version: a change that alters its results must raise it. It is part of the keys of learned
            rewards. The stages of the controls have versions of their own: raise them, too.
    """

    module: str
    learners: tuple[str, ...]
    compares: bool = False
    reads: tuple[str, ...] = READABLE
    candidates: tuple[float, ...] = (1.0, 100.0, 10_000.0)
    bounded: bool = False
    additive: bool = False
    version: int = 1


# Name to module, one line each.
PENALTIES: dict[str, Penalty] = {
    "none": Penalty("irlcli.penalties.none", ("airl", "maxent"), reads=()),
    "irmv1": Penalty("irlcli.penalties.irmv1", ("airl", "maxent")),
    "irmv1-full": Penalty("irlcli.penalties.irmv1_full", ("maxent",)),
    "closed-form": Penalty("irlcli.penalties.closed_form", ("maxent",)),
    "vrex": Penalty("irlcli.penalties.vrex", ("airl", "maxent"), True, ("penalty_estimate",)),
    "group-dro": Penalty(
        "irlcli.penalties.group_dro",
        ("airl", "maxent"),
        True,
        (),
        (1.0, 10.0, 100.0),
        bounded=True,
        version=2,
    ),
    "iga": Penalty("irlcli.penalties.iga", ("airl",), True, ("penalty_estimate",), additive=True),
    "input-gradient": Penalty(
        "irlcli.penalties.input_gradient",
        ("airl",),
        reads=(),
        candidates=(0.1, 1.0, 10.0),
        additive=True,
    ),
    "l2": Penalty(
        "irlcli.penalties.l2", ("airl",), reads=(), candidates=(1e-4, 1e-3, 1e-2), additive=True
    ),
}


def maxent_methods() -> list[str]:
    """The names of the methods that MaxEnt IRL has as well: AIRL's, by penalties of its own."""
    return [
        method.name
        for method in METHODS.values()
        if method.learner == "airl"
        and not method.sets
        and "maxent" in PENALTIES[method.penalty].learners
    ]


def check_penalty(name: str, learner: str) -> None:
    """Refuse a penalty that ``learner`` (``airl`` or ``maxent``) does not have.

    Raises:
        UsageError: unknown, or for other learners only; the hint lists those there are.
    """
    offered = sorted(n for n, penalty in PENALTIES.items() if learner in penalty.learners)
    if name not in PENALTIES:
        raise UsageError(f"unknown penalty {name!r}", suggest(name, offered))
    for field in PENALTIES[name].reads:
        if field not in READABLE:
            raise UsageError(
                f"penalty {name!r} reads {field!r}, which is not an option of penalties",
                suggest(field, READABLE),
            )
    if name not in offered:
        raise UsageError(
            f"{learner} has no penalty {name!r}", f"{learner} has: {', '.join(offered)}"
        )


def check_risks(name: str, grouping: str, settings: int) -> None:
    """Refuse a penalty that compares risks, and shuffled labels, where there is only one.

    Raises:
        UsageError: one setting, or a grouping that makes one risk of all.
    """
    if grouping == "shuffled" and settings < 2:
        raise UsageError(
            "one setting has no labels to shuffle",
            "train in another setting as well, or use the method irm",
        )
    if not PENALTIES[name].compares:
        return
    if settings < 2:
        raise UsageError(
            f"penalty {name!r} compares settings and needs at least two to train on, not one",
            "penalty irmv1 works with one; or train in another setting as well",
        )
    if grouping not in ("per-setting", "shuffled"):
        raise UsageError(
            f"penalty {name!r} compares risks, and grouping {grouping!r} makes one of all settings",
            "--grouping per-setting, or shuffled as a control",
        )


def loss_divisor(name: str, weight: float) -> float:
    """What a loss with lambda = ``weight`` is divided by, which keeps the gradient's size.

    max(1, lambda), but 1 for a penalty that is bounded.
    """
    return 1.0 if PENALTIES[name].bounded else max(1.0, weight)


def penalty_version(name: str) -> int | UnsetType:
    """The version of a penalty for keys: unset, and so not part of the key, while it is 1."""
    version = PENALTIES[name].version
    return UNSET if version == 1 else version


def discriminator_penalty(name: str) -> "Callable[[Samples, PenaltyOptions], torch.Tensor]":
    """The function ``discriminator`` of a penalty of adversarial learners.

    Raises:
        StageFailed: it cannot be imported.
    """
    return _function(name, "discriminator")


def occupancy_penalty(name: str) -> "Callable[[Occupancies], tuple[np.ndarray, np.ndarray]]":
    """The function ``occupancy`` of a penalty of MaxEnt IRL.

    Raises:
        StageFailed: it cannot be imported.
    """
    return _function(name, "occupancy")


def _function(name: str, function: str) -> Any:
    return imported(f"penalty {name!r}", f"{PENALTIES[name].module}:{function}")
