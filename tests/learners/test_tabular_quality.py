"""The measures of a recovered reward: by hand, and at the two extremes."""

import numpy as np
import pytest
from tabular_demos import GOALS, MOVES, PATH, expert_demonstrations

from irlcli.envs.gridworld.env import gridworld, walls
from irlcli.learners.occupancy import demonstrations
from irlcli.learners.soft_values import solve
from irlcli.learners.tabular_quality import assess, log_likelihood
from irlcli.tabular import stack


def test_log_likelihood_by_hand():
    settings = stack([gridworld(3), gridworld(3)])
    demos = demonstrations(settings, [[PATH], [PATH, PATH[:5]]], [[MOVES], [MOVES, MOVES]], 6)
    solution = solve(settings, np.random.default_rng(0).normal(size=(2, 2, 9)), 6)
    steps = [solution.policy[t, MOVES[t], 1, PATH[t], 1] for t in range(4)]
    assert log_likelihood(solution, 1, demos)[1] == pytest.approx(np.log(steps).sum(), abs=1e-12)
    uniform = solve(settings, np.zeros((1, 9)), 6)
    assert log_likelihood(uniform, 0, demos).max() < 0.0


def test_an_impossible_action_has_a_finite_log_likelihood():
    settings = stack([gridworld(3)])
    demos = demonstrations(settings, [[PATH]], [[MOVES]], 6)
    reward = np.zeros((1, 9))
    reward[0, 3] = 1e5  # beside the path, so that leaving it is a certainty
    found = log_likelihood(solve(settings, reward, 6), 0, demos)[0]
    assert np.isfinite(found) and found < -1e4


@pytest.mark.parametrize("goal", GOALS)
def test_the_true_reward_is_assessed_as_perfect_and_its_opposite_as_useless(goal):
    settings = stack([gridworld(6, goal=goal), gridworld(6, blocked=2, goal=goal)])
    true = settings.mdps[0].reward
    demos = expert_demonstrations(settings, [5, 5], size=6, horizon=40)
    quality = assess(settings, np.stack([true, 3.0 * true, -true]), 40, demos)
    assert np.allclose(quality.value_difference[:2], 0.0, atol=1e-9)
    assert (quality.goal_probability[:2] > 0.999).all()
    assert (quality.rank_correlation[:2] > 0.999).all()
    assert (quality.goal_probability[2] < 0.05).all() and (quality.value_difference[2] > 20).all()
    assert (quality.rank_correlation[2] < 0.0).all()
    # A larger reward makes the policy less random, and the expert is not random at all.
    assert (quality.log_likelihood[1] > quality.log_likelihood[0]).all()
    assert (quality.log_likelihood[0] > quality.log_likelihood[2] + 10.0).all()


def test_the_reward_of_a_cell_behind_walls_does_not_change_the_rank_correlation():
    settings = stack([gridworld(6, blocked=2)])
    wall = walls(6, blocked=2)
    plain = np.random.default_rng(0).normal(size=36)
    raised = plain + 50.0 * wall
    assert wall.any()
    quality = assess(
        settings, np.stack([plain, raised]), 40, expert_demonstrations(settings, [2], 6, 40)
    )
    assert quality.rank_correlation[1, 0] == quality.rank_correlation[0, 0]


def test_a_constant_reward_has_no_rank_correlation():
    settings = stack([gridworld(5)])
    quality = assess(settings, np.zeros((1, 25)), 16, expert_demonstrations(settings, [2]))
    assert np.isnan(quality.rank_correlation).all()
    assert quality.goal_probability[0, 0] < 1.0
