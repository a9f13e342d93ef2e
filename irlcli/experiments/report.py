"""The report of a table, from the artefacts that the store holds of its plan.

Each cell is looked up by its key, so no artefact that was made with other parameters fills it.
Nothing is computed here.
"""

from collections.abc import Mapping, Sequence
from itertools import product

import msgspec

from irlcli.configs import ExpertConfig
from irlcli.errors import NotFound
from irlcli.experiments import facts
from irlcli.experiments.inputs import source_in
from irlcli.experiments.plan import Plan
from irlcli.experiments.rows import made_by
from irlcli.interventions import listed_settings, without_cue
from irlcli.report.parameters import ASSESS, CUE, REWARD_LEARNING, Cell, Row, Run
from irlcli.stages import report, report_experts
from irlcli.stages.base import Request, Source
from irlcli.store import Artefact

# Row, method and seed.
_Run = tuple[str, str, int]


def request(plan: Plan, command: str) -> Request:
    """The report of a whole table. ``command`` is the command line that asks for it again.

    Raises:
        NotFound: the store fills no cell.
    """
    if plan.figure is not None:
        return plan.figure
    cells, sources = _cells(plan)
    choices = _choices(plan)
    sources |= {
        report.choice_role(*run): source_in(choice, "choice.json")
        for run, (_, choice) in choices.items()
    }
    if not any(cell.run for cell in cells):
        raise NotFound(
            f"{plan.lookup.store.root} holds no evaluation of {plan.table.name} with this config"
        )
    artefacts = _artefacts(plan)
    runs, libraries = facts.runs(artefacts.values())
    if plan.table.kind == "experts":
        return _experts(plan, command, cells, sources, runs, libraries)
    wanted = [plan.lookup.record(task.request) for task in plan.tasks.values()]
    others = facts.left_out(
        plan.lookup.store.artefacts(), [record for record in wanted if record], set(artefacts)
    )
    parameters = report.Parameters(
        kind=plan.table.name,
        title=plan.table.title,
        command=command,
        measures=tuple(m for m in plan.table.measures if m not in (ASSESS, CUE)),
        rows=tuple(_rows(plan, choices)),
        methods=plan.table.compared,
        variants=plan.table.variants,
        learned_by=plan.table.methods[0] if plan.table.variants else "",
        seeds=plan.table.seeds,
        retrainings=plan.table.retrainings,
        cells=tuple(cells),
        runs=runs,
        libraries=libraries,
        others=tuple(others),
    )
    return report.request(parameters, sources)


def _experts(
    plan: Plan,
    command: str,
    cells: Sequence[Cell],
    sources: Mapping[str, Source],
    runs: dict[str, Run],
    libraries: dict[str, dict[str, str | None]],
) -> Request:
    if not any(cell.run for cell in cells if cell.agent == "expert"):
        raise NotFound(
            f"{plan.lookup.store.root} holds no evaluation of an expert with this config"
        )
    experts: dict[str, ExpertConfig] = {}
    for row in plan.table.rows:
        config = plan.config(row.env)
        own = config.interventions[row.knob].expert
        experts[row.name] = config.expert if own is None else own
    parameters = report_experts.Parameters(
        command=command,
        steps={
            name: expert.ppo.rounds(expert.total_steps) * expert.ppo.steps_per_round
            for name, expert in experts.items()
        },
        bars={name: expert.bar for name, expert in experts.items() if expert.bar is not None},
        cells=tuple(cells),
        runs=runs,
        libraries=libraries,
    )
    return report_experts.request(parameters, sources)


def _cells(plan: Plan) -> tuple[list[Cell], dict[str, Source]]:
    """The cells with the ids that fill them, and the stage's inputs by role."""
    cells, sources = [], {}
    for task in plan.cells:
        cell = task.cell
        assert cell is not None
        artefact = _held(plan, task.request)
        if artefact is None:
            cells.append(msgspec.structs.replace(cell, why=_reason(plan, task.request)))
        else:
            cells.append(msgspec.structs.replace(cell, run=artefact.id))
            sources[cell.role] = source_in(artefact, None)
        for part, learned in task.curves.items():
            made = _held(plan, learned)
            if made is not None:
                sources[cell.curve_role(part)] = source_in(made, "metrics.parquet")
    return cells, sources


def _held(plan: Plan, request: Request) -> Artefact | None:
    """The request's artefact, if it is in the store itself."""
    step = plan.lookup(request)
    return step.artefact if step.status == "HIT" else None


def _reason(plan: Plan, request: Request) -> str:
    """What a missing evaluation waits for."""
    first = next(step for step in plan.lookup.chain(request) if step.status != "HIT")
    stage = first.label.split()[0]
    if first.status == "RESUME":
        return f"{stage} was interrupted or is running"
    if first.status == "FOUND":
        return f"{stage} is {first.why}, and `irl run` copies it"
    return f"no result of {stage}"


def _artefacts(plan: Plan) -> dict[str, Artefact]:
    """Everything the report is made from, by id."""
    held = [_held(plan, task.request) for task in plan.tasks.values()]
    return {artefact.id: artefact for artefact in held if artefact is not None}


def _rows(plan: Plan, choices: Mapping[_Run, tuple[float, Artefact]]) -> list[Row]:
    rows = []
    for row in plan.table.rows:
        config = plan.config(row.env)
        listed = config.interventions[row.knob]
        trained, unseen = (
            listed_settings(row.env, row.knob, values) for values in (listed.id, listed.ood)
        )
        demos = plan.tasks[f"{plan.selection.tag}.{row}.demos"].request
        configs = {
            "expert": config.expert_of(without_cue(row.env, unseen[0])),
            "demonstrations": config.demonstrations,
            "airl": config.airl_of(trained),
            "transfer": config.transfer_of(unseen[0]),
            "evaluation": config.evaluation,
        }
        rows.append(
            Row(
                env=row.env,
                knob=row.knob,
                trained=tuple(map(str, trained)),
                unseen=str(unseen[0]),
                demonstrations=demos.parameters.episodes,
                config=msgspec.to_builtins(configs),
                chosen=_weights(plan, row.name, choices),
                student_share=_student_shares(plan, row.name),
            )
        )
    return rows


def _student_shares(plan: Plan, row: str) -> dict[str, float]:
    """See :attr:`Row.student_share`."""
    found = {}
    for task in plan.cells:
        assert task.cell is not None
        learned = task.curves.get(REWARD_LEARNING)
        if task.cell.row == row and learned is not None:
            challenger = learned.parameters.airl.challenger
            if challenger.life > 0:
                found[task.cell.agent] = 1.0 - challenger.share
    return found


def _choices(plan: Plan) -> dict[_Run, tuple[float, Artefact]]:
    """Each lambda that was chosen, and the artefact of the choice, where the store holds it."""
    found = {}
    for row, method, seed in product(plan.table.rows, plan.table.methods, plan.table.seeds):
        task = plan.tasks.get(f"{plan.selection.tag}.{row}.{method}.{seed}")
        if task is not None and "penalty choice" in task.request.inputs:
            choice = _held(plan, made_by(task.request.inputs["penalty choice"]))
            if choice is not None:
                weight = task.request.parameters.airl.penalty_weight
                found[row.name, method, seed] = weight, choice
    return found


def _weights(
    plan: Plan, row: str, choices: Mapping[_Run, tuple[float, Artefact]]
) -> dict[str, float]:
    """Each lambda of the table's own, by method, and each chosen one, by ``METHOD SEED``."""
    listed = {} if plan.selection.candidates else plan.table.penalty_weights
    found = {method: weight for method, weight in listed.items() if method in plan.table.methods}
    chosen = {f"{m} {seed}": weight for (r, m, seed), (weight, _) in choices.items() if r == row}
    return found | chosen
