"""The tasks of results that have no rows: Figure 2 and the exact positive controls."""

from irlcli.configs.load import CONTROL, unseen_settings
from irlcli.experiments.rows import Task, made_by
from irlcli.experiments.variants import ConfigOf
from irlcli.interventions import parse_settings
from irlcli.stages import control, figure2
from irlcli.stages.base import Request


def gridworld_figure(config_of: ConfigOf) -> tuple[list[Task], Request]:
    """The datasets and the sweep of Figure 2, and the figure itself."""
    env = "gridworld"
    config = config_of(env, None)
    trained = parse_settings(env, f"path-group={','.join(config.interventions['path-group'].id)}")
    unseen = unseen_settings(env, config)
    figure = figure2.request(env, trained, unseen, config)
    sweep = made_by(figure.inputs["sweep"])
    tasks = [
        Task(f"figure2.demos.{demos.parameters.seed}", "demos", demos)
        for demos in map(made_by, sweep.inputs.values())
    ]
    return [*tasks, Task("figure2.sweep", "rewards", sweep)], figure


def controls(config_of: ConfigOf) -> tuple[list[Task], Request]:
    """The parts of the positive controls, and their report."""
    report = control.request(config_of(CONTROL, None).control)
    tasks = [
        Task(f"control.{name}", "rewards", made_by(part)) for name, part in report.inputs.items()
    ]
    return tasks, report
