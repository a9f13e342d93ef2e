"""Adversarial IRL with an invariance penalty (paper Algorithm 1; Fu et al. 2017).

Algorithm 1, as this module reads from top to bottom. In every round

1. the policy acts and is updated on the discriminator's reward (:meth:`AIRL.rewards`), and a
   challenger, if there is one, on the reward alone (:meth:`AIRL.challenger_rewards`);
2. the round's episodes become samples labelled *policy*, the demonstrations samples labelled
   *expert*, grouped into risks (:meth:`AIRL.update`);
3. the discriminator minimises :func:`~irlcli.learners.discriminator.discriminator_loss`, the mean
   of the risks' cross-entropies plus lambda times the penalty.

Tensors in, tensors out: files, logging and the RL library stay outside. Samples are laid out
[E, 2, B]: E risks, label 0 = policy and 1 = expert, B samples of each.

Absorbing states. Where episodes may end early, the sign of a learned reward alone can solve the
task (Kostrikov et al. 2019). Here an ended episode stays in an absorbing state, which keeps its
final observation or, with ``shared_absorbing``, is the same for all. The time limit is bootstrapped
through, so the state is worth the geometric series f / (1 - gamma), added in closed form. The
discriminator sees the state as often as stepping on to the horizon would show it, if a round is at
least as long as the horizon. In shorter rounds it sees the state too often. Only episodes that
begin at least one horizon before the round's end are used
(:func:`irlcli.learners.replay.whole_episodes`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from itertools import chain
from typing import Any

import numpy as np
import torch

from irlcli.configs.schema import AIRLConfig
from irlcli.data.descriptions import RewardNetwork
from irlcli.errors import StageFailed
from irlcli.learners.actions import ActionView, Policy, check_fit
from irlcli.learners.averaging import averaged_after
from irlcli.learners.cloning import clone
from irlcli.learners.discriminator import measured, minibatch_loss, penalty_weight_at
from irlcli.learners.grouping import Part, group
from irlcli.learners.images import Images
from irlcli.learners.pools import (
    Minibatch,
    Pool,
    Stratum,
    make_pool,
    sample_minibatch,
)
from irlcli.learners.replay import Replay, whole_episodes
from irlcli.learners.reward_model import AveragedReward, RewardModel, RewardModule
from irlcli.learners.risks import risk_strata
from irlcli.learners.scoring import (
    level_of,
    policy_reward,
    reward_quantiles,
    reward_scale,
    transformed_reward,
)
from irlcli.networks import all_finite
from irlcli.seeds import derive
from irlcli.symmetries import Symmetries
from irlcli.trajectories import (
    ActionSpace,
    Rollout,
    Trajectory,
    Transitions,
    join,
    transitions,
    world_settings,
)


class AIRL:
    """The discriminator, its optimiser, the demonstrations and the replay.

    Args:
        demonstrations: episodes of each of E settings.
        config: hyperparameters.
        worlds: number of worlds, equal shares of each setting, setting-major.
        rounds: of the whole training.
        horizon: time limit of the environment [steps].
        observation_size: D.
        actions: the environment's actions.
        seed: initialisation and every minibatch derive from it.
        symmetries: of the environment; None: samples are used as they are.

    Raises:
        ValueError: the demonstrations have other observations or actions than the environment, or
            one is longer than its time limit.
    """

    def __init__(
        self,
        demonstrations: Sequence[Sequence[Trajectory]],
        config: AIRLConfig,
        worlds: int,
        rounds: int,
        horizon: int,
        observation_size: int,
        actions: ActionSpace,
        seed: int,
        symmetries: Symmetries | None = None,
    ):
        self.config = config
        self._images = Images(symmetries)
        self.view = ActionView(config.actions, actions)
        self._rounds = rounds
        self._horizon = horizon
        self._seed = seed
        self._settings = len(demonstrations)
        self._world_settings = world_settings(worlds, self._settings)
        recorded = [[transitions([t], horizon) for t in episodes] for episodes in demonstrations]
        for data in chain(*recorded):
            check_fit(data, observation_size, actions)
        self._demonstrations = [[self.view.of(data) for data in episodes] for episodes in recorded]
        rng = np.random.default_rng(derive("shuffled settings", seed, 0)[0])
        counts = [len(episodes) for episodes in demonstrations]
        self._groups = group(config.grouping, counts, rng)
        self._weights = torch.tensor([g.weight for g in self._groups], dtype=torch.float32)
        shape: dict[str, Any] = {
            "observation_size": observation_size,
            "action_size": actions.size,
            "discrete": actions.discrete,
            "state_only": config.state_only,
            "hidden": config.hidden,
            "activation": config.activation,
            "gamma": config.ppo.gamma,
            "shaping": config.shaping,
            "columns": config.columns or (),
            "choices": actions.choices,
            "shared_absorbing": config.shared_absorbing or False,
        }
        members = config.averaged_rounds or 1
        self.network = RewardNetwork(**shape, members=members)
        torch.manual_seed(derive("discriminator", seed, -1)[0])
        self.model = RewardModel(**shape, dropout=config.dropout or 0.0).eval()
        weighted = config.averaged_by == "learning-rate"
        weights = [self._rate(index) if weighted else 1.0 for index in range(rounds)]
        # Round -> how many times its g joins the frozen mean; see AveragedReward.
        self._joins = Counter(averaged_after(weights, members))
        self._members: list[RewardModel] = []
        # Decoupled, so that dividing the loss by lambda does not make the decay lambda times
        # stronger.
        self._optimizer = torch.optim.AdamW(
            self.model.parameters(),
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,
        )
        self._replay, self._challenger_replay = (
            Replay(
                self._settings,
                per_round=part.replay_episodes_per_round,
                capacity=part.replay_capacity,
            )
            for part in (config, config.challenger)
        )
        # Standard deviation of the deployed g on the last round's samples of the student and on the
        # demonstrations.
        self.scale = 1.0
        for episodes in self._demonstrations:
            self._normalise([join(episodes).observations], -1)

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
        if self.view.clipped and self.config.policy_reward == "f-log-pi":
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

    def challenger_rewards(self, rollout: Rollout) -> np.ndarray:
        """The rewards [T, N] of a challenger: the current g, bounded as in ``ChallengerConfig``."""
        ceiling = level_of(self._quantiles_of(self.model), self.config.challenger.ceiling)
        gamma = self.config.challenger.ppo.gamma
        return self._of_g(rollout, lambda g: g.clamp(max=ceiling), gamma)

    def _of_g(
        self, rollout: Rollout, transform: Callable[[torch.Tensor], torch.Tensor], gamma: float
    ) -> np.ndarray:
        """``transform`` of the current g, see :func:`transformed_reward`, as rewards [T, N]."""
        data = self.view.of(rollout.transitions(slice(None), self._horizon))
        fixed = self.config.fixed_horizon
        reward = transformed_reward(self.model, data, transform, fixed, gamma)
        return reward.numpy().reshape(rollout.terminated.shape)

    def update(
        self,
        index: int,
        rollouts: Sequence[Rollout],
        policy: Policy,
        challenger_rollouts: Sequence[Rollout] = (),
    ) -> list[dict[str, float]]:
        """Train the discriminator on the rollouts of round ``index`` and those of a challenger.

        Returns the diagnostics of each setting: ``cross_entropy``, ``accuracy``, ``mean_abs_logit``
        and ``penalty`` (IRMv1) after the update, on a new minibatch of the round's episodes and that
        setting's demonstrations, which the update used, with log pi of ``policy``;
        ``optimised_cross_entropy`` (the student's alone) and ``optimised_penalty``, means over the
        update's minibatches, which hold replayed episodes too; and ``penalty_weight``, lambda. They
        describe the current g, never a mean of rounds.

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
        student_episodes = self._whole_episodes(rollouts)
        challenger_episodes = self._whole_episodes(challenger_rollouts)
        self._normalise(
            [d.observations for d, _ in (*student_episodes, *challenger_episodes)], index
        )
        current = [self._pool(data, policy) for data, _ in student_episodes]
        expert = [self._pool(join(episodes), policy) for episodes in self._demonstrations]
        risks = self._risks(current, self._replay, expert, policy)
        challenger_risks = None
        if challenger_episodes:
            pools = [self._pool(data, None) for data, _ in challenger_episodes]
            challenger_risks = self._risks(pools, self._challenger_replay, expert, None)
        generator = torch.Generator().manual_seed(derive("discriminator", self._seed, index)[0])
        losses = self._optimise(index, risks, challenger_risks, weight, generator)
        if config.replay_share > 0.0:
            rng = np.random.default_rng(derive("replay", self._seed, index)[0])
            for replay, found in (
                (self._replay, student_episodes),
                (self._challenger_replay, challenger_episodes),
            ):
                for setting, (data, numbers) in enumerate(found):
                    replay.add(setting, data, numbers, rng)
        if self.network.members > 1:
            for _ in range(self._joins[index]):
                self._members.append(deepcopy(self.model).requires_grad_(False))
        # No round's mean but the last one's is deployed, and a mean of 30 takes a tenth of a round.
        if self.network.members == 1 or index + 1 == self._rounds:
            self.scale = reward_scale(self.deployed, [*current, *expert])
        optimised_cross_entropy, optimised_penalty = np.mean(losses, 0)
        return [
            diagnostics
            | {
                "optimised_cross_entropy": float(optimised_cross_entropy),
                "optimised_penalty": float(optimised_penalty),
                "penalty_weight": weight,
            }
            for diagnostics in measured(self.model, current, expert, config.logit, generator)
        ]

    def _normalise(self, observations: Sequence[np.ndarray], index: int) -> None:
        """Add images of ``observations`` to the moments of the model's input."""
        generator = torch.Generator().manual_seed(derive("images", self._seed, index)[0])
        added = torch.as_tensor(np.concatenate(observations))
        self.model.normaliser.update(self._images.of_observations(added, generator))

    def _sampled(self, risks: Sequence[Sequence[Stratum]], generator: torch.Generator) -> Minibatch:
        batch = sample_minibatch(risks, generator, self.config.replay_share)
        return self._images.of(batch, generator)

    def _optimise(
        self,
        index: int,
        risks: Sequence[Sequence[Stratum]],
        challenger_risks: Sequence[Sequence[Stratum]] | None,
        weight: float,
        generator: torch.Generator,
    ) -> list[tuple[float, float]]:
        """Take round ``index``'s gradient steps. Returns the cross-entropy and penalty of each.

        Raises:
            StageFailed: the penalty is not finite, or the parameters stopped being finite.
        """
        config = self.config
        for parameters in self._optimizer.param_groups:
            parameters["lr"] = self._rate(index)
        losses = []
        self.model.train()
        with torch.random.fork_rng(devices=[]):
            # For dropout, which takes no generator.
            torch.manual_seed(derive("dropout", self._seed, index)[0])
            for _ in range(config.updates_per_round):
                batch = self._sampled(risks, generator)
                challenger = None
                if challenger_risks is not None:
                    challenger = self._sampled(challenger_risks, generator)
                loss = minibatch_loss(
                    self.model, batch, challenger, self._weights, config, weight, generator
                )
                self._optimizer.zero_grad()
                loss.total.backward()
                torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.max_grad_norm)
                self._optimizer.step()
                losses.append((float(loss.cross_entropy), float(loss.penalty)))
        self.model.eval()
        bad = next((found for found in losses if not all(map(math.isfinite, found))), None)
        if bad is not None and math.isfinite(bad[0]):
            raise StageFailed(
                f"penalty {config.penalty!r} is {bad[1]} in round {index}",
                "a smaller airl.learning_rate or airl.penalty_weight usually helps",
            )
        if not all_finite(self.model):
            raise StageFailed(
                f"the discriminator's parameters are not finite after round {index}",
                "a smaller airl.learning_rate or airl.penalty_weight usually helps",
            )
        return losses

    def _rate(self, index: int) -> float:
        """The discriminator's learning rate in round ``index``."""
        if self.config.learning_rate_schedule == "constant":
            return self.config.learning_rate
        return self.config.learning_rate * (1.0 - index / self._rounds)

    def _whole_episodes(self, rollouts: Sequence[Rollout]) -> list[tuple[Transitions, np.ndarray]]:
        """Each setting's transitions of this round, and the numbers of their episodes."""
        found = []
        for setting in range(self._settings if rollouts else 0):
            worlds = self._world_settings == setting
            data, episodes = whole_episodes(rollouts, worlds, self._horizon)
            found.append((self.view.of(data), episodes))
        return found

    def _pool(self, data: Transitions, policy: Policy | None) -> Pool:
        """``data`` with log pi of ``policy``; without it, for logits that are f alone."""
        log_probs = torch.zeros(len(data))
        if policy is not None and self.config.logit == "f-log-pi":
            log_probs = self.view.log_prob(policy, data)
        return make_pool(self.model, data, log_probs, self.config.fixed_horizon)

    def _risks(
        self,
        current: Sequence[Pool],
        replay: Replay,
        expert: Sequence[Pool],
        policy: Policy | None,
    ) -> list[list[Stratum]]:
        """What each risk's minibatch is drawn from, see :func:`risk_strata`."""

        def demonstrated(part: Part) -> Pool:
            own = self._demonstrations[part.setting]
            if len(part.episodes) == len(own):
                return expert[part.setting]
            return self._pool(join([own[i] for i in part.episodes]), policy)

        # Every round adds to every setting, so all of them have a past or none has.
        past = [self._pool(data, policy) for data in replay.transitions()]
        samples = self.config.batch_size * self._settings
        return risk_strata(self._groups, samples, current, past, demonstrated, self.config.pairing)

    @property
    def deployed(self) -> RewardModule:
        """What is frozen: the current reward, or the mean of those that have joined it so far."""
        return AveragedReward(self._members) if self._members else self.model

    @property
    def quantiles(self) -> tuple[float, ...]:
        """Of the deployed g on the demonstrations, see :func:`reward_quantiles`."""
        return self._quantiles_of(self.deployed)

    def _quantiles_of(self, model: RewardModule) -> tuple[float, ...]:
        pools = [self._pool(join(episodes), None) for episodes in self._demonstrations]
        return reward_quantiles(model, pools)

    # Checkpoints and snapshots

    def state_dict(self) -> dict[str, Any]:
        """What a resumed run needs from the end of the last round."""
        return {
            "model": self.model.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "scale": self.scale,
            "replay": self._replay.state_dict(),
            "challenger_replay": self._challenger_replay.state_dict(),
            "members": [member.state_dict() for member in self._members],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from ``state_dict()`` of an equally configured learner."""
        self.model.load_state_dict(state["model"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.scale = state["scale"]
        self._replay.load_state_dict(state["replay"])
        self._challenger_replay.load_state_dict(state["challenger_replay"])
        self._members = []
        for tensors in state["members"]:
            member = deepcopy(self.model).requires_grad_(False)
            member.load_state_dict(tensors)
            self._members.append(member)

    def snapshot(self) -> dict[str, Any]:
        """A copy of the reward as it is now."""
        tensors = self.model.state_dict().items()
        return {"model": {name: t.clone() for name, t in tensors}, "scale": self.scale}

    def load_snapshot(self, state: Mapping[str, Any]) -> None:
        """Go back to the reward of ``snapshot()``."""
        self.model.load_state_dict(state["model"])
        self.scale = state["scale"]
