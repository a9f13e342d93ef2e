"""Paper Fig. 2 from a sweep: the pictures of one dataset, the numbers of all."""

from collections.abc import Sequence

import msgspec

from irlcli.configs import Config
from irlcli.interventions import Setting
from irlcli.stages import sweep_maxent
from irlcli.stages.base import From, Job, Request, Stage


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """What the figure depends on, besides the sweep; ``seed`` is the dataset that is drawn."""

    env: str
    settings: tuple[str, ...]
    unseen: tuple[str, ...]
    seed: int


def request(
    env: str, settings_: Sequence[Setting], unseen: Sequence[Setting], config: Config
) -> Request:
    """Outputs ``figure2.png``, ``.pdf``, ``.csv`` (every measure) and ``.md`` (the table).

    Raises:
        UsageError: as :func:`irlcli.stages.sweep_maxent.request`.
    """
    sweep = sweep_maxent.request(env, settings_, unseen, config)
    drawn = sweep_maxent.datasets(env, settings_, config)[0]
    parameters = Parameters(
        env=env,
        settings=sweep.parameters.settings,
        unseen=sweep.parameters.unseen,
        seed=drawn.parameters.seed,
    )
    inputs = {"sweep": From(sweep), "demonstrations": From(drawn)}
    return Request(STAGE, parameters, inputs, f"figure2 {env}")


def run(job: Job) -> None:
    """Draw; nothing is fitted here."""
    import numpy as np
    import pandas as pd

    from irlcli import tabular
    from irlcli.envs.gridworld import tasks as gridworlds
    from irlcli.envs.gridworld.env import walls
    from irlcli.interventions import env_kwargs, parse_setting
    from irlcli.report import figure2, tables

    p: Parameters = job.parameters
    grid, dataset = gridworlds.read(job.inputs["demonstrations"], p.env, p.settings)
    rewards = pd.read_parquet(job.inputs["sweep"] / "rewards.parquet")
    rewards = rewards[rewards["seed"] == p.seed].set_index("variant")["reward"]
    quality = pd.read_parquet(job.inputs["sweep"] / "quality.parquet")
    found = figure2.summary(quality)
    seen, unseen = (gridworlds.stacked(texts, grid) for texts in (p.settings, p.unseen))
    demos = gridworlds.indexed(seen, list(dataset.trajectories.values()), grid)

    def route(policy, e):
        """Where the optimal policy leads if no move slips, one way of those equally good."""
        mdp, state, states = unseen.mdps[e], 0, [0]
        for t in range(grid.horizon):
            after = mdp.afterstate[policy[t, :, e, state, 0].argmax(), state]
            state = int(mdp.successor[after, 0])
            states.append(state)
        return np.array(states)

    def panel(variant, title):
        reward = np.asarray(rewards[variant])
        policy, _ = tabular.optimal_policy(unseen, reward[None], grid.horizon)
        return figure2.Panel(title, reward, {u: route(policy, e) for e, u in enumerate(p.unseen)})

    def wall(texts):
        return {
            text: walls(grid.size, **env_kwargs(p.env, parse_setting(p.env, text)))
            for text in texts
        }

    l2 = sweep_maxent.PAPER_L2
    panels = [
        panel("erm", "ERM"),
        panel(f"erm l2 {l2:g}", f"ERM + L2 {l2:g}"),
        panel("erm-balanced", "ERM-balanced"),
    ]
    panels += [
        panel(f"irm {kind} {weight:g}", f"IRM {kind}, $\\lambda$ = {weight:g}")
        for kind in sweep_maxent.PENALTIES
        for weight in sweep_maxent.PAPER_PENALTY_WEIGHTS
    ]
    paths = dict(zip(p.settings, demos.states, strict=True))
    maze = figure2.Maze(grid.size, paths, wall(p.settings), wall(p.unseen))
    figure2.draw(job.output, maze, panels, found, figure2.curves(quality), p.seed)
    found.to_csv(job.output / "figure2.csv", index=False, float_format="%.6g", lineterminator="\n")
    text = tables.markdown_table(*figure2.table(found, p.unseen))
    (job.output / "figure2.md").write_text(text)


STAGE = Stage("figure2", 2, run)
