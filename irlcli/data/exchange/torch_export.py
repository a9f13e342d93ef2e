"""A learned reward as a program of torch.export, which runs without this package."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from irlcli.learners.standalone import StandaloneReward

# torch.export keeps a batch dimension free only if the example's size is neither 0 nor 1.
_EXAMPLES = 2


def write_reward(path: Path, module: StandaloneReward, about: dict[str, object]) -> None:
    """Write ``module`` to ``path``; ``about`` becomes the extra file ``irlcli.json``.

    ``torch.export.load(path).module()`` takes the arguments of :class:`StandaloneReward`, for any
    number of steps.

    Raises:
        OSError: the file cannot be written.
    """
    model = module.model
    size = model.observation_size
    # Each of its own: torch takes one tensor in two places for one argument.
    observations, following = torch.zeros(_EXAMPLES, size), torch.zeros(_EXAMPLES, size)
    actions = torch.zeros(_EXAMPLES, model.action_size)
    if model.discrete:
        shape = [len(model.choices)] if model.choices else []
        actions = torch.zeros(_EXAMPLES, *shape, dtype=torch.int64)
    arguments = observations, actions, following, torch.zeros(_EXAMPLES, dtype=torch.bool)
    batch = torch.export.Dim("batch")
    program = torch.export.export(module.eval(), arguments, dynamic_shapes=({0: batch},) * 4)
    files = {"irlcli.json": json.dumps(about, sort_keys=True)}
    with open(path, "wb") as file:
        torch.export.save(program, file, extra_files=files)
