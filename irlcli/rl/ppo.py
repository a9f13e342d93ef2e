"""PPO (Schulman et al. 2017), as stable-baselines3 implements it, trained in seeded rounds.

What a config does not set is as in stable-baselines3, except for Adam's eps, see
:class:`irlcli.configs.PPOConfig`.

A round seeds every generator from (purpose, seed, round), starts fresh episodes, collects one or
more rollouts and updates on each. Only the network, its optimiser, running moments and a step
count outlive a round. So a run resumed from any round's checkpoint equals an uninterrupted one
byte for byte on the same machine.
"""

from __future__ import annotations

import warnings
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from msgspec import UNSET
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import LinearSchedule

from irlcli.configs import PPOConfig
from irlcli.configs.schema import ADAM_EPS
from irlcli.errors import StageFailed
from irlcli.networks import ACTIVATIONS, all_finite
from irlcli.rl.policy import NormalisingExtractor, Policy, extractor
from irlcli.rl.reward_normaliser import RunningDeviation
from irlcli.rl.worlds import RecordingVecEnv, Worlds
from irlcli.seeds import derive
from irlcli.trajectories import Rollout


class RewardSource(Protocol):
    """Where the rewards of a policy in training come from."""

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rewards [T, N] of ``policy`` for its own ``rollout``."""


class TrueReward:
    """The environment's own reward: what experts are trained on."""

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rollout's true rewards [T, N]."""
        return rollout.true_rewards


class PPOTrainer:
    """SB3's PPO, one seeded round at a time.

    With ``normalise_observations`` the moments take in each rollout after the update on it, so
    that the policy that is updated is the one that acted. With ``normalise_rewards`` the rewards
    are divided by the running standard deviation of their discounted sums (SB3's VecNormalize).
    Rollouts hold raw observations and raw rewards in either case.

    Args:
        worlds: the environments to learn in.
        ppo: hyperparameters.
        total_steps: environment steps over which the schedules run.
        seed: everything random in round r derives from (purpose, seed, r).
        purpose: the stage. Stages of one seed share neither initial weights nor episodes.
        keep_moments: leave the observations' moments as they are, as for a cloned policy: other
            moments would turn the fitted policy into another one.
    """

    def __init__(
        self,
        worlds: Worlds,
        ppo: PPOConfig,
        total_steps: int,
        seed: int,
        purpose: str,
        keep_moments: bool = False,
    ):
        torch.set_num_threads(1)
        self.ppo = ppo
        self.total_steps = total_steps
        self.steps_per_round, self.rounds = ppo.steps_per_round, ppo.rounds(total_steps)
        self._seed = seed
        self._purpose = purpose
        self._keep_moments = keep_moments
        self._venv = RecordingVecEnv(worlds)
        self._deviation = RunningDeviation(ppo.gamma, len(worlds))
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
                use_sde=ppo.use_sde,
                sde_sample_freq=ppo.sde_sample_freq or -1,
                policy_kwargs=_policy_kwargs(ppo),
                seed=derive(purpose, seed, -1)[0],
                device="cpu",
            )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        # What ``learn`` does before its loop; the rounds here replace that loop.
        _, self._callback = self.model._setup_learn(total_steps)

    @property
    def steps(self) -> int:
        """Environment steps taken so far."""
        return self.model.num_timesteps

    @property
    def policy(self) -> Policy:
        """The current policy; it keeps learning with the trainer."""
        return Policy(self.model.policy)

    def train_round(self, index: int, source: RewardSource) -> list[Rollout]:
        """Run round ``index`` on the rewards of ``source``.

        The source sees one whole rollout at a time. A truncated step is bootstrapped here with the
        value of its final observation; a terminated one is not.

        Raises:
            StageFailed: the policy's parameters stopped being finite, or a worker process died.
        """
        self.model._last_obs = self._venv.begin_round(self._purpose, self._seed, index)
        self.model._last_episode_starts = np.ones(self._venv.num_envs, dtype=bool)
        self._deviation.begin()
        self.cap_noise()
        rollouts = []
        for _ in range(self.ppo.rollouts_per_round):
            rollout = self._collect()
            self._set_rewards(rollout, source.rewards(rollout, self.policy))
            remaining = max(0.0, 1.0 - self.model.num_timesteps / self.total_steps)
            self.model._current_progress_remaining = remaining
            if self.ppo.ent_coef_schedule == "linear":
                # SB3 schedules the learning rate and the clip range only.
                self.model.ent_coef = self.ppo.ent_coef * remaining
            self.model.train()
            self.cap_noise()
            if not all_finite(self.model.policy):
                raise StageFailed(
                    f"the policy's parameters are not finite after an update in round {index}",
                    "a smaller learning rate or gradient norm usually helps",
                )
            if not self._keep_moments:
                self.observe(rollout.observations.reshape(-1, rollout.observations.shape[-1]))
            rollouts.append(rollout)
        return rollouts

    def observe(self, observations: np.ndarray) -> None:
        """Merge ``observations`` [B, D] into the policy's moments, if it normalises by them."""
        if self.ppo.normalise_observations:
            extractor = self.model.policy.features_extractor
            assert isinstance(extractor, NormalisingExtractor)
            extractor.normaliser.update(torch.as_tensor(observations))

    def cap_noise(self) -> None:
        """Keep the policy's log standard deviation at or below ``ppo.log_std_max``."""
        if self.ppo.log_std_max is not None:
            with torch.no_grad():
                self.model.policy.log_std.clamp_(max=self.ppo.log_std_max)

    def _collect(self) -> Rollout:
        model, buffer = self.model, self.model.rollout_buffer
        self._venv.start_recording()
        model.collect_rollouts(self._venv, self._callback, buffer, model.n_steps)
        # SB3 flattens the buffer's arrays in place when it trains: these are copies.
        actions = buffer.actions.copy()
        if isinstance(model.action_space, gymnasium.spaces.Discrete):
            actions = actions[..., 0].astype(np.int64)
        elif isinstance(model.action_space, gymnasium.spaces.MultiDiscrete):
            actions = actions.astype(np.int64)
        return self._venv.rollout(
            buffer.observations.copy(), actions, buffer.log_probs.copy(), self._last_observations
        )

    @property
    def _last_observations(self) -> np.ndarray:
        """[N, D], where SB3's next rollout begins."""
        return np.asarray(self.model._last_obs)

    def _set_rewards(self, rollout: Rollout, rewards: np.ndarray) -> None:
        """Let SB3's buffer hold ``rewards`` [T, N] and the advantages that follow from them."""
        if rewards is rollout.true_rewards and not self.ppo.normalise_rewards:
            # The buffer holds them since the rollout was collected.
            return
        if self.ppo.normalise_rewards:
            self._deviation.update(rewards, rollout.terminated | rollout.truncated)
            rewards = self._deviation.normalise(rewards)
        model, buffer = self.model, self.model.rollout_buffer
        rewards = np.array(rewards, dtype=np.float32)
        with torch.no_grad():
            if rollout.truncated.any():
                final = torch.as_tensor(rollout.next_observations[rollout.truncated])
                values = model.policy.predict_values(final)[:, 0].numpy()
                rewards[rollout.truncated] += model.gamma * values
            last_values = model.policy.predict_values(torch.as_tensor(self._last_observations))
        buffer.rewards[:] = rewards
        starts = np.asarray(model._last_episode_starts)
        buffer.compute_returns_and_advantage(last_values, starts)

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs from the end of the last round (tensors, numbers)."""
        return {
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
            "steps": self.model.num_timesteps,
            "reward_moments": self._deviation.state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict()`` of an equally configured trainer."""
        self.model.policy.load_state_dict(state["policy"])
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
        self.model.num_timesteps = int(state["steps"])
        self._deviation.load_state(state["reward_moments"])


def _policy_kwargs(ppo: PPOConfig) -> dict[str, Any]:
    return {
        "net_arch": list(ppo.net_arch),
        "activation_fn": ACTIVATIONS[ppo.activation],
        "ortho_init": ppo.ortho_init,
        "log_std_init": ppo.log_std_init,
        "features_extractor_class": extractor(ppo.normalise_observations),
        # Fused is one kernel for all parameters: the optimiser's step is most of a small network's
        # update.
        "optimizer_kwargs": {
            "fused": True,
            "eps": ADAM_EPS if ppo.adam_eps is UNSET else ppo.adam_eps,
        },
    }


def _schedule(value: float, kind: str) -> float | LinearSchedule:
    return LinearSchedule(value, 0.0, 1.0) if kind == "linear" else value
