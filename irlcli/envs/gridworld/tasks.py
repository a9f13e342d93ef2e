"""What the tabular stages share: gridworlds of named settings, their experts and their data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np

from irlcli import tabular
from irlcli.configs import GridworldConfig
from irlcli.data.demonstrations import Demonstrations, read_demonstrations
from irlcli.envs.gridworld import env as gridworld
from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import env_kwargs, parse_setting
from irlcli.learners import maxent
from irlcli.trajectories import Trajectory

ENV = "gridworld"
_ACTIONS = 4


@contextmanager
def usable_input() -> Iterator[None]:
    """What the solver refuses (its ValueErrors) is the user's to mend: one line and a hint."""
    try:
        yield
    except ValueError as error:
        raise UsageError(
            str(error), "see gridworld.size, gridworld.horizon and gridworld.goal in settings/"
        ) from None


def mdp(text: str, grid: GridworldConfig) -> tabular.TabularMDP:
    """The MDP of setting ``text``.

    Raises:
        UsageError: no such setting, or a goal that cannot be reached, at all or within the
            horizon; a grid too large to solve.
    """
    # Before anything of that size is built.
    with usable_input():
        tabular.check_size(grid.horizon, 1.0, _ACTIONS * grid.size**2)
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
    """The MDPs of settings ``texts``, for the solver.

    Raises:
        UsageError: as :func:`mdp`.
    """
    return tabular.stack([mdp(text, grid) for text in texts])


def sample(
    text: str, grid: GridworldConfig, episodes: int, entropy: Sequence[int]
) -> list[Trajectory]:
    """``episodes`` trajectories of the expert of setting ``text``, by value iteration.

    Raises:
        UsageError: as :func:`mdp`.
    """
    world = mdp(text, grid)
    with usable_input():
        policy = gridworld.expert_policy(world, grid.horizon)
    seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
    return gridworld.sample_trajectories(world, grid.size, policy, episodes, seed)


def read(directory: Path, env: str, texts: Sequence[str]) -> tuple[GridworldConfig, Demonstrations]:
    """The gridworld demonstrations in ``directory`` and the grid that they are of.

    Raises:
        IntegrityError: damaged, or of another environment or other settings than promised.
    """
    demos = read_demonstrations(directory)
    if demos.env != env or list(demos.trajectories) != list(texts):
        raise IntegrityError(
            f"the demonstrations are of {demos.env} {', '.join(demos.trajectories)}, not of "
            f"{env} {', '.join(texts)}"
        )
    try:
        return msgspec.convert(demos.metadata["gridworld"], GridworldConfig), demos
    except (KeyError, msgspec.ValidationError) as error:
        raise IntegrityError(
            f"the demonstrations in {directory} do not say which gridworld they are of ({error})"
        ) from None


def indexed(
    settings: tabular.StackedMDPs, groups: Sequence[Sequence[Trajectory]], grid: GridworldConfig
) -> maxent.Demonstrations:
    """Trajectories of each setting as state and action indices.

    Raises:
        UsageError: of another grid, or longer than its horizon.
    """
    with usable_input():
        states = [[gridworld.state_indices(t.observations, grid.size) for t in g] for g in groups]
        actions = [[t.actions for t in g] for g in groups]
        return maxent.demonstrations(settings, states, actions, grid.horizon)


def inputs(kind: str, grid: GridworldConfig) -> np.ndarray:
    """What the reward sees of each state, [S, F]: ``one-hot`` or its ``coordinates``."""
    if kind == "one-hot":
        return np.eye(grid.size**2)
    return gridworld.observations(grid.size).astype(np.float64)


def quality(
    texts: Sequence[str], grid: GridworldConfig, reward: np.ndarray, held_out: int
) -> dict[str, np.ndarray]:
    """How good ``reward`` [R, S] is in each of E settings, as measures [R, E] by name.

    The likelihood is that of ``held_out`` new episodes of each setting's own expert, in nats an
    episode, under the maximum-entropy policy of the reward; the others judge the optimal policy.

    Raises:
        UsageError: as :func:`mdp`.
    """
    settings = stacked(texts, grid)
    with usable_input():
        found = maxent.assess(settings, reward, grid.horizon)
    # The same episodes for every reward; a third number keeps them apart from every dataset.
    groups = [sample(t, grid, held_out, (0, e, held_out)) for e, t in enumerate(texts)]
    demos = indexed(settings, groups, grid)
    solution = maxent.solve(settings, reward, grid.horizon)
    return {
        "goal_probability": found.goal_probability,
        "true_return": found.true_return,
        "value_difference": found.value_difference,
        "rank_correlation": found.rank_correlation,
        "log_likelihood": np.stack(
            [maxent.log_likelihood(solution, r, demos) for r in range(len(reward))]
        ),
    }
