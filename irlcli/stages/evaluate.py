"""Return of a policy over whole episodes, true and by a learned reward, in its settings or others."""

from collections.abc import Sequence
from contextlib import closing
from typing import Literal

import msgspec

from irlcli.errors import UsageError
from irlcli.interventions import Setting, check_tabular, environment, parse_setting
from irlcli.settings import EvaluationSettings
from irlcli.stages import From, Job, Request, Source, Stage

Agent = Literal["policy", "random", "idle"]


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What an evaluation depends on, besides the policy and the reward."""

    env: str
    physics: int
    settings: tuple[str, ...]
    agent: Agent
    seed: int
    evaluation: EvaluationSettings


def request(
    env: str,
    settings_: Sequence[Setting],
    evaluation: EvaluationSettings,
    policy: Source | From | None = None,
    agent: Agent = "policy",
    seed: int = 0,
    who: str = "",
    reward: Source | From | None = None,
    learned: str = "",
) -> Request:
    """Episodes of ``policy`` (a ``policy.pt``), or of the random or idle agent, in ``settings_``.

    With ``reward``, a ``reward.pt``, also what that would pay. ``who`` says in the label whose
    policy it is, ``learned`` how the reward was learned; they are no part of the identity.
    Outputs ``episodes.parquet`` (a row per episode) and ``summary.json``.

    Raises:
        UsageError: a tabular environment, or a policy missing or too many.
    """
    check_tabular(env, "evaluate", wanted=False)
    if (agent == "policy") != (policy is not None):
        raise UsageError(
            f"agent {agent!r} {'needs a' if policy is None else 'takes no'} policy",
            "give a policy, or name the random or the idle agent",
        )
    texts = tuple(str(s) for s in settings_)
    parameters = Parameters(
        env=env,
        physics=environment(env).physics,
        settings=texts,
        agent=agent,
        seed=seed,
        evaluation=evaluation,
    )
    inputs = {"policy": policy, "reward": reward}
    inputs = {role: source for role, source in inputs.items() if source is not None}
    label = f"evaluate {who or agent} in {env} {', '.join(texts)} seed {seed}"
    label += f" by the reward of {learned}" if reward is not None else ""
    return Request(STAGE, parameters, inputs, label)


def run(job: Job) -> None:
    """Roll out; episode k starts from the same state for every agent and in every method."""
    import numpy as np
    import pyarrow as pa

    from irlcli import envs, rl
    from irlcli.checkpoints import load_policy_file
    from irlcli.dataset import write_table
    from irlcli.stages.frozen_reward import FrozenReward
    from irlcli.stages.outputs import shown, warn_of_errors, write_json

    p: Parameters = job.parameters
    policy, subject = p.agent, {"agent": p.agent, "env": p.env}
    if "policy" in job.inputs:
        policy, origin = load_policy_file(job.inputs["policy"])
        subject = msgspec.to_builtins(origin)
        del subject["network"]
    rows, summary, said = [], [], {"policy": subject}
    for index, text in enumerate(p.settings):
        setting, reward = parse_setting(p.env, text), None
        if "reward" in job.inputs:
            with closing(envs.make(p.env, setting)) as world:
                spaces = world.observation_space, world.action_space
            reward = FrozenReward(job.inputs["reward"], p.env, f"{p.env} {text}", *spaces)
        trajectories = rl.roll_out(
            p.env,
            setting,
            policy,
            p.evaluation.episodes,
            p.seed,
            STAGE.name,
            p.evaluation.deterministic,
        )
        warn_of_errors(job, text, trajectories)
        progress = float(np.mean([t.progress for t in trajectories]))
        rows += [
            {
                "setting": text,
                "episode": k,
                "seed": t.seed,
                "true_return": t.episode_return,
                "progress": t.progress,
                "length": len(t),
                "terminated": t.terminated,
            }
            for k, t in enumerate(trajectories)
        ]
        returns = np.array([t.episode_return for t in trajectories])
        summary.append(
            {
                "setting": text,
                "episodes": len(returns),
                "mean_return": float(returns.mean()),
                "std_return": float(returns.std(ddof=1)) if len(returns) > 1 else None,
                "mean_progress": None if np.isnan(progress) else progress,
                "mean_length": float(np.mean([len(t) for t in trajectories])),
                "terminated": float(np.mean([t.terminated for t in trajectories])),
            }
        )
        if reward is not None:
            learned = [reward.of_episode(t) for t in trajectories]
            for row, value in zip(rows[-len(learned) :], learned, strict=True):
                row["learned_return"] = value
            summary[-1]["mean_learned_return"] = float(np.mean(learned))
            about = {name: getattr(reward.origin, name) for name in ("method", "seed", "settings")}
            said["reward"] = about
        job.console.progress(
            index + 1, len(p.settings), "settings", {text: shown(returns.mean(), progress)}
        )
    write_table(pa.Table.from_pylist(rows), job.output / "episodes.parquet")
    write_json(job.output / "summary.json", said | {"settings": summary})


STAGE = Stage("evaluate", 3, run)
