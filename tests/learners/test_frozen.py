"""Learned returns, against the same network written out in numpy."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from msgspec.structs import asdict

from irlcli.configs import AIRLConfig
from irlcli.data import descriptions
from irlcli.data import tensors as checkpoints
from irlcli.data.tensors import load_policy_file, load_reward_file
from irlcli.envs.registry import environment
from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import parse_setting
from irlcli.learners.frozen import FrozenReward
from irlcli.learners.pools import make_pool
from irlcli.learners.reward_model import RewardModel, build
from irlcli.learners.scoring import reward_quantiles
from irlcli.learners.standalone import StandaloneReward
from irlcli.rl.rollout import roll_out
from irlcli.trajectories import ActionSpace, Trajectory, Transitions, transitions


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
def test_the_learned_return_is_the_sum_of_the_networks_outputs(irl, store_copy, agent):
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
    trajectories = roll_out("lunar-lander", setting, policy, 3, 0, "evaluate", modal)
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


def test_another_lambdas_reward_is_not_the_policys_own(irl, store_copy):
    common = ["--store", store_copy.path, "--profile", "smoke"]
    learn = ["train-airl", "--demos", "demos", "--method", "irm", "--penalty-weight", "7"]
    assert irl(*learn, "--name", "other", *common).code == 0
    agents = {}
    for reward in ("airl", "other"):
        named = ["--reward", reward, "--name", f"by-{reward}"]
        done = irl("evaluate", "--policy", "moved", "--ood", "1.5x", *named, *common)
        assert done.code == 0, done.err
        shown = irl("report", "returns", f"by-{reward}", "--json", "--store", store_copy.path).out
        (row,) = json.loads(shown)["rows"]
        agents[reward] = row["agent"]
        assert f"\n{row['agent']}  " in done.err
        assert isinstance(row["mean_learned_return"], float)
    assert agents == {
        "airl": "AIRL-IRM retrained policy",
        "other": "AIRL-IRM retrained policy under AIRL-IRM's reward",
    }
    student = irl("evaluate", "--policy", "airl", "--ood", "1.5x", "--reward", "other", *common)
    assert "AIRL-IRM student, zero-shot under AIRL-IRM's reward" in student.err
    own = irl("evaluate", "--policy", "airl", "--ood", "1.5x", "--reward", "airl", *common)
    assert "AIRL-IRM student, zero-shot  " in own.err
    # An expert under two rewards that differ in lambda has two rows.
    for seed, reward in enumerate(("airl", "other")):
        named = ["--ood", "1.5x", "--reward", reward, "--name", f"expert-{seed}"]
        assert irl("evaluate", "--expert", *named, "--env", "lunar-lander", *common).code == 0
    apart = irl("report", "returns", "expert-0", "expert-1", "--json", "--store", store_copy.path)
    assert [row["agent"].partition(", ")[2] for row in json.loads(apart.out)["rows"]] == [
        "reward.airl.penalty_weight 1",
        "reward.airl.penalty_weight 7",
    ]
    # One evaluation with the reward and one without differ in nothing that makes a return.
    with_it, without = (
        irl("report", "returns", n, "--store", store_copy.path).out for n in ("by-airl", "score")
    )
    assert with_it.split()[-1] == without.split()[-1]


def test_the_experts_of_other_settings_can_be_measured_by_a_reward(irl, store_copy):
    done = irl(
        *["evaluate", "--expert", "--trained-in", "engine-power=1x", "--ood", "1.25x,1x"],
        *["--reward", "airl", "--store", store_copy.path, "--profile", "smoke"],
    )
    assert done.code == 0, done.err
    assert "expert of engine-power=1x under AIRL-IRM's reward" in done.err


def continuous(path, actions, numbers=None):
    """A reward of one observation and one bounded action, g(s, a) = 2 s + 3 a; its scale is 2."""
    network = descriptions.RewardNetwork(
        observation_size=1,
        action_size=1,
        discrete=False,
        state_only=False,
        hidden=(),
        activation="tanh",
        gamma=0.9,
        shaping=True,
    )
    settings = AIRLConfig(actions=actions, fixed_horizon=False)
    about = descriptions.Reward(
        env="ant",
        settings=("mass=2x",),
        method="erm",
        seed=0,
        airl=settings,
        network=network,
        scale=2.0,
        quantiles=tuple(np.linspace(0.0, 1.0, 101).tolist()),
    )
    model = build(**asdict(network))
    state = {name: torch.zeros_like(tensor) for name, tensor in model.state_dict().items()}
    state["normaliser.variance"] += 1.0
    state["g.0.weight"] = torch.tensor(numbers or [[2.0, 3.0]])
    checkpoints.save(path, "reward", about, state)


BOX = ActionSpace(False, 1, np.array([-1.0], np.float32), np.array([1.0], np.float32))


def frozen(path, observation_size, actions):
    model, origin = load_reward_file(path)
    return FrozenReward(model, origin, 1000, 0.9, "x", observation_size, actions)


@pytest.mark.parametrize(("actions", "second"), [("executed", 1.0), ("sampled", 5.0)])
def test_actions_are_clipped_where_the_reward_saw_them_so(tmp_path, actions, second):
    continuous(tmp_path / "reward.pt", actions)
    reward = frozen(tmp_path / "reward.pt", 1, BOX)
    episode = Trajectory(
        observations=np.array([[1.0], [2.0], [50.0]], np.float32),
        actions=np.array([[-1.0], [5.0]], np.float32),
        rewards=np.zeros(2),
        terminated=True,
        truncated=False,
        seed=0,
    )
    # Without absorbing states the last observation earns nothing.
    expected = (2 * 1.0 + 3 * -1.0 + 2 * 2.0 + 3 * second) / 2.0
    assert reward.of_episode(episode) == pytest.approx(expected, rel=1e-5)
    steps = transitions([episode], 1000)
    each = reward.g_over_scale(steps.observations, steps.actions, steps.next_observations)
    assert each.tolist() == pytest.approx([-0.5, (2 * 2.0 + 3 * second) / 2.0])


def test_what_the_reward_cannot_measure_is_refused(tmp_path, smoke_store):
    path = smoke_store.path / smoke_store.airl / "reward.pt"
    four = ActionSpace(True, 4, np.empty(0), np.empty(0))
    for size, actions, message in (
        (9, four, "of size 8, but x has size 9"),
        (8, four._replace(size=2), "takes 4 discrete actions, but x has 2 discrete"),
        (8, BOX, "takes 4 discrete actions, but x has actions of size 1"),
    ):
        with pytest.raises(UsageError, match=message):
            frozen(path, size, actions)
    continuous(tmp_path / "reward.pt", "executed", [[2.0, math.nan]])
    with pytest.raises(IntegrityError, match="not finite"):
        frozen(tmp_path / "reward.pt", 1, BOX)


def bounded(network, ceiling, absorbing, terminated):
    """The rewards of two steps s = 1, 4 whose successors are s = 2, 8, for a reward g(s, a) = 2 s + 3 a."""
    model = RewardModel(**network)
    model.load_state_dict(
        {name: torch.zeros_like(tensor) for name, tensor in model.state_dict().items()}
        | {"normaliser.variance": torch.ones(1), "g.0.weight": torch.tensor([[2.0, 3.0]])}
    )
    reward = StandaloneReward(model, 1.0, absorbing, 0.9, ceiling, None, None)
    steps = [torch.tensor(values) for values in ([[1.0], [4.0]], [[1.0], [-1.0]], [[2.0], [8.0]])]
    return reward(*steps, torch.tensor([False, terminated])).tolist()


@pytest.mark.parametrize(
    ("ceiling", "absorbing", "expected"),
    [
        # g is 5 and 5; the absorbing state earns g(8, 0) = 16 times 0.9 / 0.1 once the episode ended.
        (math.inf, False, [5.0, 5.0]),
        (math.inf, True, [5.0, 5.0 + 9 * 16.0]),
        # The ceiling bounds every step of the series, not its sum.
        (4.5, True, [4.5, 4.5 + 9 * 4.5]),
        (10.0, True, [5.0, 5.0 + 9 * 10.0]),
        (-1.0, True, [-1.0, -1.0 + 9 * -1.0]),
    ],
)
def test_the_ceiling_bounds_each_step_before_the_absorbing_series(ceiling, absorbing, expected):
    network = {
        "observation_size": 1,
        "action_size": 1,
        "discrete": False,
        "state_only": False,
        "hidden": (),
        "activation": "tanh",
        "gamma": 0.9,
    }
    assert bounded(network, ceiling, absorbing, True) == pytest.approx(expected, rel=1e-5)


def test_quantiles_weigh_settings_equally_and_absorbing_rows_as_drawn():
    """g(s) = s. One setting holds 0 and, three times, an absorbing 4; the other ninety-nine 2's."""
    model = RewardModel(1, 1, False, True, (), "tanh", 0.9)
    model.load_state_dict(
        {name: torch.zeros_like(tensor) for name, tensor in model.state_dict().items()}
        | {"normaliser.variance": torch.ones(1), "g.0.weight": torch.ones(1, 1)}
    )

    def pool(states, remaining):
        count = len(states)
        data = Transitions(
            observations=np.array(states, np.float32)[:, None],
            actions=np.zeros((count, 1), np.float32),
            next_observations=np.full((count, 1), 4.0, np.float32),
            terminated=np.array([remaining > 0] * count),
            remaining=np.full(count, remaining),
        )
        return make_pool(model, data, torch.zeros(count), absorbing=True)

    quantiles = reward_quantiles(model, [pool([0.0], 3), pool([2.0] * 99, 0)])
    assert len(quantiles) == 101
    # Weights: 1/8 of 0, 1/2 of 2, 3/8 of 4.
    assert quantiles[0] == quantiles[12] == 0.0
    assert quantiles[13] == pytest.approx(2.0) == quantiles[62]
    assert quantiles[63] == pytest.approx(4.0) == quantiles[100]


def test_a_trained_reward_carries_its_quantiles_and_a_ceiling_bounds_what_it_pays(smoke_store):
    path = smoke_store.path / smoke_store.airl / "reward.pt"
    model, origin = load_reward_file(path)
    quantiles = np.array(origin.quantiles)
    assert (np.diff(quantiles) >= 0).all() and quantiles[0] < quantiles[-1]
    four = ActionSpace(True, 4, np.empty(0), np.empty(0))
    rng = np.random.default_rng(0)
    states = rng.normal(0, 3, (1, 500, 8)).astype(np.float32)
    rollout = SimpleNamespace(
        transitions=lambda *_: Transitions(
            observations=states[0],
            actions=rng.integers(4, size=500),
            next_observations=states[0],
            terminated=np.zeros(500, bool),
            remaining=np.zeros(500, np.int64),
        ),
        terminated=np.zeros((1, 500), bool),
    )
    rewards = {}
    for ceiling in (None, 0.5):
        reward = FrozenReward(model, origin, 1000, 0.9, "x", 8, four, ceiling)
        rng = np.random.default_rng(1)
        rewards[ceiling] = reward.rewards(rollout, None)
    bound = quantiles[50] / origin.scale
    assert rewards[None].max() > bound
    np.testing.assert_allclose(rewards[0.5], np.minimum(rewards[None], bound), rtol=1e-5)
