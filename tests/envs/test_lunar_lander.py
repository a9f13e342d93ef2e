"""LunarLander equals the original without interventions, and each intervention takes effect."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.box2d import lunar_lander as original
from gymnasium.utils.env_checker import check_env

from irlcli.envs import registration as envs
from irlcli.envs.lunar_lander.env import LunarLander
from irlcli.interventions import parse_setting


def run(env, seed, actions):
    """Observations and rewards of an action sequence, up to the end of the episode."""
    observation, _ = env.reset(seed=seed)
    observations, rewards = [observation], []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(int(action))
        observations.append(observation)
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(observations), np.array(rewards)


@pytest.mark.parametrize("kwargs", [{}, {"bounce": 0.5, "friction": 0.4, "engine_power": 1.25}])
def test_passes_gymnasiums_checker(kwargs):
    check_env(gymnasium.make("irlcli/LunarLander-v0", **kwargs).unwrapped, skip_render_check=True)


def test_renders_an_image():
    env = gymnasium.make("irlcli/LunarLander-v0", render_mode="rgb_array", engine_power=1.5)
    env.reset(seed=0)
    env.step(2)
    assert env.render().shape == (400, 600, 3)
    env.close()


@pytest.mark.parametrize("seed", range(4))
def test_without_intervention_it_is_bit_identical_to_the_original(seed):
    actions = np.random.default_rng(seed).integers(4, size=400)
    ours = run(LunarLander(), seed, actions)
    theirs = run(gymnasium.make("LunarLander-v3").unwrapped, seed, actions)
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1], theirs[1])


def velocity_after(action, **kwargs):
    env = LunarLander(**kwargs)
    env.reset(seed=3)
    env.step(action)
    return np.array([*env.lander.linearVelocity, env.lander.angularVelocity])


@pytest.mark.parametrize("power", [0.5, 1.25, 3.0])
def test_engine_power_multiplies_the_main_engines_impulse(power):
    # The dispersion is drawn for every action, so the same seed gives the same direction.
    nothing = velocity_after(0)
    once = velocity_after(2) - nothing
    scaled = velocity_after(2, engine_power=power) - nothing
    np.testing.assert_allclose(scaled, power * once, rtol=1e-4, atol=1e-6)


def test_engine_power_changes_neither_side_engines_nor_the_module():
    np.testing.assert_array_equal(velocity_after(1), velocity_after(1, engine_power=3.0))
    assert original.MAIN_ENGINE_POWER == 13.0


def place_on_pad(env, height, velocity):
    """Place the lander ``height`` above its standing position, moving with ``velocity``."""
    env.reset(seed=0)
    bodies = [env.lander, *env.legs]
    drop = env.lander.position[1] - (env.helipad_y + 18 / 30 + height)
    for body in bodies:
        body.position = (body.position[0], body.position[1] - drop)
        body.linearVelocity = velocity
        body.angularVelocity = 0.0


def rebound_speed(bounce):
    """Largest upward speed [m/s] after a vertical fall at 4 m/s."""
    env = LunarLander(bounce=bounce)
    place_on_pad(env, 1.0, (0.0, -4.0))
    speeds = []
    for _ in range(60):
        env.step(0)
        if any(leg.ground_contact for leg in env.legs) or speeds:
            speeds.append(env.lander.linearVelocity[1])
    return max(speeds)


def test_bounce_is_restitution():
    speeds = [rebound_speed(bounce) for bounce in (0.0, 0.5, 0.9)]
    assert speeds[0] < speeds[1] < speeds[2]
    assert speeds[2] - speeds[0] > 0.5


def test_hull_and_legs_bounce_in_every_episode():
    env = LunarLander(bounce=0.5)
    for seed in (0, 1):
        env.reset(seed=seed)
        fixtures = [fixture for body in (env.lander, *env.legs) for fixture in body.fixtures]
        assert len(fixtures) == 3
        assert {fixture.restitution for fixture in fixtures} == {0.5}


def sliding_distance(friction):
    """Distance [m] that the lander slides along the pad in 0.8 s from 3 m/s."""
    env = LunarLander(friction=friction)
    place_on_pad(env, 0.02, (3.0, 0.0))
    start = env.lander.position[0]
    for _ in range(40):
        env.step(0)
    return env.lander.position[0] - start


def test_friction_shortens_the_slide():
    distances = [sliding_distance(friction) for friction in (0.001, 0.2, 4.0)]
    assert distances[0] > distances[1] > distances[2]
    # Almost without friction: 0.8 s at 3 m/s.
    assert distances[0] == pytest.approx(2.4, rel=0.1)


def test_instances_do_not_affect_each_other():
    actions = np.random.default_rng(0).integers(4, size=200)
    kwargs = [{}, {"engine_power": 2.0, "bounce": 0.9}, {"friction": 3.0}]
    alone = [run(LunarLander(**k), 5, actions) for k in kwargs]
    together = [LunarLander(**k) for k in kwargs]
    for env in together:
        env.reset(seed=5)
    for t in range(60):
        for env, (observations, rewards) in zip(together, alone, strict=True):
            if t < len(rewards):
                observation, reward, *_ = env.step(int(actions[t]))
                np.testing.assert_array_equal(observation, observations[t + 1])
                assert reward == rewards[t]


@pytest.mark.parametrize(
    "kwargs",
    [
        {"bounce": -0.1},
        {"bounce": 1.1},
        {"bounce": float("nan")},
        {"friction": -1.0},
        {"friction": float("inf")},
        {"friction": None},
        {"bounce": "high"},
        {"engine_power": 0.0},
        {"engine_power": float("nan")},
    ],
)
def test_values_out_of_range_are_rejected_by_name(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        LunarLander(**kwargs)


def test_make_applies_the_setting():
    env = envs.make("lunar-lander", parse_setting("lunar-lander", "engine-power=1.25x"))
    assert (env.engine_power, env.bounce, env.friction) == (1.25, 0.0, 0.1)
