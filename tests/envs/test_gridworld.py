"""The gridworld's kernel against sampling, its walls, experts, observations and errors."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from irlcli.envs.gridworld.env import (
    PATH_GROUPS,
    Gridworld,
    expert_policy,
    gridworld,
    observations,
    sample_trajectories,
    state_indices,
    walls,
)
from irlcli.tabular import dense_transitions, evaluate, shortest_path_length, stack

SETTINGS = [
    {},
    *({"path_group": g} for g in PATH_GROUPS),
    {"blocked": 1},
    {"blocked": 2},
]


@pytest.mark.parametrize("goal", ["terminal", "absorbing"])
@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_rows_of_the_kernel_sum_to_one_except_after_the_end(setting, goal):
    mdp = gridworld(6, goal=goal, **setting)
    total = dense_transitions(mdp).sum(-1)
    assert np.allclose(np.delete(total, mdp.goal, axis=1), 1.0, atol=1e-14)
    assert (total[:, mdp.goal] == (1.0 if goal == "absorbing" else 0.0)).all()
    assert mdp.terminal.sum() == (goal == "terminal")


def test_kernel_of_an_inner_cell_beside_a_wall_by_hand():
    size = 6
    mdp = gridworld(size, path_group=1)
    dense = dense_transitions(mdp)
    # Right from (1, 2): the target is (2, 2), whose right and upper neighbours are walls.
    assert walls(size, path_group=1)[[2 * size + 3, 3 * size + 2]].all()
    expected = np.zeros(size * size)
    expected[2 * size + 2] = 0.8 + 2 * 0.05
    expected[2 * size + 1] = expected[1 * size + 2] = 0.05
    assert np.allclose(dense[1, 2 * size + 1], expected, atol=1e-15)
    # Right from (2, 2): the target is the cell itself.
    assert np.allclose(dense[1, 2 * size + 2], expected, atol=1e-15)


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_nothing_enters_a_wall(setting):
    mdp = gridworld(8, **setting)
    wall = walls(8, **setting)
    assert dense_transitions(mdp)[:, ~wall][..., wall].sum() == 0.0


@pytest.mark.parametrize("goal", ["terminal", "absorbing"])
def test_sampled_frequencies_agree_with_the_exact_kernel(goal):
    env = Gridworld(5, path_group=3, goal=goal)
    dense = dense_transitions(env.mdp)
    env.reset(seed=3)
    episodes, steps = 3000, 6
    counts = np.zeros((steps + 1, 25))
    actions = np.array([0, 1, 2, 1, 3, 0])
    for _ in range(episodes):
        observation, _ = env.reset()
        counts[0, state_indices(observation, 5)] += 1
        for t, action in enumerate(actions):
            observation, _, terminated, truncated, _ = env.step(action)
            assert not terminated and not truncated
            counts[t + 1, state_indices(observation, 5)] += 1
    state = env.mdp.start
    for t, action in enumerate(actions):
        state = state @ dense[action]
        error = np.sqrt(state * (1 - state) / episodes)
        assert (np.abs(counts[t + 1] / episodes - state) <= 4.5 * error + 1e-12).all()


def test_sampled_trajectories_agree_with_the_exact_evaluation():
    mdp = gridworld(6, path_group=2)
    policy = expert_policy(mdp, 30)
    episodes = sample_trajectories(mdp, 6, policy, 2000, seed=5)
    exact = evaluate(stack([mdp]), policy[:, :, None, :, None])
    returns = np.array([t.episode_return for t in episodes])
    error = returns.std() / np.sqrt(len(returns))
    assert abs(returns.mean() - exact.true_return[0, 0]) < 4.5 * error
    assert np.mean([t.terminated for t in episodes]) == pytest.approx(
        exact.goal_probability[0, 0], abs=1e-3
    )


def test_trajectories_run_from_start_to_goal_and_depend_on_their_seed_only():
    mdp = gridworld(6)
    policy = expert_policy(mdp, 40)
    five = sample_trajectories(mdp, 6, policy, 5, seed=10)
    last = sample_trajectories(mdp, 6, policy, 1, seed=14)[0]
    assert np.array_equal(five[4].observations, last.observations)
    assert np.array_equal(five[4].actions, last.actions)
    for i, trajectory in enumerate(five):
        assert trajectory.seed == 10 + i
        path = state_indices(trajectory.observations, 6)
        assert path[0] == 0 and path[-1] == mdp.goal and trajectory.terminated
        assert mdp.goal not in path[:-1]
        assert trajectory.episode_return == -len(trajectory)


def test_an_absorbing_goal_is_occupied_until_the_horizon():
    mdp = gridworld(5, goal="absorbing")
    trajectory = sample_trajectories(mdp, 5, expert_policy(mdp, 40), 1, seed=0)[0]
    assert len(trajectory) == 40 and trajectory.truncated and not trajectory.terminated
    at_goal = state_indices(trajectory.observations, 5) == mdp.goal
    assert at_goal[-1] and (np.diff(at_goal.astype(int)) >= 0).all()
    assert trajectory.episode_return == -(~at_goal).sum()


def test_path_groups_take_different_corridors():
    size = 8
    corner = {1: (0, size - 1), 2: (size - 1, 0)}
    for group in PATH_GROUPS:
        mdp = gridworld(size, path_group=group)
        episodes = sample_trajectories(mdp, size, expert_policy(mdp, 64), 100, seed=0)
        assert all(t.terminated for t in episodes)
        paths = [np.rint(t.observations * (size - 1)) for t in episodes]
        for other, at in corner.items():
            near = np.mean([(np.abs(p - at).sum(1) <= 3).any() for p in paths])
            assert (near == 1.0) if other == group else (near < 0.1)


@pytest.mark.parametrize("size", [5, 6, 7, 8, 9, 16, 33])
def test_unseen_walls_leave_a_path_and_differ_from_all_training_settings(size):
    training = [walls(size, path_group=g) for g in PATH_GROUPS]
    for blocked in (1, 2):
        wall = walls(size, blocked=blocked)
        assert not any(np.array_equal(wall, other) for other in training)
        assert shortest_path_length(gridworld(size, blocked=blocked)) >= 2 * (size - 1)
    for group in PATH_GROUPS:
        assert shortest_path_length(gridworld(size, path_group=group)) == 2 * (size - 1)


def test_experts_are_uniform_over_ties_and_optimal_without_slips():
    mdp = gridworld(4, p_slip=0.0)
    policy = expert_policy(mdp, 6)
    assert np.allclose(policy[0, :, 0], [0.5, 0.5, 0.0, 0.0])
    result = evaluate(stack([mdp]), policy[:, :, None, :, None])
    assert result.goal_probability[0, 0] == pytest.approx(1.0)
    assert result.true_return[0, 0] == pytest.approx(-6.0)


@pytest.mark.parametrize("size", [2, 3, 8, 100, 256])
def test_observations_identify_the_state_exactly(size):
    everything = observations(size)
    assert everything.dtype == np.float32 and len(np.unique(everything, axis=0)) == size**2
    assert np.array_equal(state_indices(everything, size), np.arange(size**2))


@pytest.mark.parametrize("goal", ["terminal", "absorbing"])
def test_environment_passes_gymnasiums_checker(goal):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*render.*")
        check_env(Gridworld(6, path_group=2.0, goal=goal), skip_render_check=True)


def test_environment_replays_from_a_seed_and_renders_as_text():
    env = Gridworld(5, render_mode="ansi")
    runs = []
    for _ in range(2):
        env.reset(seed=1)
        runs.append([env.step(1)[0].tolist() for _ in range(10)])
    assert runs[0] == runs[1]
    env.reset(seed=1)
    assert env.render().splitlines()[-1] == "A...."
    assert env.render().splitlines()[0] == "....G"


@pytest.mark.parametrize("action", [-1, 4, 1.5])
def test_other_actions_than_the_four_are_refused(action):
    env = Gridworld(5)
    env.reset(seed=1)
    with pytest.raises(ValueError, match="action must be 0, 1, 2 or 3"):
        env.step(action)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 1}, "size must be"),
        ({"size": 6.5}, "size must be"),
        ({"size": 4, "path_group": 1}, "at least 5"),
        ({"path_group": 4}, "path_group must be"),
        ({"path_group": 1.5}, "path_group must be"),
        ({"blocked": 3}, "blocked must be"),
        ({"blocked": float("nan")}, "blocked must be"),
        ({"goal": "sticky"}, "goal must be"),
        ({"p_slip": 1.0}, "p_slip must lie"),
        ({"p_slip": float("nan")}, "p_slip must lie"),
        ({"path_group": 1, "blocked": 1}, "cannot be reached"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        gridworld(**arguments)


def test_observations_of_another_environment_are_refused():
    with pytest.raises(ValueError, match="2 numbers"):
        state_indices(np.zeros((3, 8), np.float32), 8)
    with pytest.raises(ValueError, match="outside"):
        state_indices(np.full((1, 2), 1.5, np.float32), 8)
    with pytest.raises(ValueError, match="no cell"):
        state_indices(observations(7), 8)


def test_zero_episodes_are_refused():
    mdp = gridworld(3)
    with pytest.raises(ValueError, match="at least one episode"):
        sample_trajectories(mdp, 3, expert_policy(mdp, 8), 0, seed=0)
