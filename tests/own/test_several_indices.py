"""``MultiDiscrete`` actions: several indices at once, through every stage and out again."""

from __future__ import annotations

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

import irlcli
from irlcli.data.demonstrations import read_demonstrations
from irlcli.learners.reward_model import RewardModel
from irlcli.store import Store

SMOKE = ("--profile", "smoke", "--quiet")
SPACE = "gymnasium.spaces.MultiDiscrete([3, 2], start=[-1, 1])"


@pytest.fixture
def pulled(bench, monkeypatch):
    """The cart, pushed to the left or right with one of two forces."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(bench.directory / "minari"))
    for path, old, new in (
        (bench.module, "gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)", SPACE),
        (
            bench.module,
            "float(np.clip(action, -1.0, 1.0)[0])",
            "{-1: -1, 0: 0, 1: 1}[action[0]] * {1: 0.5, 2: 1.0}[action[1]]",
        ),
        (bench.toml, '"continuous"', '"discrete"'),
    ):
        bench.edit(path, old, new)
    return bench


def made(bench, *words):
    done = bench.irl(*words)
    assert done.code == 0, done.err
    return Store("runs").resolve(done.out.strip().rpartition("/")[2]).artefact


def groups(artefact):
    return read_demonstrations(artefact.directory).trajectories


def equal(one, other):
    assert list(one) == list(other)
    for setting in one:
        for a, b in zip(one[setting], other[setting], strict=True):
            np.testing.assert_array_equal(a.actions, b.actions)
            np.testing.assert_array_equal(a.observations, b.observations)
    return True


def test_a_reward_sees_the_choices_side_by_side():
    model = RewardModel(2, 5, True, False, (4,), "tanh", 0.9, choices=(3, 2))
    assert model.encode(torch.tensor([[2, 0], [0, 1]])).tolist() == [
        [0, 0, 1, 1, 0],
        [1, 0, 0, 0, 1],
    ]


def test_the_chain_and_the_way_out_and_back(pulled):
    own = ("--env", "cart.toml", "--intervention", "mass=1x,2x")
    demos = made(pulled, "collect-experts", *own, "--name", "demos", *SMOKE)
    first = groups(demos)["mass=1x"][0].actions
    assert first.dtype == np.int64 and first.shape[1] == 2
    assert first.max(axis=0).tolist() == [2, 1] and first.min() == 0
    learned = made(pulled, "train-airl", "--demos", "demos", "--method", "irm", *SMOKE)
    moved = made(pulled, "transfer", "--reward", learned.id, "--ood", "4x", *SMOKE)
    made(pulled, "evaluate", "--policy", moved.id, "--reward", learned.id, *SMOKE)
    made(pulled, "evaluate", "--random", *own[:2], "--intervention", "mass=2x", *SMOKE)

    for to, back in (("parquet:out.parquet", "out.parquet"), ("minari:me/cart-v0",) * 2):
        assert pulled.irl("export", "demos", "demos", "--to", to).code == 0
        # As the environment counts: from -1 and from 1.
        assert first_exported(back).tolist() == (first + np.array([-1, 1])).tolist()
        assert equal(groups(made(pulled, "import", back, *own, "--quiet")), groups(demos))

    reward = irlcli.load_reward(learned.id)
    assert (reward.choices, reward.action_size) == ((3, 2), 5)
    exported = pulled.irl("export", "reward", learned.id, "--to", "torch-export:irm.pt2")
    assert exported.code == 0, exported.err
    program = torch.export.load("irm.pt2").module()
    steps = [t for group in groups(demos).values() for t in group]
    obs, act = steps[0].observations, steps[0].actions
    paid = reward(obs[:-1], act, obs[1:], np.zeros(len(act), bool))
    found = program(*map(torch.as_tensor, (obs[:-1], act, obs[1:], np.zeros(len(act), bool))))
    np.testing.assert_allclose(found.numpy(), paid, atol=1e-6)
    # The environment itself counts its choices from -1 and from 1.
    world = irlcli.RewardWrapper(gymnasium.make("cart:Cart-v0"), reward)
    seen, _ = world.reset(seed=0)
    following, earned, *_ = world.step(np.array([1, 2]))
    told = reward(seen[None], np.array([[2, 1]]), following[None], np.array([False]))
    assert earned == pytest.approx(told[0])


def first_exported(source):
    """The actions of the first episode."""
    if source.startswith("minari:"):
        dataset = pytest.importorskip("minari").load_dataset(source.removeprefix("minari:"))
        actions = dataset[0].actions
        assert dataset.action_space.contains(actions[0])
        return actions
    rows = pq.read_table(source, filters=[("episode", "=", 0)])
    return np.array(rows["action"].to_pylist())


def test_a_clone_and_a_saved_model_choose_several_indices(pulled):
    from stable_baselines3 import PPO

    from irlcli.configs import load_config
    from irlcli.envs.registry import resolve
    from irlcli.experiments.references import demonstrations
    from irlcli.experiments.runner import Runner
    from irlcli.interventions import parse_settings
    from irlcli.stages import clone

    env = resolve("cart.toml").name
    from cart import Cart

    class FromZero(Cart):
        action_space = gymnasium.spaces.MultiDiscrete([3, 2])

    own = ("--env", "cart.toml", "--intervention", "mass=2x")
    expert = ("--expert", "mass=2x=expert.zip", "--trust", "--name", "demos")
    # SB3's policies count indices from 0, whatever the space they were given says.
    PPO("MlpPolicy", Cart(), policy_kwargs={"net_arch": [8]}).save("expert.zip")
    refused = pulled.irl("collect-experts", *own, *expert, *SMOKE)
    assert refused.code == 2 and "has actions in MultiDiscrete" in refused.err
    PPO("MlpPolicy", FromZero(), policy_kwargs={"net_arch": [8]}).save("expert.zip")
    made(pulled, "collect-experts", *own, *expert, *SMOKE)
    source, *_ = demonstrations(Store("runs"), "demos")
    config = load_config(env, "smoke")
    wanted = clone.request(source, env, parse_settings(env, "mass=2x"), config)
    copied = Runner("runs").run(wanted)
    made(pulled, "evaluate", "--policy", copied.id, "--ood", "4x", *SMOKE)
