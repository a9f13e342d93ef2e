"""Which demonstrations share a risk, and how much each setting weighs in all risks together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.learners.grouping import apportion, deal, group, hides_settings

COUNTS = st.lists(st.integers(1, 30), min_size=1, max_size=5)


def setting_weights(groups, settings):
    """Each setting's share of the total weight [E]."""
    found = np.zeros(settings)
    for g in groups:
        for part in g.parts:
            found[part.setting] += g.weight * part.share
    return found


def test_pooled_demonstrations_weigh_by_count():
    groups = group("pooled", [10, 3], np.random.default_rng(0))
    assert len(groups) == 1
    np.testing.assert_allclose(setting_weights(groups, 2), [10 / 13, 3 / 13])


@pytest.mark.parametrize("grouping", ["balanced", "per-setting"])
def test_settings_have_groups_of_their_own_and_of_equal_weight(grouping):
    groups = group(grouping, [10, 3], np.random.default_rng(0))
    parts = [part for (part,) in (g.parts for g in groups)]
    assert [(part.setting, len(part.episodes)) for part in parts] == [(0, 10), (1, 3)]
    assert setting_weights(groups, 2).tolist() == [0.5, 0.5]


@given(counts=COUNTS, seed=st.integers(0, 1000))
def test_shuffling_keeps_each_settings_weight(counts, seed):
    """Figure 2's 400/25/3 and goal-y's 10/3 weigh as much as with the true labels."""
    groups = group("shuffled", counts, np.random.default_rng(seed))
    assert sum(g.weight for g in groups) == pytest.approx(1.0)
    np.testing.assert_allclose(setting_weights(groups, len(counts)), 1 / len(counts))
    for g in groups:
        assert sum(part.share for part in g.parts) == pytest.approx(1.0)


@given(counts=COUNTS, seed=st.integers(0, 1000))
def test_shuffling_deals_out_every_episode_once(counts, seed):
    groups = group("shuffled", counts, np.random.default_rng(seed))
    for e, count in enumerate(counts):
        parts = [p.episodes for g in groups for p in g.parts if p.setting == e]
        assert sorted(np.concatenate(parts)) == list(range(count))


def test_dealt_groups_are_as_even_as_they_can_be():
    dealt = deal([8, 4, 1], np.random.default_rng(1))
    assert sorted(np.bincount(dealt[0], minlength=3)) == [2, 3, 3]
    assert sorted(np.bincount(dealt[1], minlength=3)) == [1, 1, 2]
    # One episode a setting: each group gets one.
    assert sorted(int(d[0]) for d in deal([1, 1, 1], np.random.default_rng(0))) == [0, 1, 2]


@given(count=st.integers(2, 30), settings=st.integers(2, 5), seed=st.integers(0, 1000))
def test_dealt_groups_do_not_tell_settings_of_equal_counts_apart(count, settings, seed):
    dealt = deal([count] * settings, np.random.default_rng(seed))
    if hides_settings([count] * settings):
        held = [np.bincount(groups, minlength=settings).tolist() for groups in dealt]
        assert all(each == held[0] and min(each) > 0 for each in held)
    assert {*np.concatenate(dealt)} == {*range(settings)}


@given(seed=st.integers(0, 1000))
def test_unequal_counts_are_told_apart_by_one_episode_at_most(seed):
    ten, three = deal([10, 3], np.random.default_rng(seed))
    assert [np.mean(three == 0) - np.mean(ten == 0)] == pytest.approx([1 / 6])
    assert not hides_settings([10, 1])


def test_each_episode_is_as_likely_in_any_group():
    groups = np.array([deal([5, 5], np.random.default_rng(seed))[1] for seed in range(2000)])
    # The first group has three of the five.
    np.testing.assert_allclose((groups == 0).mean(0), 0.6, atol=0.05)


def test_another_seed_deals_otherwise():
    one, other = (deal([20, 20], np.random.default_rng(seed)) for seed in (0, 1))
    assert not np.array_equal(one[0], other[0])


@given(
    pairs=st.integers(8, 500),
    raw=st.lists(st.floats(0.01, 1.0), min_size=1, max_size=5),
)
def test_samples_are_apportioned_in_even_parts(pairs, raw):
    shares = np.array(raw) / sum(raw)
    parts = apportion(2 * pairs, shares)
    assert sum(parts) == 2 * pairs
    assert all(part >= 2 and part % 2 == 0 for part in parts)
    assert np.abs(np.array(parts) - 2 * pairs * shares).max() <= 2 * len(parts)
