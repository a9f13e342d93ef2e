"""SAC (Haarnoja et al. 2018), as stable-baselines3 implements it, trained in seeded rounds.

Rounds are seeded as in :mod:`irlcli.rl.ppo`, and the replay buffer is part of a checkpoint: a run
resumed from any round's end equals an uninterrupted one byte for byte on the same machine.

Rewards are computed once, when a transition is collected: the source must be a fixed function, as a
frozen reward is. The buffer keeps them raw and divides by the running deviation of their discounted
sums when it samples. So all transitions are in one unit at any time, however small the rewards of
the first, random episodes were.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger

from irlcli.configs import SACConfig
from irlcli.errors import StageFailed
from irlcli.networks import ACTIVATIONS, all_finite
from irlcli.rl.policy import NormalisingExtractor, Policy, SquashedPolicy, extractor
from irlcli.rl.ppo import RewardSource
from irlcli.rl.reward_normaliser import RunningDeviation
from irlcli.rl.worlds import RecordingVecEnv, Worlds
from irlcli.seeds import derive
from irlcli.trajectories import Rollout

_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class _Replay(ReplayBuffer):
    """SB3's buffer of raw rewards, sampled in units of ``deviation`` unless that is None."""

    deviation: RunningDeviation | None = None

    def _normalize_reward(self, reward: np.ndarray, env: Any = None) -> np.ndarray:  # type: ignore[override]
        if self.deviation is None:
            return reward
        return self.deviation.normalise(reward).astype(np.float32)

    def state_dict(self) -> dict[str, Any]:
        """The part that is filled."""
        rows = self.buffer_size if self.full else self.pos
        arrays = {name: torch.as_tensor(getattr(self, name)[:rows].copy()) for name in _ARRAYS}
        return {**arrays, "pos": self.pos, "full": self.full}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict()`` of a buffer of equal size."""
        self.pos, self.full = int(state["pos"]), bool(state["full"])
        rows = self.buffer_size if self.full else self.pos
        for name in _ARRAYS:
            getattr(self, name)[:rows] = state[name].numpy()


class SACTrainer:
    """SB3's SAC, one seeded round at a time.

    After every ``train_freq`` steps of each world come ``gradient_steps`` updates, once more than
    ``learning_starts`` steps are done. With ``normalise_observations`` the moments of all networks take
    in the steps before the updates.

    Args:
        worlds: the environments to learn in, with continuous actions.
        sac: hyperparameters.
        total_steps: environment steps of the run.
        seed: everything random in round r derives from (purpose, seed, r).
        purpose: the stage. Stages of one seed share neither initial weights nor episodes.
    """

    def __init__(self, worlds: Worlds, sac: SACConfig, total_steps: int, seed: int, purpose: str):
        torch.set_num_threads(1)
        self.sac = sac
        self.steps_per_round, self.rounds = sac.steps_per_round, sac.rounds(total_steps)
        self.steps = 0
        self._seed = seed
        self._purpose = purpose
        self._venv = RecordingVecEnv(worlds)
        self._observations: Any = None
        self._deviation = RunningDeviation(sac.gamma, len(worlds))
        self.model = SAC(
            "MlpPolicy",
            self._venv,
            learning_rate=sac.learning_rate,
            buffer_size=sac.buffer_size,
            batch_size=sac.batch_size,
            tau=sac.tau,
            gamma=sac.gamma,
            ent_coef="auto" if sac.ent_coef is None else sac.ent_coef,
            replay_buffer_class=_Replay,
            policy_kwargs={
                "net_arch": list(sac.net_arch),
                "activation_fn": ACTIVATIONS[sac.activation],
                "features_extractor_class": extractor(sac.normalise_observations),
                # One kernel for all parameters, as for PPO.
                "optimizer_kwargs": {"fused": True},
            },
            seed=derive(purpose, seed, -1)[0],
            device="cpu",
        )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        assert isinstance(self.model.replay_buffer, _Replay)
        self._replay = self.model.replay_buffer
        if sac.normalise_rewards:
            self._replay.deviation = self._deviation

    @property
    def policy(self) -> Policy:
        """The current policy; it keeps learning with the trainer."""
        return SquashedPolicy(self.model.actor)

    def train_round(self, index: int, source: RewardSource) -> list[Rollout]:
        """Run round ``index`` on the rewards of ``source``; a rollout for every ``train_freq`` steps.

        A truncated step is bootstrapped with the value of its final observation; a terminated one
        is not.

        Raises:
            StageFailed: the networks' parameters stopped being finite, or a worker process died.
        """
        self._observations = self._venv.begin_round(self._purpose, self._seed, index)
        self._deviation.begin()
        rollouts = []
        for first in range(0, self.sac.n_steps, self.sac.train_freq):
            rollout = self._collect(min(self.sac.train_freq, self.sac.n_steps - first))
            self._store(rollout, source.rewards(rollout, self.policy))
            self._observe(rollout.observations.reshape(-1, rollout.observations.shape[-1]))
            if self.steps > self.sac.learning_starts:
                self.model.train(self.sac.gradient_steps, self.sac.batch_size)
                if not all_finite(self.model.policy):
                    raise StageFailed(
                        f"the networks' parameters are not finite after an update in round {index}",
                        "a smaller learning rate usually helps",
                    )
            rollouts.append(rollout)
        return rollouts

    def _collect(self, count: int) -> Rollout:
        """``count`` steps of every world: random ones until ``learning_starts``."""
        random = self.steps < self.sac.learning_starts
        policy, space = self.policy, self.model.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        observations, actions = [], []
        self._venv.start_recording()
        for _ in range(count):
            if random:
                shape = (self._venv.num_envs, *space.shape)
                chosen = np.random.uniform(space.low, space.high, shape).astype(np.float32)
            else:
                chosen = policy.act(self._observations)
            observations.append(self._observations)
            actions.append(chosen)
            self._observations = self._venv.step(chosen)[0]
            self.steps += self._venv.num_envs
        taken = np.stack(actions)
        log_probs = np.full(taken.shape[:2], np.nan, np.float32)
        return self._venv.rollout(np.stack(observations), taken, log_probs, self._observations)

    def _store(self, rollout: Rollout, rewards: np.ndarray) -> None:
        """Put the transitions of ``rollout``, with ``rewards`` [T, N], into the replay buffer."""
        ended = rollout.terminated | rollout.truncated
        self._deviation.update(rewards, ended)
        for t in range(len(rewards)):
            self._replay.add(
                rollout.observations[t],
                rollout.next_observations[t],
                self.model.policy.scale_action(rollout.actions[t]),
                rewards[t],
                ended[t],
                [{"TimeLimit.truncated": cut} for cut in rollout.truncated[t]],
            )

    def _observe(self, observations: np.ndarray) -> None:
        """Merge ``observations`` [B, D] into the moments of the actor and both critics."""
        if self.sac.normalise_observations:
            batch = torch.as_tensor(observations)
            for network in (self.model.actor, self.model.critic, self.model.critic_target):
                assert isinstance(network.features_extractor, NormalisingExtractor)
                network.features_extractor.normaliser.update(batch)

    @property
    def _optimizers(self) -> dict[str, Any]:
        found = {
            "actor": self.model.actor.optimizer,
            "critic": self.model.critic.optimizer,
            "temperature": self.model.ent_coef_optimizer,
        }
        return {name: optimizer for name, optimizer in found.items() if optimizer is not None}

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs from the end of the last round (tensors, numbers)."""
        temperature = self.model.log_ent_coef
        return {
            "policy": self.model.policy.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self._optimizers.items()},
            "temperature": None if temperature is None else temperature.detach().clone(),
            "replay": self._replay.state_dict(),
            "steps": self.steps,
            "reward_moments": self._deviation.state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict()`` of an equally configured trainer."""
        self.model.policy.load_state_dict(state["policy"])
        for name, optimizer in self._optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        if self.model.log_ent_coef is not None:
            with torch.no_grad():
                self.model.log_ent_coef.copy_(state["temperature"])
        self._replay.load_state_dict(state["replay"])
        self.steps = int(state["steps"])
        self._deviation.load_state(state["reward_moments"])
