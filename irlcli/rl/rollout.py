"""Whole episodes of a policy, or of an agent that learns nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Any

import gymnasium
import numpy as np
import torch

from irlcli.envs.cue import with_hints
from irlcli.envs.registration import make
from irlcli.envs.registry import environment
from irlcli.interventions import Setting, cue_in, without_cue
from irlcli.rl.policy import Policy, require_observations
from irlcli.rl.worlds import observation_size
from irlcli.seeds import derive
from irlcli.trajectories import Trajectory


def roll_out(
    env: str,
    setting: Setting,
    policy: Policy | str,
    episodes: int,
    seed: int,
    purpose: str,
    deterministic: bool = False,
    noise: float = 0.0,
    parallel: int = 16,
) -> list[Trajectory]:
    """``episodes`` whole episodes of ``policy`` (or ``"random"``, ``"idle"``) in one setting.

    Episode k starts from a state of its own, derived from (purpose, seed, k). The actions of
    the ``parallel`` episodes that run together come from one generator. With probability
    ``noise`` an action is replaced by a uniformly random one (D-REX, Brown et al. 2019, Sec. 4).
    In a built-in environment the random numbers of the random agent and of ``noise`` are those that
    the first of these episodes is reset with, so there they are not independent of its start.

    Where the setting has a cue that the policy does not take, the policy acts without it, and the
    hints are added afterwards (:mod:`irlcli.envs.cue`): so experts demonstrate.

    Raises:
        UsageError: the setting's observations are not those the policy was trained on.
    """
    torch.set_num_threads(1)
    cue = cue_in(env, setting)
    if cue is not None and isinstance(policy, Policy) and not _takes(policy, env, setting):
        plain = without_cue(env, setting)
        acted = roll_out(
            env, plain, policy, episodes, seed, purpose, deterministic, noise, parallel
        )
        return [with_hints(trajectory, *cue) for trajectory in acted]
    spec = environment(env)
    limit, own = spec.max_episode_steps, spec.own is not None
    trajectories: list[Trajectory] = []
    for first in range(0, episodes, parallel):
        batch = range(first, min(first + parallel, episodes))
        seeds = [derive(purpose, seed, k)[0] for k in batch]
        torch.manual_seed(seeds[0])
        rng = np.random.default_rng(
            derive(f"{purpose} actions", seed, first)[0] if own else seeds[0]
        )
        with ExitStack() as stack:
            worlds = [stack.enter_context(closing(make(env, setting))) for _ in batch]
            if isinstance(policy, Policy):
                require_observations(policy, worlds[0].observation_space, f"{env} {setting}")
            trajectories += _run_batch(worlds, policy, seeds, limit, deterministic, noise, rng)
    return trajectories


def _takes(policy: Policy, env: str, setting: Setting) -> bool:
    """Whether ``policy`` takes the observations of ``setting``."""
    with closing(make(env, setting)) as world:
        return observation_size(world.observation_space) == policy.observation_size


def _run_batch(
    worlds: Sequence[gymnasium.Env],
    policy: Policy | str,
    seeds: Sequence[int],
    limit: int,
    deterministic: bool,
    noise: float,
    rng: np.random.Generator,
) -> list[Trajectory]:
    """An episode of at most ``limit`` steps in each of ``worlds``, reset with its seed; see roll_out()."""
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
        if noise > 0.0:
            replaced = rng.random(len(active)) < noise
            chosen[replaced] = _random_actions(space, len(active), rng)[replaced]
        still = []
        for i, action in zip(active, chosen, strict=True):
            observation, reward, terminated, truncated, info = worlds[i].step(action)
            if "progress" in info:
                progress[i] = (0.0 if math.isnan(progress[i]) else progress[i]) + info["progress"]
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
    return np.float32 if isinstance(space, gymnasium.spaces.Box) else np.int64


def _random_actions(space: gymnasium.Space, count: int, rng: np.random.Generator) -> np.ndarray:
    if isinstance(space, gymnasium.spaces.Discrete):
        return rng.integers(space.n, size=count)
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        return rng.integers(space.nvec, size=(count, *space.shape))
    assert isinstance(space, gymnasium.spaces.Box)
    return rng.uniform(space.low, space.high, size=(count, *space.shape)).astype(np.float32)


def _idle_actions(space: gymnasium.Space, count: int) -> np.ndarray:
    """Zero, or where it is out of bounds the nearest bound; the first of several indices."""
    zeros: np.ndarray = np.zeros((count, *(space.shape or ())), dtype=_action_dtype(space))
    return (
        np.clip(zeros, space.low, space.high) if isinstance(space, gymnasium.spaces.Box) else zeros
    )
