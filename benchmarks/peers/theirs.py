"""imitation's AIRL and GAIL and stable-baselines3's PPO, one run a process, in their own environment.

Where values come from:

defaults: those of ``python -m imitation.scripts.train_adversarial`` without a named configuration
    (imitation 1.0.1, ``scripts/config`` and ``scripts/ingredients``).
best known, HalfCheetah: the tuned values that imitation 1.0.1 ships for seals' HalfCheetah,
    ``scripts/config/tuned_hps``, read from there.
best known, LunarLander: imitation tuned nothing for it. The discriminator's values are those of
    imitation's tutorials, the generator's those of rl-baselines3-zoo for LunarLander-v2.
PPO: rl-baselines3-zoo, ``hyperparams/ppo.yml``, LunarLander-v2 and HalfCheetahBulletEnv-v0.

imitation wants episodes of equal length and names absorbing states as the way there, by a wrapper of
seals, which it requires. So LunarLander's episodes last 1000 steps here, and demonstrated episodes end
with their last observation and action repeated. ``variable`` instead passes
``allow_variable_horizon``.

Its learners take worlds of one kind: they get equal shares of the worlds of all settings, and the
pooled demonstrations, which is ERM. Nothing is logged, and all worlds are stepped in one process.
"""

from __future__ import annotations

import contextlib
import functools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import imitation
import numpy as np
import pyarrow.parquet as pq
import torch
from gymnasium.wrappers import TimeLimit
from imitation.algorithms.adversarial.airl import AIRL
from imitation.algorithms.adversarial.gail import GAIL
from imitation.data.types import Trajectory
from imitation.policies.base import FeedForward32Policy, NormalizeFeaturesExtractor
from imitation.rewards.reward_nets import BasicRewardNet, BasicShapedRewardNet, NormalizedRewardNet
from imitation.util import logger
from imitation.util.networks import RunningNorm
from seals.util import AbsorbAfterDoneWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from benchmarks.peers.checks import Checks, Ended
from irlcli.envs.registration import build
from irlcli.envs.registry import environment
from irlcli.interventions import env_kwargs, parse_setting

_FOREVER = 10**9
_LEARNERS = {"airl": (AIRL, BasicShapedRewardNet), "gail": (GAIL, BasicRewardNet)}
_TUTORIAL = {
    "airl": {
        "demo_batch_size": 2048,
        "gen_replay_buffer_capacity": 512,
        "n_disc_updates_per_round": 16,
    },
    "gail": {
        "demo_batch_size": 1024,
        "gen_replay_buffer_capacity": 512,
        "n_disc_updates_per_round": 8,
    },
}
_ZOO_WORLDS = 16
_ZOO: dict[str, dict[str, Any]] = {
    "lunar-lander": {
        "policy": "MlpPolicy",
        "n_steps": 1024,
        "batch_size": 64,
        "gae_lambda": 0.98,
        "gamma": 0.999,
        "n_epochs": 4,
        "ent_coef": 0.01,
    },
    "half-cheetah": {
        "policy": "MlpPolicy",
        "n_steps": 512,
        "batch_size": 128,
        "gamma": 0.99,
        "gae_lambda": 0.9,
        "n_epochs": 20,
        "ent_coef": 0.0,
        "use_sde": True,
        "sde_sample_freq": 4,
        "max_grad_norm": 0.5,
        "vf_coef": 0.5,
        "learning_rate": 3e-5,
        "clip_range": 0.4,
        "policy_kwargs": {
            "log_std_init": -2,
            "ortho_init": False,
            "activation_fn": torch.nn.ReLU,
            "net_arch": {"pi": [256, 256], "vf": [256, 256]},
        },
    },
}


def main() -> None:
    """Run the task that the first argument describes, as JSON."""
    run = json.loads(sys.argv[1])
    torch.set_num_threads(1)
    set_random_seed(run["seed"])
    train = _train_expert if run["method"] == "zoo-ppo" else _train_student
    with contextlib.suppress(Ended):
        train(run, Checks(run))


def _train_expert(run: dict[str, Any], checks: Checks) -> None:
    env = run["row"].split(".")[0]
    values = _ZOO[env]
    worlds: VecEnv = _worlds(run, _ZOO_WORLDS)
    if env == "half-cheetah":
        worlds = VecNormalize(worlds, gamma=values["gamma"])
    model = PPO(env=worlds, seed=run["seed"], device="cpu", **values)

    def act(seen: np.ndarray) -> np.ndarray:
        if isinstance(worlds, VecNormalize):
            seen = np.asarray(worlds.normalize_obs(seen))
        return model.predict(seen, deterministic=True)[0]

    class Check(BaseCallback):
        def _on_rollout_start(self) -> None:
            checks.after(self.num_timesteps, act)

        def _on_step(self) -> bool:
            return True

    checks.begin()
    model.learn(_FOREVER, callback=Check())


def _train_student(run: dict[str, Any], checks: Checks) -> None:
    _, name, *kind = run["method"].split("-")
    learner, network = _LEARNERS[name]
    fixed = (
        environment(run["row"].split(".")[0]).max_episode_steps if kind != ["variable"] else None
    )
    count, discriminator, generator = _values(name, run["row"].split(".")[0], bool(kind))
    worlds = _worlds(run, count, fixed is not None)
    reward = network(
        worlds.observation_space, worlds.action_space, normalize_input_layer=RunningNorm
    )
    model = PPO(env=worlds, seed=run["seed"], device="cpu", **generator)
    with tempfile.TemporaryDirectory() as directory:
        trainer = learner(
            demonstrations=_demonstrations(Path(run["demos"]), fixed),
            venv=worlds,
            gen_algo=model,
            reward_net=NormalizedRewardNet(reward, RunningNorm),
            log_dir=directory,
            custom_logger=logger.configure(directory, []),
            allow_variable_horizon=kind == ["variable"],
            **discriminator,
        )
        checks.begin()
        trainer.train(
            _FOREVER,
            lambda _: checks.after(
                model.num_timesteps, lambda seen: model.predict(seen, deterministic=True)[0]
            ),
        )


def _values(name: str, env: str, best: bool) -> tuple[int, dict[str, Any], dict[str, Any]]:
    """The number of worlds, the values of the adversarial learner, and those of its PPO."""
    if best and env == "lunar-lander":
        return _ZOO_WORLDS, _TUTORIAL[name], _ZOO[env]
    if best:
        tuned = Path(imitation.__file__).parent / "scripts/config/tuned_hps"
        values = json.loads((tuned / f"{name}_seals_half_cheetah_best_hp_eval.json").read_text())
        normalised = {
            "features_extractor_class": NormalizeFeaturesExtractor,
            "features_extractor_kwargs": {"normalize_class": RunningNorm},
        }
        rl = values["rl"]
        generator = {**rl["rl_kwargs"], "policy_kwargs": normalised}
        discriminator = values["algorithm_kwargs"]
        steps = rl["batch_size"]
    else:
        generator = {"learning_rate": 3e-4, "batch_size": 64, "n_epochs": 10, "ent_coef": 0.0}
        steps = 2048
        discriminator = {
            "demo_batch_size": 1024,
            "n_disc_updates_per_round": 4,
            "gen_replay_buffer_capacity": steps,
        }
    return 8, discriminator, {"policy": FeedForward32Policy, "n_steps": steps // 8, **generator}


def _worlds(run: dict[str, Any], count: int, fixed: bool = False) -> DummyVecEnv:
    """``count`` worlds in equal shares of each setting; ``fixed``: whether no episode ends early."""
    env = run["row"].split(".")[0]
    spec = environment(env)
    settings = [parse_setting(env, text) for text in run["settings"]]

    def make(index: int) -> TimeLimit:
        setting = settings[index * len(settings) // count]
        world = build(spec, env_kwargs(env, setting), str(setting))
        return TimeLimit(AbsorbAfterDoneWrapper(world) if fixed else world, spec.max_episode_steps)

    venv = DummyVecEnv([functools.partial(make, i) for i in range(count)])
    venv.seed(run["seed"])
    return venv


def _demonstrations(path: Path, fixed: int | None) -> list[Trajectory]:
    """The exported episodes of all settings, each ``fixed`` steps long if that is given."""
    columns = pq.read_table(path).to_pydict()
    episode = np.asarray(columns["episode"])
    starts = np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
    trajectories = []
    for start, end in zip(starts, [*starts[1:], len(episode)], strict=True):
        seen = np.asarray([*columns["obs"][start:end], columns["next_obs"][end - 1]], np.float32)
        done = np.asarray(columns["action"][start:end])
        missing = 0 if fixed is None else fixed - len(done)
        seen = np.concatenate([seen, np.repeat(seen[-1:], missing, axis=0)])
        done = np.concatenate([done, np.repeat(done[-1:], missing, axis=0)])
        trajectories.append(Trajectory(seen, done, None, terminal=True))
    return trajectories


if __name__ == "__main__":
    main()
