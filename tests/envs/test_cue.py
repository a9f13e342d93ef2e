"""A cue is right as often as its strength says, and everything else is as without it."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO

from irlcli.data.demonstrations import read_demonstrations
from irlcli.envs.cue import HINTS, TEXTURE, CueWorld, Rightness, qualities, with_hints
from irlcli.envs.registration import make
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.envs.spec import Cue
from irlcli.envs.vector import VectorWorlds
from irlcli.interventions import Setting, cue_in, parse_setting, without_cue
from irlcli.rl.worlds import make_worlds
from irlcli.trajectories import Trajectory

WITH_CUE = [name for name, spec in ENVIRONMENTS.items() if "cue-strength" in spec.knobs]
STEPS = 20_000


@pytest.mark.parametrize("strength", [0.0, 0.1, 0.5, 0.8, 0.95, 1.0])
def test_hints_are_right_as_often_as_they_should(strength):
    texture, cue = Rightness(strength, seed=3).draw(STEPS).T
    # Five standard errors of a share of 20,000 steps are below 0.018.
    assert abs(np.mean(texture > 0) - TEXTURE) < 0.018
    assert abs(np.mean(cue > 0) - strength) < 0.018
    if strength != 0.5:
        assert np.sign(cue.mean()) == np.sign(strength - 0.5)


def test_hints_are_right_independently_of_each_other_and_of_other_steps():
    right = Rightness(0.8, seed=4).draw(STEPS).T
    assert abs(np.corrcoef(right)[0, 1]) < 0.035
    for signs in right:
        assert abs(np.corrcoef(signs[1:], signs[:-1])[0, 1]) < 0.035


def test_settings_differ_in_the_cue_alone():
    weak, strong = (Rightness(strength, seed=5).draw(STEPS) for strength in (0.1, 0.95))
    assert (weak[:, 0] == strong[:, 0]).all()
    assert abs(np.mean(weak[:, 1] != strong[:, 1]) - 0.85) < 0.018


def test_draws_do_not_depend_on_how_many_are_asked_for_at_once():
    one_by_one, together = Rightness(0.8, 6), Rightness(0.8, 6)
    assert np.array_equal(np.concatenate([one_by_one.draw() for _ in range(50)]), together.draw(50))


def test_the_quality_is_that_of_the_last_rewards():
    rewards = np.array([2.0, -1.0, 0.5, 0.25])
    last = Cue("default", window=1, bar=0.4)
    assert qualities(rewards, last).tolist() == [-1, 1, -1, 1, -1]
    # Sums of two: 2, 1, -0.5, 0.75. Before the first reward the quality is bad.
    two = Cue("default", window=2, bar=0.75)
    assert qualities(rewards, two).tolist() == [-1, 1, 1, -1, -1]
    # Sums of all: 2, 1, 1.5, 1.75.
    whole = Cue("default", window=1000, bar=1.5)
    assert qualities(rewards, whole).tolist() == [-1, 1, -1, -1, 1]


def test_the_qualities_of_the_control_are_those_documented():
    cues = {env: ENVIRONMENTS[env].knobs["cue-strength"].cue for env in WITH_CUE}
    assert cues == {
        "lunar-lander": Cue("engine-power=1x", window=10, bar=-1.0),
        "half-cheetah": Cue("friction=1.5:0.1:0.1", window=1, bar=0.5),
    }


def acted(env, seed, steps=60):
    """Random actions in the world without its cue, as far as the episode goes."""
    with closing(make(env, without_cue(env, parse_setting(env, "cue-strength=0.8")))) as base:
        base.action_space.seed(1)
        observations, actions, rewards = [base.reset(seed=seed)[0]], [], []
        for _ in range(steps):
            actions.append(base.action_space.sample())
            observation, reward, terminated, *_ = base.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
            if terminated:
                break
    dtype = np.int64 if ENVIRONMENTS[env].discrete_actions else np.float32
    return Trajectory(
        np.array(observations, np.float32),
        np.array(actions, dtype),
        np.array(rewards),
        terminated,
        not terminated,
        seed,
    )


@pytest.mark.parametrize("env", WITH_CUE)
@pytest.mark.parametrize("strength", [0.95, 0.1])
def test_with_the_cue_the_same_actions_lead_to_the_same_episode(env, strength):
    """To the last bit; and hints added afterwards are those that the world shows."""
    setting = parse_setting(env, f"cue-strength={strength}")
    plain = acted(env, seed=8)
    hinted = with_hints(plain, *cue_in(env, setting))
    quality = qualities(plain.rewards, cue_in(env, setting)[0])
    with closing(make(env, setting)) as world:
        seen = [world.reset(seed=8)[0]]
        for t, action in enumerate(plain.actions):
            observation, reward, terminated, *_ = world.step(action)
            seen.append(observation)
            assert reward == plain.rewards[t] and world.observation_space.contains(observation)
        assert terminated == plain.terminated
    seen = np.array(seen)
    assert seen.dtype == np.float32 and np.array_equal(seen[:, :-2], plain.observations)
    assert np.array_equal(seen, hinted.observations)
    expected = quality[:, None] * Rightness(strength, 8).draw(len(quality))
    assert np.array_equal(seen[:, -2:], expected)


@pytest.mark.parametrize("env", WITH_CUE)
def test_a_cue_is_added_to_what_else_a_setting_changes(env):
    alone = without_cue(env, parse_setting(env, "cue-strength=0.8"))
    assert alone == parse_setting(env, ENVIRONMENTS[env].knobs["cue-strength"].cue.base)
    knob = "bounce=0.5" if env == "lunar-lander" else "mass=2x"
    both = parse_setting(env, f"cue-strength=0.8,{knob}")
    assert without_cue(env, both) == parse_setting(env, knob)
    assert cue_in(env, parse_setting(env, knob)) is None
    with closing(make(env, both)) as world, closing(make(env, parse_setting(env, knob))) as base:
        assert np.array_equal(world.reset(seed=0)[0][:-2], base.reset(seed=0)[0])
        world.action_space.seed(0)
        action = world.action_space.sample()
        observation, *rest = world.step(action)
        plain, *expected = base.step(action)
        assert rest == expected and np.array_equal(observation[:-2], plain)


def test_a_seed_starts_the_same_episode_again_and_none_goes_on():
    setting = parse_setting("lunar-lander", "cue-strength=0.8")
    with closing(make("lunar-lander", setting)) as world:
        worlds = VectorWorlds([world], 5)

        def hints(seed):
            first = worlds.reset([seed])
            rest = [worlds.step(np.array([2]))[0] for _ in range(40)]
            return np.concatenate([first, *rest])[:, -2:]

        once, again, other = hints(1), hints(1), hints(2)
    assert np.array_equal(once, again)
    assert not np.array_equal(once, other)
    # Episodes of five steps: those that follow the seeded one have other cues.
    assert not np.array_equal(once[:6], once[6:12])


@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version")
def test_gymnasium_accepts_the_wrapper():
    base = gymnasium.make("irlcli/LunarLander-v0").unwrapped
    check_env(CueWorld(base, Cue("default", 1, 0.0), 0.8), skip_render_check=True)


def test_worker_processes_draw_the_same_hints():
    settings = [parse_setting("lunar-lander", f"cue-strength={s}") for s in ("0.95", "0.1")]
    seen = []
    for workers in (1, 2):
        with closing(make_worlds("lunar-lander", settings, 4, workers)) as worlds:
            first = worlds.reset(range(4))
            seen.append([first, *(worlds.step(np.full(4, 2))[0] for _ in range(80))])
    assert np.array_equal(*seen)


def test_a_saved_expert_of_the_plain_world_demonstrates_with_a_cue(irl, tmp_path):
    model = PPO(
        "MlpPolicy", make("lunar-lander", Setting()), n_steps=16, batch_size=16, device="cpu"
    )
    model.save(tmp_path / "ppo.zip")
    done = irl(
        *("collect-experts", "--env", "lunar-lander", "--setting", "cue-strength=0.95", "--trust"),
        *("--expert", f"cue-strength=0.95={tmp_path / 'ppo.zip'}", "--profile", "smoke"),
        *("--store", tmp_path / "runs"),
    )
    assert done.code == 0, done.err
    demos = read_demonstrations(Path(done.out.strip()))
    (episodes,) = demos.trajectories.values()
    assert {t.observations.shape[1] for t in episodes} == {8 + len(HINTS)}
