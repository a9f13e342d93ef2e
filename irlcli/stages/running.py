"""What running stages share: resumable work, the frozen reward of a setting, and what the user sees.

Stages import this module when they are planned, so that heavy libraries are imported inside
functions only.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isnan, nan
from typing import TYPE_CHECKING, Any

from irlcli.stages.base import EnvironmentKey, Job

if TYPE_CHECKING:
    import numpy as np

    from irlcli.data.descriptions import Reward
    from irlcli.learners.frozen import FrozenReward
    from irlcli.learners.reward_model import RewardModule
    from irlcli.rl.loop import Row, Training
    from irlcli.rl.restarts import Restarts
    from irlcli.trajectories import Trajectory


def run_training(job: Job, training: "Training | Restarts") -> "list[Row]":
    """Run ``training`` from the job's last checkpoint to the end; its rows.

    Reports every round to the job's console and offers it as a checkpoint.

    Raises:
        IntegrityError: the checkpoint holds a state that does not fit this training.
    """
    from irlcli.data import tensors

    state = tensors.restore(job.checkpoints.load(), {"training", "rows"}, job.checkpoints.discard)
    if state is not None:
        with tensors.fitting(job.output.parent):
            rows = tensors.json_value(state["rows"])
            training.load_state_dict(state["training"], rows)

    def encoded() -> bytes:
        rows = tensors.json_tensor(training.rows)
        return tensors.to_bytes({"training": training.state_dict(), "rows": rows})

    def after_round(_: "Training | Restarts", newest: "list[Row]") -> None:
        _report(job, training, newest)
        first = newest[0]["round"] == 0 and not newest[0].get("restart")
        if first and all(isnan(row["true_return"]) for row in newest):
            job.console.warn(
                "no episode ended in the first round, and every round starts new ones, so the later steps "
                "of an episode are never trained on: raise n_steps or, for PPO, rollouts_per_round"
            )
        job.checkpoints.offer(encoded)

    rows = training.run(after_round, job.console.warn)
    if training.steps < training.planned_steps:
        done = f"{training.steps:,} of {training.planned_steps:,} steps"
        job.console.progress(training.steps, training.steps, "steps", {"ended after": done})
    return rows


def run_parts(
    job: Job, parts: Sequence[Any], rows: Callable[[Any], list[dict[str, Any]]], unit: str
) -> list[dict[str, Any]]:
    """The rows of each of ``parts``, one part after the other, from the job's last checkpoint on.

    Rows hold numbers and text. Every part is reported to the job's console.

    Raises:
        IntegrityError: the checkpoint holds something else.
    """
    from irlcli.data import tensors

    state = tensors.restore(job.checkpoints.load(), {"rows"}, job.checkpoints.discard)
    with tensors.fitting(job.output.parent):
        done = [] if state is None else tensors.json_value(state["rows"])

    def encoded() -> bytes:
        return tensors.to_bytes({"rows": tensors.json_tensor(done)})

    for part in parts[len(done) :]:
        done.append(rows(part))
        job.console.progress(len(done), len(parts), unit, {})
        job.checkpoints.offer(encoded)
    return [row for found in done for row in found]


def frozen_reward(
    where: EnvironmentKey,
    setting: str,
    model: "RewardModule",
    origin: "Reward",
    ceiling: float | None = None,
    gamma: float | None = None,
) -> "FrozenReward":
    """The reward that was read from a ``reward.pt``, as it scores episodes in ``setting``.

    ``gamma`` is the discount of a policy that is trained on it; by default that of its shaping.

    Raises:
        UsageError: the reward takes other observations or actions.
    """
    from contextlib import closing

    from irlcli.envs.registration import make
    from irlcli.interventions import parse_setting
    from irlcli.learners.frozen import FrozenReward
    from irlcli.rl.worlds import action_space, observation_size

    with closing(make(where.name, parse_setting(where.name, setting))) as world:
        return FrozenReward(
            model,
            origin,
            horizon=where.max_episode_steps,
            gamma=origin.network.gamma if gamma is None else gamma,
            where=f"{where.name} {setting}",
            observation_size=observation_size(world.observation_space),
            actions=action_space(world.action_space),
            ceiling=ceiling,
        )


def deciding_score(
    job: Job,
    setting: str,
    episodes: "Sequence[Trajectory]",
    score: "Callable[[Trajectory], float]",
) -> float:
    """Mean ``score`` of a policy's ``episodes``, by which it is kept or not. Errors are named."""
    import numpy as np

    from irlcli.trajectories import counted

    job.warn_of_errors(setting, episodes)
    return float(np.mean([score(episode) for episode in counted(episodes)]))


def warn_of_labels(job: Job, counts: Sequence[int]) -> None:
    """Warn if shuffled labels still tell settings with ``counts`` [E] demonstrations apart."""
    from irlcli.learners.grouping import hides_settings

    if not hides_settings(counts):
        job.console.warn(
            "shuffled labels still reveal the settings, so this is not a valid control: one setting "
            f"has too few demonstrations ({min(counts)}) for {len(counts)} groups"
        )


def warn_of_failures(
    job: Job, settings: Mapping[str, "Sequence[Trajectory]"], deterministic: bool | None
) -> None:
    """Warn of demonstrations that end early and earn less than those of the setting that do not.

    The absorbing states after such an end count as the expert's, so a reward may score them highly.
    ``deterministic``: whether they are the expert's most likely actions, or samples; None: unknown.
    """
    import numpy as np

    other_kind = ""
    if deterministic is not None:
        other = "false" if deterministic else "true"
        other_kind = (
            f"; see whether fewer do with --set demonstrations.deterministic={other}, or leave them out "
            "with --set demonstrations.full_length=true"
        )
    for text, episodes in settings.items():
        early, others = (
            [t.episode_return for t in episodes if t.terminated == ended] for ended in (True, False)
        )
        if early and others and np.mean(early) < np.mean(others):
            job.console.warn(
                f"{len(early)} of {len(episodes)} demonstrations in {text} end early and earn less than "
                "the others: a reward may score absorbing states after such ends highly"
                + other_kind
            )


def warn_of_shared_ends(job: Job, settings: Mapping[str, "Sequence[Trajectory]"]) -> None:
    """Warn if demonstrations end early although all absorbing states are one (``shared_absorbing``)."""
    for text, episodes in settings.items():
        if early := sum(t.terminated for t in episodes):
            job.console.warn(
                f"{early} of {len(episodes)} demonstrations in {text} end early: with "
                "airl.shared_absorbing the reward cannot tell these ends, a landing for example, from a "
                "fall; if they are no falls, --set airl.shared_absorbing=none, otherwise leave them out "
                "with --set demonstrations.full_length=true"
            )


def shown(true_return: float, progress: float | None) -> str:
    """A true return for the user, with the environment's progress if it reports one."""
    if isnan(true_return):
        return "no episode has ended"
    no_progress = progress is None or isnan(progress)
    return f"return {true_return:z.0f}" + ("" if no_progress else f" progress {progress:z.0f}")


def summary_of(setting: str, trajectories: "Sequence[Trajectory]") -> dict[str, Any]:
    """The means of ``trajectories`` in one setting, as ``summary.json`` has them."""
    import numpy as np

    returns = np.array([t.episode_return for t in trajectories])
    lengths = np.array([len(t) for t in trajectories])
    return means_of(setting, returns, lengths, float(np.mean([t.progress for t in trajectories])))


def means_of(
    setting: str, returns: "np.ndarray | None", lengths: "np.ndarray", progress: float = nan
) -> dict[str, Any]:
    """The means over episodes in one setting. ``returns`` are None where they are unknown."""
    several = len(lengths) > 1
    return {
        "setting": setting,
        "episodes": len(lengths),
        "mean_return": None if returns is None else float(returns.mean()),
        "std_return": float(returns.std(ddof=1)) if returns is not None and several else None,
        "mean_progress": None if isnan(progress) else progress,
        "mean_length": float(lengths.mean()),
    }


def _report(job: Job, training: "Training | Restarts", newest: "list[Row]") -> None:
    facts = {row["setting"]: shown(row["true_return"], row["progress"]) for row in newest}
    if "restart" in newest[0]:
        facts["restart"] = str(newest[0]["restart"] + 1)
    if "accuracy" in newest[0]:
        accuracy = sum(row["accuracy"] for row in newest) / len(newest)
        facts["discriminator"] = f"accuracy {accuracy:.2f}"
    if "challenger_return" in newest[0]:
        # In the order of the settings.
        returns = [row["challenger_return"] for row in newest]
        facts["challenger"] = "return " + ", ".join(
            "-" if isnan(r) else f"{r:.0f}" for r in returns
        )
    job.console.progress(training.steps, training.planned_steps, "steps", facts)
    scalars = {
        f"{row['setting']}/{name}": float(value)
        for row in newest
        for name, value in row.items()
        if name not in ("restart", "round", "steps", "setting")
    }
    job.console.scalars(training.steps, scalars)
