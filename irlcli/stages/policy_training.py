"""What the stages that train a policy share: rounds, checkpoints, metrics."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from irlcli import checkpoints
from irlcli.rl import PPOTrainer, RewardFunction, Rollout, world_groups
from irlcli.stages import Job
from irlcli.stages.adversary import Adversary
from irlcli.stages.outputs import shown
from irlcli.stages.selection import Selection

Row = dict[str, Any]


def train_rounds(
    job: Job,
    trainer: PPOTrainer,
    settings: Sequence[str],
    reward: RewardFunction | None = None,
    adversary: Adversary | None = None,
    selection: Selection | None = None,
) -> list[Row]:
    """Train from the last checkpoint to the end; returns one row per round and setting.

    The policy is paid by ``adversary``, which learns from every round's rollouts, else by
    ``reward``, else by the true reward. With ``selection``, the networks of the best round are
    in place at the end instead of the last one's.
    """
    first, rows = 0, []
    if adversary is not None:
        reward = partial(adversary.reward, policy=trainer.policy)
    names = {"trainer", "adversary", "selection", "round", "rows"}
    state = checkpoints.restore(job.checkpoints.load(), names, job.console.warn)
    if state is not None:
        first, rows = _resume(job, trainer, adversary, selection, state)
    elif adversary is not None:
        adversary.clone_experts(trainer)
    for index in range(first, trainer.rounds):
        rollouts = trainer.train_round(index, reward)
        _warn(job, index, rollouts, settings)
        newest = episode_rows(index, trainer.steps, rollouts, settings)
        if adversary is not None:
            for row, diagnostics in zip(
                newest, adversary.train_round(index, rollouts, trainer.policy), strict=True
            ):
                row.update(diagnostics)
        if selection is not None:
            score = selection.consider(index, trainer.policy, adversary)
            for row in newest:
                row["score"] = score
        rows += newest
        _report(job, trainer, newest)
        job.checkpoints.offer(partial(_state, trainer, adversary, selection, index + 1, rows))
    if selection is not None:
        selection.restore(trainer.policy, adversary)
    return rows


def _resume(
    job: Job,
    trainer: PPOTrainer,
    adversary: Adversary | None,
    selection: Selection | None,
    state: Row,
) -> tuple[int, list[Row]]:
    """Number of rounds done and their rows; all go on from ``state``."""
    # Whatever a crafted state makes torch and Python raise.
    with checkpoints.fitting(job.output.parent, Exception):
        trainer.load_state_dict(state["trainer"])
        if adversary is not None:
            adversary.load_state_dict(state["adversary"])
        if selection is not None:
            selection.load_state_dict(state["selection"])
        return int(state["round"]), list(json.loads(state["rows"].numpy().tobytes()))


def _state(
    trainer: PPOTrainer,
    adversary: Adversary | None,
    selection: Selection | None,
    rounds_done: int,
    rows: Sequence[Row],
) -> bytes:
    return checkpoints.to_bytes(
        {
            "trainer": trainer.state_dict(),
            "adversary": adversary.state_dict() if adversary is not None else {},
            "selection": selection.state_dict() if selection is not None else {},
            "round": rounds_done,
            # As a tensor: they grow with the rounds, and the index of a tensor file is bounded.
            "rows": torch.frombuffer(bytearray(json.dumps(rows).encode()), dtype=torch.uint8),
        }
    )


def _warn(job: Job, index: int, rollouts: Sequence[Rollout], settings: Sequence[str]) -> None:
    """Name the worlds whose episode could not go on."""
    groups = world_groups(rollouts[0].terminated.shape[1], len(settings))
    for world, error in (e for rollout in rollouts for e in rollout.errors):
        job.console.warn(
            f"{settings[groups[world]]}, world {world}, round {index}: {error}; the episode ended "
            "there and training goes on"
        )


def episode_rows(
    index: int, steps: int, rollouts: Sequence[Rollout], settings: Sequence[str]
) -> list[Row]:
    """One row per setting: true return and length of the episodes that ended in this round.

    A setting in which none ended has NaN, not zero; so has the progress of an environment that
    reports none.
    """
    groups = world_groups(rollouts[0].terminated.shape[1], len(settings))
    rows = []
    for group, setting in enumerate(settings):
        columns = groups == group
        ended = np.concatenate([(r.lengths[:, columns] > 0).ravel() for r in rollouts])
        returns = np.concatenate([r.returns[:, columns].ravel() for r in rollouts])[ended]
        lengths = np.concatenate([r.lengths[:, columns].ravel() for r in rollouts])[ended]
        terminated = np.concatenate([r.terminated[:, columns].ravel() for r in rollouts])[ended]
        progress = np.concatenate([r.progress[:, columns].ravel() for r in rollouts])[ended]
        rows.append(
            {
                "round": index,
                "steps": steps,
                "setting": setting,
                "episodes": int(ended.sum()),
                "true_return": _mean(returns),
                "progress": _mean(progress),
                "episode_length": _mean(lengths),
                "terminated": _mean(terminated),
            }
        )
    return rows


def _report(job: Job, trainer: PPOTrainer, newest: Sequence[Row]) -> None:
    facts = {row["setting"]: shown(row["true_return"], row["progress"]) for row in newest}
    if "accuracy" in newest[0]:
        accuracy = np.mean([row["accuracy"] for row in newest])
        facts["discriminator"] = f"accuracy {accuracy:.2f}"
    job.console.progress(trainer.steps, trainer.rounds * trainer.steps_per_round, "steps", facts)
    scalars = {
        f"{row['setting']}/{name}": float(value)
        for row in newest
        for name, value in row.items()
        if name not in ("round", "steps", "setting")
    }
    job.console.scalars(trainer.steps, scalars)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
