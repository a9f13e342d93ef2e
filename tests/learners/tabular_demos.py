"""Small mazes and demonstrations in them, for the tests of MaxEnt IRL."""

import numpy as np

from irlcli.envs.gridworld.env import (
    PATH_GROUPS,
    expert_policy,
    gridworld,
    sample_trajectories,
    state_indices,
)
from irlcli.learners.occupancy import demonstrations
from irlcli.tabular import stack

GOALS = ("terminal", "absorbing")
# Through a 3x3 grid from the start to the goal.
PATH = np.array([0, 1, 2, 5, 8])
MOVES = np.array([1, 1, 0, 0])


def mazes(size=5, goal="absorbing"):
    """The three path groups, stacked."""
    return stack([gridworld(size, path_group=g, goal=goal) for g in PATH_GROUPS])


def expert_demonstrations(settings, counts, size=5, horizon=16):
    """Episodes of each setting's expert, ``counts`` [E] of them."""
    episodes = [
        sample_trajectories(mdp, size, expert_policy(mdp, horizon), count, seed=100 * e)
        for e, (mdp, count) in enumerate(zip(settings.mdps, counts, strict=True))
    ]
    states = [[state_indices(t.observations, size) for t in group] for group in episodes]
    return demonstrations(settings, states, [[t.actions for t in g] for g in episodes], horizon)
