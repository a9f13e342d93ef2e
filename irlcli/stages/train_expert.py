"""The expert of one setting: PPO on the true reward. Trained once, shared by every dataset."""

from contextlib import closing

import msgspec

from irlcli.configs import Config, ExpertConfig, PPOConfig
from irlcli.configs.relevance import check_rate, relevant_ppo
from irlcli.envs.registry import environment
from irlcli.interventions import Setting, check_tabular, parse_setting, without_cue
from irlcli.stages.base import EnvironmentKey, Job, Request, Stage, environment_key
from irlcli.stages.running import run_training


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What an expert depends on."""

    environment: EnvironmentKey
    setting: str
    seed: int
    total_steps: int
    ppo: PPOConfig


def request(env: str, setting: Setting, seed: int, expert: ExpertConfig) -> Request:
    """The expert of ``setting``: outputs ``policy.pt``, ``policy.json``, ``metrics.parquet``.

    Raises:
        UsageError: a tabular environment, an option that needs continuous actions, or a budget
            that leaves no update.
    """
    check_tabular(env, "train-expert", wanted=False)
    parameters = Parameters(
        environment=environment_key(env, [setting]),
        setting=str(setting),
        seed=seed,
        total_steps=expert.total_steps,
        ppo=relevant_ppo(expert.ppo, environment(env).discrete_actions, "expert.ppo"),
    )
    check_rate(expert.ppo, expert.total_steps, "expert.total_steps", "expert.ppo")
    return Request(STAGE, parameters, {}, f"train-expert {env} {setting} seed {seed}")


def demonstrator(env: str, setting: Setting, config: Config) -> Request:
    """The expert that demonstrates in ``setting``: that of the same setting without a cue.

    Raises:
        UsageError: as :func:`request`.
    """
    own = without_cue(env, setting)
    return request(env, own, 0, config.expert_of(own))


def run(job: Job) -> None:
    """Train; the metrics hold one row per round with the true return of the ended episodes."""
    from irlcli.data.outputs import write_policy, write_rows
    from irlcli.rl.loop import Training
    from irlcli.rl.ppo import PPOTrainer, TrueReward
    from irlcli.rl.worlds import make_worlds

    p: Parameters = job.parameters
    env = p.environment.name
    settings = [parse_setting(env, p.setting)]
    with closing(make_worlds(env, settings, p.ppo.n_envs, job.workers)) as worlds:
        trainer = PPOTrainer(worlds, p.ppo, p.total_steps, p.seed, STAGE.name)
        training = Training(trainer, TrueReward(), [p.setting])
        rows = run_training(job, training)
    write_policy(
        job.output,
        trainer.policy,
        p.ppo,
        env=env,
        agent="expert",
        settings=(p.setting,),
        seed=p.seed,
    )
    write_rows(job.output / "metrics.parquet", rows)


STAGE = Stage("train-expert", 2, run, reads=("expert",))
