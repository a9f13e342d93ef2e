"""How a reward depends on a hint: in closed form, with rewards that are known functions."""

from __future__ import annotations

import numpy as np
import pytest

from irlcli.report.cue import hint_contrasts
from irlcli.trajectories import Transitions

TEXTURE, CUE = -2, -1


def steps(count=200):
    """Random states, and hints that are both 1 in three steps of four."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(count, 5)).astype(np.float32)
    observations[:, TEXTURE:] = np.where(np.arange(count) % 4 < 3, 1.0, -1.0)[:, None]
    none = np.zeros(count, dtype=np.int64)
    return Transitions(observations, none, observations, none == 1, none)


def pay(score):
    return hint_contrasts(lambda s, a, n: score(s), steps())


def test_a_weight_is_paid_twice_between_minus_one_and_one():
    found = pay(lambda s: 3.0 * s[:, CUE] - 0.5 * s[:, TEXTURE] + s[:, 0])
    assert found == {"texture": pytest.approx(-1.0), "cue": pytest.approx(6.0)}


def test_a_reward_of_the_state_pays_nothing_for_hints():
    assert pay(lambda s: s[:, 0] * s[:, 1]) == {"texture": 0.0, "cue": 0.0}


def test_everything_else_stays_as_recorded():
    """A reward for agreement: the texture is 1 in three steps of four, -1 in the fourth."""
    found = pay(lambda s: s[:, TEXTURE] * s[:, CUE])
    assert found == {"texture": pytest.approx(2 * 0.5), "cue": pytest.approx(2 * 0.5)}
