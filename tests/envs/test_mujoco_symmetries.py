"""An image of a transition of MuJoCo's Ant is a transition, with the same true reward."""

import numpy as np
import pytest
from mujoco_robots import Ant

from irlcli.envs.declared_symmetries import check_group
from irlcli.envs.mujoco.symmetries import ant
from irlcli.symmetries import Symmetries

CHANGED = {"mass": 2.0, "friction": 0.5, "actuator_strength": 0.75, "joint_limit": 0.75}
LONG_LEGS = {"leg_length": 2.0}


def image(group: Symmetries, element: int, state: np.ndarray) -> np.ndarray:
    """The image of positions and velocities [29]; the plane through the goal is y = 0."""
    turned = group.observations[element].astype(float)
    sideways = turned[14, 14]
    return np.concatenate([state[:2] * [1.0, sideways], turned[:27, :27] @ state[2:]])


@pytest.mark.parametrize("setting", [{}, CHANGED, LONG_LEGS], ids=str)
def test_images_of_transitions_are_transitions_with_the_same_reward(setting):
    group = ant([setting])
    rng = np.random.default_rng(0)
    touched = 0.0
    for element, (turned, moved) in enumerate(zip(*group[:2], strict=True)):
        env, other = Ant(**setting), Ant(**setting)
        env.reset(seed=0)
        other.reset(seed=0)
        # Into a state without any symmetry of its own, with feet on the floor.
        for _ in range(30):
            env.step(rng.uniform(-1.0, 1.0, 8))
        state = image(group, element, np.concatenate([env.data.qpos, env.data.qvel]))
        other.set_state(state[:15], state[15:])
        # Its first reward counts from where the robot was one substep before it was placed.
        for step in range(20):
            action = rng.uniform(-1.0, 1.0, 8)
            observation, reward, *_ = env.step(action)
            found, earned, *_ = other.step(moved @ action)
            np.testing.assert_allclose(found, turned @ observation, atol=0.01)
            touched = max(touched, np.abs(observation[33:]).max())
            if step > 0:
                assert earned == pytest.approx(reward, abs=0.01)
        env.close()
        other.close()
    assert touched > 0.1


@pytest.mark.parametrize(
    ("settings", "count"), [([{}, CHANGED], 16), ([LONG_LEGS], 4), ([{}, LONG_LEGS], 4)], ids=str
)
def test_they_are_a_group_of_different_maps_with_both_signs_of_a_quaternion(settings, count):
    group = ant(settings)
    check_group(group, 105, 8)
    assert len(group.observations) == count
    assert len(np.unique(group.observations.reshape(count, -1), axis=0)) == count
    assert len(np.unique(np.round(group.actions, 4).reshape(count, -1), axis=0)) == count // 2
    opposite = np.ones(105)
    opposite[1:5] = -1.0
    assert any(np.allclose(each, np.diag(opposite), atol=1e-6) for each in group.observations)
