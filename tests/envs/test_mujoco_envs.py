"""The MuJoCo robots as Gymnasium environments: the originals, seeds, falls, invalid input."""

from __future__ import annotations

import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from mujoco_robots import ROBOTS, actions, roll

from irlcli.envs.registration import make
from irlcli.envs.vector import VectorWorlds
from irlcli.interventions import parse_setting

FALLING = sorted(set(ROBOTS) - {"HalfCheetah"})


@pytest.fixture(params=sorted(ROBOTS))
def name(request):
    return request.param


def unchanged(name: str):
    """A robot whose every multiplier is given, and is 1."""
    return ROBOTS[name](
        mass=1, friction=1, gravity=1, leg_length=1, actuator_strength=1, joint_limit=1
    )


def default(name: str):
    """A robot without arguments."""
    return ROBOTS[name]()


@pytest.mark.parametrize("robot", [default, unchanged])
def test_without_changes_every_step_is_that_of_gymnasium_to_the_last_bit(name, robot):
    ours = robot(name)
    original = gymnasium.make(f"{name}-v5").unwrapped
    episodes = 0
    for env in (ours, original):
        env.reset(seed=3)
    for action in actions(original, 150):
        observation, reward, terminated, truncated, info = ours.step(action)
        expected = original.step(action)
        np.testing.assert_array_equal(ours.data.qpos, original.data.qpos)
        np.testing.assert_array_equal(ours.data.qvel, original.data.qvel)
        np.testing.assert_array_equal(observation, expected[0].astype(np.float32))
        assert (reward, terminated, truncated) == expected[1:4]
        assert {key: info[key] for key in expected[4] if key.startswith("reward")} == {
            key: value for key, value in expected[4].items() if key.startswith("reward")
        }
        if terminated:
            episodes += 1
            first = [env.reset()[0].astype(np.float32) for env in (ours, original)]
            np.testing.assert_array_equal(*first)
    assert episodes or name in ("Ant", "HalfCheetah")


def test_passes_gymnasiums_checker(name):
    env = ROBOTS[name]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
    env.close()


def test_gymnasiums_arguments_keep_their_meaning(name):
    arguments = {"exclude_current_positions_from_observation": False}
    ours = ROBOTS[name](**arguments)
    original = gymnasium.make(f"{name}-v5", **arguments).unwrapped
    found, expected = (env.reset(seed=3)[0] for env in (ours, original))
    np.testing.assert_array_equal(found, expected.astype(np.float32))
    assert ours.observation_space.contains(found)


def test_an_episode_depends_on_its_seed_only(name):
    env = ROBOTS[name]()
    expected = roll(env, 7)
    roll(env, 8)
    np.testing.assert_array_equal(roll(env, 7), expected)
    np.testing.assert_array_equal(roll(ROBOTS[name](), 7), expected)
    assert not np.array_equal(roll(env, 8), expected)


def test_robots_of_one_process_do_not_affect_each_other(name):
    expected = roll(ROBOTS[name](mass=2.0), 3, 30)
    env, others = ROBOTS[name](mass=2.0), [ROBOTS[name](), ROBOTS[name](leg_length=0.5)]
    env.reset(seed=3)
    for other in others:
        other.reset(seed=4)
    for action, row in zip(actions(env, 30, 3), expected[1:], strict=True):
        for other in others:
            other.step(np.ones(env.action_space.shape))
        observation, _, terminated, _, _ = env.step(action)
        np.testing.assert_array_equal(env.reset()[0] if terminated else observation, row)


def test_a_pickled_robot_is_made_as_it_was(name):
    env = ROBOTS[name](mass=2.0)
    again = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(again.model.body_mass, env.model.body_mass)


def test_progress_is_the_distance_moved_forward():
    env = ROBOTS["HalfCheetah"]()
    env.reset(seed=0)
    start = env.data.qpos[0]
    steps = [env.step(action)[4]["progress"] for action in actions(env, 50)]
    assert sum(steps) == pytest.approx(env.data.qpos[0] - start)


@pytest.mark.parametrize("name", FALLING)
def test_a_fall_ends_the_episode_unless_told_otherwise(name):
    ends = {}
    for terminates in (0, 1):
        env = ROBOTS[name](terminate_when_unhealthy=terminates)
        env.reset(seed=0)
        # Lifted too high; a hopper is healthy at every height above 0.7 m.
        env.data.qpos[env.z_index] = 0.1 if name == "Hopper" else 3.0
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert not truncated and info["reward_survive"] == 0.0
        ends[terminates] = terminated
        assert not env.is_healthy
        env.reset(seed=0)
        assert env.is_healthy
    assert ends == {0: False, 1: True}


def test_a_setting_says_whether_a_fall_ends_the_episode():
    for text, expected in (("default", True), ("mass=2x,terminate-when-unhealthy=0", False)):
        world = make("mujoco-hopper", parse_setting("mujoco-hopper", text))
        world.reset(seed=0)
        assert any(world.step(action)[2] for action in actions(world, 200)) == expected


def test_actions_are_clipped_to_the_motors_range(name):
    env = ROBOTS[name]()
    ends = []
    for factor in (1.0, 50.0):
        env.reset(seed=0)
        ends.append(env.step(factor * env.action_space.high))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1]


def test_single_precision_actions_have_the_effect_of_double_ones():
    """Worker processes receive float64, and must lead to the same bytes."""
    env = ROBOTS["HalfCheetah"]()
    ends = []
    for dtype in (np.float32, np.float64):
        env.reset(seed=0)
        ends.append(env.step(actions(env, 1)[0].astype(np.float32).astype(dtype)))
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1]


@pytest.mark.parametrize("action", [np.full(6, np.nan), np.full(6, np.inf), np.zeros(5)])
def test_invalid_actions_are_rejected(action):
    env = ROBOTS["HalfCheetah"]()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must"):
        env.step(action)


@pytest.mark.parametrize("broken", [np.nan, 1e30])
def test_an_unstable_simulation_ends_the_episode_and_leaves_no_trace(
    name, broken, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    env = ROBOTS[name]()
    expected = roll(env, 5, 20)
    env.reset(seed=0)
    before = env.step(np.zeros(env.action_space.shape))[0]
    env.data.qvel[-1] = broken
    observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert "the simulation is unstable" in info["error"]
    np.testing.assert_array_equal(observation, before)
    np.testing.assert_array_equal(roll(env, 5, 20), expected)
    # MuJoCo would write a file here.
    assert not list(tmp_path.iterdir()) and capfd.readouterr() == ("", "")


def test_a_robot_that_is_thrown_apart_earns_nothing_for_it(name):
    """MuJoCo's own bound is 1e10; below it the speed forward would still be paid."""
    env = ROBOTS[name]()
    for speed, thrown in ((20.0, False), (1000.0, True), (-1000.0, True)):
        env.reset(seed=0)
        env.data.qvel[0] = speed
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert truncated == thrown == ("error" in info)
        assert (reward == 0.0 and not terminated) if thrown else reward > 1.0


def test_worlds_go_on_after_one_became_unstable():
    worlds = VectorWorlds([ROBOTS["HalfCheetah"](), ROBOTS["HalfCheetah"]()], 50)
    worlds.reset([0, 1])
    worlds.envs[1].data.qpos[3] = np.inf
    _, _, ended = worlds.step(np.zeros((2, 6)))
    assert [(end.world, end.terminated) for end in ended] == [(1, False)]
    assert "unstable" in ended[0].error
    for _ in range(5):
        observations, rewards, ended = worlds.step(np.zeros((2, 6)))
        assert np.isfinite(observations).all() and np.isfinite(rewards).all() and not ended
