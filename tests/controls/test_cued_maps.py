"""Cued maps: their shares are exact, and what is visited there has closed forms."""

import numpy as np
import pytest

from irlcli.controls.cued_maps import Maps, demonstrate, draw, features, hint_weights, judge, torus
from irlcli.learners.soft_values import solve

STRENGTHS = np.broadcast_to(np.array([[0.95], [0.8]]), (3, 2, 1))


def agreement(maps, bit, quality):
    """Share of the cells of one quality whose cue agrees with it [R, E]."""
    shown = maps.kinds >> bit & 1
    group = maps.quality == quality
    return ((shown == maps.quality) & group).sum(-1) / group.sum(-1)


def test_each_cue_agrees_with_the_quality_in_its_share_of_good_and_of_bad_cells():
    maps = draw([0, 1, 2], 20, 0.75, STRENGTHS, purpose=0)
    assert (maps.quality.mean(-1) == 0.5).all()
    for quality in (0.0, 1.0):
        assert (agreement(maps, 0, quality) == 0.75).all()
        assert (agreement(maps, 1, quality) == STRENGTHS[..., 0]).all()


def test_maps_depend_on_their_seed_and_purpose_only():
    three = draw([0, 1, 2], 6, 0.75, STRENGTHS, purpose=0)
    one = draw([1], 6, 0.75, STRENGTHS[:1], purpose=0)
    other = draw([1], 6, 0.75, STRENGTHS[:1], purpose=1)
    assert np.array_equal(three.kinds[1:2], one.kinds)
    assert not np.array_equal(one.quality, other.quality)
    assert not np.array_equal(three.kinds[0], three.kinds[1])


@pytest.mark.parametrize("strength", [-0.1, 1.1, np.nan])
def test_a_strength_outside_0_and_1_is_refused(strength):
    with pytest.raises(ValueError, match=r"must lie in \[0, 1\]"):
        draw([0], 4, 0.75, np.full((1, 2, 1), strength), purpose=0)


def test_what_a_linear_reward_pays_is_twice_its_coefficients():
    """From bad to good a feature goes from -1 to 1."""
    shown = features(2)
    assert sorted(map(tuple, shown)) == sorted(set(map(tuple, shown))) and len(shown) == 8
    assert np.allclose(hint_weights((shown @ [0.5, -1.0, 2.0])[None]), [[1.0, -2.0, 4.0]])


def test_an_agent_stays_or_moves_to_one_of_four_neighbours():
    mdp = torus(5, 1).mdps[0]
    assert sorted(mdp.afterstate[:, 0]) == [0, 1, 4, 5, 20]
    assert all(sorted(row) == list(range(25)) for row in mdp.afterstate)


def test_a_reward_of_nothing_visits_all_cells_equally():
    maps = draw([0, 1], 6, 0.75, STRENGTHS[:2], purpose=0)
    found = judge(torus(6, 2), maps, np.zeros((2, 4)), 2.0, 5)
    assert np.allclose(found.quality, 0.5) and np.allclose(found.optimal_quality, 0.5)
    # The expert's return against that of visiting every cell equally.
    expert = solve(torus(6, 2), 2.0 * maps.quality, 5).occupancy
    returns = (expert * 2.0 * maps.quality).sum(-1).mean(-1)
    assert np.allclose(expert.sum(-1), 6.0) and (returns > 7.0).all()
    assert np.allclose(found.value_difference, returns - 6.0 * 2.0 * 0.5)


def test_the_true_reward_differs_by_nothing():
    """A texture that always agrees with the quality is the true reward."""
    maps = draw([0, 1], 6, 1.0, STRENGTHS[:2], purpose=0)
    found = judge(torus(6, 2), maps, np.tile([0.0, 2.0], (2, 2)), 2.0, 5)
    assert np.allclose(found.value_difference, 0.0)
    assert (found.optimal_quality >= found.quality).all() and (found.quality > 0.7).all()


def test_experts_visit_cells_as_their_soft_optimal_policy_does():
    maps = draw([0], 4, 0.75, STRENGTHS[:1], purpose=0)
    settings = torus(4, 2)
    (demos,) = demonstrate(settings, 2.0 * maps.quality, 3, 20_000, [0])
    occupancy = solve(settings, 2.0 * maps.quality, 3).occupancy[0]
    for e in range(2):
        visits = np.bincount(np.concatenate(demos.states[e]), minlength=16) / 20_000
        assert np.allclose(visits, occupancy[e], atol=0.02)
        for path, moves in zip(demos.states[e][:50], demos.actions[e][:50], strict=True):
            assert np.array_equal(settings.mdps[e].afterstate[moves, path[:-1]], path[1:])


def test_experts_of_one_run_do_not_depend_on_the_others():
    maps = draw([0, 1], 4, 0.75, STRENGTHS[:2], purpose=0)
    settings = torus(4, 2)
    both = demonstrate(settings, maps.quality, 3, 5, [0, 1])
    alone = Maps(maps.quality[1:], maps.kinds[1:])
    (one,) = demonstrate(settings, alone.quality, 3, 5, [1])
    assert np.array_equal(np.stack(both[1].states), np.stack(one.states))
