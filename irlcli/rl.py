"""Reinforcement learning: the only module that knows stable-baselines3.

PPO is trained in *rounds*. A round seeds every generator from (seed, round), starts fresh
episodes, collects one or more rollouts and updates on each. What leaves a round is only the
network, its optimiser, running moments and a step count, so a run continued from any round's
checkpoint equals an uninterrupted one byte for byte on the same machine.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from msgspec import UNSET
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from irlcli import envs
from irlcli.activations import ACTIVATIONS
from irlcli.descriptions import PolicyNetwork
from irlcli.envs.vector import Ended, VectorWorlds
from irlcli.envs.workers import WorkerWorlds
from irlcli.errors import StageFailed, UsageError
from irlcli.interventions import Setting, environment
from irlcli.seeds import derive
from irlcli.settings import PPOSettings
from irlcli.trajectories import Trajectory

# Normalised observations and rewards are clipped to this, as in SB3's VecNormalize.
_CLIP = 10.0

# Of behavioural cloning: Adam's learning rate, and demonstrated steps a minibatch.
_CLONING_RATE = 1e-3
_CLONING_BATCH = 256

Worlds = VectorWorlds | WorkerWorlds

# Categorical re-checks its support on every one of millions of calls; SB3 builds it from
# logits that are finite or the run has failed already.
torch.distributions.Distribution.set_default_validate_args(False)


@dataclass(frozen=True)
class Rollout:
    """T steps of N worlds, time first. ``s`` is ``observations``, ``s'`` ``next_observations``.

    ``next_observations`` holds the true successor also where an episode ended (not the first
    observation of the next episode). ``actions`` are the policy's samples: where they leave the
    action space it is the environment that clips them. ``log_probs`` are log pi(a|s) of the
    sampling policy. ``errors`` names the worlds whose episode could not go on, and why.
    """

    observations: np.ndarray  # [T, N, D] float32
    actions: np.ndarray  # [T, N] int64 or [T, N, A] float32
    next_observations: np.ndarray  # [T, N, D] float32
    log_probs: np.ndarray  # [T, N] float32
    true_rewards: np.ndarray  # [T, N] float64
    terminated: np.ndarray  # [T, N] bool
    truncated: np.ndarray  # [T, N] bool
    lengths: np.ndarray  # [T, N] int64: length of the episode that ended here, else 0
    returns: np.ndarray  # [T, N] float64: its true return
    progress: np.ndarray  # [T, N] float64: its progress, NaN if the environment reports none
    errors: tuple[tuple[int, str], ...]


RewardFunction = Callable[[Rollout], np.ndarray]


class _RecordingVecEnv(VecEnv):
    """What SB3 steps: our worlds, plus a record of the transitions that its buffer drops."""

    def __init__(self, worlds: Worlds):
        self.worlds = worlds
        super().__init__(len(worlds), worlds.observation_space, worlds.action_space)
        self.seeds: Sequence[int] = range(len(worlds))
        self.rewards: list[np.ndarray] = []
        self.ended: list[tuple[int, Ended]] = []
        self._actions: np.ndarray | None = None
        self._no_infos: list[dict[str, Any]] = [{} for _ in range(len(worlds))]

    def start_recording(self) -> None:
        self.rewards, self.ended = [], []

    def reset(self) -> np.ndarray:
        return self.worlds.reset(self.seeds)

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observations, rewards, ended = self.worlds.step(self._actions)
        dones = np.zeros(self.num_envs, dtype=bool)
        infos = self._no_infos
        if ended:
            infos = list(self._no_infos)
            for end in ended:
                self.ended.append((len(self.rewards), end))
                dones[end.world] = True
                infos[end.world] = {
                    "terminal_observation": end.final_observation,
                    "TimeLimit.truncated": not end.terminated,
                }
        self.rewards.append(rewards)
        # SB3 adds the bootstrapped value of truncated steps to the array it is handed.
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        self.worlds.close()

    def get_attr(self, attr_name, indices=None):
        # SB3 asks for the render mode: nothing is drawn in training.
        return [None for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        raise AttributeError("training worlds may live in other processes")

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise AttributeError("training worlds may live in other processes")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False for _ in self._get_indices(indices)]


class _NormalisingExtractor(FlattenExtractor):
    """Observations as (s - mean) / std by running moments, clipped.

    The moments are buffers of the policy's network: saved with it, changed by :meth:`update` only.
    """

    def __init__(self, observation_space: gymnasium.Space):
        super().__init__(observation_space)
        self.register_buffer("mean", torch.zeros(self.features_dim, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(self.features_dim, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Normalised observations [B, D] float32."""
        std = (self.variance + 1e-8).sqrt().float()
        return ((observations - self.mean.float()) / std).clamp(-_CLIP, _CLIP)

    def update(self, observations: np.ndarray) -> None:
        """Merge the moments of ``observations`` [B, D]."""
        moments = _moments(self.mean.numpy(), self.variance.numpy(), float(self.count))
        moments.update(observations.astype(np.float64))
        self.mean.copy_(torch.as_tensor(moments.mean))
        self.variance.copy_(torch.as_tensor(moments.var))
        self.count.fill_(moments.count)


def _moments(mean: Any, variance: Any, count: float) -> RunningMeanStd:
    moments = RunningMeanStd()
    moments.mean, moments.var, moments.count = np.asarray(mean), np.asarray(variance), count
    return moments


class PPOTrainer:
    """SB3's PPO, one seeded round at a time.

    With ``normalise_observations`` the moments take in each rollout after the update on it, so
    that the policy updated is the one that acted; a clone keeps those of its demonstrations.
    With ``normalise_rewards`` PPO is paid the rewards over the running standard deviation of
    their discounted sums (SB3's VecNormalize). Rollouts hold raw observations and raw rewards
    either way.

    Args:
        worlds: the environments to learn in.
        ppo: hyper-parameters.
        total_steps: environment steps the schedules run over.
        seed: everything random in round r derives from (purpose, seed, r).
        purpose: the stage; stages of one seed share neither initial weights nor worlds.

    Raises:
        UsageError: gSDE or a standard deviation, where actions are discrete.
    """

    def __init__(self, worlds: Worlds, ppo: PPOSettings, total_steps: int, seed: int, purpose: str):
        torch.set_num_threads(1)
        self.ppo = ppo
        self.total_steps = total_steps
        self._seed = seed
        self._purpose = purpose
        if isinstance(worlds.action_space, gymnasium.spaces.Discrete):
            for name in ("use_sde", "log_std_init", "log_std_max"):
                value = getattr(ppo, name)
                if value is not UNSET and value is not False:
                    raise UsageError(
                        f"ppo.{name} needs continuous actions", f"leave ppo.{name} unset"
                    )
        self._venv = _RecordingVecEnv(worlds)
        self._cloned = False
        self._reward_moments = _moments(0.0, 1.0, 0.0)
        self._discounted = np.zeros(len(worlds))
        with warnings.catch_warnings():
            # A buffer that the batch size does not divide gives one short batch, as intended.
            warnings.filterwarnings("ignore", message=".*mini-batch size.*")
            self.model = PPO(
                "MlpPolicy",
                self._venv,
                n_steps=ppo.n_steps,
                batch_size=ppo.batch_size,
                n_epochs=ppo.n_epochs,
                learning_rate=_schedule(ppo.learning_rate, ppo.learning_rate_schedule),
                clip_range=_schedule(ppo.clip_range, ppo.clip_range_schedule),
                gamma=ppo.gamma,
                gae_lambda=ppo.gae_lambda,
                ent_coef=ppo.ent_coef,
                vf_coef=ppo.vf_coef,
                max_grad_norm=ppo.max_grad_norm,
                use_sde=bool(ppo.use_sde),
                sde_sample_freq=ppo.sde_sample_freq or -1,
                policy_kwargs=_policy_kwargs(ppo),
                seed=derive(purpose, seed, -1)[0],
                device="cpu",
            )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        # What ``learn`` does before its loop; the rounds here take the place of that loop.
        _, self._callback = self.model._setup_learn(total_steps)

    @property
    def steps(self) -> int:
        """Environment steps taken so far."""
        return self.model.num_timesteps

    @property
    def steps_per_round(self) -> int:
        """Environment steps of one round."""
        return _steps_per_round(self.ppo)

    @property
    def rounds(self) -> int:
        """Rounds that make up at least ``total_steps``."""
        return rounds(self.ppo, self.total_steps)

    @property
    def policy(self) -> Policy:
        """The current policy; it keeps learning with the trainer."""
        return Policy(self.model.policy)

    def train_round(self, index: int, reward: RewardFunction | None = None) -> list[Rollout]:
        """Run round ``index``; with ``reward``, on its [T, N] rewards instead of the true ones.

        ``reward`` sees one whole rollout at a time. A truncated step is bootstrapped here, on
        the value of its final observation; a terminated one is not.

        Raises:
            StageFailed: the policy's parameters stopped being finite, or a worker process died.
        """
        generator_seed, *world_seeds = derive(
            self._purpose, self._seed, index, 1 + self._venv.num_envs
        )
        torch.manual_seed(generator_seed)
        # SB3 shuffles its minibatches by numpy's global generator.
        np.random.seed(generator_seed % 2**32)
        self._venv.seeds = world_seeds
        self.model._last_obs = self._venv.reset()
        self.model._last_episode_starts = np.ones(self._venv.num_envs, dtype=bool)
        self._discounted[:] = 0.0
        rollouts = []
        for _ in range(self.ppo.rollouts_per_round):
            rollout = self._collect()
            if reward is not None or self.ppo.normalise_rewards:
                rewards = rollout.true_rewards if reward is None else reward(rollout)
                if self.ppo.normalise_rewards:
                    rewards = self._normalised(rewards, rollout)
                self._replace_rewards(rollout, rewards)
            remaining = max(0.0, 1.0 - self.model.num_timesteps / self.total_steps)
            self.model._current_progress_remaining = remaining
            if self.ppo.ent_coef_schedule == "linear":
                # SB3 schedules the learning rate and the clip range only.
                self.model.ent_coef = self.ppo.ent_coef * remaining
            self.model.train()
            self._cap_noise()
            if not all(bool(torch.isfinite(p).all()) for p in self.model.policy.parameters()):
                raise StageFailed(
                    f"the policy's parameters are not finite after an update in round {index}",
                    "a smaller learning rate or gradient norm usually helps",
                )
            if self.ppo.normalise_observations and not self._cloned:
                seen = rollout.observations
                self.model.policy.features_extractor.update(seen.reshape(-1, seen.shape[-1]))
            rollouts.append(rollout)
        return rollouts

    def clone(
        self,
        observations: np.ndarray,
        log_likelihood: Callable[[np.ndarray], torch.Tensor],
        epochs: int,
    ) -> None:
        """Fit the policy to demonstrations by maximum likelihood, before the first round.

        The moments of observations stay those of the demonstrations: others would make another
        policy of the one fitted, before it has learned to earn by them.

        Args:
            observations: of the demonstrations, [B, D].
            log_likelihood: log pi(a|s) [b] of the demonstrations with indices [b], with gradient.
            epochs: how often each demonstration is seen.
        """
        policy = self.model.policy
        self._cloned = True
        if self.ppo.normalise_observations:
            policy.features_extractor.update(observations)
        generator = torch.Generator().manual_seed(derive("cloning", self._seed, 0)[0])
        optimizer = torch.optim.Adam(policy.parameters(), lr=_CLONING_RATE)
        for _ in range(epochs):
            order = torch.randperm(len(observations), generator=generator)
            for rows in order.split(_CLONING_BATCH):
                loss = -log_likelihood(rows.numpy()).mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        self._cap_noise()

    def _cap_noise(self) -> None:
        if self.ppo.log_std_max is not UNSET:
            with torch.no_grad():
                self.model.policy.log_std.clamp_(max=self.ppo.log_std_max)

    def _normalised(self, rewards: np.ndarray, rollout: Rollout) -> np.ndarray:
        """``rewards`` [T, N] over the deviation of their discounted sums, this rollout's included."""
        ended = rollout.terminated | rollout.truncated
        sums = np.empty(rewards.shape)
        for t in range(len(rewards)):
            sums[t] = self._discounted = self.ppo.gamma * self._discounted + rewards[t]
            self._discounted = np.where(ended[t], 0.0, self._discounted)
        self._reward_moments.update(sums.ravel())
        return np.clip(rewards / np.sqrt(self._reward_moments.var + 1e-8), -_CLIP, _CLIP)

    def _collect(self) -> Rollout:
        model, buffer = self.model, self.model.rollout_buffer
        self._venv.start_recording()
        model.collect_rollouts(self._venv, self._callback, buffer, model.n_steps)
        shape = (model.n_steps, self._venv.num_envs)
        # SB3 flattens the buffer's arrays in place when it trains: these are copies.
        observations = buffer.observations.copy()
        next_observations = np.concatenate([observations[1:], model._last_obs[None]])
        terminated, truncated = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        lengths, returns = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        progress = np.full(shape, np.nan)
        for t, end in self._venv.ended:
            next_observations[t, end.world] = end.final_observation
            terminated[t, end.world] = end.terminated
            truncated[t, end.world] = not end.terminated
            lengths[t, end.world] = end.length
            returns[t, end.world] = end.episode_return
            progress[t, end.world] = end.progress
        actions = buffer.actions.copy()
        if isinstance(model.action_space, gymnasium.spaces.Discrete):
            actions = actions[..., 0].astype(np.int64)
        return Rollout(
            observations=observations,
            actions=actions,
            next_observations=next_observations,
            log_probs=buffer.log_probs.copy(),
            true_rewards=np.stack(self._venv.rewards),
            terminated=terminated,
            truncated=truncated,
            lengths=lengths,
            returns=returns,
            progress=progress,
            errors=tuple((end.world, end.error) for _, end in self._venv.ended if end.error),
        )

    def _replace_rewards(self, rollout: Rollout, rewards: np.ndarray) -> None:
        model, buffer = self.model, self.model.rollout_buffer
        rewards = np.array(rewards, dtype=np.float32)
        with torch.no_grad():
            if rollout.truncated.any():
                final = torch.as_tensor(rollout.next_observations[rollout.truncated])
                values = model.policy.predict_values(final)[:, 0].numpy()
                rewards[rollout.truncated] += model.gamma * values
            last_values = model.policy.predict_values(torch.as_tensor(model._last_obs))
        buffer.rewards[:] = rewards
        buffer.compute_returns_and_advantage(last_values, model._last_episode_starts)

    def state_dict(self) -> dict[str, Any]:
        """What a later process needs to go on from the end of the last round (tensors, numbers)."""
        moments = self._reward_moments
        return {
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
            "steps": self.model.num_timesteps,
            "reward_moments": [float(moments.mean), float(moments.var), float(moments.count)],
            "cloned": self._cloned,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict()`` of an equally configured trainer."""
        self.model.policy.load_state_dict(state["policy"])
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
        self.model.num_timesteps = int(state["steps"])
        # Older checkpoints have neither of these.
        self._reward_moments = _moments(*state.get("reward_moments", (0.0, 1.0, 0.0)))
        self._cloned = state.get("cloned", False)


def _steps_per_round(ppo: PPOSettings) -> int:
    return ppo.rollouts_per_round * ppo.n_steps * ppo.n_envs


def rounds(ppo: PPOSettings, total_steps: int) -> int:
    """Rounds that make up at least ``total_steps``."""
    return -(-total_steps // _steps_per_round(ppo))


class Policy:
    """A stochastic policy pi(a|s), as SB3's actor-critic network.

    Of one trained with gSDE this is the distribution of a single action: its noise is drawn
    anew at every step, while in training it is held for ``sde_sample_freq`` steps.
    """

    def __init__(self, network: ActorCriticPolicy):
        self.network = network

    def act(self, observations: np.ndarray, deterministic: bool = False) -> np.ndarray:
        """Actions [N] or [N, A] for observations [N, D]; samples by torch's global generator."""
        with torch.no_grad():
            distribution = self.network.get_distribution(torch.as_tensor(observations))
            actions = distribution.mode() if deterministic else distribution.distribution.sample()
            return actions.numpy()

    def log_prob(
        self, observations: torch.Tensor, actions: torch.Tensor, gradient: bool = False
    ) -> torch.Tensor:
        """log pi(a|s) [B] for observations [B, D] and actions [B] or [B, A]."""
        with torch.set_grad_enabled(gradient):
            return self.network.get_distribution(observations).log_prob(actions)

    def gaussian(
        self, observations: torch.Tensor, gradient: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and deviation [B, A] of pi(.|s) for observations [B, D]."""
        with torch.set_grad_enabled(gradient):
            distribution = self.network.get_distribution(observations).distribution
            return distribution.mean, distribution.stddev

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The network's tensors."""
        return self.network.state_dict()

    @staticmethod
    def describe(env: str, ppo: PPOSettings) -> PolicyNetwork:
        """What, with the tensors, is enough to rebuild the policy (``load_policy``)."""
        return PolicyNetwork(
            algorithm="ppo",
            env=env,
            net_arch=ppo.net_arch,
            activation=ppo.activation,
            ortho_init=ppo.ortho_init,
            normalise_observations=bool(ppo.normalise_observations),
            use_sde=bool(ppo.use_sde),
        )


def load_policy(
    network_: PolicyNetwork, state: dict[str, torch.Tensor], setting: Setting
) -> Policy:
    """The policy that ``Policy.describe`` and ``Policy.state_dict`` wrote down.

    ``setting`` is one that it was trained in: a goal, for one, adds to the observation.

    Raises:
        RuntimeError: the description and the tensors do not fit each other.
    """
    torch.set_num_threads(1)
    world = envs.make(network_.env, setting)
    network = ActorCriticPolicy(
        world.observation_space,
        world.action_space,
        lambda _: 0.0,
        net_arch=list(network_.net_arch),
        activation_fn=ACTIVATIONS[network_.activation],
        ortho_init=network_.ortho_init,
        features_extractor_class=_extractor(network_.normalise_observations),
        use_sde=network_.use_sde,
    )
    world.close()
    network.load_state_dict(state)
    network.set_training_mode(False)
    return Policy(network)


def _extractor(normalising: bool) -> type[FlattenExtractor]:
    return _NormalisingExtractor if normalising else FlattenExtractor


def make_worlds(env: str, settings: Sequence[Setting], count: int, workers: int = 1) -> Worlds:
    """``count`` worlds in equal shares of each setting, as :func:`world_groups` says.

    More than one worker (and at most one per world) steps them in as many processes, to the
    same results.
    """
    groups = world_groups(count, len(settings))
    factories = [partial(envs.make, env, settings[group]) for group in groups]
    limit = environment(env).max_episode_steps
    if min(workers, count) > 1:
        return WorkerWorlds(factories, limit, min(workers, count))
    return VectorWorlds([factory() for factory in factories], limit)


def world_groups(count: int, settings: int) -> np.ndarray:
    """Index [count] of the setting of each world: equal shares, setting-major."""
    return np.arange(count) * settings // count


def roll_out(
    env: str,
    setting: Setting,
    policy: Policy | str,
    episodes: int,
    seed: int,
    purpose: str,
    deterministic: bool = False,
    parallel: int = 16,
) -> list[Trajectory]:
    """``episodes`` whole episodes of ``policy`` (or ``"random"``, ``"idle"``) in one setting.

    Episode k starts from a state of its own, derived from (purpose, seed, k). The actions of
    the ``parallel`` episodes that run together come from one generator.

    Raises:
        UsageError: the setting's observations are not those the policy was trained on.
    """
    torch.set_num_threads(1)
    limit = environment(env).max_episode_steps
    trajectories: list[Trajectory] = []
    for first in range(0, episodes, parallel):
        batch = range(first, min(first + parallel, episodes))
        seeds = [derive(purpose, seed, k)[0] for k in batch]
        torch.manual_seed(seeds[0])
        rng = np.random.default_rng(seeds[0])
        worlds = [envs.make(env, setting) for _ in batch]
        if isinstance(policy, Policy):
            require_observations(policy, worlds[0].observation_space, f"{env} {setting}")
        trajectories += _run_batch(worlds, policy, seeds, limit, deterministic, rng)
        for world in worlds:
            world.close()
    return trajectories


def require_observations(policy: Policy, space: gymnasium.Space, where: str) -> None:
    """Check that ``policy`` takes the observations of ``space``, those of ``where``.

    Raises:
        UsageError: it takes others.
    """
    size = policy.network.observation_space.shape[0]
    if space.shape[0] != size:
        raise UsageError(
            f"the policy takes observations of size {size}, those of {where} have size "
            f"{space.shape[0]}",
            "a goal (goal-y, direction) is part of the observation: name a setting with the same "
            "kind of intervention as in training",
        )


def _run_batch(worlds, policy, seeds, limit, deterministic, rng) -> list[Trajectory]:
    observations = [[w.reset(seed=s)[0]] for w, s in zip(worlds, seeds, strict=True)]
    actions: list[list[Any]] = [[] for _ in worlds]
    rewards: list[list[float]] = [[] for _ in worlds]
    progress = [math.nan for _ in worlds]
    errors: list[str | None] = [None for _ in worlds]
    ends = [(False, False)] * len(worlds)
    active = list(range(len(worlds)))
    space = worlds[0].action_space
    while active:
        current = np.stack([observations[i][-1] for i in active])
        if isinstance(policy, Policy):
            chosen = policy.act(current, deterministic)
        elif policy == "random":
            chosen = _random_actions(space, len(active), rng)
        else:
            chosen = _idle_actions(space, len(active))
        still = []
        for i, action in zip(active, chosen, strict=True):
            observation, reward, terminated, truncated, info = worlds[i].step(action)
            if "progress" in info:
                progress[i] = (progress[i] if rewards[i] else 0.0) + info["progress"]
            errors[i] = info.get("error")
            observations[i].append(np.asarray(observation, dtype=np.float32))
            actions[i].append(action)
            rewards[i].append(float(reward))
            truncated = truncated or len(rewards[i]) >= limit
            ends[i] = (bool(terminated), bool(truncated and not terminated))
            if not (terminated or truncated):
                still.append(i)
        active = still
    return [
        Trajectory(
            observations=np.stack(observations[i]),
            actions=np.asarray(actions[i], dtype=_action_dtype(space)),
            rewards=np.asarray(rewards[i], dtype=np.float64),
            terminated=ends[i][0],
            truncated=ends[i][1],
            seed=seeds[i],
            progress=progress[i],
            error=errors[i],
        )
        for i in range(len(worlds))
    ]


def _action_dtype(space: gymnasium.Space) -> type:
    return np.int64 if isinstance(space, gymnasium.spaces.Discrete) else np.float32


def _random_actions(space: gymnasium.Space, count: int, rng: np.random.Generator) -> np.ndarray:
    if isinstance(space, gymnasium.spaces.Discrete):
        return rng.integers(space.n, size=count)
    return rng.uniform(space.low, space.high, size=(count, *space.shape)).astype(np.float32)


def _idle_actions(space: gymnasium.Space, count: int) -> np.ndarray:
    if isinstance(space, gymnasium.spaces.Discrete):
        return np.zeros(count, dtype=np.int64)
    return np.zeros((count, *space.shape), dtype=np.float32)


def _policy_kwargs(ppo: PPOSettings) -> dict[str, Any]:
    return {
        "net_arch": list(ppo.net_arch),
        "activation_fn": ACTIVATIONS[ppo.activation],
        "ortho_init": ppo.ortho_init,
        "log_std_init": ppo.log_std_init or 0.0,
        "features_extractor_class": _extractor(bool(ppo.normalise_observations)),
        # One kernel for all parameters: the optimiser's step is most of a small network's update.
        "optimizer_kwargs": {"fused": True},
    }


def _schedule(value: float, kind: str) -> float | LinearSchedule:
    return LinearSchedule(value, 0.0, 1.0) if kind == "linear" else value
