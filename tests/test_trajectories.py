"""Trajectories and transitions: what is checked, and how episodes become transitions."""

import numpy as np
import pytest

from irlcli.trajectories import Rollout, Trajectory, side_by_side, transitions


def make_trajectory(steps, seed=0, terminated=True):
    rng = np.random.default_rng(seed)
    return Trajectory(
        observations=rng.normal(size=(steps + 1, 8)).astype(np.float32),
        actions=rng.integers(4, size=steps),
        rewards=rng.normal(size=steps),
        terminated=terminated,
        truncated=not terminated,
        seed=seed,
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": np.zeros((3, 2), np.float32)}, "need observations"),
        ({"actions": np.zeros(5, np.int64)}, "need 3 actions"),
        ({"rewards": np.zeros(0)}, "at least one step"),
        ({"rewards": np.array([0.0, np.nan, 0.0])}, "rewards are not finite"),
        ({"observations": np.zeros((4, 2))}, "float32"),
        ({"actions": np.zeros(3, np.int32)}, "int64 or float32"),
        ({"truncated": True}, "either terminated or truncated"),
    ],
)
def test_trajectories_are_validated(changes, message):
    fields = {
        "observations": np.zeros((4, 2), np.float32),
        "actions": np.zeros(3, np.int64),
        "rewards": np.zeros(3),
        "terminated": True,
        "truncated": False,
        "seed": 0,
    }
    with pytest.raises(ValueError, match=message):
        Trajectory(**{**fields, **changes})


def test_trajectories_are_frozen():
    with pytest.raises(ValueError, match="read-only"):
        make_trajectory(3).rewards[0] = 1.0


def test_transitions_count_the_steps_left_of_the_horizon():
    data = transitions([make_trajectory(4), make_trajectory(3, terminated=False)], horizon=10)
    assert data.terminated.tolist() == [False] * 3 + [True] + [False] * 3
    assert data.remaining.tolist() == [0, 0, 0, 6, 0, 0, 0]
    first = make_trajectory(4)
    np.testing.assert_array_equal(data.next_observations[:4], first.observations[1:])
    with pytest.raises(ValueError, match="exceeds the horizon"):
        transitions([make_trajectory(11)], horizon=10)
    with pytest.raises(ValueError, match="at least one"):
        transitions([], horizon=10)


def a_rollout(values, errors=()):
    """Of three steps; each number of a world is its value in ``values``."""
    world = np.broadcast_to(np.asarray(values, dtype=np.float64), (3, len(values)))
    names = ("observations", "actions", "next_observations")
    arrays = dict.fromkeys(names, world[..., None]) | dict.fromkeys(
        ("log_probs", "true_rewards", "returns", "progress"), world
    )
    flags = dict.fromkeys(("terminated", "truncated"), world > 1.0)
    return Rollout(**arrays, **flags, lengths=world.astype(np.int64), errors=tuple(errors))


def test_rollouts_side_by_side_have_the_worlds_of_the_first_part_first():
    parts = a_rollout([1.0, 2.0], [(1, "fell")]), a_rollout([3.0, 4.0, 5.0], [(0, "a"), (2, "b")])
    found = side_by_side(parts)
    np.testing.assert_array_equal(found.observations[0, :, 0], [1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(found.returns[2], [1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_array_equal(found.terminated[1], [False, True, True, True, True])
    assert found.errors == ((1, "fell"), (2, "a"), (4, "b"))
