"""Input gradient: how steep g is, whatever the setting.

Zero-centred (Mescheder et al. 2018), at the points of Gulrajani et al. (2017). No invariance is
sought: a reward that is flat in every input, also in those that differ between settings, is the
control for a penalty whose gain may be smoothness alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from irlcli.penalties import PenaltyOptions, Samples

if TYPE_CHECKING:
    import torch


def discriminator(samples: Samples, options: PenaltyOptions) -> torch.Tensor:
    """mean ||d g / d x||^2 at points x between policy and expert samples, a scalar."""
    assert samples.input_gradient is not None
    return samples.input_gradient()
