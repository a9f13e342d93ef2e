"""Paper Fig. 2 from a sweep: pictures of one dataset's rewards, numbers from all datasets."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from irlcli.configs import Config, MaxEntConfig
from irlcli.interventions import Setting
from irlcli.stages import sweep_maxent
from irlcli.stages.base import EnvironmentKey, From, Job, Request, Stage
from irlcli.stages.sweep_maxent import (
    FIGURE2_PENALTIES,
    PAPER_L2,
    PAPER_PENALTY_WEIGHTS,
    SweepVariant,
)
from irlcli.stages.train_maxent import indexed, read_gridworld


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the figure depends on, besides the sweep.

    ``seed`` is the dataset that is drawn, ``shared`` the sweep's hyperparameters, for the caption.
    """

    environment: EnvironmentKey
    settings: tuple[str, ...]
    unseen: tuple[str, ...]
    seed: int
    shared: MaxEntConfig


def request(
    env: str, settings: Sequence[Setting], unseen: Sequence[Setting], config: Config
) -> Request:
    """Outputs ``figure2.png``, ``.pdf``, ``.csv`` (every measure), ``differences.csv`` and ``README.md``.

    Raises:
        UsageError: as :func:`irlcli.stages.sweep_maxent.request`.
    """
    sweep = sweep_maxent.request(env, settings, unseen, config)
    p: sweep_maxent.Parameters = sweep.parameters
    seed = p.seeds[0]
    parameters = Parameters(
        environment=p.environment,
        settings=p.settings,
        unseen=p.unseen,
        seed=seed,
        shared=p.shared,
    )
    inputs = {"sweep": From(sweep), "demonstrations": sweep.inputs[f"demonstrations {seed}"]}
    return Request(STAGE, parameters, inputs, f"figure2 {env}")


def panels() -> list[tuple[SweepVariant, str]]:
    """The variants whose rewards are drawn, with their titles."""
    drawn = [
        (SweepVariant(grouping="pooled"), "ERM"),
        (SweepVariant(grouping="pooled", l2=PAPER_L2), f"ERM + L2 {PAPER_L2:g}"),
        (SweepVariant(grouping="balanced"), "ERM-balanced"),
    ]
    for penalty in FIGURE2_PENALTIES:
        for weight in PAPER_PENALTY_WEIGHTS:
            variant = SweepVariant(grouping="per-setting", penalty=penalty, penalty_weight=weight)
            drawn.append((variant, f"IRM {penalty}, $\\lambda$ = {weight:g}"))
    return drawn


def run(job: Job) -> None:
    """Summarise the sweep and draw; nothing is fitted here."""
    import numpy as np
    import pandas as pd

    from irlcli.data.outputs import write_csv
    from irlcli.envs.gridworld import tasks
    from irlcli.envs.gridworld.env import walls
    from irlcli.interventions import env_kwargs, parse_setting
    from irlcli.report import figure2
    from irlcli.tabular import backward, intended_path

    p: Parameters = job.parameters
    env = p.environment.name
    grid, episodes = read_gridworld(job.inputs["demonstrations"], env, p.settings)
    rewards = pd.read_parquet(job.inputs["sweep"] / "rewards.parquet")
    rewards = rewards[rewards["seed"] == p.seed].set_index("variant")["reward"]
    quality = pd.read_parquet(job.inputs["sweep"] / "quality.parquet")
    summary = figure2.summary(quality)
    seen, unseen = (tasks.stacked(texts, grid) for texts in (p.settings, p.unseen))
    demos = indexed(seen, episodes, grid)

    def panel(variant: SweepVariant, title: str) -> figure2.Panel:
        reward = np.asarray(rewards[str(variant)])
        policy, _ = backward(unseen, reward[None], grid.horizon)
        routes = {
            text: intended_path(mdp, policy[:, :, e, :, 0])
            for e, (text, mdp) in enumerate(zip(p.unseen, unseen.mdps, strict=True))
        }
        return figure2.Panel(title, reward, routes)

    def wall(texts: Sequence[str]) -> dict[str, np.ndarray]:
        return {
            text: walls(grid.size, **env_kwargs(env, parse_setting(env, text))) for text in texts
        }

    paths = dict(zip(p.settings, demos.states, strict=True))
    maze = figure2.Maze(grid.size, paths, wall(p.settings), wall(p.unseen))
    drawn = [panel(variant, title) for variant, title in panels()]
    figure2.draw(job.output, maze, drawn, summary, figure2.curves(quality), p.seed)
    write_csv(job.output / "figure2.csv", summary)
    differences = figure2.differences(quality, p.unseen)
    write_csv(job.output / "differences.csv", differences)
    m = p.shared
    warmup = m.penalty_warmup_iterations
    facts = [
        f"Datasets: {summary['datasets'].iloc[0]}, seeds from {p.seed}, each with "
        + ", ".join(f"{len(group)} episodes in {t}" for t, group in paths.items()),
        f"Gridworld: size {grid.size}, horizon {grid.horizon}, {grid.goal} goal, "
        f"slip probability {grid.p_slip:g}",
        f"Reward: {m.features}, of {m.inputs} inputs"
        + (f", {m.hidden} hidden units" if m.features == "learned" else ""),
        f"Fit: {m.iterations} iterations of RMSProp at learning rate {m.learning_rate:g}"
        + (f", the first {warmup} at lambda 0" if warmup else ""),
    ]
    (job.output / "README.md").write_text(
        figure2.page(summary, differences, p.unseen, facts), encoding="utf-8"
    )


STAGE = Stage("figure2", 5, run)
