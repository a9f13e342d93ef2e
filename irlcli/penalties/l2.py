"""L2: the squared size of the weights, whatever the setting.

The control for a penalty whose gain may be shrinkage alone. Part of the loss, so Adam rescales its
gradient: lambda is not a rate of decay. ``airl.weight_decay`` has one; it is decoupled from the loss
(AdamW) and present in every method.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from irlcli.penalties import PenaltyOptions, Samples

if TYPE_CHECKING:
    import torch


def discriminator(samples: Samples, options: PenaltyOptions) -> torch.Tensor:
    """||theta||^2 / 2 of all weights, a scalar."""
    return 0.5 * sum((p.square().sum() for p in samples.parameters), samples.risks.new_zeros(()))
