"""Where the time of adversarial IRL goes, against stepping the bare environment.

Everything is measured in this process and in its CPU seconds. Bare stepping and training rounds
alternate, so that other load and changes of the machine's speed affect both alike. Run by
``make bench``.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections import defaultdict
from collections.abc import Callable, Sequence

import gymnasium
import numpy as np
import torch

from irlcli import learners
from irlcli.configs import AIRLConfig, load_config
from irlcli.configs.relevance import relevant_airl
from irlcli.envs.declared_symmetries import symmetries
from irlcli.envs.registry import environment
from irlcli.interventions import Setting, parse_settings
from irlcli.learners.airl import AIRL
from irlcli.rl.challengers import Challengers
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import Worlds, action_space, make_worlds, observation_size
from irlcli.trajectories import Trajectory

INTERVENTIONS = {
    "lunar-lander": "engine-power=1x,1.25x",
    "ant": "leg-length=1x,2x",
    "half-cheetah": "friction=1.5:0.1:0.1,2:0.6:0.6",
}


def main() -> None:
    """Print seconds per 1000 environment steps by part, and their ratio to bare stepping."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="lunar-lander", choices=sorted(INTERVENTIONS))
    parser.add_argument("--profile", default="standard")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--intervention", help="KNOB=VALUE,... in place of the usual one")
    arguments = parser.parse_args()
    settings = parse_settings(arguments.env, arguments.intervention or INTERVENTIONS[arguments.env])
    config = load_config(arguments.env, arguments.profile).airl_of(settings)

    bare = make_worlds(arguments.env, settings, config.ppo.n_envs)
    # Random demonstrations cost as much to learn from as an expert's.
    demos = [roll_out(arguments.env, s, "random", 10, 0, "bench") for s in settings]
    worlds = make_worlds(arguments.env, settings, config.ppo.n_envs)
    trainer, learner, challengers = build(arguments.env, settings, worlds, demos, config)

    seconds: dict[str, float] = defaultdict(float)
    for owner, name, part in (
        (worlds, "step", "environment"),
        (worlds, "reset", "environment"),
        (trainer.model, "collect_rollouts", "rollout"),
        (trainer.model, "train", "PPO update"),
        (learner, "rewards", "rewards"),
    ):
        setattr(owner, name, _timed(getattr(owner, name), seconds, part))

    steps = 0
    for index in range(-1, arguments.rounds):
        if index == 0:
            # The first round warmed up caches and lazy imports.
            seconds.clear()
            steps = 0
        count = trainer.steps_per_round
        started = time.process_time()
        _step_bare(bare, count, index + 1)
        seconds["bare stepping"] += time.process_time() - started
        started = time.process_time()
        rollouts = trainer.train_round(index + 1, learner)
        challenge = []
        if challengers is not None:
            own = dict(seconds)
            before = time.process_time()
            challenge = challengers.train_round(index + 1)
            seconds["challenger"] += time.process_time() - before
            # Its steps are counted there, not as the student's environment.
            seconds["environment"] = own["environment"]
        policy_done = time.process_time()
        learner.update(index + 1, rollouts, trainer.policy, challenge)
        ended = time.process_time()
        seconds["discriminator"] += ended - policy_done
        seconds["AIRL in all"] += ended - started
        steps += count
    seconds["policy forward and buffer"] = seconds.pop("rollout") - seconds["environment"]
    parts = ["environment", "policy forward and buffer", "rewards", "PPO update", "discriminator"]
    parts += [] if challengers is None else ["challenger"]
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


def build(
    env: str,
    settings: Sequence[Setting],
    worlds: Worlds,
    demos: Sequence[Sequence[Trajectory]],
    config: AIRLConfig,
) -> tuple[PPOTrainer, AIRL, Challengers | None]:
    """Student, learner and challengers (if ``config`` has any), as ``irl train-airl`` makes them."""
    spec = environment(env)
    config = relevant_airl(config, spec.discrete_actions)
    size, actions = observation_size(worlds.observation_space), action_space(worlds.action_space)
    trainer = PPOTrainer(
        worlds, config.ppo, config.total_steps, 0, "bench", keep_moments=config.bc_epochs > 0
    )
    images = None
    if config.symmetries is True:
        images = symmetries(env, settings, size, actions.size)
    learner = learners.learner(config.learner)(
        demos,
        config,
        worlds=len(worlds),
        rounds=trainer.rounds,
        horizon=spec.max_episode_steps,
        observation_size=size,
        actions=actions,
        seed=0,
        symmetries=images,
    )
    if config.challenger.life == 0:
        return trainer, learner, None
    theirs = [worlds]
    if config.challenger.per_setting is True and len(settings) > 1:
        share = config.ppo.n_envs // len(settings)
        theirs = [make_worlds(env, [setting], share) for setting in settings]
    return trainer, learner, Challengers(theirs, config.challenger, learner, 0, "bench")


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
