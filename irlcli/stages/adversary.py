"""The learning opponent of train-airl: rollouts and demonstrations in, rewards out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import torch
from msgspec import UNSET

from irlcli import checkpoints, descriptions
from irlcli.dataset import Demonstrations
from irlcli.envs.vector import VectorWorlds
from irlcli.errors import IntegrityError, StageFailed
from irlcli.interventions import environment
from irlcli.irl import airl
from irlcli.irl.networks import RewardModel
from irlcli.rl import Policy, PPOTrainer, Rollout, world_groups
from irlcli.seeds import derive
from irlcli.settings import PENALISED, AIRLSettings
from irlcli.stages.actions import SeenActions
from irlcli.stages.outputs import write_json
from irlcli.trajectories import Trajectory, Transitions, join, transitions


class Adversary:
    """Discriminator, its optimiser and the demonstrations.

    ERM pools every setting's transitions into one group (by count, as they come); ERM-balanced
    and IRM keep one group per setting, each of equal weight. IRM-shuffled, the control, has as
    many groups, but of episodes and worlds dealt out at random.

    Args:
        demos: demonstrations; their settings are the groups.
        config: AIRL settings.
        worlds: where the policy acts; equal shares of each setting, setting-major.
        seed: initialisation and every minibatch derive from it.

    Raises:
        IntegrityError: the demonstrations' observations are not the environment's.
        UsageError: ``airl.actions`` that the environment does not have.
    """

    def __init__(
        self, demos: Demonstrations, config: AIRLSettings, worlds: VectorWorlds, seed: int
    ):
        self.config = config
        self._horizon = environment(demos.env).max_episode_steps
        self._seed = seed
        self.actions = SeenActions(config, worlds.action_space)
        groups = list(demos.trajectories.values())
        self._world_settings = world_groups(len(worlds), len(groups))
        self._world_groups = self._world_settings
        self._expert_settings = [self._transitions(group) for group in groups]
        self._expert = self._expert_settings
        if config.method == "irm-shuffled":
            rng = np.random.default_rng(derive("shuffled settings", seed, 0)[0])
            of_episodes = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
            episodes = [trajectory for group in groups for trajectory in group]
            dealt = deal(of_episodes, rng)
            self._expert = [
                self._transitions([episodes[i] for i in np.flatnonzero(dealt == e)])
                for e in range(len(groups))
            ]
            self._world_groups = deal(self._world_settings, rng)
        size = worlds.observation_space.shape[0]
        if self._expert[0].observations.shape[1] != size:
            raise IntegrityError(
                f"the demonstrations have observations of size "
                f"{self._expert[0].observations.shape[1]}, {demos.env} has {size}"
            )
        discrete = isinstance(worlds.action_space, gymnasium.spaces.Discrete)
        self._network = descriptions.RewardNetwork(
            observation_size=size,
            action_size=int(worlds.action_space.n) if discrete else worlds.action_space.shape[0],
            discrete=discrete,
            state_only=config.state_only,
            hidden=config.hidden,
            activation=config.activation,
            gamma=config.ppo.gamma,
        )
        torch.manual_seed(derive("discriminator", seed, -1)[0])
        self.model = RewardModel(**msgspec.to_builtins(self._network))
        self._optimizer = torch.optim.Adam(
            self.model.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._scale = 1.0
        self._past: list[Transitions] = []
        for data in self._expert:
            self.model.normaliser.update(torch.as_tensor(data.observations))

    def _transitions(self, episodes: Sequence[Trajectory]) -> Transitions:
        return self.actions.of(transitions(episodes, self._horizon))

    def reward(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rewards [T, N] of ``policy`` for its rollout, by the present discriminator."""
        data = self.actions.of(rollout_transitions(rollout, slice(None), self._horizon))
        log_probs = torch.as_tensor(rollout.log_probs.ravel())
        if self.actions.clipped:
            log_probs = self.actions.log_prob(policy, data)
        reward = airl.policy_reward(
            self.model,
            data,
            log_probs,
            self.config.policy_reward,
            self.config.fixed_horizon,
            self.config.ppo.gamma,
        )
        return reward.numpy().reshape(rollout.terminated.shape)

    def clone_experts(self, trainer: PPOTrainer) -> None:
        """Let the student of ``trainer`` begin as a clone of all experts, if that is asked for.

        Every method's begins alike: each demonstrated step counts the same.
        """
        if self.config.bc_epochs is UNSET:
            return
        data = join(self._expert_settings)

        def log_likelihood(rows: np.ndarray) -> torch.Tensor:
            return self.actions.log_prob(trainer.policy, data.take(rows), gradient=True)

        trainer.clone(data.observations, log_likelihood, self.config.bc_epochs)

    def train_round(
        self, index: int, rollouts: Sequence[Rollout], policy: Policy
    ) -> list[dict[str, float]]:
        """One discriminator round on this round's rollouts; diagnostics per setting.

        Raises:
            StageFailed: the discriminator's parameters stopped being finite.
        """
        config = self.config
        data = self._by_group(rollouts, self._world_groups)
        self.model.normaliser.update(
            torch.as_tensor(np.concatenate([d.observations for d in data]))
        )
        policy_pools = [self._pool(d, policy) for d in data]
        expert_pools = [self._pool(d, policy) for d in self._expert]
        past_pools = [self._pool(d, policy) for d in self._past]
        groups = self._grouped(policy_pools, expert_pools, past_pools)
        weight = 0.0
        if config.method in PENALISED:
            weight = airl.penalty_weight_at(
                index,
                config.penalty_weight,
                config.penalty_warmup_rounds,
                config.penalty_ramp_rounds,
            )
        # Every method sees as many samples per update.
        size = config.batch_size * len(expert_pools) // len(groups[0])
        generator = torch.Generator().manual_seed(derive("discriminator", self._seed, index)[0])
        for _ in range(config.updates_per_round):
            batch = airl.sample_minibatch(
                groups[0], groups[1], size, generator, groups[2], config.replay_share
            )
            losses = self._losses(batch, weight)
            self._optimizer.zero_grad()
            losses.total.backward()
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.max_grad_norm)
            self._optimizer.step()
        if not all(bool(torch.isfinite(p).all()) for p in self.model.parameters()):
            raise StageFailed(
                f"the discriminator's parameters are not finite after round {index}",
                "a smaller airl.learning_rate or airl.penalty_weight usually helps",
            )
        self._remember(data, index)
        self._scale = airl.reward_scale(self.model, [*policy_pools, *expert_pools])
        # Per setting whatever the method pools or shuffles, so that methods can be compared.
        if config.method == "irm-shuffled":
            true = self._by_group(rollouts, self._world_settings)
            policy_pools = [self._pool(d, policy) for d in true]
            expert_pools = [self._pool(d, policy) for d in self._expert_settings]
        with torch.no_grad():
            batch = airl.sample_minibatch(policy_pools, expert_pools, 1024, generator)
            return _diagnostics(self._losses(batch, weight), weight)

    def _by_group(self, rollouts: Sequence[Rollout], groups: np.ndarray) -> list[Transitions]:
        """A round's transitions per group; ``groups`` [N] says to which each world belongs.

        Episodes that the round's end may have cut are left out whole. The rest are whole and
        an unbiased sample of the policy's (Wald: which ones depends on when they start only).
        """
        ended = np.concatenate([r.terminated | r.truncated for r in rollouts])
        whole = np.split(starts_by(ended, len(ended) - self._horizon), len(rollouts))
        parts = []
        for group in range(len(self._expert)):
            worlds = groups == group
            parts.append(
                [
                    rollout_transitions(r, worlds, self._horizon).take(kept[:, worlds].ravel())
                    for r, kept in zip(rollouts, whole, strict=True)
                ]
            )
        return [self.actions.of(join(part)) for part in parts]

    def _pool(self, data: Transitions, policy: Policy) -> airl.Pool:
        log_probs = self.actions.log_prob(policy, data)
        return airl.make_pool(self.model, data, log_probs, self.config.fixed_horizon)

    def _grouped(
        self, policy: list[airl.Pool], expert: list[airl.Pool], past: list[airl.Pool]
    ) -> tuple[list[airl.Pool], list[airl.Pool], list[airl.Pool]]:
        """Policy, expert and past pools of each group that has a loss of its own."""

        def pooled(pools: list[airl.Pool], copies: int) -> list[airl.Pool]:
            return [airl.join_pools(pools)] * copies if pools else []

        if self.config.method == "erm":
            return pooled(policy, 1), pooled(expert, 1), pooled(past, 1)
        if self.config.pairing == "pooled":
            return pooled(policy, len(expert)), expert, pooled(past, len(expert))
        return policy, expert, past

    def _remember(self, data: Sequence[Transitions], index: int) -> None:
        """Keep a uniform sample of this round; thin the past where it outgrows its capacity."""
        rng = np.random.default_rng(derive("replay", self._seed, index)[0])
        config = self.config
        if config.replay_share == 0.0:
            return
        kept = [
            d.take(rng.choice(len(d), min(config.replay_per_round, len(d)), replace=False))
            for d in data
        ]
        if self._past:
            kept = [join(pair) for pair in zip(self._past, kept, strict=True)]
        self._past = [
            d
            if len(d) <= config.replay_capacity
            else d.take(np.sort(rng.choice(len(d), config.replay_capacity, replace=False)))
            for d in kept
        ]

    def _losses(self, batch: airl.Minibatch, weight: float) -> airl.Losses:
        logit, f = airl.logits(self.model, batch)
        unbiased = self.config.penalty_estimate == "unbiased"
        return airl.discriminator_losses(logit, f, weight, self.config.penalty_scaling, unbiased)

    def state_dict(self) -> dict[str, Any]:
        """What a later process needs to go on from the end of the last round."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "scale": self._scale,
            "past": [
                {f.name: torch.as_tensor(getattr(d, f.name)) for f in fields(Transitions)}
                for d in self._past
            ],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict()`` of an equally configured adversary."""
        self.model.load_state_dict(state["model"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._scale = state["scale"]
        self._past = [
            Transitions(**{name: tensor.numpy() for name, tensor in d.items()})
            for d in state["past"]
        ]

    def reward_state(self) -> dict[str, Any]:
        """A copy of the reward as it is now."""
        tensors = self.model.state_dict().items()
        return {"model": {name: t.clone() for name, t in tensors}, "scale": self._scale}

    def load_reward_state(self, state: Mapping[str, Any]) -> None:
        """Go back to the reward of ``reward_state()``."""
        self.model.load_state_dict(state["model"])
        self._scale = state["scale"]

    def write_reward(self, directory: Path, **origin: Any) -> None:
        """Write ``reward.pt`` and, for readers without torch, ``reward.json``.

        ``origin`` are the fields of ``descriptions.Reward`` besides the network and the scale.
        """
        description = descriptions.Reward(network=self._network, scale=self._scale, **origin)
        checkpoints.save(directory / "reward.pt", "reward", description, self.model.state_dict())
        write_json(directory / "reward.json", msgspec.to_builtins(description))


def deal(settings: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Groups [N] instead of ``settings`` [N], as many, each with an equal share of every setting.

    Which member of a setting goes to which group is random; no group stays empty.
    """
    groups = np.empty_like(settings)
    count = settings.max() + 1
    for setting in range(count):
        members = rng.permutation(np.flatnonzero(settings == setting))
        groups[members] = (setting + np.arange(len(members))) % count
    return groups


def starts_by(ended: np.ndarray, latest: int) -> np.ndarray:
    """Steps [T, N] bool whose episode starts at step ``latest`` or before; the first always does.

    ``ended`` [T, N] marks the last step of each episode; every world starts one at step 0.
    """
    starts = np.zeros(ended.shape, dtype=np.int64)
    starts[1:] = np.where(ended[:-1], np.arange(1, len(ended))[:, None], 0)
    return np.maximum.accumulate(starts) <= max(latest, 0)


def rollout_transitions(rollout: Rollout, worlds: np.ndarray | slice, horizon: int) -> Transitions:
    """The transitions [T * n] of some of a rollout's worlds, time-major."""

    def flat(array: np.ndarray) -> np.ndarray:
        chosen = array[:, worlds]
        return chosen.reshape(-1, *chosen.shape[2:])

    terminated = flat(rollout.terminated)
    return Transitions(
        observations=flat(rollout.observations),
        actions=flat(rollout.actions),
        next_observations=flat(rollout.next_observations),
        terminated=terminated,
        remaining=np.where(terminated, horizon - flat(rollout.lengths), 0),
    )


def _diagnostics(losses: airl.Losses, weight: float) -> list[dict[str, float]]:
    return [
        {
            "cross_entropy": float(losses.cross_entropy[e]),
            "accuracy": float(losses.accuracy[e]),
            "mean_abs_logit": float(losses.mean_abs_logit[e]),
            "penalty": float(losses.penalty[e]),
            "penalty_weight": weight,
        }
        for e in range(len(losses.penalty))
    ]
