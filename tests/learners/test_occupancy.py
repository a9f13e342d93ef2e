"""Demonstrations as indices, and their occupancies by hand and in the limit."""

import numpy as np
import pytest
from tabular_demos import GOALS, MOVES, PATH, expert_demonstrations

from irlcli.envs.gridworld.env import expert_policy, gridworld
from irlcli.learners.occupancy import demonstrations, mean_occupancy
from irlcli.tabular import forward, stack


@pytest.mark.parametrize("goal", GOALS)
def test_expert_occupancy_by_hand(goal):
    settings = stack([gridworld(3, goal=goal)])
    demos = demonstrations(settings, [[PATH, PATH]], [[MOVES, MOVES]], horizon=6)
    expected = np.zeros(9)
    expected[PATH] = 1.0
    if goal == "absorbing":
        expected[8] += 2.0
    assert np.allclose(mean_occupancy(settings.mdps[0], demos.states[0], 6), expected)


def test_a_recording_that_stays_in_the_goal_counts_like_one_that_ended():
    settings = stack([gridworld(3, goal="absorbing")])
    ended = demonstrations(settings, [[PATH]], [[MOVES]], horizon=6)
    stayed = demonstrations(
        settings, [[np.append(PATH, [8, 8])]], [[np.append(MOVES, [2, 3])]], horizon=6
    )
    one, other = (mean_occupancy(settings.mdps[0], d.states[0], 6) for d in (ended, stayed))
    assert np.array_equal(one, other)
    assert np.array_equal(ended.actions[0][0], stayed.actions[0][0])


def test_expert_occupancy_converges_to_the_exact_one():
    mdp = gridworld(5, path_group=3, goal="absorbing")
    settings = stack([mdp])
    demos = expert_demonstrations(settings, [3000], horizon=24)
    policy = expert_policy(mdp, 24)
    exact = forward(settings, policy[:, :, None, :, None])[0][0, 0]
    assert np.abs(mean_occupancy(mdp, demos.states[0], 24) - exact).max() < 0.15


def test_bad_demonstrations_are_refused():
    settings = stack([gridworld(3)])

    def make(path, moves, horizon=6):
        demonstrations(settings, [[np.array(path)]], [[np.array(moves)]], horizon)

    with pytest.raises(ValueError, match="1 settings need 1 groups"):
        demonstrations(settings, [[PATH], [PATH]], [[MOVES], [MOVES]], 6)
    with pytest.raises(ValueError, match="setting 0 has no demonstrations"):
        demonstrations(settings, [[]], [[]], 6)
    with pytest.raises(ValueError, match="takes 4 steps, the horizon is 3"):
        make(PATH, MOVES, horizon=3)
    with pytest.raises(ValueError, match="stops after 3 steps"):
        make(PATH[:4], MOVES[:3])
    with pytest.raises(ValueError, match="another state or action space"):
        make([0, 1, 9], [1, 1])
    with pytest.raises(ValueError, match="another state or action space"):
        make(PATH, [1, 1, 0, 4])
    with pytest.raises(ValueError, match="4 actions but 4 states"):
        make(PATH[:4], MOVES)
