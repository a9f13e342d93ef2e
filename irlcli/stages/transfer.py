"""A new policy, from random initialisation, on a frozen reward in an unseen setting (Sec. 5.3)."""

from contextlib import closing

import msgspec

from irlcli.errors import UsageError
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
    import torch

    from irlcli import rl
    from irlcli.checkpoints import load_reward_file
    from irlcli.irl import airl
    from irlcli.stages.actions import SeenActions
    from irlcli.stages.adversary import rollout_transitions
    from irlcli.stages.outputs import write_metrics, write_policy
    from irlcli.stages.policy_training import train_rounds

    p: Parameters = job.parameters
    model, origin = load_reward_file(job.inputs["reward"])
    ppo = p.transfer.ppo
    horizon = environment(p.env).max_episode_steps
    absorbing = origin.airl.fixed_horizon

    def reward(rollout):
        data = actions.of(rollout_transitions(rollout, slice(None), horizon))
        log_probs = torch.as_tensor(rollout.log_probs.ravel())
        g = airl.policy_reward(model, data, log_probs, "g", absorbing, ppo.gamma)
        return (g / origin.scale).numpy().reshape(rollout.terminated.shape)

    settings = [parse_setting(p.env, p.setting)]
    with closing(rl.make_worlds(p.env, settings, ppo.n_envs, job.workers)) as worlds:
        size, learned = worlds.observation_space.shape[0], origin.network.observation_size
        if size != learned:
            raise UsageError(
                f"the reward takes observations of size {learned}, those of {p.env} {p.setting} "
                f"have size {size}",
                "a goal (goal-y, direction) is part of the observation: transfer to a setting "
                "with the same kind of intervention as in training",
            )
        actions = SeenActions(origin.airl, worlds.action_space)
        trainer = rl.PPOTrainer(worlds, ppo, p.transfer.total_steps, p.seed, STAGE.name)
        rows = train_rounds(job, trainer, [p.setting], reward)
    write_policy(
        job.output,
        trainer.policy,
        ppo,
        p.env,
        agent="transfer",
        settings=(p.setting,),
        seed=p.seed,
        method=origin.method,
        reward_seed=origin.seed,
        reward_settings=origin.settings,
    )
    write_metrics(job.output, rows)


STAGE = Stage("transfer", 2, run)
