"""Parameters and points of a report on two LunarLander rows, made up for the tests beside."""

import pandas as pd

from irlcli.report.build import build
from irlcli.report.parameters import EXPERT_BY_REWARD, Cell, Code, Parameters, Row, Run

BOUNCE, POWER = "lunar-lander bounce", "lunar-lander engine-power"
CONFIG = {
    "expert": {"total_steps": 1000},
    "demonstrations": {"episodes": 20},
    "airl": {"total_steps": 2000, "penalty_weight": 1.0, "select": "last"},
    "transfer": {"total_steps": 3000, "from_student": {"total_steps": 400}},
    "evaluation": {"episodes": 20},
}
ROWS = tuple(
    Row(
        env="lunar-lander",
        knob=knob,
        trained=tuple(f"{knob}={v}" for v in trained),
        unseen=f"{knob}={unseen}",
        demonstrations=(20, 20),
        config=CONFIG,
    )
    for knob, trained, unseen in (
        ("bounce", ("0.1", "0.5"), "0.9"),
        ("engine-power", ("1x", "1.25x"), "1.5x"),
    )
)
BASELINES = ("expert", "random", "idle", "reused")


def run_of(number, stage="evaluate", commit="c0ffee", dirty=None, libraries="lib", inputs=()):
    return Run(
        stage=stage,
        about=f"run {number}",
        code=(Code(commit=commit, dirty=dirty),),
        libraries=libraries,
        seconds=90.0,
        resumed=0,
        inputs=inputs,
    )


def example(values, **more):
    """Parameters and points; ``values`` maps (row, agent, measure) to a return for each seed."""
    cells, points, runs = [], [], {}
    for (row, agent, measure), returns in values.items():
        for index, value in enumerate(returns):
            seed = None if agent in BASELINES else index
            id16 = "" if value is None else f"{len(runs):016x}"
            why = "no result of train-airl" if value is None else ""
            cells.append(Cell(row, agent, measure, seed, run=id16, why=why))
            if id16:
                runs[id16] = run_of(len(runs))
                points.append(
                    {
                        "row": row,
                        "agent": agent,
                        "measure": measure,
                        "seed": seed,
                        "retraining": 0,
                        "setting": "bounce=0.9",
                        "true_return": value,
                        "progress": None,
                        "learned_return": None,
                        "regret_error": None,
                        "gap_error": None,
                        "episodes": 20,
                        "stopped": 0,
                        "evaluation": id16,
                        "demonstrations": "",
                    }
                )
    given = {
        "rows": ROWS,
        "measures": ("transfer", "zero-shot", "id"),
        "methods": ("erm", "irm"),
        "seeds": (0, 1, 2),
        "others": (),
    } | more
    p = Parameters(
        kind="table1",
        title="Table 1",
        command="irl report table1",
        cells=tuple(cells),
        runs=runs,
        libraries={"lib": {"numpy": "2"}},
        **given,
    )
    return p, pd.DataFrame(points)


def complete(student=200.0):
    """Returns of every cell; ``student`` is ERM's in distribution, where experts earn 250."""
    values = {}
    for row in (BOUNCE, POWER):
        values |= {
            (row, "expert", "ood"): [250.0],
            (row, "random", "ood"): [-200.0],
            (row, "idle", "ood"): [-120.0],
            (row, "expert", "id"): [250.0],
            (row, "reused", "ood"): [90.0, 130.0],
            (row, "reused", "id"): [200.0, 300.0],
            (row, "erm", "id"): [student - 1, student, student + 1],
            (row, "irm", "id"): [240.0, 241.0, 242.0],
            (row, "erm", "zero-shot"): [100.0, 110.0, 120.0],
            (row, "irm", "zero-shot"): [150.0, 160.0, 175.0],
            (row, "erm", "transfer"): [1.0, 2.0, 3.0],
            (row, "irm", "transfer"): [2.0, 3.0, 7.0],
        }
    return values


def scored(pairs_by_method):
    """The report on :func:`complete` with learned returns.

    ``pairs_by_method`` maps (row, method) to (retrained policy, expert) of each seed.
    """
    values = complete()
    for (row, method), pairs in pairs_by_method.items():
        values[row, method, EXPERT_BY_REWARD] = [250.0 for _ in pairs]
    p, points = example(values)
    for (row, method), pairs in pairs_by_method.items():
        for column, measure in enumerate(("transfer", EXPERT_BY_REWARD)):
            chosen = (points["row"] == row) & (points["agent"] == method)
            chosen &= points["measure"] == measure
            points.loc[chosen, "learned_return"] = [pair[column] for pair in pairs]
    return build(p, points, {}, {})


def metrics(accuracy, optimised_penalty, weight, penalty=0.5):
    """Metrics of ten rounds in two settings; only the last round is of the end."""
    return pd.DataFrame(
        {
            "round": k,
            "setting": setting,
            "accuracy": accuracy if k == 9 else 0.0,
            "mean_abs_logit": 50.0 if k == 9 else 0.0,
            "cross_entropy": (0.3 if setting == "a" else 0.5) if k == 9 else 9.0,
            "penalty": penalty if k == 9 else 9.0,
            "optimised_cross_entropy": 0.2 if k == 9 else 9.0,
            "optimised_penalty": optimised_penalty if k == 9 else 9.0,
            "penalty_weight": weight if k == 9 else 0.0,
        }
        for k in range(10)
        for setting in "ab"
    )


def cell(report, row, agent, measure):
    c = report.cells
    return c[(c["row"] == row) & (c["agent"] == agent) & (c["measure"] == measure)].iloc[0]


def table(report, title):
    (found,) = (t for t in report.tables if t.title.startswith(title))
    return found


def column(table, name):
    return [row[table.columns.index(name)] for row in table.rows]
