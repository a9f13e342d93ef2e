"""Small AIRL runs that several tests share."""

import dataclasses

from msgspec.structs import replace

from irlcli.configs import AIRLConfig, PPOConfig
from irlcli.envs.registry import environment
from irlcli.interventions import parse_settings
from irlcli.learners import airl
from irlcli.learners.airl import AIRL
from irlcli.rl.ppo import PPOTrainer
from irlcli.rl.rollout import roll_out
from irlcli.rl.worlds import action_space, make_worlds

LANDER = "lunar-lander"
SETTINGS = parse_settings(LANDER, "engine-power=1x,1.25x")
CONFIG = AIRLConfig(updates_per_round=2, batch_size=32, ppo=PPOConfig(n_envs=8, n_steps=64))


def random_episodes(count, env=LANDER, settings=SETTINGS):
    """``count`` episodes of the random agent in each setting."""
    return [roll_out(env, s, "random", count, 0, f"test {s}") for s in settings]


def make(
    demos,
    config=CONFIG,
    env=LANDER,
    settings=SETTINGS,
    seed=0,
    total_steps=10_000,
    horizon=None,
    kind=AIRL,
    symmetries=None,
    **changes,
):
    """A trainer and a learner of ``demos`` in ``settings``, both with the time limit ``horizon``."""
    config = replace(config, **changes)
    horizon = horizon or environment(env).max_episode_steps
    worlds = make_worlds(env, settings[: len(demos)], config.ppo.n_envs)
    worlds.max_episode_steps = horizon
    trainer = PPOTrainer(
        worlds, config.ppo, total_steps, seed, "test", keep_moments=config.bc_epochs > 0
    )
    learner = kind(
        demos,
        config,
        worlds=len(worlds),
        rounds=trainer.rounds,
        horizon=horizon,
        observation_size=worlds.observation_space.shape[0],
        actions=action_space(worlds.action_space),
        seed=seed,
        symmetries=symmetries,
    )
    return trainer, learner


def moved(rollout, value, worlds=slice(None)):
    """``rollout`` with all observations of ``worlds`` at ``value``."""
    states = {"observations": rollout.observations, "next_observations": rollout.next_observations}
    states = {name: array.copy() for name, array in states.items()}
    for array in states.values():
        array[:, worlds] = value
    return dataclasses.replace(rollout, **states)


def worlds_of(settings, count, horizon):
    """``count`` worlds of ``settings`` with the time limit ``horizon``."""
    worlds = make_worlds(LANDER, settings, count)
    worlds.max_episode_steps = horizon
    return worlds


def record_losses(monkeypatch):
    """A list to which every update adds its student's minibatch, its challenger's, and the loss."""
    seen, original = [], airl.minibatch_loss

    def record(model, batch, challenger, *arguments):
        loss = original(model, batch, challenger, *arguments)
        seen.append((batch, challenger, loss))
        return loss

    monkeypatch.setattr(airl, "minibatch_loss", record)
    return seen
