"""What a learned reward pays, against the same network written out in numpy."""

import json

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch

from irlcli import rl
from irlcli.checkpoints import load_policy_file
from irlcli.errors import UsageError
from irlcli.interventions import environment, parse_setting
from irlcli.stages.frozen_reward import FrozenReward


def by_hand(path, about):
    """g / scale [B] of observations [B, D] and action vectors [B, A]."""
    state = torch.load(path, weights_only=True)["state"]
    arrays = {name: tensor.numpy() for name, tensor in state.items()}
    mean, variance = arrays["normaliser.mean"], arrays["normaliser.variance"]
    layers = sorted({int(n.split(".")[1]) for n in arrays if n.startswith("g.")})

    def g(observations, actions):
        x = np.clip((observations - mean) / np.sqrt(variance + 1e-8), -10, 10)
        if not about["network"]["state_only"]:
            x = np.concatenate([x, actions], -1)
        for layer in layers:
            x = x @ arrays[f"g.{layer}.weight"].T + arrays[f"g.{layer}.bias"]
            if layer != layers[-1]:
                x = np.tanh(x)
        return x[:, 0] / about["scale"]

    return g


@pytest.mark.parametrize("agent", ["policy", "idle"])
def test_evaluate_says_what_the_reward_pays(irl, store_copy, agent):
    whom = ["--idle"] if agent == "idle" else ["--policy", "moved"]
    common = ["--ood", "1.5x", "--episodes", "3", "--store", store_copy.path, "--profile", "smoke"]
    done = irl("evaluate", *whom, "--reward", "airl", *common)
    assert done.code == 0, done.err
    assert "learned return" in done.err and "by the reward of irm lambda" in done.err
    made = store_copy.path / done.out.strip().rpartition("/")[2]
    episodes = pd.read_parquet(made / "episodes.parquet")

    learned = store_copy.path / store_copy.airl
    about = json.loads((learned / "reward.json").read_text())
    assert about["network"]["activation"] == "tanh" and about["airl"]["fixed_horizon"]
    g = by_hand(learned / "reward.pt", about)
    policy = agent
    if agent == "policy":
        policy, _ = load_policy_file(store_copy.path / store_copy.transfer / "policy.pt")
    setting = parse_setting("lunar-lander", "engine-power=1.5x")
    made_with = json.loads((made / "manifest.json").read_text())["parameters"]
    modal = made_with["evaluation"]["deterministic"]
    trajectories = rl.roll_out("lunar-lander", setting, policy, 3, 0, "evaluate", modal)
    horizon = environment("lunar-lander").max_episode_steps
    expected = []
    for t in trajectories:
        total = g(t.observations[:-1], np.eye(4)[t.actions]).sum()
        left = horizon - len(t) if t.terminated else 0
        expected.append(total + left * g(t.observations[-1:], np.zeros((1, 4))).item())
    assert any(t.terminated for t in trajectories)
    assert list(episodes["true_return"]) == [t.episode_return for t in trajectories]
    assert list(episodes["learned_return"]) == pytest.approx(expected, rel=1e-4)
    summary = json.loads((made / "summary.json").read_text())
    assert summary["settings"][0]["mean_learned_return"] == episodes["learned_return"].mean()
    assert summary["reward"] == {
        "method": "irm",
        "seed": 0,
        "settings": ["engine-power=1x", "engine-power=1.25x"],
    }
    # Without the reward it is another evaluation, which says nothing of it.
    plain = irl(
        "evaluate", *whom, "--env", "lunar-lander", "--ood", "engine-power=1.5x", *common[2:]
    )
    other = store_copy.path / plain.out.strip().rpartition("/")[2]
    assert other != made
    assert "learned_return" not in pd.read_parquet(other / "episodes.parquet")
    assert "reward" not in json.loads((other / "summary.json").read_text())
    listed = irl("ls", "--store", store_copy.path).out.splitlines()
    (line,) = (line for line in listed if made.name in line)
    assert "by the reward of irm lambda" in line
    # A reward that only measures made no policy.
    assert ("of train-airl" in line) == (agent == "policy")


def test_observations_of_another_size_are_refused(smoke_store):
    path = smoke_store.path / smoke_store.airl / "reward.pt"
    wide = gymnasium.spaces.Box(-1, 1, (9,))
    with pytest.raises(UsageError, match="size 8, those of lunar-lander x have size 9"):
        FrozenReward(path, "lunar-lander", "lunar-lander x", wide, gymnasium.spaces.Discrete(4))
