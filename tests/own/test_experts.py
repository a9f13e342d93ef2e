"""Experts that were trained elsewhere: saved by stable-baselines3, or as a policy here."""

from __future__ import annotations

import pickle
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from irlcli.data.demonstrations import read_demonstrations
from irlcli.envs.registry import resolve
from irlcli.interventions import Setting
from irlcli.rl.saved import File, load_saved
from irlcli.store import Store, file_digest

COLLECT = ("collect-experts", "--env", "cart.toml", "--profile", "smoke", "--quiet")


def trained(name: str, env, path, **options):
    import stable_baselines3

    # Networks that a test makes in no time, with their first, random weights.
    options |= {"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "seed": 0}
    model = getattr(stable_baselines3, name)("MlpPolicy", env, **options)
    model.save(path)
    return model


def cart():
    sys.path.append(str(Path.cwd()))
    from cart import Cart

    return Cart()


def demonstrations(irl, *words):
    done = irl(*words, "--name", "demos")
    assert done.code == 0, done.err
    artefact = Store("runs").resolve("demos").artefact
    return artefact, read_demonstrations(artefact.directory).trajectories


@pytest.mark.parametrize("name", ["PPO", "SAC", "TD3"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_saved_model_acts_in_its_setting(bench, name):
    model = trained(name, cart(), "expert.zip")
    given = ("--intervention", "mass=1x,2x", "--expert", "mass=2x=expert.zip", "--trust")
    greedy = ("--set", "demonstrations.deterministic=true")
    artefact, found = demonstrations(bench.irl, *COLLECT, *given, *greedy)
    inputs = artefact.manifest.record.inputs
    assert inputs["expert mass=2x"] == file_digest(bench.directory / "expert.zip")
    # The other one was trained.
    stages = sorted(a.manifest.record.stage for a in Store("runs").artefacts())
    assert stages == ["collect-experts", "train-expert"]
    for trajectory in found["mass=2x"]:
        expected, _ = model.predict(trajectory.observations[:-1], deterministic=True)
        np.testing.assert_allclose(
            np.clip(trajectory.actions, -1.0, 1.0), np.clip(expected, -1.0, 1.0), atol=1e-6
        )


def test_samples_are_reproducible_and_another_file_is_another_key(bench):
    trained("PPO", cart(), "expert.zip")
    given = ("--intervention", "mass=1x", "--expert", "mass=1x=expert.zip", "--trust")
    first, found = demonstrations(bench.irl, *COLLECT, *given)
    # Drawn from the expert's Gaussian, and kept as they were drawn.
    actions = np.concatenate([t.actions for t in found["mass=1x"]])
    assert actions.std() > 0.5 and abs(actions).max() > 1.0
    again, _ = demonstrations(bench.irl, *COLLECT, *given, "--store", "runs")
    assert again.id == first.id
    shutil.rmtree("runs")
    assert demonstrations(bench.irl, *COLLECT, *given)[0].id == first.id
    trained("PPO", cart(), "expert.zip", n_steps=16, batch_size=16)
    assert demonstrations(bench.irl, *COLLECT, *given)[0].id != first.id


def test_the_noise_of_a_sac_with_gsde_is_drawn_for_every_step(bench):
    """Not once when the model is loaded, from whatever ran before in this process."""
    trained("SAC", cart(), "expert.zip", use_sde=True)
    given = ("--intervention", "mass=1x", "--expert", "mass=1x=expert.zip", "--trust")
    found = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        found.append(demonstrations(bench.irl, *COLLECT, *given, "--store", "runs")[1]["mass=1x"])
        shutil.rmtree("runs")
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one.actions, other.actions)
    saved = File("expert.zip", Path("expert.zip").read_bytes())
    policy = load_saved(saved, resolve("cart.toml").name, Setting())
    seen = np.repeat(found[0][0].observations[:1], 3, axis=0)
    drawn = np.concatenate([policy.act(seen), policy.act(seen)])
    assert len(np.unique(drawn)) == len(drawn)


def test_a_ppo_that_squashes_its_actions_is_refused(bench):
    options = {"net_arch": [8], "squash_output": True}
    import stable_baselines3

    model = stable_baselines3.PPO(
        "MlpPolicy", cart(), n_steps=16, batch_size=16, use_sde=True, policy_kwargs=options
    )
    model.save("expert.zip")
    given = ("--intervention", "mass=1x", "--expert", "mass=1x=expert.zip", "--trust")
    refused = bench.irl(*COLLECT, *given)
    assert refused.code == 2 and "squash_output" in refused.err


def test_a_model_trained_under_vecnormalize_needs_its_statistics(bench):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    venv = VecNormalize(DummyVecEnv([cart]), norm_reward=False)
    options = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 16, "batch_size": 16, "seed": 0}
    import stable_baselines3

    model = stable_baselines3.PPO("MlpPolicy", venv, **options).learn(16)
    model.save("expert.zip")
    venv.save("statistics.pkl")
    (bench.directory / "other.pkl").write_bytes(pickle.dumps([1]))
    (bench.directory / "bomb.pkl").write_bytes(pickle.dumps(Bomb()))
    chosen = (*COLLECT, "--intervention", "mass=1x", "--set", "demonstrations.deterministic=true")
    for expert, trust, code, named in (
        ("expert.zip", ["--trust"], 2, "was trained under VecNormalize"),
        ("expert.zip+nothing.pkl", ["--trust"], 3, "no file nothing.pkl"),
        ("expert.zip+other.pkl", ["--trust"], 4, "other.pkl holds a list"),
        ("expert.zip+bomb.pkl", [], 2, "runs the code in it"),
    ):
        refused = bench.irl(*chosen, "--expert", f"mass=1x={expert}", *trust)
        assert refused.code == code and named in refused.err, refused.err
    assert not (bench.directory / "mark").exists()
    given = ("--expert", "mass=1x=expert.zip+statistics.pkl", "--trust")
    artefact, found = demonstrations(bench.irl, *chosen, *given)
    assert artefact.manifest.record.inputs == {
        "expert mass=1x": file_digest(bench.directory / "expert.zip"),
        "normaliser mass=1x": file_digest(bench.directory / "statistics.pkl"),
    }
    for trajectory in found["mass=1x"]:
        seen = trajectory.observations[:-1]
        expected, _ = model.predict(venv.normalize_obs(seen), deterministic=True)
        np.testing.assert_allclose(np.clip(trajectory.actions, -1, 1), expected, atol=1e-6)
        raw, _ = model.predict(seen, deterministic=True)
        assert abs(raw - expected).max() > 1e-3


def test_sac_that_learned_without_vecnormalize_needs_no_statistics(bench):
    import stable_baselines3

    options = {"policy_kwargs": {"net_arch": [8]}, "buffer_size": 10, "seed": 0}
    stable_baselines3.SAC("MlpPolicy", cart(), **options).learn(3).save("expert.zip")
    given = ("--intervention", "mass=1x", "--expert", "mass=1x=expert.zip", "--trust")
    _, found = demonstrations(bench.irl, *COLLECT, *given)
    assert list(found) == ["mass=1x"]


def test_dqn_acts_greedily(bench):
    import gymnasium

    (bench.directory / "pole.toml").write_text(
        '[env]\nid = "CartPole-v1"\n[knobs.reward]\nargument = "sutton_barto_reward"\n'
        'forms = ["absolute"]\nlow = 0\nhigh = 1\nwhole = true\n'
        "[profiles.smoke.demonstrations]\nepisodes = 2\n"
    )
    model = trained("DQN", gymnasium.make("CartPole-v1"), "expert.zip")
    words = ("collect-experts", "--env", "pole.toml", "--profile", "smoke", "--quiet")
    given = ("--intervention", "reward=0", "--expert", "reward=0=expert.zip", "--trust")
    artefact, found = demonstrations(bench.irl, *words, *given)
    own = artefact.manifest.record.parameters["environment"]["own"]
    assert own["distribution"] == "gymnasium" and own["version"] == gymnasium.__version__
    for trajectory in found["reward=0"]:
        expected, _ = model.predict(trajectory.observations[:-1], deterministic=True)
        assert (trajectory.actions == expected).all()


def test_a_policy_of_the_store_can_be_the_expert(bench):
    first, _ = demonstrations(bench.irl, *COLLECT, "--intervention", "mass=1x")
    expert = first.manifest.record.inputs["expert mass=1x"]
    (policy,) = Store("runs").index().holders(expert)
    given = ("--setting", "drag=0.5,mass=2x", "--expert", f"drag=0.5,mass=2x={policy.id}")
    second, _ = demonstrations(bench.irl, *COLLECT, *given)
    assert second.manifest.record.inputs == {"expert drag=0.5,mass=2x": expert}


class Bomb:
    """A pickle that leaves a mark when it is read."""

    def __reduce__(self):
        return (open, ("mark", "w"))


def test_nothing_in_a_saved_model_runs_without_trust(bench):
    import base64
    import json

    bomb = base64.b64encode(pickle.dumps(Bomb())).decode()
    with zipfile.ZipFile("expert.zip", "w") as archive:
        data = {"clip_range_vf": None, "policy_class": {":type:": "x", ":serialized:": bomb}}
        archive.writestr("data", json.dumps(data))
    given = ("--intervention", "mass=1x", "--expert", "mass=1x=expert.zip")
    for words in (given, (*given, "--dry-run")):
        refused = bench.irl(*COLLECT, *words)
        assert refused.code == 2 and "runs the code in it" in refused.err
        assert "--trust" in refused.err
    assert bench.irl(*COLLECT, *given, "--trust", "--dry-run").code == 0
    assert not (bench.directory / "mark").exists()
    # The test's file does what such a file can do.
    assert bench.irl(*COLLECT, *given, "--trust").code == 4
    assert (bench.directory / "mark").exists()


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        (["--expert", "mass=1x"], 2, "'mass=1x'"),
        (["--expert", "expert.zip"], 2, "'expert.zip'"),
        (["--expert", "wind=1x=e.zip"], 2, "no intervention 'wind'"),
        (["--expert", "mass=1x=nothing.zip", "--trust"], 3, "no file nothing.zip"),
        (["--expert", "mass=1x=nothing"], 3, "'nothing'"),
        (["--expert", "mass=1x=text.zip"], 2, "runs the code in it"),
        (["--expert", "mass=1x=text.zip", "--trust"], 4, "not saved by stable-baselines3"),
        (["--expert", "mass=4x=text.zip", "--trust"], 2, "--expert names mass=4x"),
        (["--expert", "mass=1x=text.zip"] * 2, 2, "two experts of mass=1x"),
        (["--expert", "mass=1x=pole.zip", "--trust"], 2, "has observations in Box"),
        (["--expert", "mass=1x=a2c.zip", "--trust"], 4, "another algorithm than PPO, SAC"),
    ],
)
def test_a_wrong_expert_is_one_clear_line(bench, words, code, named):
    import gymnasium

    (bench.directory / "text.zip").write_text("no archive")
    for name, file in (("PPO", "pole.zip"), ("A2C", "a2c.zip")):
        if file in str(words):
            trained(name, gymnasium.make("CartPole-v1"), file)
    done = bench.irl(*COLLECT, "--intervention", "mass=1x", *words)
    error, *rest = done.err.splitlines()
    assert (done.code, done.out) == (code, "") and named in error, done.err
    assert len(rest) == 1 and rest[0].startswith("hint: ")


def test_a_file_that_is_no_archive_is_refused_before_other_experts_are_trained(bench):
    (bench.directory / "text.zip").write_text("no archive")
    given = ["--expert", "mass=1x=text.zip", "--trust", "--intervention", "mass=1x,2x"]
    done = bench.irl(*COLLECT, *given)
    assert done.code == 4 and "text.zip was not saved by stable-baselines3" in done.err
    assert not list(Store("runs").artefacts())


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_bank_says_if_its_expert_is_not_the_one_who_demonstrated(bench, own):
    given = ()
    if own:
        trained("PPO", cart(), "expert.zip")
        given = ("--expert", "mass=1x=expert.zip", "--trust")
    where = ("--intervention", "mass=1x")
    smoke = ("--profile", "smoke")
    for line in (
        (*COLLECT, *where, *given, "--name", "demos"),
        ("train-airl", "--demos", "demos", "--method", "erm", "--name", "erm", *smoke),
        ("evaluate", "--expert", "--env", "cart.toml", "--setting", "mass=1x", *smoke),
    ):
        done = bench.irl(*line)
        assert done.code == 0, done.err
    assessed = bench.irl("assess", "erm", *smoke)
    assert assessed.code == 0, assessed.err
    assert ("of mass=1x in the bank is not the one who demonstrated" in assessed.err) == own
