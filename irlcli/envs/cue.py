"""A hint of how well the agent does, with a strength that differs between settings.

The positive control for invariant rewards. Every step has a *quality*: good or bad, by the true
rewards of the last steps (:class:`irlcli.envs.spec.Cue`). It is not observed. Two hints are, as the
last entries of the observation:

- the *texture* agrees with the quality in 75 % of the steps, in every setting;
- the *cue* agrees with it in a share of the steps that is the setting, ``cue-strength``.

A hint is +1 or -1. Whether it is right is drawn anew at every step, from a random stream of the
world's seed, whoever acts: demonstrations and rollouts get their cues by one rule. Nothing else
changes, so an expert of the world without the cue demonstrates, and :func:`with_hints` adds what a
learner would have seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from irlcli.envs.spec import Cue
from irlcli.trajectories import Trajectory

# As coloured MNIST's labels with 25 % noise (Arjovsky et al. 2019).
TEXTURE = 0.75
#: The last entries of an observation.
HINTS = ("texture", "cue")
# Keeps the draws apart from those of the environment, which takes the same seed.
_STREAM = 0x637565


class Rightness:
    """Which hints are right, step after step.

    Args:
        strength: probability that the cue is right, in [0, 1].
        seed: of the episode; None for unpredictable draws.
    """

    def __init__(self, strength: float, seed: int | None = None):
        self._probabilities = np.array([TEXTURE, strength])
        self._random = np.random.default_rng(None if seed is None else [_STREAM, seed])

    def draw(self, steps: int = 1) -> np.ndarray:
        """[steps, 2] float32: 1 where the texture and the cue are right, else -1."""
        numbers = self._random.random((steps, len(HINTS)))
        return np.where(numbers < self._probabilities, 1.0, -1.0).astype(np.float32)


def qualities(rewards: np.ndarray, cue: Cue) -> np.ndarray:
    """The quality [T + 1] of every observation of an episode with ``rewards`` [T]: 1 or -1.

    Before the first reward it is bad, unless the bar is negative.
    """
    sums = [0.0, *np.cumsum(rewards).tolist()]
    return np.array([_quality(sums, t, cue) for t in range(len(sums))], dtype=np.float32)


def _quality(sums: Sequence[float], t: int, cue: Cue) -> float:
    """The quality at time ``t``, from the sums of the rewards before each time."""
    return 1.0 if sums[t] - sums[max(t - cue.window, 0)] > cue.bar else -1.0


class CueWorld(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """An environment whose observation ends with hints of the quality.

    Args:
        env: the environment, with a vector as its observation.
        cue: what the quality is.
        strength: of the cue, in [0, 1].
    """

    def __init__(self, env: gymnasium.Env, cue: Cue, strength: float):
        gymnasium.utils.RecordConstructorArgs.__init__(self, cue=cue, strength=strength)
        gymnasium.Wrapper.__init__(self, env)
        self._cue, self._strength = cue, strength
        self._rightness = Rightness(strength)
        self._sums = [0.0]
        space = env.observation_space
        assert isinstance(space, gymnasium.spaces.Box)
        ones = np.ones(len(HINTS), dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(
            np.concatenate([space.low, -ones]), np.concatenate([space.high, ones]), dtype=np.float32
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; without a seed, the draws continue where the last episode ended."""
        if seed is not None:
            self._rightness = Rightness(self._strength, seed)
        self._sums = [0.0]
        observation, info = self.env.reset(seed=seed, options=options)
        return self._hinted(observation), info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """Advance as the environment does."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._sums.append(self._sums[-1] + float(reward))
        return self._hinted(observation), reward, terminated, truncated, info

    def _hinted(self, observation: np.ndarray) -> np.ndarray:
        quality = _quality(self._sums, len(self._sums) - 1, self._cue)
        return np.concatenate([observation, quality * self._rightness.draw()[0]], dtype=np.float32)


def with_hints(episode: Trajectory, cue: Cue, strength: float) -> Trajectory:
    """``episode``, with the hints that :class:`CueWorld` would have drawn from its seed."""
    right = Rightness(strength, episode.seed).draw(len(episode) + 1)
    hints = qualities(episode.rewards, cue)[:, None] * right
    return replace(episode, observations=np.concatenate([episode.observations, hints], 1))
