"""A retrained policy: on a frozen reward, in one setting, at first random (Sec. 5.3) or the student."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from irlcli import labels
from irlcli.configs import TransferConfig
from irlcli.configs.relevance import relevant_transfer
from irlcli.envs.registry import environment
from irlcli.errors import UsageError
from irlcli.interventions import Setting, check_tabular, parse_setting
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Source, Stage, environment_key
from irlcli.stages.running import deciding_score, frozen_reward, run_training

if TYPE_CHECKING:
    from pathlib import Path

    from irlcli.learners.frozen import FrozenReward
    from irlcli.rl.loop import Training
    from irlcli.rl.policy import Policy
    from irlcli.rl.restarts import Restarts
    from irlcli.rl.worlds import Worlds


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
    start: Source | From | None = None,
) -> Request:
    """A policy trained on ``reward`` (a ``reward.pt``) in ``setting``.

    It begins at random, or as ``start``: the ``policy.pt`` of the student that was trained while
    the reward was learned. The label names ``reward_label``: how the reward was learned. It is
    not part of the identity.

    Outputs ``policy.pt``, ``policy.json`` and ``metrics.parquet``.

    Raises:
        UsageError: a tabular environment, or an algorithm or option that does not fit its actions
            or the start.
    """
    check_tabular(env, "transfer", wanted=False)
    parameters = Parameters(
        environment=environment_key(env, [setting]),
        setting=str(setting),
        seed=seed,
        transfer=relevant_transfer(
            transfer, environment(env).discrete_actions, from_student=start is not None
        ),
    )
    label = f"transfer {env} {setting} seed {seed}"
    label += f" on the reward of {reward_label}" if reward_label else ""
    how = labels.retrained(
        transfer.algorithm, transfer.ceiling, start is not None, parameters.transfer.restarts
    )
    label += f" {how}" if how else ""
    inputs = {"reward": reward} | ({} if start is None else {"start": start})
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Train on g / scale. The true return is in the metrics only: no training or choice uses it."""
    from irlcli.data.outputs import write_policy, write_rows
    from irlcli.data.tensors import load_reward_file
    from irlcli.envs.spaces import check_spaces
    from irlcli.rl.policy import require_observations
    from irlcli.rl.restarts import Restarts
    from irlcli.rl.worlds import make_worlds

    p: Parameters = job.parameters
    env, settings = p.environment.name, [parse_setting(p.environment.name, p.setting)]
    model, origin = load_reward_file(job.inputs["reward"])
    check_spaces(env, [*(parse_setting(env, text) for text in origin.settings), *settings])
    student, config = _student(job.inputs.get("start"), p.transfer.algorithm_config)
    reward = frozen_reward(
        p.environment, p.setting, model, origin, p.transfer.ceiling, config.gamma
    )
    with closing(make_worlds(env, settings, config.n_envs, job.workers)) as worlds:
        if student is not None:
            require_observations(student, worlds.observation_space, f"{env} {p.setting}")
        training = _training(job, worlds, config, reward, student)
        rows = run_training(job, training)
    write_policy(
        job.output,
        training.policy,
        config,
        env=env,
        agent="transfer",
        settings=(p.setting,),
        seed=p.seed,
        method=origin.method,
        reward_seed=origin.seed,
        reward_settings=origin.settings,
        algorithm=p.transfer.algorithm,
        ceiling=p.transfer.ceiling,
        from_student=student is not None,
        restarts=tuple(training.scores) if isinstance(training, Restarts) else (),
    )
    write_rows(job.output / "metrics.parquet", rows)


def _training(
    job: Job, worlds: Worlds, config: Any, reward: FrozenReward, student: Policy | None
) -> Training | Restarts:
    """One training on ``reward``, or with ``transfer.restarts`` the best of several."""
    from irlcli.rl import algorithm
    from irlcli.rl.loop import Training
    from irlcli.rl.restarts import Restarts
    from irlcli.seeds import derive

    p: Parameters = job.parameters

    def begin(restart: int) -> Training:
        seed = derive(f"{STAGE.name} restart", p.seed, restart)[0] if restart else p.seed
        # Other moments of the observations would turn the student into another policy.
        kept = {} if student is None else {"keep_moments": True}
        trainer = algorithm(p.transfer.algorithm)(
            worlds, config, p.transfer.total_steps, seed, STAGE.name, **kept
        )
        if student is not None:
            trainer.policy.load_state_dict(student.state_dict())
        return Training(trainer, reward, [p.setting])

    if p.transfer.restarts is UNSET:
        return begin(0)
    until = p.transfer.restart_steps
    return Restarts(
        begin,
        p.transfer.restarts,
        partial(_learned_return, job, reward),
        None if until is UNSET else until,
    )


def _learned_return(job: Job, reward: FrozenReward, policy: Policy) -> float:
    """Mean of ``policy`` over ``transfer.restart_episodes``, which are the same for every restart."""
    from irlcli.rl.rollout import roll_out

    p: Parameters = job.parameters
    setting = parse_setting(p.environment.name, p.setting)
    count = p.transfer.restart_episodes
    # Set wherever there are restarts.
    assert not isinstance(count, UnsetType)
    job.console.progress(0, count, "episodes", {"measuring": "learned return"})
    found = roll_out(p.environment.name, setting, policy, count, p.seed, "restart score")
    return deciding_score(job, p.setting, found, reward.of_episode)


def _student(path: Path | None, config: Any) -> tuple[Policy | None, Any]:
    """The policy to start from, if any, and ``config`` with its network.

    Raises:
        UsageError: not a student.
    """
    if path is None:
        return None, config
    from irlcli.data.tensors import load_policy_file

    student, about = load_policy_file(path)
    if about.agent != "student":
        raise UsageError(
            f"the policy to start from is of the agent {about.agent}, not a student",
            "name the policy.pt beside the reward",
        )
    own = ("net_arch", "activation", "normalise_observations")
    return student, replace(config, **{name: getattr(about.network, name) for name in own})


# Policies are retrained with the PPO of the experts.
STAGE = Stage("transfer", 3, run, reads=("transfer", "expert.ppo"))
