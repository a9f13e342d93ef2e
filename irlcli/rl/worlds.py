"""The environments that a policy is trained in, and the view of them that SB3 steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from irlcli.envs.registration import factory
from irlcli.envs.registry import environment
from irlcli.envs.spaces import check_spaces
from irlcli.envs.vector import Ended, VectorWorlds
from irlcli.envs.workers import WorkerWorlds
from irlcli.interventions import Setting
from irlcli.seeds import derive
from irlcli.trajectories import ActionSpace, Rollout, world_settings

Worlds = VectorWorlds | WorkerWorlds


def make_worlds(env: str, settings: Sequence[Setting], count: int, workers: int = 1) -> Worlds:
    """``count`` worlds in equal shares of each setting, see :func:`world_settings`.

    More than one worker (at most one per world) steps them in as many processes, with the same
    results.

    Raises:
        UsageError: see :func:`irlcli.envs.spaces.check_spaces`.
    """
    check_spaces(env, settings)
    factories = [factory(env, settings[index]) for index in world_settings(count, len(settings))]
    limit = environment(env).max_episode_steps
    if min(workers, count) > 1:
        return WorkerWorlds(factories, limit, min(workers, count))
    return VectorWorlds([make() for make in factories], limit)


def action_space(space: gymnasium.Space) -> ActionSpace:
    """What learners need to know of ``space``."""
    if isinstance(space, gymnasium.spaces.Discrete):
        return ActionSpace(True, int(space.n), np.empty(0), np.empty(0))
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        choices = tuple(space.nvec.tolist())
        return ActionSpace(True, sum(choices), np.empty(0), np.empty(0), choices)
    assert isinstance(space, gymnasium.spaces.Box)
    return ActionSpace(False, space.shape[0], space.low, space.high)


def observation_size(space: gymnasium.Space) -> int:
    """The length D of a flat observation of ``space``."""
    assert isinstance(space, gymnasium.spaces.Box)
    return math.prod(space.shape)


class RecordingVecEnv(VecEnv):
    """The worlds as SB3 steps them, and a record of what SB3's rollout buffer drops."""

    def __init__(self, worlds: Worlds):
        self.worlds = worlds
        super().__init__(len(worlds), worlds.observation_space, worlds.action_space)
        self._world_seeds: Sequence[int] = range(len(worlds))
        self.rewards: list[np.ndarray] = []
        self.ended: list[tuple[int, Ended]] = []
        self._actions = np.empty(0)
        self._no_infos: list[dict[str, Any]] = [{} for _ in range(len(worlds))]

    def start_recording(self) -> None:
        """Forget what was recorded."""
        self.rewards, self.ended = [], []

    def begin_round(self, purpose: str, seed: int, index: int) -> np.ndarray:
        """Seed every generator from (purpose, seed, round), and start fresh episodes.

        Returns their first observations [N, D].
        """
        generator_seed, *self._world_seeds = derive(purpose, seed, index, 1 + self.num_envs)
        torch.manual_seed(generator_seed)
        # SB3 draws its minibatches with numpy's global generator.
        np.random.seed(generator_seed)
        return self.reset()

    def reset(self) -> np.ndarray:
        return self.worlds.reset(self._world_seeds)

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
        # SB3 adds the bootstrapped value of truncated steps to the array that it receives.
        return observations, rewards.astype(np.float32), dones, infos

    def rollout(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        log_probs: np.ndarray,
        last_observations: np.ndarray,
    ) -> Rollout:
        """The T steps recorded since :meth:`start_recording`.

        Args:
            observations: [T, N, D], in which the policy acted.
            actions: [T, N], or [T, N, K] or [T, N, A], its samples.
            log_probs: [T, N].
            last_observations: [N, D], in which the next step begins.
        """
        shape = observations.shape[:2]
        next_observations = np.concatenate([observations[1:], last_observations[None]])
        terminated, truncated = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        lengths, returns = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        progress = np.full(shape, np.nan)
        for t, end in self.ended:
            next_observations[t, end.world] = end.final_observation
            terminated[t, end.world] = end.terminated
            truncated[t, end.world] = not end.terminated
            lengths[t, end.world] = end.length
            returns[t, end.world] = end.episode_return
            progress[t, end.world] = end.progress
        return Rollout(
            observations=observations,
            actions=actions,
            next_observations=next_observations,
            log_probs=log_probs,
            true_rewards=np.stack(self.rewards),
            terminated=terminated,
            truncated=truncated,
            lengths=lengths,
            returns=returns,
            progress=progress,
            errors=tuple((end.world, end.error) for _, end in self.ended if end.error),
        )

    def close(self) -> None:
        self.worlds.close()

    def get_attr(self, attr_name, indices=None):
        # SB3 asks for the render mode. Nothing is drawn in training.
        return [None for _ in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        raise AttributeError("training worlds may live in other processes")

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise AttributeError("training worlds may live in other processes")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False for _ in self._get_indices(indices)]
