"""The gridworld of paper Sec. 5.1: from the bottom left to the top right, on slippery ground.

The same maze as exact arrays (for the tractable solver and the experts) and as a gymnasium
environment. A cell (x, y) is state ``y * size + x``, y upwards. Its observation is
(x, y) / (size - 1), float32, which :func:`state_indices` inverts exactly.

Actions are up, right, down, left. An action's *target* is the next cell, or the same cell if the
next one is a wall or outside. With probability 1 - p_slip the agent lands on the target, else on
one of the target's four neighbours, each equally likely. A neighbour that is a wall or outside
counts as the target, so no slip leads through a wall.

The true reward is the same in every setting: -1 for each step that starts outside the goal.

Settings differ in walls only. Every path crosses the anti-diagonal. ``path_group`` closes it except
for one gate: 1 at the top left, 2 at the bottom right, 3 in the middle (paper Fig. 2a). ``blocked``
puts bars across the corridors of the first group, or of the first two, in cells that belong to no
gate. No expert demonstrates in these mazes.
"""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np

from irlcli.tabular import TabularMDP, backward, shortest_path_length, stack, true_reward
from irlcli.trajectories import Trajectory

Goal = Literal["terminal", "absorbing"]
PATH_GROUPS = (1, 2, 3)
_MOVES = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)])  # (dx, dy) of up, right, down, left
_LARGEST = 1024  # cells per side: a million states
_SMALLEST_WITH_PATHS = 5


def walls(size: int, path_group: float = 0, blocked: float = 0) -> np.ndarray:
    """[S] bool, True where a wall stands.

    Args:
        size: cells per side, at least 2 (at least 5 with gates or bars).
        path_group: the open gate, 1, 2 or 3; 0 for no gates.
        blocked: the number of barred corridors: 0, 1 (group 1) or 2 (groups 1 and 2).

    Raises:
        ValueError: a number outside its range, or a grid too small to hold the walls.
    """
    if not (isinstance(size, (int, np.integer)) and 2 <= size <= _LARGEST):
        raise ValueError(f"size must be a whole number from 2 to {_LARGEST}, not {size}")
    if path_group not in (0, *PATH_GROUPS):
        raise ValueError(f"path_group must be 0 (open), 1, 2 or 3, not {path_group}")
    if blocked not in (0, 1, 2):
        raise ValueError(f"blocked must be 0, 1 or 2, not {blocked}")
    if (path_group or blocked) and size < _SMALLEST_WITH_PATHS:
        raise ValueError(f"path groups need a size of at least {_SMALLEST_WITH_PATHS}, not {size}")
    wall = np.zeros((size, size), dtype=bool)  # [y, x]
    third, half = size // 3, size // 2
    if path_group:
        x = np.arange(size)
        middle = np.abs(2 * x - (size - 1)) <= 2
        gate = np.select([x < third, x >= size - third, middle], PATH_GROUPS, default=0)
        closed = x[gate != path_group]
        wall[size - 1 - closed, closed] = True
    if blocked >= 1:
        wall[half, : half - 1] = True
    if blocked >= 2:
        wall[: half - 1, half] = True
    return wall.ravel()


def gridworld(
    size: int = 8,
    path_group: float = 0,
    blocked: float = 0,
    goal: Goal = "terminal",
    p_slip: float = 0.2,
) -> TabularMDP:
    """The gridworld as exact arrays: A = 4, S = size^2, K = 5.

    Every action in the goal leads to the last of its S + 1 afterstates, which stays at the goal
    (``absorbing``) or ends the episode (``terminal``).

    Raises:
        ValueError: as :func:`walls`; an unknown goal; p_slip outside [0, 1); or walls that make
            the goal unreachable.
    """
    wall = walls(size, path_group, blocked)
    if goal not in ("terminal", "absorbing"):
        raise ValueError(f"goal must be 'terminal' or 'absorbing', not {goal!r}")
    if not 0.0 <= p_slip < 1.0:
        raise ValueError(f"p_slip must lie in [0, 1), not {p_slip}")
    n = size * size
    cell = np.arange(n)
    neighbour = np.empty((len(_MOVES), n), dtype=np.int64)
    for a, (dx, dy) in enumerate(_MOVES):
        x, y = cell % size + dx, cell // size + dy
        inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
        to = np.where(inside, y * size + x, cell)
        neighbour[a] = np.where(wall[to] | wall, cell, to)
    goal_state = n - 1
    afterstate = neighbour.copy()
    afterstate[:, goal_state] = n
    successor = np.concatenate([np.stack([cell, *neighbour], 1), np.full((1, 5), goal_state)])
    probability = np.tile(np.array([1.0 - p_slip, *[p_slip / 4] * 4]), (n + 1, 1))
    probability[n] = 0.0
    probability[n, 0] = 1.0 if goal == "absorbing" else 0.0
    start = np.zeros(n)
    start[0] = 1.0
    reward = np.full(n, -1.0)
    reward[goal_state] = 0.0
    mdp = TabularMDP(afterstate, successor, probability, start, reward, goal_state)
    shortest_path_length(mdp)
    return mdp


def observations(size: int) -> np.ndarray:
    """[S, 2] float32: (x, y) / (size - 1) of every state."""
    cell = np.arange(size * size)
    return (np.stack([cell % size, cell // size], 1) / (size - 1)).astype(np.float32)


def state_indices(observation: np.ndarray, size: int) -> np.ndarray:
    """The states [...] int64 whose observations are ``observation`` [..., 2].

    Raises:
        ValueError: an observation of another environment, or of a grid of another size.
    """
    observation = np.asarray(observation)
    if observation.shape[-1:] != (2,):
        raise ValueError(f"a gridworld observation has 2 numbers, not {observation.shape[-1:]}")
    position = np.rint(observation.astype(np.float64) * (size - 1))
    if not ((position >= 0) & (position < size)).all():
        raise ValueError(f"observations outside a gridworld of size {size}")
    state = (position[..., 1] * size + position[..., 0]).astype(np.int64)
    if not np.array_equal(observations(size)[state], observation.astype(np.float32)):
        raise ValueError(f"observations that match no cell of a gridworld of size {size}")
    return state


def expert_policy(mdp: TabularMDP, horizon: int) -> np.ndarray:
    """The optimal policy pi_t(a|s) [H, A, S] for the true reward, by value iteration.

    Equally good actions are equally likely.

    Raises:
        ValueError: as :func:`irlcli.tabular.backward`.
    """
    settings = stack([mdp])
    return backward(settings, true_reward(settings), horizon)[0][:, :, 0, :, 0]


def sample_trajectories(
    mdp: TabularMDP, size: int, policy: np.ndarray, episodes: int, seed: int
) -> list[Trajectory]:
    """``episodes`` trajectories of ``policy`` [H, A, S], the i-th from seed ``seed + i``.

    An episode terminates where the MDP ends it, and is truncated after H steps otherwise. It
    depends on its own seed only.

    Raises:
        ValueError: fewer than one episode.
    """
    if episodes < 1:
        raise ValueError(f"at least one episode is needed, not {episodes}")
    horizon = len(policy)
    generators = [np.random.default_rng(seed + i) for i in range(episodes)]
    draws = np.stack([g.random((horizon + 1, 2)) for g in generators])
    state = np.searchsorted(np.cumsum(mdp.start), draws[:, horizon, 0], side="right")
    states = np.empty((episodes, horizon + 1), dtype=np.int64)
    actions = np.empty((episodes, horizon), dtype=np.int64)
    states[:, 0] = state
    for t in range(horizon):
        actions[:, t] = _choose(policy[t].T[state], draws[:, t, 0])
        after = mdp.afterstate[actions[:, t], state]
        state = mdp.successor[after, _choose(mdp.probability[after], draws[:, t, 1])]
        states[:, t + 1] = state
    ends = mdp.terminal[states]
    ends[:, -1] = True
    cells = observations(size)
    found = []
    for i, length in enumerate(ends.argmax(1)):
        path = states[i, : length + 1]
        terminated = bool(mdp.terminal[path[-1]])
        found.append(
            Trajectory(
                observations=cells[path],
                actions=actions[i, :length].copy(),
                rewards=mdp.reward[path[:-1]],
                terminated=terminated,
                truncated=not terminated,
                seed=seed + i,
            )
        )
    return found


def _choose(probability: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """An index from each row of ``probability`` [B, K], by inversion of ``uniform`` [B]."""
    cumulative = np.cumsum(probability, 1)
    # Scaled by the total, so that rounding cannot move a draw past the last possible index.
    passed = (cumulative <= uniform[:, None] * cumulative[:, -1:]).sum(1)
    return passed.clip(max=probability.shape[1] - 1)


class Gridworld(gymnasium.Env[np.ndarray, np.int64]):
    """The gridworld as an environment; see the module for cells, actions, slips and reward.

    With ``goal="terminal"`` the goal ends the episode; with ``absorbing`` the agent stays there at
    reward 0. The environment itself has no time limit.

    Args:
        size, path_group, blocked, goal, p_slip: as :func:`gridworld`.
        render_mode: ``None`` or ``"ansi"``.

    Raises:
        ValueError: as :func:`gridworld`.
    """

    metadata: dict[str, Any] = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        size: int = 8,
        path_group: float = 0,
        blocked: float = 0,
        goal: Goal = "terminal",
        p_slip: float = 0.2,
        render_mode: str | None = None,
    ):
        self.mdp = gridworld(size, path_group, blocked, goal, p_slip)
        self.size = size
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0.0, 1.0, (2,), np.float32)
        self.action_space = gymnasium.spaces.Discrete(self.mdp.n_actions)
        self._wall = walls(size, path_group, blocked)
        self._observations = observations(size)
        self._state = int(self.mdp.start.argmax())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start at the bottom left; returns the observation [2] float32."""
        super().reset(seed=seed, options=options)
        self._state = int(self.mdp.start.argmax())
        return self._observations[self._state].copy(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One move: observation [2] float32, true reward, terminated, truncated (never), info.

        Raises:
            ValueError: ``action`` is not 0, 1, 2 or 3.
        """
        if not self.action_space.contains(action):
            raise ValueError(f"action must be 0, 1, 2 or 3, not {action!r}")
        reward = float(self.mdp.reward[self._state])
        after = self.mdp.afterstate[int(action), self._state]
        chances = self.mdp.probability[after]
        if chances.any():
            choice = _choose(chances[None], self.np_random.random(1))[0]
            self._state = int(self.mdp.successor[after, choice])
        terminated = bool(self.mdp.terminal[self._state])
        return self._observations[self._state].copy(), reward, terminated, False, {}

    def render(self) -> str | None:
        """The grid as text, top row first: ``A`` agent, ``G`` goal, ``#`` wall."""
        if self.render_mode != "ansi":
            return None
        marks = np.where(self._wall, "#", ".")
        marks[self.mdp.goal] = "G"
        marks[self._state] = "A"
        return "\n".join("".join(row) for row in marks.reshape(self.size, self.size)[::-1])
