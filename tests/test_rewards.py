"""Learned rewards that leave the package: a function, two wrappers, and a file of torch.export."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.vec_env import DummyVecEnv

import irlcli
import irlcli.envs.registration
from irlcli.configs import AIRLConfig
from irlcli.data.descriptions import RewardNetwork
from irlcli.data.outputs import write_reward
from irlcli.errors import IrlError, UsageError
from irlcli.learners.reward_model import build

SPACES = {"half-cheetah": (17, 6, False), "lunar-lander": (8, 4, True)}
SETTING = {"half-cheetah": "leg-length=0.7", "lunar-lander": "bounce=0.1"}
SCALE = 2.5


def write_random_reward(directory, env, **airl):
    """A ``reward.pt`` with random weights, and its model."""
    size, actions, discrete = SPACES[env]
    config = AIRLConfig(**airl)
    network = RewardNetwork(
        observation_size=size,
        action_size=actions,
        discrete=discrete,
        state_only=False,
        hidden=(16,),
        activation="tanh",
        gamma=0.9,
        shaping=True,
    )
    torch.manual_seed(0)
    import msgspec

    model = build(**msgspec.structs.asdict(network))
    model.normaliser.update(torch.randn(100, size) * 3 + 1)
    quantiles = tuple(np.linspace(-0.5, 0.5, 101).tolist())
    learner = SimpleNamespace(network=network, scale=SCALE, quantiles=quantiles, deployed=model)
    directory.mkdir(exist_ok=True)
    write_reward(
        directory, learner, airl=config, env=env, settings=(SETTING[env],), method="erm", seed=0
    )
    return directory / "reward.pt", model.requires_grad_(False)


def steps(env, count, seed=0):
    """Random arguments of a reward."""
    size, actions, discrete = SPACES[env]
    rng = np.random.default_rng(seed)
    chosen = (
        rng.integers(actions, size=count)
        if discrete
        else 2 * rng.normal(size=(count, actions)).astype(np.float32)
    )
    obs, following = (rng.normal(size=(count, size)).astype(np.float32) for _ in range(2))
    return obs, chosen, following, rng.random(count) < 0.3


# The function


@pytest.mark.parametrize("env", SPACES)
@pytest.mark.parametrize("absorbing", [False, True])
@pytest.mark.parametrize("ceiling", [None, 0.75, 0.0])
def test_it_is_g_by_scale_with_ceiling_and_absorbing_states(tmp_path, env, absorbing, ceiling):
    view = "sampled" if env == "lunar-lander" else "executed"
    path, model = write_random_reward(tmp_path, env, fixed_horizon=absorbing, actions=view)
    reward = irlcli.load_reward(path, gamma=0.75, ceiling=ceiling)
    obs, act, following, done = steps(env, 50)
    bound = math.inf if ceiling is None else ceiling - 0.5  # of the quantiles from -0.5 to 0.5
    if SPACES[env][2]:
        vectors = np.eye(4, dtype=np.float32)[act]
    else:
        vectors = np.clip(act, -1.0, 1.0)
    g = model.reward(torch.as_tensor(obs), torch.as_tensor(vectors)).numpy()
    expected = np.minimum(g, bound)
    if absorbing:
        none = torch.zeros(50, SPACES[env][1])
        final = model.reward(torch.as_tensor(following), none).numpy()
        # 0.75 + 0.75^2 + ... = 3
        expected = expected + done * 3.0 * np.minimum(final, bound)
    found = reward(obs, act, following, done)
    np.testing.assert_allclose(found, expected / SCALE, rtol=1e-5, atol=1e-6)
    assert found.dtype == np.float32
    assert (reward.env, reward.settings) == (env, (SETTING[env],))


@pytest.mark.filterwarnings("error")
def test_arrays_that_cannot_be_written_to_are_scored_without_a_warning(tmp_path):
    path, _ = write_random_reward(tmp_path, "half-cheetah")
    arrays = steps("half-cheetah", 20)
    expected = irlcli.load_reward(path)(*arrays)
    for array in arrays:
        array.flags.writeable = False
    np.testing.assert_array_equal(irlcli.load_reward(path)(*arrays), expected)


@pytest.mark.parametrize("env", SPACES)
def test_it_is_what_transfer_trains_on(tmp_path, env):
    """The reward of a rollout's steps, absorbing states included."""
    from irlcli.data.tensors import load_reward_file
    from irlcli.stages.base import environment_key
    from irlcli.stages.running import frozen_reward
    from irlcli.trajectories import Rollout

    path, _ = write_random_reward(tmp_path, env, fixed_horizon=True)
    model, origin = load_reward_file(path)
    frozen = frozen_reward(environment_key(env), SETTING[env], model, origin, gamma=0.97)
    obs, act, following, done = (a.reshape(10, 4, *a.shape[1:]) for a in steps(env, 40))
    numbers = np.zeros((10, 4))
    rollout = Rollout(
        obs,
        act,
        following,
        numbers,
        numbers,
        done,
        ~done,
        numbers.astype(int),
        numbers,
        numbers,
        (),
    )
    paid = frozen.rewards(rollout, None)
    reward = irlcli.load_reward(path, gamma=0.97)
    flat = [a.reshape(40, *a.shape[2:]) for a in (obs, act, following, done)]
    np.testing.assert_array_equal(reward(*flat), paid.reshape(-1))


def test_a_name_and_an_id_are_found_in_a_store(smoke_store):
    by_name = irlcli.load_reward("airl", store=smoke_store.path)
    by_id = irlcli.load_reward(smoke_store.airl[:8], store=smoke_store.path)
    arguments = steps("lunar-lander", 5)
    np.testing.assert_array_equal(by_name(*arguments), by_id(*arguments))
    assert by_name.method == "irm"
    # A path is read in the store that it lies in, whatever ``store`` is.
    directory = smoke_store.path / smoke_store.airl
    for path in (directory, str(directory / "reward.pt")):
        by_path = irlcli.load_reward(path, store="elsewhere")
        np.testing.assert_array_equal(by_name(*arguments), by_path(*arguments))


def test_errors_name_arguments_not_options(tmp_path):
    with pytest.raises(IrlError) as caught:
        irlcli.load_reward("irm", store=tmp_path / "none")
    assert 'store="DIRECTORY"' in caught.value.hint
    for ref in (3, None, ["irm"]):
        with pytest.raises(UsageError, match="is not text or a path"):
            irlcli.load_reward(ref)


def test_what_it_cannot_use_is_named(smoke_store, tmp_path):
    path, _ = write_random_reward(tmp_path, "half-cheetah")
    reward = irlcli.load_reward(path)
    obs, act, following, done = steps("half-cheetah", 5)
    for arguments, message in (
        ((obs[:, :8], act, following, done), r"obs is \[5, 8\], not \[5, 17\]"),
        ((obs[0], act[0], following[0], False), r"obs is \[17\], not \[B, 17\]"),
        ((obs, act[:, 0], following, done), r"act is \[5\], not \[5, 6\]"),
        ((obs, act, following[:4], done), r"next_obs is \[4, 17\], not \[5, 17\]"),
        ((obs, act, following, False), r"done is \[\], not \[5\]"),
        ((obs, act, following, [0.5] * 5), "done must hold"),
        ((obs, act, following, ["False"] * 5), "done must hold"),
    ):
        with pytest.raises(ValueError, match=message):
            reward(*arguments)
    for words, error in (
        ({"ref": "nothing", "store": smoke_store.path}, "nothing"),
        ({"ref": "demos", "store": smoke_store.path}, "reward.pt"),
        ({"ref": path, "gamma": 1.0}, "gamma"),
        ({"ref": path, "gamma": "0.9"}, "gamma '0.9' is not a number"),
        ({"ref": path, "ceiling": 1.5}, "ceiling"),
        ({"ref": path, "setting": "leg-length=99"}, "leg-length"),
        ({"ref": path, "setting": "goal-y=0"}, "observations of size"),
        ({"ref": tmp_path / "no.pt"}, "no.pt"),
    ):
        with pytest.raises(IrlError, match=error):
            irlcli.load_reward(**words)


def test_a_policy_is_scored_by_rewards_of_its_environment_only(irl, smoke_store, tmp_path):
    path, _ = write_random_reward(tmp_path, "half-cheetah")
    common = ["--reward", path, "--store", smoke_store.path]
    for line in (["evaluate", "--policy", "airl"], ["play", "airl", "--out", tmp_path / "x.gif"]):
        done = irl(*line, *common)
        assert done.code == 2 and "'airl' is a policy of lunar-lander" in done.err
        assert "half-cheetah" in done.err and "--env" not in done.err


def test_importing_the_package_stays_light():
    code = (
        "import sys, irlcli; irlcli.__version__; dir(irlcli); "
        "assert not {'torch', 'numpy', 'gymnasium', 'msgspec'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="has no attribute 'load_rewards'"):
        _ = irlcli.load_rewards


# The wrappers


class Count(gymnasium.Env):
    """Counts its steps. Ends at 3, terminated if ``terminates``."""

    observation_space = gymnasium.spaces.Box(0.0, 10.0, (1, 1), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, terminates=True):
        self.terminates = terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.full((1, 1), 0.0, np.float32), {}

    def step(self, action):
        self.t += 1
        ended = self.t == 3
        shown = np.full((1, 1), self.t, np.float32)
        return shown, -1.0, ended and self.terminates, ended and not self.terminates, {"own": 1}


def digits(obs, act, next_obs, done):
    """Tells its arguments: s, s', a and whether the step terminated, as the digits of a number."""
    return 100 * obs[:, 0] + 10 * next_obs[:, 0] + act[:, 0] + 0.5 * done


@pytest.mark.parametrize("terminates", [True, False])
def test_a_wrapped_environment_pays_the_learned_reward(terminates):
    env = irlcli.RewardWrapper(Count(terminates), digits)
    for _ in range(2):  # the second episode begins anew
        env.reset(seed=0)
        found = [env.step(np.array([1.0], np.float32)) for _ in range(3)]
        assert [reward for _, reward, *_ in found] == [11.0, 121.0, 231.5 if terminates else 231.0]
        assert [info for *_, info in found] == [{"own": 1, "true_reward": -1.0}] * 3


@pytest.mark.parametrize("terminates", [True, False])
def test_a_wrapped_vec_env_pays_the_learned_reward(terminates):
    """Also where an episode ends: the successor is its last observation, not the next first one."""
    venv = irlcli.RewardVecEnvWrapper(DummyVecEnv([lambda: Count(terminates)] * 2), digits)
    venv.reset()
    for _ in range(2):
        found = [venv.step(np.array([[1.0], [2.0]], np.float32)) for _ in range(3)]
        last = 0.5 if terminates else 0.0
        assert [rewards.tolist() for _, rewards, _, _ in found] == [
            [11.0, 12.0],
            [121.0, 122.0],
            [231.0 + last, 232.0 + last],
        ]
        assert found[0][1].dtype == np.float32
        assert all(info["true_reward"] == -1.0 for *_, infos in found for info in infos)


def sac(env):
    return SAC("MlpPolicy", env, learning_starts=20, batch_size=16, policy_kwargs={"net_arch": [8]})


def test_sac_of_stable_baselines_trains_on_a_wrapped_environment(tmp_path):
    path, _ = write_random_reward(tmp_path, "half-cheetah", fixed_horizon=False)
    reward = irlcli.load_reward(path)
    env = irlcli.RewardWrapper(gymnasium.make("irlcli/HalfCheetah-v0", leg_length=0.7), reward)
    agent = sac(env).learn(60)
    stored = agent.replay_buffer
    assert stored.size() == 60
    np.testing.assert_allclose(stored.rewards[:60], _of(stored, reward, 60), atol=1e-6)


def test_sac_of_stable_baselines_trains_on_a_wrapped_vec_env(tmp_path):
    path, _ = write_random_reward(tmp_path, "half-cheetah", fixed_horizon=False)
    reward = irlcli.load_reward(path)
    make = lambda: gymnasium.make("irlcli/HalfCheetah-v0", leg_length=0.7)  # noqa: E731
    agent = sac(irlcli.RewardVecEnvWrapper(DummyVecEnv([make, make]), reward)).learn(120)
    stored = agent.replay_buffer
    np.testing.assert_allclose(stored.rewards[:60], _of(stored, reward, 60), atol=1e-6)


def _of(stored, reward, count):
    """What ``reward`` gives for the first ``count`` rows of a replay buffer."""
    worlds = stored.observations.shape[1]
    columns = [
        reward(
            stored.observations[:count, world],
            stored.actions[:count, world],
            stored.next_observations[:count, world],
            stored.dones[:count, world].astype(bool),
        )
        for world in range(worlds)
    ]
    return np.stack(columns, axis=1)


def test_discrete_actions_work_too(tmp_path):
    path, _ = write_random_reward(tmp_path, "lunar-lander", actions="sampled")
    reward = irlcli.load_reward(path)
    for env in (
        irlcli.RewardWrapper(gymnasium.make("irlcli/LunarLander-v0"), reward),
        irlcli.RewardVecEnvWrapper(
            DummyVecEnv([lambda: gymnasium.make("irlcli/LunarLander-v0")]), reward
        ),
    ):
        DQN("MlpPolicy", env, learning_starts=10, policy_kwargs={"net_arch": [8]}).learn(30)
    still = np.zeros((1, 8), dtype=np.float32)
    for index in (-1, 4, -0.9, 3.5):
        with pytest.raises(ValueError, match="act must hold indices from 0 to 3"):
            reward(still, [index], still, [False])


def test_the_discount_is_by_default_that_of_the_reward_learning(tmp_path):
    path, _ = write_random_reward(tmp_path, "lunar-lander", fixed_horizon=True, actions="sampled")
    plain, own, other = (
        irlcli.load_reward(path, **given)(*steps("lunar-lander", 50))
        for given in ({}, {"gamma": 0.9}, {"gamma": 0.75})
    )
    assert np.array_equal(plain, own) and not np.array_equal(own, other)


def test_an_environment_of_other_spaces_is_refused_before_its_first_step(tmp_path):
    path, _ = write_random_reward(tmp_path, "half-cheetah", fixed_horizon=False)
    reward = irlcli.load_reward(path)
    make = lambda: gymnasium.make("irlcli/LunarLander-v0")  # noqa: E731
    message = (
        "observations of size 8 and 4 discrete actions, the reward takes 17 and actions of size 6"
    )
    with pytest.raises(ValueError, match=message):
        irlcli.RewardWrapper(make(), reward)
    with pytest.raises(ValueError, match=message):
        irlcli.RewardVecEnvWrapper(DummyVecEnv([make]), reward)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (gymnasium.spaces.MultiDiscrete([3, 2]), None),
        (gymnasium.spaces.MultiDiscrete([2, 3]), "discrete actions of 2 x 3 choices"),
        (gymnasium.spaces.Discrete(5), "5 discrete actions"),
        (gymnasium.spaces.Box(-1, 1, (5,)), "actions of size 5"),
        (gymnasium.spaces.Tuple([gymnasium.spaces.Discrete(5)]), "actions in Tuple"),
    ],
)
def test_several_choices_are_compared_one_by_one(actions, words):
    """Each of these spaces flattens to size 5."""
    network = SimpleNamespace(observation_size=4, action_size=5, discrete=True, choices=(3, 2))
    about = SimpleNamespace(env="x", settings=(), method="erm", seed=0, network=network)
    check = irlcli.LearnedReward(None, about).check_spaces
    observations = gymnasium.spaces.Box(-1, 1, (4,))
    if words is None:
        check(observations, actions)
        return
    with pytest.raises(ValueError, match=words):
        check(observations, actions)


def test_only_vectors_are_observations():
    """One of four states flattens to size 4, but a wrapper would hand over an index."""
    network = SimpleNamespace(observation_size=4, action_size=5, discrete=True, choices=())
    about = SimpleNamespace(env="x", settings=(), method="erm", seed=0, network=network)
    check = irlcli.LearnedReward(None, about).check_spaces
    with pytest.raises(ValueError, match=r"observations in Discrete\(4\)"):
        check(gymnasium.spaces.Discrete(4), gymnasium.spaces.Discrete(5))


# The file


READ = """
import sys
sys.modules["irlcli"] = None
import numpy, torch
arrays = numpy.load(sys.argv[2])
program = torch.export.load(sys.argv[1]).module()
for count in (1, 2, 50):
    arguments = [torch.as_tensor(arrays[n][:count]) for n in ("obs", "act", "next_obs", "done")]
    numpy.testing.assert_allclose(program(*arguments).numpy(), arrays["reward"][:count], atol=1e-6)
numpy.testing.assert_array_equal(program(*arguments).numpy(), arrays["reward"])
if arguments[1].dtype == torch.int64:
    for index in (-1, 4):
        arguments[1][7] = index
        unknown = program(*arguments).isnan()
        assert unknown[7] and unknown.sum() == 1
"""


@pytest.mark.parametrize("env", SPACES)
def test_an_exported_reward_runs_without_the_package(irl, tmp_path, env):
    view = "sampled" if env == "lunar-lander" else "executed"
    path, _ = write_random_reward(tmp_path, env, fixed_horizon=True, actions=view)
    out = tmp_path / "reward.pt2"
    done = irl("export", "reward", path, "--to", f"torch-export:{out}", "--store", tmp_path / "s")
    assert done.code == 0, done.err
    names = ("obs", "act", "next_obs", "done")
    arguments = dict(zip(names, steps(env, 50), strict=True))
    reward = irlcli.load_reward(path)
    np.savez(tmp_path / "a.npz", reward=reward(**arguments), **arguments)
    command = [sys.executable, "-W", "error", "-c", READ, str(out), str(tmp_path / "a.npz")]
    read = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert read.returncode == 0, read.stderr
    about = {"irlcli.json": ""}
    torch.export.load(out, extra_files=about)
    assert json.loads(about["irlcli.json"])["env"] == env
    line = ["transfer", "--reward", out, "--ood", "engine-power=2x", "--store", tmp_path / "s"]
    refused = irl(*line)
    reason = refused.err.partition("(")[2].partition(")\n")[0]
    assert refused.code == 4 and 0 < len(reason) < 100, refused.err


def test_a_reward_is_exported_once_and_only_a_reward(irl, smoke_store, tmp_path):
    (tmp_path / "old.pt2").write_text("mine")
    for words, code, named in (
        (["airl", "--to", f"torch-export:{tmp_path}/old.pt2"], 2, "exists"),
        (["airl", "--to", "parquet:x"], 2, "'parquet:x'"),
        (["demos", "--to", f"torch-export:{tmp_path}/x.pt2"], 2, "reward.pt"),
    ):
        done = irl("export", "reward", *words, "--store", smoke_store.path)
        assert done.code == code and named in done.err and "hint: " in done.err, done.err
    assert (tmp_path / "old.pt2").read_text() == "mine"
