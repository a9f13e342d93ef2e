"""Expert of one setting: PPO on the true reward. Trained once, shared by every dataset."""

from contextlib import closing

import msgspec

from irlcli.interventions import Setting, check_tabular, environment
from irlcli.settings import ExpertSettings, PPOSettings
from irlcli.stages import Job, Request, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What an expert depends on."""

    env: str
    physics: int
    setting: str
    seed: int
    total_steps: int
    ppo: PPOSettings


def request(env: str, setting: Setting, seed: int, expert: ExpertSettings) -> Request:
    """The expert of ``setting``: outputs ``policy.pt``, ``policy.json``, ``metrics.parquet``.

    Raises:
        UsageError: a tabular environment.
    """
    check_tabular(env, "train-expert", wanted=False)
    parameters = Parameters(
        env=env,
        physics=environment(env).physics,
        setting=str(setting),
        seed=seed,
        total_steps=expert.total_steps,
        ppo=expert.ppo,
    )
    return Request(STAGE, parameters, {}, f"train-expert {env} {setting} seed {seed}")


def run(job: Job) -> None:
    """Train; the metrics hold one row per round with the true return of the episodes ended."""
    from irlcli import rl
    from irlcli.interventions import parse_setting
    from irlcli.stages.outputs import write_metrics, write_policy
    from irlcli.stages.policy_training import train_rounds

    p: Parameters = job.parameters
    settings = [parse_setting(p.env, p.setting)]
    with closing(rl.make_worlds(p.env, settings, p.ppo.n_envs, job.workers)) as worlds:
        trainer = rl.PPOTrainer(worlds, p.ppo, p.total_steps, p.seed, STAGE.name)
        rows = train_rounds(job, trainer, [p.setting])
    write_policy(
        job.output,
        trainer.policy,
        p.ppo,
        p.env,
        agent="expert",
        settings=(p.setting,),
        seed=p.seed,
    )
    write_metrics(job.output, rows)


STAGE = Stage("train-expert", 2, run)
