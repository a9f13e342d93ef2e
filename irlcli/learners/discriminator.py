"""The discriminator's loss: cross-entropies of risks, and an invariance penalty (paper Eq. 2 to 5).

Samples are laid out [E, 2, B]: E risks, label 0 = policy and 1 = expert, B samples of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch

from irlcli.learners.pools import Minibatch
from irlcli.learners.reward_model import RewardModel
from irlcli.penalties import PenaltyOptions, Samples, discriminator_penalty, loss_divisor
from irlcli.penalties.risk import cross_entropy


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
    """A minibatch's loss and what it consists of, all scalar tensors."""

    total: torch.Tensor
    cross_entropy: torch.Tensor
    penalty: torch.Tensor


def discriminator_loss(
    logits: torch.Tensor,
    f: torch.Tensor,
    weights: torch.Tensor,
    one_risk: bool,
    penalty: str,
    options: PenaltyOptions,
    share: float = 1.0,
    beside: torch.Tensor | float = 0.0,
    parameters: Sequence[torch.Tensor] = (),
    slope: Callable[[], torch.Tensor] | None = None,
) -> Loss:
    """(share sum_e w_e BCE_e + beside + lambda penalty) / max(1, lambda) (paper Eq. 5, Algorithm 1).

    The paper sums over settings where this averages. Dividing by lambda keeps the gradient's size
    when the penalty dominates; a bounded one does not (:func:`irlcli.penalties.loss_divisor`).
    Penalties of risks do not see challengers: they are so easy to distinguish from experts that the
    penalty would be small for any reward. ``input-gradient`` sees them.

    Args:
        logits: f - log pi [E, 2, B].
        f: the learned part [E, 2, B].
        weights: w [E], in sum one.
        one_risk: whether the penalty sees all E as one risk (``balanced``).
        penalty: a key of ``irlcli.penalties.PENALTIES``.
        options: how the penalty is estimated, and lambda.
        share: of this cross-entropy in the loss; the challengers' has the rest.
        beside: what else is minimised, a scalar.
        parameters, slope: of the discriminator, see :class:`irlcli.penalties.Samples`.
    """
    risks = cross_entropy(logits)
    risk = (weights * risks).sum()
    seen = Samples(logits, f, risks, share * weights, tuple(parameters), slope)
    if one_risk:
        one = share * weights.sum(0, keepdim=True)
        seen = seen._replace(logits=_merged(logits), f=_merged(f), risks=risk[None], weights=one)
    penalised = discriminator_penalty(penalty)(seen, options)
    total = share * risk + beside
    if options.weight > 0.0:
        total = total + options.weight * penalised
        total = total / loss_divisor(penalty, options.weight)
    return Loss(total, risk.detach(), penalised.detach())


def _merged(samples: torch.Tensor) -> torch.Tensor:
    """[E, 2, B] as one risk [1, 2, E * B]."""
    return samples.transpose(0, 1).reshape(1, 2, -1)


def penalty_weight_at(index: int, weight: float, warmup: int, ramp: int) -> float:
    """lambda of round ``index``: 0 for ``warmup`` rounds, then linear over ``ramp`` to ``weight``."""
    if index < warmup:
        return 0.0
    return weight * min(1.0, (index - warmup + 1) / max(1, ramp))
