"""EPIC does not see shaping and scale, and sees everything else."""

import numpy as np
import pytest

from irlcli.report.epic import canonical, epic_distance
from irlcli.trajectories import Transitions

DISCOUNT = 0.9


@pytest.fixture
def coverage():
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(3, 400, 2))
    return Transitions(*steps, terminated=np.zeros(400, bool), remaining=np.zeros(400, int))


def task(s, a, s_next):
    return s[:, 0] * a[:, 1] + 0.5 * s_next[:, 1]


def potential(s):
    return 10.0 * np.sin(s).sum(1)


def shaped(s, a, s_next):
    return 3.0 * task(s, a, s_next) + DISCOUNT * potential(s_next) - potential(s) + 7.0


def test_shaping_and_scale_do_not_count(coverage):
    assert epic_distance(task, shaped, coverage, DISCOUNT) == pytest.approx(0.0, abs=1e-6)


def test_the_canonical_reward_of_shaping_alone_is_constant(coverage):
    def shaping(s, a, s_next):
        return DISCOUNT * potential(s_next) - potential(s)

    found = canonical(shaping, coverage, coverage, DISCOUNT)
    assert np.ptp(found) == pytest.approx(0.0, abs=1e-9)
    assert epic_distance(task, shaping, coverage, DISCOUNT) is None


def test_the_opposite_reward_is_at_distance_one(coverage):
    opposite = epic_distance(task, lambda *step: -shaped(*step), coverage, DISCOUNT)
    assert opposite == pytest.approx(1.0)


def test_an_unrelated_reward_is_in_the_middle(coverage):
    """r = 0: sqrt(1 / 2)."""
    unrelated = epic_distance(task, lambda s, a, s_next: a[:, 0] ** 3, coverage, DISCOUNT)
    assert unrelated == pytest.approx(np.sqrt(0.5), abs=0.05)


def test_other_discounts_do_not_cancel_the_shaping(coverage):
    assert epic_distance(task, shaped, coverage, 0.5) > 0.1
