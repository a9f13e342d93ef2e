"""The PyBullet robots in the chain: continuous actions, normalisation, progress, workers, play."""

import math
import multiprocessing
import shutil
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from msgspec import UNSET
from PIL import Image

from irlcli.configs import PPOConfig, load_config
from irlcli.data.tensors import from_bytes, to_bytes
from irlcli.envs import registration as envs
from irlcli.envs.registry import environment
from irlcli.envs.vector import VectorWorlds
from irlcli.errors import StageFailed, UsageError
from irlcli.interventions import parse_setting, parse_settings
from irlcli.rl import ppo as rl
from irlcli.rl.loop import train_rounds
from irlcli.seeds import derive
from irlcli.stages import collect_experts, train_airl
from irlcli.stages.base import From, Job
from irlcli.store import Store

SETTINGS = parse_settings("reacher", "gravity=0.5x,2x")
PPO = {"n_envs": 2, "n_steps": 160, "batch_size": 128, "n_epochs": 1, "net_arch": (16, 16)}
NORMALISED = {"normalise_observations": True, "normalise_rewards": True}


def make_trainer(worlds=None, seed=0, **changes):
    ppo = PPOConfig(**{**PPO, **changes})
    worlds = worlds or rl.make_worlds("reacher", SETTINGS, ppo.n_envs)
    return rl.PPOTrainer(worlds, ppo, 1000, seed, "test")


def test_the_action_seen_by_all_is_the_unclipped_sample():
    trainer = make_trainer(log_std_init=1.0, **NORMALISED)
    rollouts = []

    def reward(rollout):
        # Called before the update: the policy is still the one that acted.
        observations = torch.as_tensor(rollout.observations).flatten(0, 1)
        actions = torch.as_tensor(rollout.actions).flatten(0, 1)
        log_probs = trainer.policy.log_prob(observations, actions).numpy()
        np.testing.assert_allclose(rollout.log_probs.ravel(), log_probs, atol=1e-4)
        rollouts.append(rollout)
        return rollout.true_rewards

    trainer.train_round(0, reward)
    (rollout,) = rollouts
    assert np.abs(rollout.actions).max() > 2.0
    # The world moved by the clipped one.
    _, first, _ = derive("test", 0, 0, 3)
    world = envs.make("reacher", SETTINGS[0])
    observation, _ = world.reset(seed=first)
    for t in range(20):
        np.testing.assert_array_equal(rollout.observations[t, 0], observation)
        observation, paid, *_ = world.step(np.clip(rollout.actions[t, 0], -1.0, 1.0))
        assert rollout.true_rewards[t, 0] == paid


def test_the_cap_on_the_deviation_holds_after_every_round():
    """A reward that pays for large actions would raise it: the learning rate sees to that."""
    deviations = {}
    for cap in (UNSET, -0.5):
        trainer = make_trainer(log_std_init=-0.6, log_std_max=cap, learning_rate=0.05, n_epochs=4)
        for index in range(3):
            trainer.train_round(index, lambda rollout: (rollout.actions**2).sum(-1))
        deviations[cap] = trainer.model.policy.log_std.detach().numpy()
    assert deviations[UNSET].max() > -0.5
    assert deviations[-0.5].max() == np.float32(-0.5)


def test_a_cap_needs_continuous_actions():
    worlds = rl.make_worlds("lunar-lander", [parse_setting("lunar-lander", "bounce=0.5")], 1)
    with pytest.raises(UsageError, match=r"ppo\.log_std_max needs continuous actions"):
        rl.PPOTrainer(worlds, PPOConfig(n_envs=1, log_std_max=-1.0), 1000, 0, "test")


def test_a_clone_is_the_maximum_likelihood_fit():
    """Actions drawn from one Gaussian wherever the robot is: the fit has its mean and deviation."""
    trainer = make_trainer(**NORMALISED)
    rng = np.random.default_rng(0)
    observations = rng.normal(3.0, 2.0, (4096, trainer.policy.network.observation_space.shape[0]))
    observations = observations.astype(np.float32)
    mean, deviation = np.array([0.5, -0.3]), np.array([0.2, 0.6])
    actions = torch.as_tensor(rng.normal(mean, deviation, (4096, 2)).astype(np.float32))

    def log_likelihood(rows):
        seen = torch.as_tensor(observations[rows])
        return trainer.policy.log_prob(seen, actions[rows], gradient=True)

    before = trainer.policy.state_dict()["value_net.weight"].clone()
    trainer.clone(observations, log_likelihood, 150)
    found = trainer.policy.gaussian(torch.as_tensor(observations))
    np.testing.assert_allclose(found[0].mean(0), actions.mean(0), atol=0.02)
    np.testing.assert_allclose(found[1][0], actions.std(0), rtol=0.05)
    # The moments are those of the demonstrations, and the value of a state is not touched.
    network = trainer.policy.network
    np.testing.assert_allclose(network.features_extractor.mean, observations.mean(0), atol=1e-4)
    assert torch.equal(trainer.policy.state_dict()["value_net.weight"], before)
    capped = make_trainer(log_std_max=-1.0, **NORMALISED)
    trainer = capped
    capped.clone(observations, log_likelihood, 5)
    assert capped.policy.network.log_std.max() == -1.0


def test_a_clone_sees_what_its_demonstrations_normalise():
    """Moments that took in other states would change the policy fitted; also after a restart."""
    trainer = make_trainer(**NORMALISED)
    observations = np.random.default_rng(0).normal(
        size=(64, trainer._venv.observation_space.shape[0])
    )
    trainer.clone(
        observations.astype(np.float32),
        lambda rows: trainer.policy.network.log_std.sum() * torch.ones(len(rows)),
        1,
    )
    resumed = make_trainer(**NORMALISED)
    resumed.load_state_dict(from_bytes(to_bytes(trainer.state_dict())))
    uncloned = make_trainer(**NORMALISED)
    for each in (trainer, resumed, uncloned):
        each.train_round(0)
    for each in (trainer, resumed):
        moments = each.policy.network.features_extractor
        assert moments.count == 64
        np.testing.assert_allclose(moments.mean, observations.mean(0), atol=1e-6)
        np.testing.assert_allclose(moments.variance, observations.var(0), rtol=1e-5)
    assert uncloned.policy.network.features_extractor.count == 320


def test_demonstrations_hold_the_unclipped_sample():
    policy = make_trainer(log_std_init=1.0).policy
    (trajectory,) = rl.roll_out("reacher", SETTINGS[0], policy, 1, seed=4, purpose="test")
    assert np.abs(trajectory.actions).max() > 2.0
    world = envs.make("reacher", SETTINGS[0])
    observation, _ = world.reset(seed=trajectory.seed)
    progress = 0.0
    for t in range(len(trajectory)):
        np.testing.assert_array_equal(trajectory.observations[t], observation)
        clipped = np.clip(trajectory.actions[t], -1.0, 1.0)
        observation, paid, _, _, info = world.step(clipped)
        assert trajectory.rewards[t] == paid
        progress += info["progress"]
    assert trajectory.progress == pytest.approx(progress)
    assert trajectory.error is None


def test_observations_are_normalised_by_the_moments_of_all_rollouts_so_far():
    trainer = make_trainer(rollouts_per_round=2, **NORMALISED)
    seen = [r.observations.reshape(-1, 9) for i in range(2) for r in trainer.train_round(i)]
    extractor = trainer.model.policy.features_extractor
    together = np.concatenate(seen).astype(np.float64)
    np.testing.assert_allclose(extractor.mean, together.mean(0), atol=1e-9)
    np.testing.assert_allclose(extractor.variance, together.var(0), atol=1e-9)
    assert extractor.count == len(together)
    normal = extractor(torch.as_tensor(seen[-1]))
    expected = (seen[-1] - together.mean(0)) / np.sqrt(together.var(0) + 1e-8)
    np.testing.assert_allclose(normal, np.clip(expected, -10, 10), atol=1e-3)


def test_rewards_are_divided_by_the_deviation_of_their_discounted_sums():
    trainer = make_trainer(gamma=0.9, gae_lambda=0.0, normalise_rewards=True)
    (rollout,) = trainer.train_round(0)
    rewards, sums = rollout.true_rewards, []
    for world in range(2):
        total = 0.0
        for t in range(160):
            total = 0.9 * total + rewards[t, world]
            sums.append(total)
            if rollout.truncated[t, world]:
                total = 0.0
    paid = trainer.model.rollout_buffer.rewards
    # A truncated step is paid the value of what would have followed as well.
    expected = np.clip(rewards / np.std(sums), -10, 10)
    plain = ~rollout.truncated
    np.testing.assert_allclose(paid[plain], expected[plain], rtol=1e-4)


def test_a_resumed_robot_equals_an_uninterrupted_one_and_evaluation_leaves_it_alone():
    def train(trainer, rounds):
        for index in rounds:
            trainer.train_round(index)
        return to_bytes(trainer.state_dict())

    sde = {"use_sde": True, "sde_sample_freq": 4, "log_std_init": -1.0}
    through = make_trainer(**NORMALISED, **sde)
    first = make_trainer(**NORMALISED, **sde)
    stored = train(first, [0])
    rl.roll_out("reacher", SETTINGS[0], first.policy, 1, seed=0, purpose="test")
    assert to_bytes(first.state_dict()) == stored
    resumed = make_trainer(**NORMALISED, **sde)
    resumed.load_state_dict(from_bytes(stored))
    assert train(resumed, [1, 2]) == train(through, [0, 1, 2])


def test_a_saved_robot_acts_as_before_in_a_goal_setting():
    setting = parse_setting("half-cheetah", "direction=-10..0")
    worlds = rl.make_worlds("half-cheetah", [setting], 2)
    trainer = make_trainer(worlds, n_steps=64, use_sde=True, activation="relu", **NORMALISED)
    trainer.train_round(0)
    description = rl.Policy.describe("half-cheetah", trainer.ppo)
    stored = from_bytes(to_bytes(trainer.policy.state_dict()))
    policy = rl.load_policy(description, stored, setting)
    observations = np.random.default_rng(0).normal(size=(20, 19)).astype(np.float32)
    np.testing.assert_array_equal(
        policy.act(observations, deterministic=True),
        trainer.policy.act(observations, deterministic=True),
    )


def test_the_noise_of_gsde_has_the_reported_likelihood():
    trainer = make_trainer(use_sde=True, sde_sample_freq=4, log_std_init=-0.5)
    observation = np.full((20_000, 9), 0.3, dtype=np.float32)
    torch.manual_seed(0)
    actions = trainer.policy.act(observation)
    distribution = trainer.policy.network.get_distribution(torch.as_tensor(observation[:1]))
    deviation = distribution.distribution.stddev.detach().numpy()[0]
    mean = distribution.mode().detach().numpy()[0]
    np.testing.assert_allclose(actions.mean(0), mean, atol=4 * deviation.max() / 140)
    np.testing.assert_allclose(actions.std(0), deviation, rtol=0.03)


class Exploding(gymnasium.Env):
    """Reports progress 2 a step; its state stops being finite at every 7th."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, explodes):
        self.explodes = explodes

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        observation = np.full(1, self.steps, dtype=np.float32)
        if self.explodes and self.steps == 7:
            return observation, 0.0, False, True, {"error": "the state is not finite"}
        return observation, 1.0, False, False, {"progress": 2.0}


def test_an_exploded_world_is_named_and_training_goes_on(tmp_path):
    warnings = []
    console = SimpleNamespace(
        progress=lambda *a: None, scalars=lambda *a: None, warn=warnings.append
    )
    checkpoints = SimpleNamespace(load=lambda: None, offer=lambda state: None)
    worlds = VectorWorlds([Exploding(False), Exploding(True)], 16)
    trainer = make_trainer(worlds)
    job = Job(None, {}, tmp_path, checkpoints, console)
    rows = train_rounds(job, trainer, ["mass=1x", "mass=10x"])
    assert len(rows) == 2 * trainer.rounds
    calm, wild = rows[:2]
    assert (calm["true_return"], calm["progress"], calm["episode_length"]) == (16.0, 32.0, 16.0)
    assert (wild["true_return"], wild["progress"], wild["episode_length"]) == (6.0, 12.0, 7.0)
    assert "mass=10x, world 1, round 0: the state is not finite" in warnings[0]
    assert not any("mass=1x" in warning for warning in warnings)


def test_environments_without_progress_report_none():
    worlds = rl.make_worlds("lunar-lander", [parse_setting("lunar-lander", "default")], 1)
    worlds.max_episode_steps = 3
    worlds.reset([0])
    ended = [end for _ in range(3) for end in worlds.step(np.zeros(1, dtype=np.int64))[2]]
    assert math.isnan(ended[0].progress) and ended[0].error is None


@pytest.fixture(scope="module")
def chains(tmp_path_factory, run_irl):
    """The Reacher's chain with one worker and with two, by the command line: two stores."""
    base = tmp_path_factory.mktemp("robots")
    for workers in ("1", "2"):
        common = ["--store", str(base / workers), "--profile", "smoke", "--quiet"]
        common += ["--workers", workers, "--name"]
        for arguments in (
            ["collect-experts", "--env", "reacher", "--intervention", "gravity", *common, "demos"],
            ["train-airl", "--demos", "demos", "--method", "irm", *common, "airl"],
            ["transfer", "--reward", "airl", "--ood", "gravity", *common, "moved"],
            ["evaluate", "--policy", "moved", *common, "score"],
        ):
            done = run_irl(arguments)
            assert done.code == 0, done.err
    return base


def test_the_number_of_workers_changes_no_byte(chains):
    one, two = Store(chains / "1"), Store(chains / "2")
    assert one.names() == two.names()
    assert one.ids() == two.ids() and len(one.ids()) == 6
    assert not two.verify(two.ids())
    assert {a.provenance()["workers"] for a in two.artefacts()} == {2}


def test_progress_stands_beside_the_return(chains, irl):
    done = irl("report", "returns", "score", "--store", chains / "1")
    assert done.code == 0 and "progress" in done.out.splitlines()[0]
    assert "reacher gravity=4x" in done.out


@pytest.mark.parametrize(
    ("env", "intervention", "ood"),
    [("ant", "leg-length=1x,2x", "3x"), ("half-cheetah", "goal-y", "goal-y")],
)
def test_walkers_go_through_the_chain(tmp_path, irl, env, intervention, ood):
    common = ["--store", tmp_path, "--profile", "smoke", "--quiet", "--name"]
    for section in ("expert", "airl", "transfer"):
        common[:0] = ["--set", f"{section}.ppo.n_steps=64", "--set", f"{section}.total_steps=256"]
    for arguments in (
        ["collect-experts", "--env", env, "--intervention", intervention, *common, "demos"],
        ["train-airl", "--demos", "demos", "--method", "erm", *common, "airl"],
        ["transfer", "--reward", "airl", "--ood", ood, *common, "moved"],
    ):
        done = irl(*arguments)
        assert done.code == 0, done.err
    done = irl("transfer", "--reward", "airl", "--ood", "mass=2x", *common, "other")
    if env == "ant":
        assert done.code == 0, done.err
    else:
        refused = [done]
        refused.append(irl("evaluate", "--policy", "moved", "--ood", "mass=2x", *common[:-1]))
        refused.append(
            irl("play", "moved", "--ood", "mass=2x", "--store", tmp_path, "--out", "x.gif")
        )
        for done in refused:
            assert done.code == 2
            assert "half-cheetah mass=2x has other observations than goal-y=" in done.err
            assert "hint: name a setting of goal-y, direction" in done.err
            assert "RUN" not in done.err


def test_play_draws_the_settings_side_by_side(chains, irl, tmp_path):
    file = tmp_path / "moved.gif"
    arguments = ["play", "moved", "--store", chains / "1", "--ood", "2x,0.5x", "--steps", "12"]
    done = irl(*arguments, "--out", file)
    assert done.code == 0, done.err
    assert done.out == f"{file}\n"
    with Image.open(file) as gif:
        assert gif.n_frames == 5 and gif.width == 3 * 320
        gif.seek(4)
        picture = np.array(gif.convert("RGB")).astype(int)
    left, middle = picture[16:, :320], picture[16:, 320:640]
    assert left.std() > 1.0
    assert (left != middle).any()
    assert (picture[:16, :320] != picture[:16, 320:640]).any()


def test_play_refuses_a_damaged_policy(chains, irl, tmp_path):
    store = tmp_path / "runs"
    shutil.copytree(chains / "1", store, symlinks=True)
    path = Store(store).resolve("moved").artefact.directory / "policy.pt"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    done = irl("play", "moved", "--store", store, "--out", tmp_path / "x.gif")
    assert done.code == 4 and "hint:" in done.err
    assert not (tmp_path / "x.gif").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["play", "moved", "--out", "x.mp4"], "does not end in .gif"),
        (["play", "moved", "--out", "no/x.gif"], "no/x.gif cannot be written"),
        (["play", "moved", "--ood", "mass=2x", "--out", "x.gif"], "no intervention 'mass'"),
        (["play", "score", "--out", "x.gif"], "holds no policy.pt"),
        (
            ["train-airl", "--demos", "demos", "--set", "airl.ppo.use_sde=true"],
            "gSDE's noise outlasts a step",
        ),
        (
            [
                *("collect-experts", "--env", "lunar-lander", "--intervention", "bounce=0.1"),
                *("--profile", "smoke", "--set", "expert.ppo.use_sde=true"),
            ],
            "ppo.use_sde needs continuous actions",
        ),
        (["evaluate", "--idle", "--env", "reacher", "--ood", "gravity=21x"], "0 to 20"),
        (["evaluate", "--idle", "--env", "ant", "--ood", "friction=1"], "as triple"),
        (
            ["evaluate", "--idle", "--env", "ant", "--ood", "gravity=2x"],
            "'gravity' belongs to reacher",
        ),
        (["evaluate", "--idle", "--env", "reacher", "--ood", "gravity", "--workers", "0"], "0"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(chains, irl, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    done = irl(*arguments, "--store", chains / "1")
    assert done.code in (2, 3) and done.out == ""
    assert said in done.err and "hint:" in done.err and "Traceback" not in done.err


@pytest.mark.parametrize("rounds", [0, 1])
def test_a_killed_worker_is_a_named_failure(rounds):
    """Also before the first round, while the trainer is made."""
    worlds = rl.make_worlds("reacher", SETTINGS, 2, workers=2)
    trainer = make_trainer(worlds) if rounds else None
    if trainer is not None:
        trainer.train_round(0)
    (worker, *_) = multiprocessing.active_children()
    worker.kill()
    with pytest.raises(StageFailed, match=r"worker . .* died: signal 9") as caught:
        (trainer or make_trainer(worlds)).train_round(1)
    assert caught.value.hint
    assert not multiprocessing.active_children()
    worlds.close()


@pytest.mark.parametrize("env", ["ant", "half-cheetah", "reacher"])
@pytest.mark.parametrize("profile", ["smoke", "standard", "paper"])
def test_every_intervention_of_the_settings_can_be_learned_from(env, profile):
    config = load_config(env, profile)
    assert set(config.interventions) == set(environment(env).knobs)
    for knob, values in config.interventions.items():
        settings = parse_settings(env, f"{knob}={','.join(values.id)}")
        demos = collect_experts.request(env, settings, config)
        train_airl.request(From(demos), env, settings, config.airl)
        parse_settings(env, f"{knob}={','.join(values.ood)}")
