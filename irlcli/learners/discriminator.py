"""The discriminator's loss: cross-entropies of risks, and an invariance penalty (paper Eq. 2 to 5).

Samples are laid out [E, 2, B]: E risks, label 0 = policy and 1 = expert, B samples of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch

from irlcli.configs.schema import AIRLConfig
from irlcli.errors import StageFailed
from irlcli.learners.pools import Minibatch, Pool, Stratum, sample_minibatch
from irlcli.learners.reward_model import RewardModel
from irlcli.penalties import PenaltyOptions, Samples, discriminator_penalty, loss_divisor
from irlcli.penalties.risk import cross_entropy

# Samples of either label behind each setting's diagnostics.
_DIAGNOSTIC_SAMPLES = 1024


def discriminator_logits(
    model: RewardModel, batch: Minibatch, form: str = "f-log-pi"
) -> tuple[torch.Tensor, torch.Tensor]:
    """(logits, f), each [E, 2, B]. The sigmoid of the logits is D.

    ``form`` is ``f-log-pi`` (paper Eq. 2) or ``f`` (the discriminator of GAIL, Ho and Ermon 2016).
    """
    f = model(batch.observations, batch.actions, batch.next_observations, batch.terminated)
    return (f if form == "f" else f - batch.log_probs), f


def gradient_penalty(model: RewardModel, batch: Minibatch, mix: torch.Tensor) -> torch.Tensor:
    """Mean squared gradient of g by its input, on lines between policy and expert samples.

    Zero-centred (Mescheder et al. 2018), at the points of Gulrajani et al. (2017). It bounds how
    steep g gets, so that g still rises where a policy is far from the demonstrations.

    Args:
        batch: samples [E, 2, B].
        mix: share of the expert's sample in each point [E, B, 1], in [0, 1].
    """
    x = model.inputs(batch.observations, batch.actions)
    points = (mix * x[:, 1] + (1.0 - mix) * x[:, 0]).detach().requires_grad_()
    (gradient,) = torch.autograd.grad(model.g(points).sum(), points, create_graph=True)
    return gradient.square().sum(-1).mean()


class Loss(NamedTuple):
    """A minibatch's loss and two of its parts, all scalar tensors.

    ``cross_entropy`` is the student's, BCE, with weight one.
    """

    total: torch.Tensor
    cross_entropy: torch.Tensor
    penalty: torch.Tensor


def discriminator_loss(
    logits: torch.Tensor,
    f: torch.Tensor,
    weights: torch.Tensor,
    config: AIRLConfig,
    penalty_weight: float,
    challenger_logits: torch.Tensor | None = None,
    input_gradient: Callable[[], torch.Tensor] | None = None,
    parameters: Sequence[torch.Tensor] = (),
) -> Loss:
    """((1 - s) BCE + s BCE_challenger + c GP + lambda penalty) / max(1, lambda).

    Paper Eq. 5 and Algorithm 1, with the parts that make a reward retrainable. BCE is the mean
    sum_e w_e BCE_e; the paper sums over settings. Dividing by lambda keeps the gradient's size
    when the penalty dominates; a bounded one does not (:func:`irlcli.penalties.loss_divisor`).
    Penalties of risks do not see challengers: they are so easy to distinguish from experts that the
    penalty would be small for any reward. ``input-gradient`` sees them.

    Args:
        logits: of the student's and the experts' samples [E, 2, B].
        f: the learned part [E, 2, B].
        weights: w [E], summing to one.
        config: s (``challenger.share``), c (``gradient_penalty``), the penalty and its estimate.
            With the grouping ``balanced`` the penalty sees all E as one risk.
        penalty_weight: lambda of this round.
        challenger_logits: of a challenger's and the experts' samples [E, 2, B]; None: there is none.
        input_gradient: GP, the mean squared gradient of g by its input, computed when called.
        parameters: of the discriminator, see :class:`irlcli.penalties.Samples`.

    Raises:
        StageFailed: the penalty's function returned something else than a scalar with a gradient.
    """
    student_share, others = 1.0, torch.zeros(())
    if challenger_logits is not None:
        student_share = 1.0 - config.challenger.share
        challenged = (weights * cross_entropy(challenger_logits)).sum()
        others = others + config.challenger.share * challenged
    if input_gradient is not None and config.gradient_penalty > 0.0:
        others = others + config.gradient_penalty * input_gradient()
    risks = cross_entropy(logits)
    risk = (weights * risks).sum()
    seen = Samples(logits, f, risks, student_share * weights, tuple(parameters), input_gradient)
    if config.grouping == "balanced":
        seen = seen._replace(
            logits=_merged(logits),
            f=_merged(f),
            risks=risk[None],
            weights=student_share * weights.sum(0, keepdim=True),
        )
    unbiased = config.penalty_estimate == "unbiased"
    options = PenaltyOptions(config.penalty_scaling, unbiased, penalty_weight)
    penalised = discriminator_penalty(config.penalty)(seen, options)
    _check_penalty(config.penalty, penalised, logits.requires_grad and penalty_weight > 0.0)
    total = student_share * risk + others
    if penalty_weight > 0.0:
        total = total + penalty_weight * penalised
        total = total / loss_divisor(config.penalty, penalty_weight)
    return Loss(total, risk.detach(), penalised.detach())


def _check_penalty(name: str, found: object, weighed: bool) -> None:
    if not isinstance(found, torch.Tensor) or found.shape:
        kind = f"{list(found.shape)}" if isinstance(found, torch.Tensor) else type(found).__name__
        raise StageFailed(
            f"penalty {name!r} returned {kind}, not a scalar tensor", "return one, as mean() does"
        )
    if weighed and not found.requires_grad:
        raise StageFailed(
            f"penalty {name!r} has no gradient, so it would change nothing",
            "compute it from its Samples, without detach() or item()",
        )


def minibatch_loss(
    model: RewardModel,
    batch: Minibatch,
    challenger: Minibatch | None,
    weights: torch.Tensor,
    config: AIRLConfig,
    penalty_weight: float,
    generator: torch.Generator,
) -> Loss:
    """:func:`discriminator_loss` of ``model``, as ``config`` says.

    Args:
        batch: the student's and the experts' samples [E, 2, B].
        challenger: a challenger's and the experts'; None: there is none.
        weights: w [E], summing to one.
        penalty_weight: lambda of this round.
        generator: draws the points of the gradient penalty.
    """
    logits, f = discriminator_logits(model, batch, config.logit)
    challenger_logits = None
    if challenger is not None:
        challenger_logits, _ = discriminator_logits(model, challenger, config.logit)

    def input_gradient() -> torch.Tensor:
        found = []
        for part in (batch,) if challenger is None else (batch, challenger):
            mix = torch.rand(*part.log_probs[:, 0].shape, 1, generator=generator)
            found.append(gradient_penalty(model, part, mix))
        return torch.stack(found).mean()

    return discriminator_loss(
        logits,
        f,
        weights,
        config,
        penalty_weight,
        challenger_logits,
        input_gradient,
        tuple(model.parameters()),
    )


def _merged(samples: torch.Tensor) -> torch.Tensor:
    """[E, 2, B] as one risk [1, 2, E * B]."""
    return samples.transpose(0, 1).reshape(1, 2, -1)


def penalty_weight_at(index: int, weight: float, warmup: int, ramp: int) -> float:
    """lambda of round ``index``: 0 for ``warmup`` rounds, then linear over ``ramp`` to ``weight``."""
    if index < warmup:
        return 0.0
    return weight * min(1.0, (index - warmup + 1) / max(1, ramp))


def full_weight_from(warmup: int, ramp: int) -> int:
    """The first round whose lambda is the whole weight."""
    return warmup + max(1, ramp) - 1


@torch.no_grad()
def measured(
    model: RewardModel,
    current: Sequence[Pool],
    expert: Sequence[Pool],
    form: str,
    generator: torch.Generator,
) -> list[dict[str, float]]:
    """How well the discriminator separates each setting's ``current`` from its ``expert`` samples.

    Per setting, whatever the grouping, so that methods can be compared. The penalty is the unbiased
    IRMv1 of the logits, whatever the method's is.
    """
    risks = [
        [Stratum(policy, expert_, None, _DIAGNOSTIC_SAMPLES)]
        for policy, expert_ in zip(current, expert, strict=True)
    ]
    logits, f = discriminator_logits(model, sample_minibatch(risks, generator), form)
    entropies, weights = cross_entropy(logits), torch.ones(1)
    penalty = discriminator_penalty("irmv1")
    found = []
    for e in range(len(risks)):
        own = slice(e, e + 1)
        correct = torch.stack([logits[e, 0] < 0, logits[e, 1] > 0]).float()
        samples = Samples(logits[own], f[own], entropies[own], weights)
        found.append(
            {
                "cross_entropy": float(entropies[e]),
                "accuracy": float(correct.mean()),
                "mean_abs_logit": float(logits[e].abs().mean()),
                "penalty": float(penalty(samples, PenaltyOptions())),
            }
        )
    return found
