"""Adversarial IRL from demonstrations: ERM, ERM-balanced or IRM (paper Algorithm 1)."""

import msgspec

from irlcli.errors import UsageError
from irlcli.settings import AIRLSettings
from irlcli.stages import From, Job, Request, Source, Stage

class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a learned reward depends on, besides its demonstrations."""

    seed: int
    airl: AIRLSettings


def request(demos: Source | From, airl: AIRLSettings, seed: int = 0, label: str = "") -> Request:
    """A reward and a student policy learned from ``demos``.

    Outputs ``reward.pt``, ``policy.pt`` (the student), their descriptions as JSON, and
    ``metrics.parquet`` with one row per round and setting.
    """
    label = label or f"train-airl {airl.method} seed {seed}"
    return Request(STAGE, Parameters(seed=seed, airl=airl), {"demonstrations": demos}, label)


def run(job: Job) -> None:
    """Alternate policy rounds and discriminator rounds, all settings together."""
    from irlcli import rl
    from irlcli.dataset import read_demonstrations
    from irlcli.interventions import parse_setting
    from irlcli.stages.adversary import Adversary
    from irlcli.stages.outputs import write_metrics, write_policy
    from irlcli.stages.policy_training import train_rounds

    p: Parameters = job.parameters
    demos = read_demonstrations(job.inputs["demonstrations"])
    settings = list(demos.trajectories)
    if p.airl.ppo.n_envs % len(settings):
        raise UsageError(
            f"{p.airl.ppo.n_envs} worlds cannot be shared equally by {len(settings)} settings",
            f"--set airl.ppo.n_envs to a multiple of {len(settings)}",
        )
    worlds = rl.make_worlds(
        demos.env, [parse_setting(demos.env, s) for s in settings], p.airl.ppo.n_envs
    )
    trainer = rl.PPOTrainer(worlds, p.airl.ppo, p.airl.total_steps, p.seed)
    adversary = Adversary(demos, p.airl, worlds, p.seed)
    rows = train_rounds(job, trainer, settings, adversary=adversary)
    origin = {
        "env": demos.env,
        "settings": settings,
        "method": p.airl.method,
        "seed": p.seed,
        "airl": msgspec.to_builtins(p.airl),
    }
    write_policy(job.output, trainer.policy, p.airl.ppo, {"agent": "student", **origin})
    adversary.write_reward(job.output, origin)
    write_metrics(job.output, rows)


STAGE = Stage("train-airl", 1, run)
