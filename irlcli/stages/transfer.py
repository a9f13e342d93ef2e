"""A retrained policy: from random initialisation, on a frozen reward, in one setting (Sec. 5.3)."""

from contextlib import closing

import msgspec

from irlcli.configs import TransferConfig
from irlcli.configs.relevance import relevant_transfer
from irlcli.envs.registry import environment
from irlcli.interventions import Setting, check_tabular, parse_setting
from irlcli.stages.base import (
    EnvironmentKey,
    From,
    Job,
    Request,
    Source,
    Stage,
    environment_key,
    run_training,
)


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a retrained policy depends on, besides the reward."""

    environment: EnvironmentKey
    setting: str
    seed: int
    transfer: TransferConfig


def request(
    reward: Source | From,
    env: str,
    setting: Setting,
    transfer: TransferConfig,
    seed: int = 0,
    reward_label: str = "",
) -> Request:
    """A policy trained on ``reward`` (a ``reward.pt``) in ``setting``.

    ``reward_label`` tells in the label how the reward was learned. It is not part of the identity.

    Outputs ``policy.pt``, ``policy.json`` and ``metrics.parquet``.

    Raises:
        UsageError: a tabular environment, or an option that does not fit its actions.
    """
    check_tabular(env, "transfer", wanted=False)
    parameters = Parameters(
        environment=environment_key(env),
        setting=str(setting),
        seed=seed,
        transfer=relevant_transfer(transfer, environment(env).discrete_actions),
    )
    label = f"transfer {env} {setting} seed {seed}"
    label += f" on the reward of {reward_label}" if reward_label else ""
    return Request(STAGE, parameters, {"reward": reward}, label)


def run(job: Job) -> None:
    """Train on g / scale. The metrics report the true return, which the policy never sees."""
    from irlcli.data.outputs import write_metrics, write_policy
    from irlcli.data.tensors import load_reward_file
    from irlcli.learners.frozen import FrozenReward
    from irlcli.rl import algorithm
    from irlcli.rl.loop import LastRound, NoLearner, Training
    from irlcli.rl.worlds import action_space, make_worlds, observation_size

    p: Parameters = job.parameters
    env, ppo = p.environment.name, p.transfer.ppo
    settings = [parse_setting(env, p.setting)]
    model, origin = load_reward_file(job.inputs["reward"])
    with closing(make_worlds(env, settings, ppo.n_envs, job.workers)) as worlds:
        reward = FrozenReward(
            model,
            origin,
            horizon=p.environment.max_episode_steps,
            gamma=ppo.gamma,
            where=f"{env} {p.setting}",
            observation_size=observation_size(worlds.observation_space),
            actions=action_space(worlds.action_space),
        )
        trainer = algorithm(p.transfer.algorithm)(
            worlds, ppo, p.transfer.total_steps, p.seed, STAGE.name
        )
        training = Training(trainer, reward, NoLearner(1), LastRound(), [p.setting])
        rows = run_training(job, training)
    write_policy(
        job.output,
        trainer.policy,
        ppo,
        env=env,
        agent="transfer",
        settings=(p.setting,),
        seed=p.seed,
        method=origin.method,
        reward_seed=origin.seed,
        reward_settings=origin.settings,
    )
    write_metrics(job.output, rows)


STAGE = Stage("transfer", 2, run)
