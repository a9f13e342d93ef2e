"""Adversarial IRL from demonstrations: ERM, ERM-balanced or IRM (paper Algorithm 1)."""

from collections.abc import Sequence
from contextlib import closing

import msgspec

from irlcli.errors import IntegrityError, UsageError
from irlcli.interventions import Setting, check_tabular, environment, parse_setting
from irlcli.settings import PENALISED, AIRLSettings
from irlcli.stages import From, Job, Request, Source, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a learned reward depends on, besides its demonstrations."""

    env: str
    physics: int
    settings: tuple[str, ...]
    seed: int
    airl: AIRLSettings


def request(
    demos: Source | From,
    env: str,
    settings_: Sequence[Setting],
    airl: AIRLSettings,
    seed: int = 0,
) -> Request:
    """A reward and a student policy learned from ``demos``, recorded in ``settings_`` of ``env``.

    Outputs ``reward.pt``, ``policy.pt`` (the student), their descriptions as JSON, and
    ``metrics.parquet`` with one row per round and setting.

    Raises:
        UsageError: a tabular environment, gSDE, or worlds that the settings cannot share equally.
    """
    check_tabular(env, "train-airl", wanted=False)
    if airl.ppo.use_sde:
        raise UsageError(
            "airl.ppo.use_sde: AIRL needs log pi(a|s) of the action taken, and gSDE's noise "
            "outlasts a step",
            "leave it unset; airl.ppo.log_std_init sets how much the policy explores",
        )
    texts = tuple(str(s) for s in settings_)
    if airl.ppo.n_envs % len(texts):
        raise UsageError(
            f"{airl.ppo.n_envs} worlds cannot be shared equally by {len(texts)} settings",
            f"--set airl.ppo.n_envs to a multiple of {len(texts)}",
        )
    if airl.method not in PENALISED:
        # What does not enter the loss is no part of the identity.
        airl = msgspec.structs.replace(
            airl, penalty_weight=0.0, penalty_warmup_rounds=0, penalty_ramp_rounds=0
        )
    parameters = Parameters(
        env=env, physics=environment(env).physics, settings=texts, seed=seed, airl=airl
    )
    label = f"train-airl {airl.method} {env} {', '.join(texts)} seed {seed}"
    return Request(STAGE, parameters, {"demonstrations": demos}, label)


def run(job: Job) -> None:
    """Alternate policy rounds and discriminator rounds, all settings together."""
    from irlcli import rl
    from irlcli.dataset import read_demonstrations
    from irlcli.stages.adversary import Adversary
    from irlcli.stages.outputs import write_metrics, write_policy
    from irlcli.stages.policy_training import train_rounds

    p: Parameters = job.parameters
    demos = read_demonstrations(job.inputs["demonstrations"])
    settings = list(p.settings)
    if demos.env != p.env or list(demos.trajectories) != settings:
        raise IntegrityError(
            f"the demonstrations are of {demos.env} {', '.join(demos.trajectories)}, not of "
            f"{p.env} {', '.join(settings)}"
        )
    parsed = [parse_setting(demos.env, s) for s in settings]
    with closing(rl.make_worlds(demos.env, parsed, p.airl.ppo.n_envs, job.workers)) as worlds:
        trainer = rl.PPOTrainer(worlds, p.airl.ppo, p.airl.total_steps, p.seed, STAGE.name)
        adversary = Adversary(demos, p.airl, worlds, p.seed)
        rows = train_rounds(job, trainer, settings, adversary=adversary)
    origin = {"settings": p.settings, "method": p.airl.method, "seed": p.seed}
    write_policy(job.output, trainer.policy, p.airl.ppo, p.env, agent="student", **origin)
    adversary.write_reward(job.output, env=p.env, airl=p.airl, **origin)
    write_metrics(job.output, rows)


STAGE = Stage("train-airl", 2, run)
