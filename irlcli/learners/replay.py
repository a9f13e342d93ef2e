"""Whole episodes of past policies, so that the discriminator remembers what they did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch

from irlcli.trajectories import Rollout, Transitions, join


def whole_episodes(
    rollouts: Sequence[Rollout], worlds: np.ndarray, horizon: int
) -> tuple[Transitions, np.ndarray]:
    """A round's transitions [B] in ``worlds`` [N] bool, and the episode number [B] of each.

    Episodes that the round's end may have cut are left out whole. Which ones are left depends only
    on when they start, so sums over them are unbiased (Wald). Their shares are so nearly: a round
    of many short episodes counts no more than one of few long ones. If a round is shorter than the
    horizon, each world's first episode is kept up to the round's end.
    """
    ended = np.concatenate([r.terminated | r.truncated for r in rollouts])
    steps, count = ended.shape
    kept = np.split(starts_by(ended, steps - horizon), len(rollouts))
    before = np.zeros(ended.shape, dtype=np.int64)
    before[1:] = np.cumsum(ended[:-1], 0)
    # The worlds' episode numbers do not overlap.
    numbers = np.split(before + (steps + 1) * np.arange(count), len(rollouts))
    parts, episodes = [], []
    for rollout, whole, number in zip(rollouts, kept, numbers, strict=True):
        rows = whole[:, worlds].ravel()
        parts.append(rollout.transitions(worlds, horizon).take(rows))
        episodes.append(number[:, worlds].ravel()[rows])
    return join(parts), np.concatenate(episodes)


def starts_by(ended: np.ndarray, latest: int) -> np.ndarray:
    """Steps [T, N] bool whose episode starts at step ``latest`` or before; the first always does.

    ``ended`` [T, N] marks the last step of each episode; every world starts one at step 0.
    """
    starts = np.zeros(ended.shape, dtype=np.int64)
    starts[1:] = np.where(ended[:-1], np.arange(1, len(ended))[:, None], 0)
    return np.maximum.accumulate(starts) <= max(latest, 0)


class Replay:
    """A sample of the episodes of all past rounds, for each setting.

    Every round adds equally many episodes, and all past rounds stay equally likely (reservoir sampling, Vitter 1985, algorithm R):
    otherwise the discriminator forgets what the policy no longer does.

    Args:
        settings: their number.
        per_round: episodes that a round adds to each setting.
        capacity: episodes kept of each setting.
    """

    def __init__(self, settings: int, *, per_round: int, capacity: int):
        self._per_round = per_round
        self._capacity = capacity
        self._episodes: list[list[Transitions]] = [[] for _ in range(settings)]
        self._seen = [0] * settings

    def add(
        self, setting: int, data: Transitions, episodes: np.ndarray, rng: np.random.Generator
    ) -> None:
        """Add some of the episodes of ``data`` [B], numbered by ``episodes`` [B]."""
        kept = self._episodes[setting]
        numbers = np.unique(episodes)
        chosen = rng.choice(numbers, min(self._per_round, len(numbers)), replace=False)
        for number in np.sort(chosen):
            episode = data.take(np.flatnonzero(episodes == number))
            self._seen[setting] += 1
            if len(kept) < self._capacity:
                kept.append(episode)
            elif (place := rng.integers(self._seen[setting])) < self._capacity:
                kept[place] = episode

    def transitions(self) -> list[Transitions]:
        """Each setting's episodes, one after the other; empty before the first round."""
        return [join(episodes) for episodes in self._episodes if episodes]

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs: per setting, joined episodes and their lengths."""
        return {
            "seen": list(self._seen),
            "settings": [
                {
                    "lengths": torch.tensor([len(e) for e in episodes], dtype=torch.int64),
                    **({} if not episodes else _tensors(join(episodes))),
                }
                for episodes in self._episodes
            ],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict()``."""
        self._seen = [int(count) for count in state["seen"]]
        self._episodes = []
        for stored in state["settings"]:
            lengths = stored["lengths"].numpy()
            ends = np.cumsum(lengths)
            rows = [np.arange(end - n, end) for n, end in zip(lengths, ends, strict=True)]
            if not rows:
                self._episodes.append([])
                continue
            tensors = {name: t.numpy() for name, t in stored.items() if name != "lengths"}
            joined = Transitions(**tensors)
            self._episodes.append([joined.take(own) for own in rows])


def _tensors(data: Transitions) -> dict[str, torch.Tensor]:
    return {f.name: torch.as_tensor(getattr(data, f.name)) for f in fields(Transitions)}
