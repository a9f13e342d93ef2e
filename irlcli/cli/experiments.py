"""``irl plan`` and ``irl run``: the tables and figures of ``settings/experiments.toml``."""

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from irlcli.cli import cluster as cluster_jobs
from irlcli.cli import complete
from irlcli.cli import console as out
from irlcli.cli.cluster import ClusterOptions
from irlcli.cli.options import Out, planning_command, stage_command
from irlcli.cli.session import StageSession
from irlcli.cli.table_report import check_out, copy_outputs, print_report, report_of
from irlcli.errors import Interrupted, IrlError, NotFound, StageFailed, UsageError
from irlcli.requests.tables import (
    TableChoice,
    check_tag,
    check_worlds,
    open_plan,
    steps_of,
    warn_of_damage,
)

if TYPE_CHECKING:
    from irlcli.experiments.execute import Outcome
    from irlcli.experiments.plan import Plan
    from irlcli.experiments.runner import Runner

_TableName = Annotated[
    str, typer.Argument(metavar="TABLE", help="e.g. table1.", autocompletion=complete.tables)
]
Seeds = Annotated[str | None, typer.Option(help="Seeds of the reward learning, e.g. 0,1,2.")]
Methods = Annotated[str | None, typer.Option(help="Methods to compare, e.g. erm,irm.")]
Rows = Annotated[
    str | None,
    typer.Option(help="Only these rows, e.g. lunar-lander.bounce, or ant for all of Ant's."),
]
ChoosePenalty = Annotated[
    str | None,
    typer.Option(
        help="Choose lambda among these candidates by leaving one training setting out, e.g. 0.1,1,10. "
        "own: each penalty's own candidates."
    ),
]
_Until = Annotated[
    str | None,
    typer.Option(
        help="Stop after this phase, without a report: experts, demos, rewards, transfers or returns."
    ),
]
_Only = Annotated[str | None, typer.Option(metavar="NAME", help="One step and what it needs.")]
_Tag = Annotated[
    str | None,
    typer.Option(
        help="Prefix of all names. Default: the profile, or the name of a table that has settings of its own."
    ),
]
TableFile = Annotated[
    Path | None,
    typer.Option("--experiments", help="File with the tables. Default: settings/experiments.toml."),
]

# -P: as for the script `irl`, the working directory is not on Python's path.
_PROCESS = (sys.executable, "-P", "-m", "irlcli")
_JOBS = "Jobs of a cluster"
_CONTINUE = "run the same command again to continue"
_JOBS_GO_ON = (
    "the jobs continue: --status shows them, --cancel stops them, the same command waits again"
)


@planning_command
def plan(
    session: StageSession,
    table: _TableName,
    seeds: Seeds = None,
    methods: Methods = None,
    rows: Rows = None,
    choose_penalty: ChoosePenalty = None,
    until: _Until = None,
    only: _Only = None,
    tag: _Tag = None,
    experiments: TableFile = None,
    to: Annotated[
        str | None,
        typer.Option(metavar="ENGINE", help="Print the plan for another engine: snakemake."),
    ] = None,
) -> None:
    """Show which steps of a table exist or are missing, and why.

    HIT: in the store. FOUND: in a store of --from. RUN: can be computed now. RESUME: can be
    resumed. BLOCKED: waits for other steps. Nothing is computed, written or moved.
    """
    if to not in (None, "snakemake"):
        raise UsageError(f"unknown --to {to!r}", "the only engine is snakemake")
    if to is not None and session.as_json:
        raise UsageError("--to prints no JSON", "omit --json or --to")
    choice = TableChoice(table, seeds, methods, rows, choose_penalty, until, only, tag, experiments)
    plan = open_plan(session, choice)
    check_tag(session, choice, plan.table)
    if only is None:
        check_worlds(plan)
    if to is None:
        _print_plan(session, choice, plan)
        return
    from irlcli.experiments.snakemake import snakefile

    needs = {name: plan.needs[name] for name in plan.tasks}
    line = shlex.join(["irl", *sys.argv[1:]])
    out.print_data(snakefile(needs, _step_command(session, choice, plan, "irl"), line).rstrip())


def _print_plan(session: StageSession, choice: TableChoice, plan: "Plan") -> None:
    from irlcli.experiments.status import STATUSES

    steps = steps_of(plan, session.console.warn)
    counts = {status: sum(s["status"] == status for s in steps) for status in STATUSES}
    if session.as_json:
        command = _step_command(session, choice, plan, "irl")
        for step in steps:
            step["command"] = command(step["name"])
        out.print_json("plan", {"table": choice.table, "counts": counts, "steps": steps})
        return
    for step in steps:
        out.print_data(f"{step['status']:8}{step['name']}: {step['why']}")
    parts = [f"{count} {status}" for status, count in counts.items() if count]
    out.print_note(f"{len(steps)} steps: {', '.join(parts)}")
    older = [step["other_versions"] for step in steps if step["other_versions"]]
    if older:
        session.console.warn(
            f"{len(older)} of the artefacts were made with other library versions: "
            f"{', '.join(sorted({text for texts in older for text in texts}))}"
        )


@stage_command
def run(
    session: StageSession,
    table: _TableName,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1, help="Processes at a time, besides one that waits for another run. Default: 1."
        ),
    ] = None,
    seeds: Seeds = None,
    methods: Methods = None,
    rows: Rows = None,
    choose_penalty: ChoosePenalty = None,
    until: _Until = None,
    only: _Only = None,
    expect: Annotated[
        str | None,
        typer.Option(
            hidden=True, help="Digest of the request that --only had when it was planned."
        ),
    ] = None,
    tag: _Tag = None,
    experiments: TableFile = None,
    directory: Out = None,
    cluster: Annotated[
        str | None,
        typer.Option(help="Make the steps as jobs: slurm, or local.", rich_help_panel=_JOBS),
    ] = None,
    partition: Annotated[
        str | None, typer.Option(help="Slurm's partition.", rich_help_panel=_JOBS)
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(
            help=f"Time limit of a job, e.g. 90 or 1-12. Default: {cluster_jobs.DEFAULT_TIME}.",
            rich_help_panel=_JOBS,
        ),
    ] = None,
    cpus: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=f"CPUs of a job. Default: {cluster_jobs.DEFAULTS.cpus}.",
            rich_help_panel=_JOBS,
        ),
    ] = None,
    array_parallelism: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=f"Jobs of an array that run at a time. Default: {cluster_jobs.DEFAULTS.parallelism}.",
            rich_help_panel=_JOBS,
        ),
    ] = None,
    sbatch: Annotated[
        list[str],
        typer.Option(
            metavar="OPTION=VALUE",
            help="Another option of sbatch, e.g. account=NAME, repeatable.",
            rich_help_panel=_JOBS,
        ),
    ] = [],  # noqa: B006
    requeues: Annotated[
        int | None,
        typer.Option(
            min=0,
            help=f"How often a stopped job is requeued. Default: {cluster_jobs.DEFAULT_REQUEUES}; "
            f"with --cluster local {cluster_jobs.LOCAL_REQUEUES}, its maximum.",
            rich_help_panel=_JOBS,
        ),
    ] = None,
    detach: Annotated[
        bool, typer.Option("--detach", help="Submit and exit.", rich_help_panel=_JOBS)
    ] = False,
    status: Annotated[
        bool, typer.Option("--status", help="Show the jobs and exit.", rich_help_panel=_JOBS)
    ] = False,
    cancel: Annotated[
        bool, typer.Option("--cancel", help="Cancel the jobs and exit.", rich_help_panel=_JOBS)
    ] = False,
) -> None:
    """Compute the missing steps of a table, then its report.

    Each missing step is made by a process of its own: this command with --only NAME. Run it again
    after a failure or an interruption: finished steps are kept, interrupted ones resume. With
    --cluster each step is a job; --status and --cancel apply to the jobs of this table.
    """
    choice = TableChoice(table, seeds, methods, rows, choose_penalty, until, only, tag, experiments)
    options = ClusterOptions(
        cluster=cluster,
        partition=partition,
        time=time,
        cpus=cpus,
        parallelism=array_parallelism,
        sbatch=sbatch,
        requeues=requeues,
        jobs=jobs,
        detach=detach,
        status=status,
        cancel=cancel,
    )
    options.check(choice, directory, session.dry_run)
    if expect is not None:
        # The command that an artefact records is to make it at any time.
        session.command = [word for word in session.command if word not in ("--expect", expect)]
    runner = session.runner()
    plan = open_plan(session, choice)
    check_tag(session, choice, plan.table)
    if directory is not None:
        check_out(directory, session.store.root, plan.table)
    if only is None and not (status or cancel):
        check_worlds(plan)
    if session.dry_run:
        _print_plan(session, choice, plan)
        return
    if status or cancel:
        (cluster_jobs.print_status if status else cluster_jobs.cancel)(session, plan, options)
        return
    runner.store.create()
    with session.reading():
        if only is not None:
            if expect not in (None, plan.identities[only]):
                raise UsageError(
                    f"what {only} is made from has changed since the run was planned: its settings, "
                    "its table, its environment's code or the version of a stage",
                    "run the same command again, with another --tag where the values differ",
                )
            _make_one(session, runner, plan, only)
            return
        warn_of_damage(plan, session.console.warn)
        command = _expecting(plan, _step_command(session, choice, plan, *_PROCESS))
        if cluster is None:
            outcome = _make_all(session, runner, plan, command, jobs or 1)
        else:
            ended = cluster_jobs.run_jobs(session, runner, plan, command, options)
            if ended is None:
                return
            outcome = ended
        if until is not None:
            # Otherwise the report has them.
            for name, found in plan.choices():
                session.console.say(f"{name}: {found}")
        elif not outcome.interrupted:
            _report(session, plan, choice, directory, outcome)
    _raise_for(outcome, plan, _JOBS_GO_ON if cluster == "slurm" else _CONTINUE)
    if session.as_json and until is not None:
        counts = {field: len(getattr(outcome, field)) for field in ("existed", "copied", "made")}
        out.print_json("run", {"table": table, **counts})


def _make_one(session: StageSession, runner: "Runner", plan: "Plan", only: str) -> None:
    """Make one step and what it needs in this process, inputs first."""
    try:
        for name in list(plan.tasks):
            step = plan.step(name)
            artefact = step.artefact if step.status == "HIT" and name != only else None
            if artefact is None:
                artefact = runner.run(plan.tasks[name].request)
                # A choice of lambda decides what the next requests are.
                plan.refresh()
            runner.store.set_name(name, artefact)
            if name == only:
                session.print_artefact(artefact, only)
    finally:
        session.console.close()


def _make_all(
    session: StageSession,
    runner: "Runner",
    plan: "Plan",
    command: Callable[[str], list[str]],
    jobs: int,
) -> "Outcome":
    from irlcli.cli.jobs import job_display
    from irlcli.experiments.execute import Execution

    display = job_display(session.console)
    try:
        return Execution(plan, runner, command, jobs, display).run()
    finally:
        display.close()


def _step_command(
    session: StageSession, choice: TableChoice, plan: "Plan", *program: str
) -> Callable[[str], list[str]]:
    """The command line by which ``program`` makes one step, by its name."""
    words = [*session.config_words(), *choice.words(), "--tag", plan.selection.tag]
    words += session.place_words()
    return lambda name: [*program, "run", choice.table, "--only", name, *words]


def _expecting(plan: "Plan", command: Callable[[str], list[str]]) -> Callable[[str], list[str]]:
    """``command`` with the digest of the step's request: files may change before the step starts.

    With a lambda to choose, later requests are not known before the choice.
    """
    if plan.selection.candidates:
        return command
    return lambda name: [*command(name), "--expect", plan.identities[name]]


def _report(
    session: StageSession,
    plan: "Plan",
    choice: TableChoice,
    directory: Path | None,
    outcome: "Outcome",
) -> None:
    # A step that failed may have moved a damaged artefact to quarantine.
    plan.lookup.forget()
    try:
        request = report_of(session, choice, plan)
    except NotFound:
        if outcome.failed:
            # The failures are reported, and they are the reason.
            return
        raise
    name = choice.report_name(plan.selection.tag)
    (artefact,) = session.run([request], name)
    if directory is not None:
        copy_outputs(session, artefact, directory, plan.table)
    session.print_artefact(artefact, name)
    if not session.as_json:
        print_report(session, artefact)


def _raise_for(outcome: "Outcome", plan: "Plan", continue_hint: str) -> None:
    """End with the exit code of what went wrong; the hint is for a run that a signal stopped.

    Raises:
        IrlError: a step failed, or a signal stopped the run.
    """
    if not outcome.exit_code:
        return
    total = len(plan.tasks)
    if outcome.interrupted:
        # Steps may have ended after the signal.
        plan.lookup.forget_missing()
        there = sum(plan.step(name).status == "HIT" for name in plan.tasks)
        error: IrlError = Interrupted(f"stopped: {there} of {total} steps exist", continue_hint)
    else:
        names = ", ".join(list(outcome.failed)[:3])
        names += f" and {len(outcome.failed) - 3} more" if len(outcome.failed) > 3 else ""
        them = "it" if len(outcome.failed) == 1 else "them"
        verb = "waits" if len(outcome.blocked) == 1 else "wait"
        waiting = f"; {len(outcome.blocked)} {verb} for {them}" if outcome.blocked else ""
        again = "run the same command again: finished steps are kept"
        error = StageFailed(
            f"{len(outcome.failed)} of {total} steps failed: {names}{waiting}",
            again if outcome.exit_code in (4, 75, 130) else f"fix the problem and {again}",
            {
                "failed": {name: failure._asdict() for name, failure in outcome.failed.items()},
                "blocked": outcome.blocked,
            },
        )
    error.exit_code = outcome.exit_code
    raise error
