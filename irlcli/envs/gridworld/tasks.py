"""Gridworlds by setting and config: their MDPs, their experts' episodes, their states' features."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from irlcli import tabular
from irlcli.configs.exact import GridworldConfig
from irlcli.envs.gridworld import env as gridworld
from irlcli.errors import UsageError
from irlcli.interventions import env_kwargs, parse_setting
from irlcli.trajectories import Trajectory

ENV = "gridworld"
_ACTIONS = 4


@contextmanager
def usable_input() -> Iterator[None]:
    """Report the solver's ValueErrors as usage errors: the user's settings cause them."""
    try:
        yield
    except ValueError as error:
        raise UsageError(
            str(error), "see gridworld.size, gridworld.horizon and gridworld.goal in settings/"
        ) from None


def mdp(text: str, grid: GridworldConfig) -> tabular.TabularMDP:
    """The MDP of setting ``text``.

    Raises:
        UsageError: no such setting; a goal that cannot be reached, at all or within the horizon;
            or a grid too large to solve.
    """
    with usable_input():
        # These checks come first, because building a grid of that size may take minutes.
        tabular.check_size(grid.horizon, _ACTIONS * grid.size**2)
        if grid.horizon < 2 * (grid.size - 1):
            raise ValueError(
                f"the goal is {2 * (grid.size - 1)} steps away, the horizon only {grid.horizon}"
            )
        return gridworld.gridworld(
            grid.size,
            goal=grid.goal,
            p_slip=grid.p_slip,
            **env_kwargs(ENV, parse_setting(ENV, text)),
        )


def stacked(texts: Sequence[str], grid: GridworldConfig) -> tabular.StackedMDPs:
    """The MDPs of settings ``texts``, stacked for the solver.

    Raises:
        UsageError: as :func:`mdp`.
    """
    return tabular.stack([mdp(text, grid) for text in texts])


def sample(
    text: str, grid: GridworldConfig, episodes: int, entropy: Sequence[int]
) -> list[Trajectory]:
    """``episodes`` trajectories of the expert of setting ``text``, found by value iteration.

    Raises:
        UsageError: as :func:`mdp`.
    """
    problem = mdp(text, grid)
    with usable_input():
        policy = gridworld.expert_policy(problem, grid.horizon)
    seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
    return gridworld.sample_trajectories(problem, grid.size, policy, episodes, seed)


def features(kind: str, grid: GridworldConfig) -> np.ndarray:
    """What the reward sees of each state, [S, F]: ``one-hot``, or its ``coordinates``."""
    if kind == "one-hot":
        return np.eye(grid.size**2)
    return gridworld.observations(grid.size).astype(np.float64)
