"""Demonstrations in finite MDPs: state and action indices, and how often states are visited."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlcli.tabular import StackedMDPs, TabularMDP


@dataclass(frozen=True, eq=False)
class IndexedDemonstrations:
    """The demonstrations of E settings, as state and action indices.

    Attributes:
        states: by setting, its trajectories, each [T + 1] int64.
        actions: the same, each [T] int64.
    """

    states: tuple[tuple[np.ndarray, ...], ...]
    actions: tuple[tuple[np.ndarray, ...], ...]

    @property
    def counts(self) -> np.ndarray:
        """[E], trajectories per setting."""
        return np.array([len(group) for group in self.states])


def demonstrations(
    settings: StackedMDPs,
    states: Sequence[Sequence[np.ndarray]],
    actions: Sequence[Sequence[np.ndarray]],
    horizon: int,
) -> IndexedDemonstrations:
    """Check demonstrations and cut each one where it first reaches the goal.

    The MDP determines what happens after that: an absorbing goal is occupied until the horizon, a
    terminal goal once. How the environment recorded it does not matter.

    Args:
        states: for each of E settings its trajectories of state indices, each [T + 1].
        actions: the same for action indices, each [T].
        horizon: H [steps].

    Raises:
        ValueError: not one group for each setting, an empty group, indices out of range, a
            trajectory longer than the horizon, or one that ends before both goal and horizon.
    """
    e, n, a = settings.shape
    if len(states) != e or len(actions) != e:
        raise ValueError(f"{e} settings need {e} groups of demonstrations, not {len(states)}")
    cut_states, cut_actions = [], []
    for i, (mdp, group, choices) in enumerate(zip(settings.mdps, states, actions, strict=True)):
        if len(group) == 0:
            raise ValueError(f"setting {i} has no demonstrations")
        paths, moves = [], []
        for path, chosen in zip(group, choices, strict=True):
            if len(path) != len(chosen) + 1:
                raise ValueError(f"setting {i}: {len(chosen)} actions but {len(path)} states")
            if path.min() < 0 or path.max() >= n or chosen.min() < 0 or chosen.max() >= a:
                raise ValueError(f"setting {i}: demonstrations of another state or action space")
            at_goal = np.flatnonzero(path == mdp.goal)
            length = int(at_goal[0]) if len(at_goal) else len(chosen)
            if length > horizon:
                raise ValueError(
                    f"setting {i}: a demonstration takes {length} steps, the horizon is {horizon}"
                )
            if not len(at_goal) and length < horizon:
                raise ValueError(
                    f"setting {i}: a demonstration stops after {length} steps, "
                    f"before the goal and before the horizon of {horizon}"
                )
            paths.append(np.asarray(path[: length + 1], dtype=np.int64))
            moves.append(np.asarray(chosen[:length], dtype=np.int64))
        cut_states.append(tuple(paths))
        cut_actions.append(tuple(moves))
    return IndexedDemonstrations(tuple(cut_states), tuple(cut_actions))


def mean_occupancy(mdp: TabularMDP, paths: Sequence[np.ndarray], horizon: int) -> np.ndarray:
    """rho_E [S]: visits of each state, averaged over ``paths`` of state indices.

    ``paths`` are those of :class:`IndexedDemonstrations`: each ends at the goal or at the horizon.
    """
    occupancy = np.zeros(mdp.n_states)
    for path in paths:
        np.add.at(occupancy, path, 1.0)
        if path[-1] == mdp.goal and not mdp.terminal[mdp.goal]:
            occupancy[mdp.goal] += horizon + 1 - len(path)
    return occupancy / len(paths)
