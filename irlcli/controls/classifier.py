"""A small classifier, trained with the invariance penalties of AIRL's discriminator.

A discriminator is a logistic classifier, so its penalties can be tried where their effect has been
published. Nothing here is adversarial: the samples are fixed, all of them are in every step, and R
runs that do not affect each other are trained side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch.nn.functional import dropout

from irlcli.controls.methods import LabelMethod
from irlcli.penalties import (
    PENALTIES,
    PenaltyOptions,
    Samples,
    discriminator_penalty,
    loss_divisor,
)
from irlcli.penalties.risk import cross_entropy


class Schedule(NamedTuple):
    """How long and how fast. ``warmup`` steps come first, at lambda = 0."""

    steps: int
    warmup: int
    learning_rate: float


class Networks(torch.nn.Module):
    """R classifiers: one hidden layer of tanh units, or linear if ``hidden`` is 0.

    A run's initial weights depend on its seed only.
    """

    def __init__(self, inputs: int, hidden: int, seeds: Sequence[int]):
        super().__init__()
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]

        def draw(fan_in: int, fan_out: int) -> torch.nn.Parameter:
            bound = fan_in**-0.5
            layers = [
                torch.empty(fan_in + 1, fan_out).uniform_(-bound, bound, generator=g)
                for g in generators
            ]
            return torch.nn.Parameter(torch.stack(layers))

        widths = [inputs, hidden, 1] if hidden else [inputs, 1]
        # The last row of each layer is its bias.
        self.layers = torch.nn.ParameterList(map(draw, widths, widths[1:]))

    def forward(self, x: torch.Tensor, drop: float = 0.0) -> torch.Tensor:
        """Logits [R, ...] of ``x`` [R, ..., D]."""
        shape = x.shape[:-1]
        x = x.reshape(len(x), -1, x.shape[-1])
        for k, layer in enumerate(self.layers):
            if k:
                x = dropout(x.tanh(), drop)
            x = torch.baddbmm(layer[:, -1:], x, layer[:, :-1])
        return x.reshape(shape)


def train(
    samples: torch.Tensor,
    method: LabelMethod,
    schedule: Schedule,
    hidden: int,
    seeds: Sequence[int],
) -> Networks:
    """Minimise (mean_e R_e + lambda penalty) / max(1, lambda) by Adam, full batch.

    A bounded penalty is not divided (:func:`irlcli.penalties.loss_divisor`).

    The penalty is the plain one. The unbiased estimate has no lower bound on samples that stay the
    same: a network can make the halves' gradients disagree.

    Args:
        samples: [R, E, 2, B, D] float32, laid out as a discriminator's: label 0, then 1.
        hidden: width of the hidden layer; 0 for a linear classifier.
        seeds: R, for the initial weights, and for what ``method`` draws. The masks of dropout come from
            one generator with the first seed, so with dropout a run depends on the others.
    """
    if method.shuffled:
        samples = torch.stack([_dealt(x, seed) for x, seed in zip(samples, seeds, strict=True)])
    networks = Networks(samples.shape[-1], hidden, seeds)
    optimiser = torch.optim.Adam(networks.parameters(), lr=schedule.learning_rate)
    options = PenaltyOptions(unbiased=False, weight=method.weight)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seeds[0])
        for step in range(schedule.steps):
            logits = networks(samples, method.dropout)
            risks = torch.func.vmap(cross_entropy)(logits)
            loss = risks.mean(1).sum()
            if step >= schedule.warmup and method.weight:
                penalised = _penalty(method.penalty, networks, samples, logits, risks, options)
                loss = loss + method.weight * penalised
                loss = loss / loss_divisor(method.penalty, method.weight)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    return networks


def accuracy(networks: Networks, samples: torch.Tensor) -> torch.Tensor:
    """Share of the samples [R, E, 2, B, D] that are classified rightly [R, E]; a tie is half."""
    with torch.no_grad():
        logits = networks(samples)
    right = torch.stack([-logits[:, :, 0], logits[:, :, 1]], 2).sign()
    return (0.5 + 0.5 * right).mean((-1, -2))


def _penalty(
    name: str,
    networks: Networks,
    samples: torch.Tensor,
    logits: torch.Tensor,
    risks: torch.Tensor,
    options: PenaltyOptions,
) -> torch.Tensor:
    """The sum of the R runs' penalties, a scalar."""
    penalty = discriminator_penalty(name)
    weights = torch.full((risks.shape[1],), 1.0 / risks.shape[1])
    if PENALTIES[name].additive:
        parameters = tuple(networks.parameters())

        def input_gradient() -> torch.Tensor:
            points = samples.mean(2).requires_grad_()
            (by_input,) = torch.autograd.grad(networks(points).sum(), points, create_graph=True)
            return by_input.square().sum(-1).mean((1, 2)).sum()

        # Only the weights and the summed risks mean anything here: a run's risk depends on its own
        # weights alone.
        seen = Samples(logits[0], logits[0], risks.sum(0), weights, parameters, input_gradient)
        return penalty(seen, options)

    def of_one(own: torch.Tensor, entropies: torch.Tensor) -> torch.Tensor:
        # A penalty that is not registered as additive must fail here, not find no weights.
        seen = Samples(own, own, entropies, weights, parameters=None)  # type: ignore[arg-type]
        return penalty(seen, options)

    return torch.func.vmap(of_one)(logits, risks).sum()


def _dealt(samples: torch.Tensor, seed: int) -> torch.Tensor:
    """``samples`` [E, 2, B, D] dealt out at random to as many groups of the same size."""
    generator = torch.Generator().manual_seed(seed)
    settings, labels, count, inputs = samples.shape
    each = samples.transpose(0, 1).reshape(labels, settings * count, inputs)
    order = torch.stack(
        [torch.randperm(settings * count, generator=generator) for _ in range(labels)]
    )
    mixed = each.gather(1, order[..., None].expand_as(each))
    return mixed.reshape(labels, settings, count, inputs).transpose(0, 1)
