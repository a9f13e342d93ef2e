"""Adversarial IRL with an invariance penalty (paper Algorithm 1; Fu et al. 2017).

Algorithm 1, as this module reads from top to bottom. In every round

1. the policy acts and is updated on the discriminator's reward (:meth:`AIRL.rewards`);
2. the round's episodes become samples labelled *policy*, the demonstrations samples labelled
   *expert*, grouped into risks (:meth:`AIRL.update`);
3. the discriminator minimises :func:`discriminator_loss`, the mean of the risks' cross-entropies
   plus lambda times the penalty.

Tensors in, tensors out: files, logging and the RL library stay outside. Samples are laid out
[E, 2, B]: E risks, label 0 = policy and 1 = expert, B samples of each.

Absorbing states. Where episodes may end early, the sign of a learned reward alone can solve the
task (Kostrikov et al. 2019). Here an ended episode stays in an absorbing state that keeps its final
observation. The time limit is bootstrapped through, so the state is worth the geometric series
f / (1 - gamma), added in closed form. The discriminator sees the state as often as stepping on to
the horizon would show it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from msgspec.structs import asdict
from torch.nn.functional import softplus

from irlcli.configs.schema import AIRLConfig
from irlcli.data.descriptions import RewardNetwork
from irlcli.errors import StageFailed
from irlcli.learners.actions import ActionView, Policy
from irlcli.learners.cloning import clone
from irlcli.learners.grouping import Group, Part, apportion, group
from irlcli.learners.pools import (
    Minibatch,
    Pool,
    Stratum,
    join_pools,
    make_pool,
    sample_minibatch,
)
from irlcli.learners.replay import Replay, whole_episodes
from irlcli.learners.reward_model import RewardModel
from irlcli.penalties import PenaltyOptions, discriminator_penalty
from irlcli.seeds import derive
from irlcli.trajectories import (
    ActionSpace,
    Rollout,
    Trajectory,
    Transitions,
    join,
    transitions,
    world_settings,
)

# Samples of either label behind each setting's diagnostics.
_DIAGNOSTIC_SAMPLES = 1024


# The loss


def discriminator_logits(model: RewardModel, batch: Minibatch) -> tuple[torch.Tensor, torch.Tensor]:
    """(f - log pi, f), each [E, 2, B]. The sigmoid of the first is D (paper Eq. 2)."""
    f = model(batch.observations, batch.actions, batch.next_observations, batch.terminated)
    return f - batch.log_probs, f


def cross_entropy(logits: torch.Tensor) -> torch.Tensor:
    """Binary cross-entropy [E] of ``logits`` [E, 2, B], labels weighted equally.

    Paper Eq. 3 with its sign corrected: expert = 1, policy = 0, to be minimised.
    """
    return 0.5 * (softplus(logits[:, 0]).mean(-1) + softplus(-logits[:, 1]).mean(-1))


class Loss(NamedTuple):
    """A minibatch's loss and what it consists of, all scalar tensors."""

    total: torch.Tensor
    cross_entropy: torch.Tensor
    penalty: torch.Tensor


def discriminator_loss(
    logits: torch.Tensor,
    f: torch.Tensor,
    weights: torch.Tensor,
    one_risk: bool,
    penalty: str,
    penalty_weight: float,
    options: PenaltyOptions,
) -> Loss:
    """(sum_e w_e BCE_e + lambda penalty) / max(1, lambda) (paper Eq. 5, Algorithm 1).

    The paper sums over settings where this averages. Dividing by lambda keeps the gradient's size
    when the penalty dominates.

    Args:
        logits: f - log pi [E, 2, B].
        f: the learned part [E, 2, B].
        weights: w [E], in sum one.
        one_risk: whether the penalty sees all E as one risk (``balanced``).
        penalty: a key of ``irlcli.penalties.PENALTIES``.
        penalty_weight: lambda, at least 0.
        options: how the penalty is estimated.
    """
    risks = cross_entropy(logits)
    risk = (weights * risks).sum()
    seen = (logits, f, risks)
    if one_risk:
        seen = (_merged(logits), _merged(f), risk[None])
    penalised = discriminator_penalty(penalty)(*seen, options)
    total = risk
    if penalty_weight > 0.0:
        total = (risk + penalty_weight * penalised) / max(1.0, penalty_weight)
    return Loss(total, risk.detach(), penalised.detach())


def _merged(samples: torch.Tensor) -> torch.Tensor:
    """[E, 2, B] as one risk [1, 2, E * B]."""
    return samples.transpose(0, 1).reshape(1, 2, -1)


def penalty_weight_at(index: int, weight: float, warmup: int, ramp: int) -> float:
    """lambda of round ``index``: 0 for ``warmup`` rounds, then linear over ``ramp`` to ``weight``."""
    if index < warmup:
        return 0.0
    return weight * min(1.0, (index - warmup + 1) / max(1, ramp))


# The policy's reward


def policy_reward(
    model: RewardModel,
    data: Transitions,
    log_probs: torch.Tensor,
    form: str,
    absorbing: bool,
    gamma: float,
) -> torch.Tensor:
    """The reward of each transition [B] float32, without gradient.

    ``form`` is ``f-log-pi`` (log D - log(1 - D), Algorithm 1), ``f`` or ``g``. With ``absorbing``,
    a terminated transition also earns the discounted sum of its absorbing state's rewards for a
    policy that discounts by ``gamma``: gamma / (1 - gamma) times the reward there, where log pi is
    zero.
    """
    with torch.no_grad():
        observations = torch.as_tensor(data.observations)
        actions = model.encode(torch.as_tensor(data.actions))
        successors = torch.as_tensor(data.next_observations)
        terminated = torch.as_tensor(data.terminated, dtype=torch.float32)
        if form == "g":
            reward = model.reward(observations, actions)
        else:
            ends = torch.zeros_like(terminated) if absorbing else terminated
            reward = model(observations, actions, successors, ends)
        if form == "f-log-pi":
            reward = reward - log_probs
        if absorbing and bool(terminated.any()):
            g, f = model.absorbing_reward(successors)
            series = gamma / (1.0 - gamma)
            reward = reward + terminated * series * (g if form == "g" else f)
        return reward


# The learner


class AIRL:
    """The discriminator, its optimiser, the demonstrations and the replay.

    Args:
        demonstrations: episodes of each of E settings.
        config: hyperparameters.
        worlds: number of worlds, equal shares of each setting, setting-major.
        horizon: time limit of the environment [steps].
        observation_size: D.
        actions: the environment's actions.
        seed: initialisation and every minibatch derive from it.

    Raises:
        ValueError: the demonstrations' observations are not of size D.
    """

    def __init__(
        self,
        demonstrations: Sequence[Sequence[Trajectory]],
        config: AIRLConfig,
        worlds: int,
        horizon: int,
        observation_size: int,
        actions: ActionSpace,
        seed: int,
    ):
        self.config = config
        self.view = ActionView(config.actions, actions)
        self._horizon = horizon
        self._seed = seed
        self._settings = len(demonstrations)
        self._world_settings = world_settings(worlds, self._settings)
        self._demonstrations = [
            [self.view.of(transitions([episode], horizon)) for episode in episodes]
            for episodes in demonstrations
        ]
        size = self._demonstrations[0][0].observations.shape[1]
        if size != observation_size:
            raise ValueError(
                f"the demonstrations have observations of size {size}, the environment "
                f"{observation_size}"
            )
        rng = np.random.default_rng(derive("shuffled settings", seed, 0)[0])
        counts = [len(episodes) for episodes in demonstrations]
        self._groups = group(config.grouping, counts, rng)
        self._weights = torch.tensor([g.weight for g in self._groups])
        self.network = RewardNetwork(
            observation_size=observation_size,
            action_size=actions.size,
            discrete=actions.discrete,
            state_only=config.state_only,
            hidden=config.hidden,
            activation=config.activation,
            gamma=config.ppo.gamma,
        )
        torch.manual_seed(derive("discriminator", seed, -1)[0])
        self.model = RewardModel(**asdict(self.network))
        # Decoupled, so that dividing the loss by lambda does not make the decay lambda times
        # stronger.
        self._optimizer = torch.optim.AdamW(
            self.model.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._replay = Replay(
            self._settings, config.replay_episodes_per_round, config.replay_capacity
        )
        # Standard deviation of g on the last round's samples.
        self.scale = 1.0
        for episodes in self._demonstrations:
            self.model.normaliser.update(torch.as_tensor(join(episodes).observations))

    def begin(self, trainer: Any) -> None:
        """Before the first round: let the student begin as a clone, if the config asks for it.

        All methods begin alike: each demonstrated step counts the same. ``trainer`` is a
        :class:`irlcli.rl.ppo.PPOTrainer`.
        """
        if self.config.bc_epochs > 0:
            data = join([episode for episodes in self._demonstrations for episode in episodes])
            clone(trainer, data, self.view, self.config.bc_epochs, self._seed)

    def rewards(self, rollout: Rollout, policy: Policy) -> np.ndarray:
        """The rewards [T, N] of ``policy`` for its rollout, by the current discriminator."""
        data = self.view.of(rollout.transitions(slice(None), self._horizon))
        log_probs = torch.as_tensor(rollout.log_probs.ravel())
        if self.view.clipped:
            log_probs = self.view.log_prob(policy, data)
        reward = policy_reward(
            self.model,
            data,
            log_probs,
            self.config.policy_reward,
            self.config.fixed_horizon,
            self.config.ppo.gamma,
        )
        return reward.numpy().reshape(rollout.terminated.shape)

    def update(
        self, index: int, rollouts: Sequence[Rollout], policy: Policy
    ) -> list[dict[str, float]]:
        """Train the discriminator on the rollouts of round ``index``.

        Returns the diagnostics of each setting: ``cross_entropy``, ``accuracy``, ``mean_abs_logit``
        and ``penalty`` (IRMv1) on fresh samples of the current policy and that setting's
        demonstrations; ``optimised_cross_entropy`` and ``optimised_penalty``, means over the
        round's minibatches, which hold replayed episodes too; and ``penalty_weight``, lambda.

        Raises:
            StageFailed: the discriminator's parameters stopped being finite.
        """
        config = self.config
        weight = penalty_weight_at(
            index,
            config.penalty_weight,
            config.penalty_warmup_rounds,
            config.penalty_ramp_rounds,
        )
        generated, episodes = self._generated(rollouts)
        self.model.normaliser.update(
            torch.as_tensor(np.concatenate([data.observations for data in generated]))
        )
        current = [self._pool(data, policy) for data in generated]
        expert = [self._pool(join(episodes), policy) for episodes in self._demonstrations]
        risks = self._risks(current, expert, policy)
        generator = torch.Generator().manual_seed(derive("discriminator", self._seed, index)[0])
        losses = []
        for _ in range(config.updates_per_round):
            batch = sample_minibatch(risks, generator, config.replay_share)
            loss = discriminator_loss(
                *discriminator_logits(self.model, batch),
                self._weights,
                config.grouping == "balanced",
                config.penalty,
                weight,
                self._penalty_options,
            )
            self._optimizer.zero_grad()
            loss.total.backward()
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.max_grad_norm)
            self._optimizer.step()
            losses.append((float(loss.cross_entropy), float(loss.penalty)))
        if not all(bool(torch.isfinite(p).all()) for p in self.model.parameters()):
            raise StageFailed(
                f"the discriminator's parameters are not finite after round {index}",
                "a smaller airl.learning_rate or airl.penalty_weight usually helps",
            )
        if config.replay_share > 0.0:
            rng = np.random.default_rng(derive("replay", self._seed, index)[0])
            for setting, (data, numbers) in enumerate(zip(generated, episodes, strict=True)):
                self._replay.add(setting, data, numbers, rng)
        self.scale = reward_scale(self.model, [*current, *expert])
        optimised_cross_entropy, optimised_penalty = np.mean(losses, 0)
        return [
            diagnostics
            | {
                "optimised_cross_entropy": float(optimised_cross_entropy),
                "optimised_penalty": float(optimised_penalty),
                "penalty_weight": weight,
            }
            for diagnostics in self._diagnostics(current, expert, generator)
        ]

    def _generated(self, rollouts: Sequence[Rollout]) -> tuple[list[Transitions], list[np.ndarray]]:
        """Each setting's transitions of this round, and the numbers of their episodes."""
        data, numbers = [], []
        for setting in range(self._settings):
            worlds = self._world_settings == setting
            found, episodes = whole_episodes(rollouts, worlds, self._horizon)
            data.append(self.view.of(found))
            numbers.append(episodes)
        return data, numbers

    def _pool(self, data: Transitions, policy: Policy) -> Pool:
        log_probs = self.view.log_prob(policy, data)
        return make_pool(self.model, data, log_probs, self.config.fixed_horizon)

    def _risks(
        self, current: Sequence[Pool], expert: Sequence[Pool], policy: Policy
    ) -> list[list[Stratum]]:
        """What each risk's minibatch is drawn from. Every method draws as many samples."""
        # Every round adds to every setting, so all of them have a past or none has.
        past = [self._pool(data, policy) for data in self._replay.transitions()]
        size = self.config.batch_size * self._settings // len(self._groups)

        def paired(pools: Sequence[Pool], part: Part) -> list[Pool]:
            """The policy's pools that go with ``part``: of the same settings, or of all."""
            if self.config.pairing == "pooled":
                return list(pools)
            return [pools[setting] for setting in part.episodes]

        def demonstrated(setting: int, episodes: np.ndarray) -> Pool:
            own = self._demonstrations[setting]
            if len(episodes) == len(own):
                return expert[setting]
            return self._pool(join([own[i] for i in episodes]), policy)

        def strata(members: Group) -> list[Stratum]:
            counts = apportion(size, [part.share for part in members.parts])
            return [
                Stratum(
                    policy=join_pools(paired(current, part)),
                    expert=join_pools([demonstrated(e, i) for e, i in part.episodes.items()]),
                    past=(join_pools(paired(past, part)),) if past else (),
                    count=count,
                )
                for part, count in zip(members.parts, counts, strict=True)
            ]

        return [strata(members) for members in self._groups]

    def _diagnostics(
        self, current: Sequence[Pool], expert: Sequence[Pool], generator: torch.Generator
    ) -> list[dict[str, float]]:
        """Per setting, whatever the grouping, so that methods can be compared."""
        found = []
        risks = [
            [Stratum(policy, expert_, (), _DIAGNOSTIC_SAMPLES)]
            for policy, expert_ in zip(current, expert, strict=True)
        ]
        with torch.no_grad():
            batch = sample_minibatch(risks, generator)
            logits, f = discriminator_logits(self.model, batch)
            entropies = cross_entropy(logits)
            measure = discriminator_penalty("irmv1")
            for e in range(self._settings):
                own = slice(e, e + 1)
                correct = torch.stack([logits[e, 0] < 0, logits[e, 1] > 0]).float()
                penalty = measure(logits[own], f[own], entropies[own], self._penalty_options)
                found.append(
                    {
                        "cross_entropy": float(entropies[e]),
                        "accuracy": float(correct.mean()),
                        "mean_abs_logit": float(logits[e].abs().mean()),
                        "penalty": float(penalty),
                    }
                )
        return found

    @property
    def _penalty_options(self) -> PenaltyOptions:
        return PenaltyOptions(
            self.config.penalty_scaling, self.config.penalty_estimate == "unbiased"
        )

    @property
    def quantiles(self) -> tuple[float, ...]:
        """Of g on the demonstrations, see :func:`reward_quantiles`."""
        return reward_quantiles(
            self.model,
            [
                make_pool(self.model, data, torch.zeros(len(data)), self.config.fixed_horizon)
                for data in map(join, self._demonstrations)
            ],
        )

    # Checkpoints and snapshots

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs from the end of the last round."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "scale": self.scale,
            "replay": self._replay.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict()`` of an equally configured learner."""
        self.model.load_state_dict(state["model"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.scale = state["scale"]
        self._replay.load_state_dict(state["replay"])

    def snapshot(self) -> dict[str, Any]:
        """A copy of the reward as it is now."""
        tensors = self.model.state_dict().items()
        return {"model": {name: t.clone() for name, t in tensors}, "scale": self.scale}

    def load_snapshot(self, state: Mapping[str, Any]) -> None:
        """Go back to the reward of ``snapshot()``."""
        self.model.load_state_dict(state["model"])
        self.scale = state["scale"]


# What the frozen reward is worth


def reward_scale(model: RewardModel, pools: Sequence[Pool]) -> float:
    """Standard deviation of g over the samples of ``pools``, each row as often as drawn.

    Fixed on training data, it makes frozen rewards of different runs comparable. Nothing is
    centred, which would change what the reward asks for.
    """
    with torch.no_grad():
        g = torch.cat([model.reward(pool.observations, pool.actions)[pool.draw] for pool in pools])
    return max(float(g.double().std()), 1e-6)


def reward_quantiles(model: RewardModel, demonstrations: Sequence[Pool]) -> tuple[float, ...]:
    """The 0, 1, ... 100 % quantiles of g over the settings' pools of ``demonstrations``.

    Each row counts as often as drawn; all settings weigh the same.
    """
    with torch.no_grad():
        g = [model.reward(pool.observations, pool.actions)[pool.draw] for pool in demonstrations]
    weights = np.concatenate([np.full(len(values), 1.0 / len(values)) for values in g])
    found = np.quantile(
        torch.cat(g).double().numpy(),
        np.linspace(0.0, 1.0, 101),
        weights=weights,
        method="inverted_cdf",
    )
    return tuple(float(value) for value in found)


def episode_reward(model: RewardModel, data: Transitions, absorbing: bool) -> float:
    """Undiscounted sum of g over ``data``; with ``absorbing``, up to the horizon."""
    with torch.no_grad():
        pool = make_pool(model, data, torch.zeros(len(data)), absorbing)
        g = model.reward(pool.observations, pool.actions)
    return float(g.double()[pool.draw].sum())
