"""An image of a transition is a transition: physics and true reward do not tell them apart."""

import numpy as np
import pytest
from bullet_robots import body, pybullet

from irlcli.envs.ant.env import Ant
from irlcli.envs.ant.symmetries import symmetries
from irlcli.envs.declared_symmetries import check_group
from irlcli.symmetries import Symmetries

SQUARE = [{"friction": (2.0, 0.6, 0.6)}, {"mass": 2.0}, {}]
LONG_LEGS = {"leg_length": 2.0}
GOAL = {"goal_y": 900.0}


def same_orientation(group, observation: np.ndarray, other: np.ndarray) -> np.ndarray:
    """``observation`` with the quaternion's sign of ``other``: both signs describe one orientation."""
    found, where = observation.copy(), group.quaternion
    if found[where] @ other[where] < 0.0:
        found[where] *= -1.0
    return found


def placed(env: Ant, observation: np.ndarray, position: tuple[float, float, float]) -> None:
    """Put the robot into the state that ``observation`` describes."""
    robot, client = body(env)
    pybullet.resetBasePositionAndOrientation(robot, position, observation[1:5], client)
    pybullet.resetBaseVelocity(robot, observation[13:16], observation[16:19], client)
    for joint, (angle, speed) in enumerate(zip(observation[5:13], observation[19:27], strict=True)):
        pybullet.resetJointState(robot, joint, angle, speed, client)


@pytest.mark.parametrize("setting", [*SQUARE, LONG_LEGS, GOAL], ids=str)
def test_images_of_transitions_are_transitions_with_the_same_reward(setting):
    group = symmetries([setting])
    rng = np.random.default_rng(0)
    for turned, moved in zip(group.observations, group.actions, strict=True):
        env, other = Ant(**setting), Ant(**setting)
        observation, _ = env.reset(seed=0)
        other.reset(seed=0)
        # Into a state without any symmetry of its own.
        for _ in range(3):
            observation, *_ = env.step(rng.uniform(-1.0, 1.0, 8))
        x, y, z = pybullet.getBasePositionAndOrientation(*body(env))[0]
        reflected = turned[14, 14] < 0.0
        placed(other, turned @ observation, (x, -y if reflected else y, z))
        # Its first reward counts from where the robot was before it was placed.
        for step in range(12):
            action = rng.uniform(-1.0, 1.0, 8)
            observation, reward, *_ = env.step(action)
            found, earned, *_ = other.step(moved @ action)
            expected = same_orientation(group, turned @ observation, found)
            np.testing.assert_allclose(found, expected, atol=0.02)
            if step > 0:
                assert earned == pytest.approx(reward, abs=0.02)
        env.close()
        other.close()


@pytest.mark.parametrize("settings", [SQUARE, [LONG_LEGS], [GOAL], [{}, LONG_LEGS]], ids=str)
def test_images_form_a_group(settings):
    group = symmetries(settings)
    count, width = group.observations.shape[:2]
    np.testing.assert_array_equal(group.observations[0], np.eye(width))
    np.testing.assert_array_equal(group.actions[0], np.eye(8))
    rng = np.random.default_rng(0)
    observation, action = rng.normal(size=width), rng.normal(size=8)
    images = [(o @ observation, a @ action) for o, a in zip(*group[:2], strict=True)]
    for other, moved in zip(*group[:2], strict=True):
        for seen, acted in images:
            again = same_orientation(group, other @ seen, other @ seen)
            matches = [
                np.allclose(same_orientation(group, again, image), image, atol=1e-5)
                and np.allclose(moved @ acted, action_, atol=1e-5)
                for image, action_ in images
            ]
            assert sum(matches) == 1
    # All are different.
    for i in range(count):
        for j in range(i):
            assert not np.allclose(images[i][1], images[j][1])


@pytest.mark.parametrize(
    ("settings", "count"),
    [(SQUARE, 8), ([LONG_LEGS], 2), ([{}, LONG_LEGS], 2), ([GOAL], 4), ([GOAL | LONG_LEGS], 1)],
    ids=str,
)
def test_only_what_holds_in_every_setting_is_a_symmetry(settings, count):
    assert len(symmetries(settings).observations) == count


@pytest.mark.parametrize("settings", [SQUARE, [LONG_LEGS], [GOAL], [GOAL | LONG_LEGS]], ids=str)
def test_the_ants_symmetries_pass_the_check(settings):
    group = symmetries(settings)
    check_group(group, group.observations.shape[-1], 8)


def broken(**changes):
    """The group of a point on a line, (x, v) and one action, with one thing wrong."""
    parts = {
        "observations": np.array([np.eye(2), -np.eye(2)], np.float32),
        "actions": np.array([[[1.0]], [[-1.0]]], np.float32),
    }
    return Symmetries(**(parts | changes))


QUARTER = np.array([[0.0, 1.0], [-1.0, 0.0]])


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (broken(), None),
        ([np.eye(2)], "not list"),
        (broken(observations=np.array([np.eye(2), -np.eye(2)])), "not float64"),
        (broken(observations=np.ones((2, 3, 3), np.float32)), "not float32 [2, 3, 3]"),
        (broken(actions=np.ones((1, 1, 1), np.float32)), "not float32 [1, 1, 1]"),
        (broken(actions=-np.ones((2, 1, 1), np.float32)), "first map of actions"),
        (broken(observations=np.array([np.eye(2), QUARTER], np.float32)), "no group"),
        (broken(actions=np.array([[[1.0]], [[2.0]]], np.float32)), "no group"),
        # A mask instead of a reflection.
        (
            broken(
                observations=np.array([np.eye(2), np.diag([1.0, 0.0])], np.float32),
                actions=np.ones((2, 1, 1), np.float32),
            ),
            "undoes map 1",
        ),
        # Twice a quarter turn is the identity up to the sign of a quaternion.
        (
            broken(observations=np.array([np.eye(2), QUARTER], np.float32), quaternion=slice(2)),
            None,
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_what_is_declared_must_be_a_group_of_maps_of_the_right_size(found, said):
    if said is None:
        check_group(found, 2, 1)
        return
    with pytest.raises(ValueError, match=r".") as caught:
        check_group(found, 2, 1)
    assert said in str(caught.value)
