"""Where the time of adversarial IRL goes, against stepping the bare environment.

Everything is measured in this one process and in its CPU seconds, alternating bare stepping and
training rounds, so that other load and a change of the machine's speed meet both alike. Run by
``make bench``.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np
import torch

from irlcli.configs import load_config
from irlcli.data.demonstrations import Demonstrations
from irlcli.interventions import parse_settings
from irlcli.learners.adversary import Adversary
from irlcli.rl import ppo as rl

INTERVENTIONS = {
    "lunar-lander": "engine-power=1x,1.25x",
    "ant": "leg-length=1x,2x",
    "half-cheetah": "leg-length=0.7,1.3",
}


def main() -> None:
    """Print seconds per 1000 environment steps by part, and their ratio to bare stepping."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="lunar-lander", choices=sorted(INTERVENTIONS))
    parser.add_argument("--profile", default="standard")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--intervention", help="KNOB=VALUE,... in place of the usual one")
    arguments = parser.parse_args()
    config = load_config(arguments.env, arguments.profile).airl
    settings = parse_settings(arguments.env, arguments.intervention or INTERVENTIONS[arguments.env])

    bare = rl.make_worlds(arguments.env, settings, config.ppo.n_envs)
    worlds = rl.make_worlds(arguments.env, settings, config.ppo.n_envs)
    # Random demonstrations cost as much to learn from as an expert's.
    demos = Demonstrations(
        arguments.env,
        {str(s): tuple(rl.roll_out(arguments.env, s, "random", 10, 0, "bench")) for s in settings},
        {},
    )
    trainer = rl.PPOTrainer(worlds, config.ppo, config.total_steps, 0, "bench")
    adversary = Adversary(demos, config, worlds, 0)

    seconds: dict[str, float] = defaultdict(float)
    worlds.step = _timed(worlds.step, seconds, "environment")
    worlds.reset = _timed(worlds.reset, seconds, "environment")
    trainer.model.collect_rollouts = _timed(trainer.model.collect_rollouts, seconds, "rollout")
    trainer.model.train = _timed(trainer.model.train, seconds, "PPO update")
    reward = _timed(partial(adversary.reward, policy=trainer.policy), seconds, "rewards")

    steps = 0
    for index in range(-1, arguments.rounds):
        if index == 0:
            # The round before it warmed caches and lazy imports up.
            seconds.clear()
            steps = 0
        count = trainer.steps_per_round
        started = time.process_time()
        _step_bare(bare, count, index + 1)
        seconds["bare stepping"] += time.process_time() - started
        started = time.process_time()
        rollouts = trainer.train_round(index + 1, reward)
        policy_done = time.process_time()
        adversary.train_round(index + 1, rollouts, trainer.policy)
        ended = time.process_time()
        seconds["discriminator"] += ended - policy_done
        seconds["AIRL in all"] += ended - started
        steps += count
    seconds["policy forward and buffer"] = seconds.pop("rollout") - seconds["environment"]
    parts = ("environment", "policy forward and buffer", "rewards", "PPO update", "discriminator")
    seconds["rest"] = seconds["AIRL in all"] - sum(seconds[part] for part in parts)

    print(
        f"{arguments.env}, {len(settings)} settings, profile {arguments.profile}, {steps:,} steps, "
        f"one process, at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB"
    )
    print(f"{'part':28}{'CPU ms / 1000 steps':>20}{'share':>8}{'x bare':>8}")
    for part in ("bare stepping", *parts, "rest", "AIRL in all"):
        share = "" if part == "bare stepping" else f"{seconds[part] / seconds['AIRL in all']:.0%}"
        ratio = seconds[part] / seconds["bare stepping"]
        print(f"{part:28}{1e6 * seconds[part] / steps:20.1f}{share:>8}{ratio:8.2f}")


def _timed(function: Callable, seconds: dict[str, float], part: str) -> Callable:
    def timed(*arguments, **keywords):
        started = time.process_time()
        try:
            return function(*arguments, **keywords)
        finally:
            seconds[part] += time.process_time() - started

    return timed


def _step_bare(worlds, steps: int, seed: int) -> None:
    """The environment alone, with random actions: its own step and reset, nothing else."""
    rng = np.random.default_rng(seed)
    space = worlds.action_space
    for i, env in enumerate(worlds.envs):
        env.reset(seed=seed * 1000 + i)
        actions = _random_actions(space, steps // len(worlds.envs), rng)
        length = 0
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            length += 1
            if terminated or truncated or length >= worlds.max_episode_steps:
                env.reset()
                length = 0


def _random_actions(space, count: int, rng: np.random.Generator):
    if isinstance(space, gymnasium.spaces.Discrete):
        return rng.integers(space.n, size=count).tolist()
    return rng.uniform(space.low, space.high, size=(count, *space.shape)).astype(np.float32)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
