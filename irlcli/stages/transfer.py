"""A new policy, from random initialisation, on a frozen reward in an unseen setting (Sec. 5.3)."""

from contextlib import closing
from functools import partial

import msgspec

from irlcli.interventions import Setting, check_tabular, environment, parse_setting
from irlcli.settings import TransferSettings
from irlcli.stages import From, Job, Request, Source, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a transferred policy depends on, besides the reward."""

    env: str
    physics: int
    setting: str
    seed: int
    transfer: TransferSettings


def request(
    reward: Source | From,
    env: str,
    setting: Setting,
    transfer: TransferSettings,
    seed: int = 0,
    learned: str = "",
) -> Request:
    """A policy trained on ``reward`` (a ``reward.pt``) in ``setting``.

    ``learned`` says in the label how the reward was learned, so that one transfer can be told
    from another; it is no part of the identity.

    Outputs ``policy.pt``, ``policy.json`` and ``metrics.parquet``.

    Raises:
        UsageError: a tabular environment.
    """
    check_tabular(env, "transfer", wanted=False)
    parameters = Parameters(
        env=env,
        physics=environment(env).physics,
        setting=str(setting),
        seed=seed,
        transfer=transfer,
    )
    label = f"transfer {env} {setting} seed {seed}" + (f" of {learned}" if learned else "")
    return Request(STAGE, parameters, {"reward": reward}, label)


def run(job: Job) -> None:
    """Train on g / scale; the metrics report the true return, which the policy never sees."""
    from irlcli import rl
    from irlcli.stages.frozen_reward import FrozenReward
    from irlcli.stages.outputs import write_metrics, write_policy
    from irlcli.stages.policy_training import train_rounds

    p: Parameters = job.parameters
    ppo = p.transfer.ppo
    settings = [parse_setting(p.env, p.setting)]
    with closing(rl.make_worlds(p.env, settings, ppo.n_envs, job.workers)) as worlds:
        reward = FrozenReward(
            job.inputs["reward"],
            p.env,
            f"{p.env} {p.setting}",
            worlds.observation_space,
            worlds.action_space,
        )
        trainer = rl.PPOTrainer(worlds, ppo, p.transfer.total_steps, p.seed, STAGE.name)
        rows = train_rounds(job, trainer, [p.setting], partial(reward.of_steps, gamma=ppo.gamma))
    write_policy(
        job.output,
        trainer.policy,
        ppo,
        p.env,
        agent="transfer",
        settings=(p.setting,),
        seed=p.seed,
        method=reward.origin.method,
        reward_seed=reward.origin.seed,
        reward_settings=reward.origin.settings,
    )
    write_metrics(job.output, rows)


STAGE = Stage("transfer", 2, run)
