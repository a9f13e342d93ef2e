"""The PyBullet robots as gymnasium environments: interface, seeds, invalid input, rendering."""

from __future__ import annotations

import gc
import math
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from bullet_robots import ROBOTS, body, pybullet
from gymnasium.utils.env_checker import check_env
from original_robots import MODELS

from irlcli.envs.ant.env import Ant
from irlcli.envs.registration import transition_reward
from irlcli.envs.vector import VectorWorlds

EVERY = [(name, model) for name in ROBOTS for model in MODELS]
SIZES = {"ant": (27, 8, 8), "half_cheetah": (17, 6, 9), "reacher": (9, 2, 4)}


@pytest.fixture(params=sorted(ROBOTS))
def env(request):
    env = ROBOTS[request.param]()
    yield env
    env.close()


@pytest.mark.parametrize(("name", "model"), EVERY)
def test_passes_gymnasiums_checker(name, model):
    env = MODELS[model][name]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("name", ["Ant", "HalfCheetah", "Reacher"])
def test_passes_gymnasiums_rendering_check_without_a_display(name, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    env = gymnasium.make(f"irlcli/{name}-v0", render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env)
    env.close()


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_has_the_documented_sizes(name):
    env = ROBOTS[name]()
    observation, _ = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape == (SIZES[name][0],)
    assert observation.dtype == np.float32
    assert env.action_space.shape == (SIZES[name][1],)
    env.close()


def roll(env, seed: int, steps: int = 60) -> np.ndarray:
    random = np.random.default_rng(seed)
    path = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        path.append(env.step(random.uniform(-1, 1, env.action_space.shape))[0])
    return np.array(path)


def test_an_episode_depends_on_its_seed_only(env):
    expected = roll(env, 7)
    roll(env, 8)
    np.testing.assert_array_equal(roll(env, 7), expected)
    fresh = type(env)()
    np.testing.assert_array_equal(roll(fresh, 7), expected)
    fresh.close()
    assert not np.array_equal(roll(env, 8), expected)


def test_two_environments_in_one_process_do_not_affect_each_other(env):
    expected = roll(env, 3)
    other = type(env)()
    other.reset(seed=4)
    env.reset(seed=3)
    random = np.random.default_rng(3)
    for row in expected[1:]:
        other.step(np.ones(env.action_space.shape))
        action = random.uniform(-1, 1, env.action_space.shape)
        np.testing.assert_array_equal(env.step(action)[0], row)
    other.close()


def test_actions_beyond_the_actuators_range_are_clipped(env):
    size = env.action_space.shape
    env.reset(seed=0)
    clipped = env.step(np.full(size, 1.0))
    env.reset(seed=0)
    beyond = env.step(np.full(size, 50.0))
    np.testing.assert_array_equal(clipped[0], beyond[0])
    assert clipped[1] == beyond[1]


def test_the_reward_is_the_sum_of_its_terms(env):
    env.reset(seed=0)
    for _ in range(20):
        _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert reward == pytest.approx(sum(info.values()))
        assert not terminated
        assert not truncated


def test_an_idle_ant_is_rewarded_for_being_alive_only():
    env = Ant()
    env.reset(seed=0)
    infos = [env.step(np.zeros(8))[4] for _ in range(300)]
    env.close()
    assert sum(info["alive"] for info in infos) == 300.0
    assert abs(sum(info["progress"] for info in infos)) * 0.0165 < 1.0


def test_the_reset_option_joint_positions_sets_the_start(env):
    size = {Ant: 8}.get(type(env), 9 if env.action_space.shape == (6,) else 4)
    positions = np.linspace(0.01, 0.05, size)
    observation, _ = env.reset(seed=0, options={"joint_positions": positions})
    if isinstance(env, Ant):
        np.testing.assert_allclose(observation[5:13], positions, rtol=1e-6)
    elif size == 9:
        np.testing.assert_allclose(observation[:8], positions[1:], rtol=1e-6)
    else:
        np.testing.assert_allclose(observation[:2], positions[2:], rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint_positions": [0.0]}, "finite numbers"),
        ({"joint_positions": [math.nan] * 8}, "finite numbers"),
        ({"positions": [0.0] * 8}, "the only reset option is 'joint_positions'"),
    ],
)
def test_invalid_reset_options_are_rejected(options, message):
    env = Ant()
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    env.close()


def test_invalid_actions_are_rejected(env):
    env.reset(seed=0)
    size = env.action_space.shape[0]
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full(size, np.nan))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.full(size, np.inf))
    with pytest.raises(ValueError, match=rf"shape \({size},\), not \({size + 1},\)"):
        env.step(np.zeros(size + 1))


def explode(env) -> None:
    robot, client = body(env)
    for joint in range(pybullet.getNumJoints(robot, physicsClientId=client)):
        pybullet.resetJointState(robot, joint, math.nan, math.nan, physicsClientId=client)


def test_a_simulation_that_explodes_truncates_the_episode_and_leaves_the_next_one_unaffected(env):
    expected = roll(env, 5)
    env.reset(seed=0)
    before = env.step(np.zeros(env.action_space.shape))[0]
    explode(env)
    observation, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
    assert info == {"error": "the state of the world is not finite"}
    assert (reward, terminated, truncated) == (0.0, False, True)
    np.testing.assert_array_equal(observation, before)
    np.testing.assert_array_equal(roll(env, 5), expected)


QUIET = """
import os, sys
sys.path.insert(0, {fake!r})
import irlcli.envs.bullet.engine
print(sys.modules["pybullet"].__file__)
"""


def test_importing_pybullet_hides_its_banner_and_forwards_other_output(tmp_path):
    (tmp_path / "pybullet.py").write_text(
        "import os\nos.write(2, b'pybullet build time: today\\nreal trouble\\n')\n"
    )
    imports = [
        subprocess.run(
            [sys.executable, "-c", QUIET.format(fake=fake)], capture_output=True, text=True
        )
        for fake in (str(tmp_path), "")
    ]
    assert imports[0].stdout == f"{tmp_path / 'pybullet.py'}\n"
    assert imports[0].stderr == "real trouble\n"
    assert (imports[1].returncode, imports[1].stderr) == (0, "")


def test_stepping_several_environments_continues_after_one_explodes():
    worlds = VectorWorlds([Ant(), Ant()], max_episode_steps=50)
    worlds.reset([0, 1])
    explode(worlds.envs[1])
    observations, rewards, ended = worlds.step(np.zeros((2, 8)))
    assert [end.world for end in ended] == [1]
    assert not ended[0].terminated
    for _ in range(5):
        observations, rewards, ended = worlds.step(np.zeros((2, 8)))
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
    worlds.close()


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_renders_without_a_display(name, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    env = ROBOTS[name](render_mode="rgb_array")
    plain = ROBOTS[name]()
    np.testing.assert_array_equal(roll(env, 1, 10), roll(plain, 1, 10))
    image = env.render()
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    assert image.std() > 1.0
    env.close()
    plain.close()


def test_a_window_without_a_display_is_rejected(env, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(RuntimeError, match="needs a display"):
        type(env)(render_mode="human")
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(RuntimeError, match="needs a display"):
        type(env)(render_mode="human")


def test_closing_twice_is_harmless(env):
    env.reset(seed=0)
    env.close()
    env.close()


def test_a_world_that_nobody_closed_is_closed_when_it_is_dropped():
    """Bullet keeps the 28 MiB of a client until it is told to disconnect."""

    def connected() -> set[int]:
        gc.collect()
        return {client for client in range(100) if pybullet.isConnected(client)}

    before = connected()
    env = Ant()
    env.reset(seed=0)
    assert len(connected()) == len(before) + 1
    del env
    assert connected() == before


def test_resets_do_not_leak_memory():
    env = Ant()

    def resident() -> int:
        with open("/proc/self/statm") as statm:
            return int(statm.read().split()[1]) * 4096

    for _ in range(50):
        env.reset(seed=0)
    before = resident()
    for _ in range(200):
        env.reset(seed=0)
    env.close()
    assert resident() - before < 8 * 2**20


def test_the_reachers_reward_is_a_function_of_the_transition():
    """Step by step, also beyond the action bounds and at the elbow's limit."""
    stuck = 0
    for seed, gravity in ((0, 0.5), (1, 4.0), (2, 1.0)):
        env = gymnasium.make("irlcli/Reacher-v0", gravity=gravity).unwrapped
        rng = np.random.default_rng(seed)
        observation, _ = env.reset(seed=seed)
        steps = []
        for t in range(150):
            # The second half bends the elbow to its limit.
            action = rng.uniform(-2, 2, 2) if t < 75 else np.array([0.0, 1.5])
            after, reward, _, _, info = env.step(action)
            steps.append((observation, action, after, reward))
            stuck += info["stuck"] < 0
            observation = after
        s, a, s_next, rewards = (np.array(part) for part in zip(*steps, strict=True))
        found = transition_reward("reacher")(s, a, s_next)
        np.testing.assert_allclose(found, rewards, atol=1e-5)
    assert stuck > 10


def test_other_robots_rewards_are_no_functions_of_the_transition():
    assert transition_reward("ant") is None and transition_reward("half-cheetah") is None
