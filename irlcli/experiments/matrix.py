"""Which artefacts a table or figure of the paper stands on.

Every cell is found by planning: the chain of requests that the command line would make is built and
the store is asked how much of it exists. Nothing is run, and nothing is taken for a cell that was
made with other parameters.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from irlcli.configs import PENALISED, Config
from irlcli.errors import NotFound, UsageError
from irlcli.experiments.references import flat
from irlcli.experiments.runner import Runner, Step, source_of
from irlcli.interventions import parse_settings
from irlcli.stages import (
    choose_penalty,
    collect_experts,
    evaluate,
    report,
    report_experts,
    train_airl,
    train_expert,
    transfer,
)
from irlcli.stages.base import From, Request, Source
from irlcli.store import Artefact, Resolved, digest, read_json

METHODS = ("erm", "irm", "erm-balanced", "irm-shuffled")
_STAGES = ("expert", "demonstrations", "airl", "transfer", "evaluation")


class Experiment(NamedTuple):
    """Rows of (environment, knob), and what is measured of each student or its reward."""

    title: str
    rows: tuple[tuple[str, str], ...]
    measures: tuple[str, ...]


EXPERIMENTS = {
    "table1": Experiment(
        "Table 1: transfer to an unseen setting",
        (
            ("lunar-lander", "bounce"),
            ("lunar-lander", "engine-power"),
            ("ant", "friction"),
            ("ant", "leg-length"),
        ),
        ("transfer", "zero-shot", "id"),
    ),
    "figure3": Experiment(
        "Figure 3: zero-shot, physical interventions",
        (("ant", "leg-length"), ("half-cheetah", "friction"), ("reacher", "gravity")),
        ("zero-shot", "id"),
    ),
    "figure4": Experiment(
        "Figure 4: zero-shot, goal interventions",
        (("ant", "goal-y"), ("half-cheetah", "goal-y")),
        ("zero-shot", "id"),
    ),
}


class _Planned(NamedTuple):
    """A wanted evaluation: its cell, the request, and the stages whose learning curves belong."""

    cell: report.Cell
    request: Request
    curves: Mapping[str, Request]


class _Plans:
    """Plans of requests, each made once."""

    def __init__(self, runner: Runner):
        self._runner = runner
        self.store = runner.store
        self._made: dict[int, tuple[Request, list[Step]]] = {}

    def __call__(self, request: Request) -> list[Step]:
        # By identity: equal requests are rare, and the request is kept so that its id stays its.
        if id(request) not in self._made:
            self._made[id(request)] = request, self._runner.plan(request)
        return self._made[id(request)][1]


def request(
    kind: str,
    runner: Runner,
    settings: Callable[[str, Mapping[str, Any] | None], Config],
    methods: Sequence[str],
    seeds: Sequence[int],
    command: str,
    env: str | None = None,
    candidates: Sequence[float] = (),
) -> Request:
    """The report ``kind`` on what ``runner``'s store holds of it.

    Args:
        kind: a key of :data:`EXPERIMENTS`.
        runner: plans; runs nothing here.
        settings: the settings of an environment under flags such as ``airl.method``.
        methods, seeds: of the reward learning.
        command: how to ask for this report again; printed in it.
        env: only this environment's rows.
        candidates: for lambda, where it was chosen by ``train-airl --choose-penalty``.

    Raises:
        UsageError: a method or a seed that is unknown or named twice; no row of ``env``.
        NotFound: the store holds no evaluation of any row.
    """
    experiment = EXPERIMENTS[kind]
    _check(methods, "method", METHODS)
    _check(seeds, "seed")
    wanted = [row for row in experiment.rows if env in (None, row[0])]
    if not wanted:
        names = sorted({row[0] for row in experiment.rows})
        raise UsageError(f"{kind} has no row of {env!r}", f"its environments: {', '.join(names)}")
    plan = _Plans(runner)
    learner = _Learner(plan, settings, candidates)
    rows, planned = [], []
    for name, knob in wanted:
        row, cells = _row(name, knob, experiment.measures, settings, methods, seeds, learner)
        rows.append(row)
        planned += cells
    cells, runs, sources, expected = [], {}, {}, {}
    for item in planned:
        steps = plan(item.request)
        for step in steps:
            if step.artefact is not None:
                runs[step.artefact.id] = step.artefact
        artefact = steps[-1].artefact
        cells.append(_placed(item.cell, steps))
        for stage, curve in item.curves.items():
            learned = plan(curve)[-1].artefact
            if learned is not None:
                role = f"{item.cell.row} {item.cell.agent} {item.cell.seed} {stage}"
                sources[role] = _output(learned, "metrics.parquet")
        if artefact is not None:
            sources[cells[-1].role] = source_of(Resolved(artefact, artefact.directory))
        _expect(plan, item.request, expected)
    if not any(cell.run for cell in cells):
        raise NotFound(
            f"{runner.store.root} holds no evaluation of {kind} with these settings",
            f"`make {kind}` makes them; --profile, --set, --seeds and --methods must be those of "
            "the runs, `irl ls` lists what there is",
        )
    facts, libraries = _facts(runs.values())
    parameters = report.Parameters(
        kind=kind,
        title=experiment.title,
        command=command,
        measures=experiment.measures,
        rows=tuple(rows),
        methods=tuple(methods),
        seeds=tuple(seeds),
        cells=tuple(cells),
        runs=facts,
        libraries=libraries,
        others=tuple(_others(runner.store.artefacts(), expected, set(runs))),
    )
    return report.request(parameters, sources)


def experts(
    runner: Runner,
    settings: Callable[[str, Mapping[str, Any] | None], Config],
    command: str,
    envs: Sequence[str],
) -> Request:
    """The report on the experts of every setting that ``settings`` lists for ``envs``.

    Raises:
        NotFound: the store holds none of them.
    """
    plan = _Plans(runner)
    cells, runs, sources, budgets, bars = [], {}, {}, {}, {}
    for env in envs:
        config = settings(env, None)
        budgets[env] = config.expert.total_steps
        if config.expert.bar is not None:
            bars[env] = config.expert.bar
        for knob, listed in config.interventions.items():
            for measure, values in (("id", listed.id), ("ood", listed.ood)):
                if not values:
                    continue
                places = parse_settings(env, f"{knob}={','.join(values)}")
                wanted = [
                    (agent, "", evaluate.request(env, places, config.evaluation, agent=agent))
                    for agent in ("random", "idle")
                ]
                for place in places:
                    learned = train_expert.request(env, place, 0, config.expert_of(place))
                    made = plan(learned)[-1].artefact
                    if made is not None:
                        role = f"{env} {place} learning"
                        sources[role] = _output(made, "metrics.parquet")
                    policy = From(learned, "policy.pt")
                    measured = evaluate.request(env, [place], config.evaluation, policy)
                    wanted.append(("expert", str(place), measured))
                for agent, place, measured in wanted:
                    steps = plan(measured)
                    cell = report.Cell(f"{env} {knob}", agent, measure, place=place)
                    cells.append(_placed(cell, steps))
                    for step in steps:
                        if step.artefact is not None:
                            runs[step.artefact.id] = step.artefact
                    found = steps[-1].artefact
                    if found is not None:
                        sources[cells[-1].role] = source_of(Resolved(found, found.directory))
    if not any(cell.run for cell in cells if cell.agent == "expert"):
        raise NotFound(
            f"{runner.store.root} holds no evaluation of an expert of these settings",
            "`make experts` makes them; --profile and --set must be those of the runs",
        )
    facts, _ = _facts(runs.values())
    parameters = report_experts.Parameters(
        command=command, steps=budgets, bars=bars, cells=tuple(cells), runs=facts
    )
    return report_experts.request(parameters, sources)


class _Learner(NamedTuple):
    """Requests for learned rewards, as ``train-airl`` makes them."""

    plan: _Plans
    settings: Callable[[str, Mapping[str, Any] | None], Config]
    candidates: Sequence[float]

    def __call__(
        self, demos: Request, env: str, trained: Sequence[Any], method: str, seed: int
    ) -> Request:
        airl = self.settings(env, {"airl.method": method}).airl
        if not self.candidates or method not in PENALISED:
            return train_airl.request(From(demos), env, trained, airl, seed)
        choice = choose_penalty.request(From(demos), env, trained, airl, self.candidates, seed)
        made = self.plan(choice)[-1].artefact
        if made is not None:
            value = read_json(self.plan.store.open(made, "choice.json"))
            weight = msgspec.convert(value, choose_penalty.Choice).chosen
            airl = msgspec.structs.replace(airl, penalty_weight=weight)
        basis = {"penalty choice": From(choice, "choice.json")}
        return train_airl.request(From(demos), env, trained, airl, seed, basis)

    def has_chosen(self, airl: Request) -> bool:
        """Whether the lambda of ``airl`` is that of a choice that has been made."""
        basis = airl.inputs.get("penalty choice")
        return basis is not None and self.plan(basis.request)[-1].artefact is not None


def _check(values: Sequence[Any], what: str, known: Sequence[Any] | None = None) -> None:
    if not values:
        raise UsageError(f"no {what} is named", f"name at least one {what}")
    for i, value in enumerate(values):
        if known is not None and value not in known:
            raise UsageError(f"unknown {what} {value!r}", f"known: {', '.join(known)}")
        if value in values[:i]:
            raise UsageError(f"{what} {value} is named twice", f"name each {what} once")


def _row(
    env, knob, measures, settings, methods, seeds, learner
) -> tuple[report.Row, list[_Planned]]:
    """One row of the table and everything that it stands on."""
    config = settings(env, None)
    listed = config.interventions[knob]
    trained, unseen = (
        parse_settings(env, f"{knob}={','.join(v)}") for v in (listed.id, listed.ood)
    )
    if len(unseen) != 1:
        raise UsageError(
            f"{env} {knob} holds {len(unseen)} values out: {', '.join(listed.ood)}",
            "a row has one held-out setting",
        )
    name = f"{env} {knob}"
    demos = collect_experts.request(env, trained, config, 0, listed.episodes)

    def measured(
        places: Sequence[Any],
        policy: Request | None,
        agent: str = "policy",
        reward: Request | None = None,
    ) -> Request:
        source = None if policy is None else From(policy, "policy.pt")
        paid = None if reward is None else From(reward, "reward.pt")
        return evaluate.request(env, places, config.evaluation, source, agent, reward=paid)

    def expert(place: Any) -> Request:
        return train_expert.request(env, place, 0, config.expert_of(place))

    planned = [
        _Planned(
            report.Cell(name, agent, "ood", place=str(unseen[0])),
            measured(unseen, None, agent),
            {},
        )
        for agent in ("random", "idle")
    ]
    planned.append(
        _Planned(
            report.Cell(name, "expert", "ood", place=str(unseen[0])),
            measured(unseen, expert(unseen[0])),
            {},
        )
    )
    for e in trained:
        wanted = (
            ("expert", "id", [e]),
            ("reused", "ood", unseen),
            ("reused", "id", trained),
        )
        planned += [
            _Planned(report.Cell(name, agent, m, place=str(e)), measured(places, expert(e)), {})
            for agent, m, places in wanted
        ]
    chosen = {}
    for method in methods:
        for seed in seeds:
            airl = learner(demos, env, trained, method, seed)
            if learner.has_chosen(airl):
                chosen[f"{method} {seed}"] = airl.parameters.airl.penalty_weight
            moved = transfer.request(From(airl, "reward.pt"), env, unseen[0], config.transfer, seed)
            where = {
                "transfer": (unseen, moved, {"transfer-learning": moved}),
                "zero-shot": (unseen, airl, {"reward-learning": airl}),
                "id": (trained, airl, {}),
            }
            for measure in measures:
                places, policy, curves = where[measure]
                cell = report.Cell(name, method, measure, seed)
                wanted = measured(places, policy)
                if measure == "transfer":
                    # One without the reward has the same true returns: better than none.
                    paid = measured(places, policy, reward=airl)
                    if learner.plan(paid)[-1].artefact or not learner.plan(wanted)[-1].artefact:
                        wanted = paid
                planned.append(_Planned(cell, wanted, curves))
            if "transfer" in measures:
                cell = report.Cell(name, method, "expert by reward", seed, str(unseen[0]))
                paid = measured(unseen, expert(unseen[0]), reward=airl)
                planned.append(_Planned(cell, paid, {}))
    tree = msgspec.to_builtins(config)
    row = report.Row(
        env=env,
        knob=knob,
        trained=tuple(str(e) for e in trained),
        unseen=str(unseen[0]),
        demonstrations=demos.parameters.episodes,
        config={stage: tree[stage] for stage in _STAGES},
        chosen=chosen,
    )
    return row, planned


def _placed(cell: report.Cell, steps: Sequence[Step]) -> report.Cell:
    """The cell with its run, or with what it waits for."""
    artefact = steps[-1].artefact
    if artefact is not None:
        return msgspec.structs.replace(cell, run=artefact.id)
    first = next(step for step in steps if step.artefact is None)
    stage = first.label.split()[0]
    state = "was interrupted or is at work" if first.status == "RESUME" else "has not run"
    return msgspec.structs.replace(cell, why=f"{stage} {state}")


def _output(artefact: Artefact, name: str) -> Source:
    return source_of(Resolved(artefact, artefact.directory / name))


def _facts(artefacts: Iterable[Artefact]) -> tuple[dict[str, report.Run], dict[str, Any]]:
    """What provenance says of each artefact, and the sets of library versions that occur."""
    runs, libraries = {}, {}
    for artefact in sorted(artefacts, key=lambda a: a.id):
        said = artefact.provenance()
        git = said.get("git") or {}
        versions = {"python": said.get("python"), **(said.get("libraries") or {})}
        name = digest(versions)[:8]
        libraries[name] = versions
        record = artefact.manifest.record
        runs[artefact.id] = report.Run(
            stage=record.stage,
            about=_subject_text(record.stage, record.parameters),
            code=tuple(dict.fromkeys(_code(state) for state in said.get("attempts") or [git])),
            libraries=name,
            seconds=said.get("seconds"),
            resumed=said.get("resumed"),
            inputs=tuple(sorted(set(_ids(said.get("inputs") or {})))),
        )
    return runs, libraries


def _code(said: Mapping[str, Any]) -> report.Code:
    return report.Code(commit=said.get("commit"), dirty=said.get("dirty"))


def _ids(inputs: Mapping[str, str]) -> Iterator[str]:
    for place in inputs.values():
        yield place.partition("/")[0]


# Runs that are none of the cells'

_Subject = tuple[Any, ...]


def _subject(stage: str, parameters: Mapping[str, Any], inputs: Mapping[str, str]) -> _Subject:
    """What a run is about; runs about the same that differ in anything else are never mixed."""
    learner = parameters.get("airl")
    places = parameters.get("settings", parameters.get("setting"))
    return (
        stage,
        parameters.get("env"),
        tuple(places) if isinstance(places, list) else places,
        learner.get("method") if isinstance(learner, dict) else None,
        parameters.get("agent"),
        # An evaluation's seed is a parameter like another; a run's tells it from its siblings.
        parameters.get("seed") if stage != "evaluate" else None,
        tuple(sorted(inputs.values())) if stage in ("transfer", "evaluate") else None,
    )


def _subject_text(stage: str, parameters: Mapping[str, Any]) -> str:
    _, env, places, method, agent, *_ = _subject(stage, parameters, {})
    texts = [places] if isinstance(places, str) else list(places or ())
    return " ".join(str(t) for t in (env, *texts, method, agent) if t and t != "policy")


def _expect(
    plan: _Plans, request: Request, expected: dict[_Subject, tuple[int, dict[str, Any]]]
) -> None:
    """Note what the runs of ``request`` and of all it needs must look like."""
    inputs = {}
    for role, source in request.inputs.items():
        _expect(plan, source.request, expected)
        found = plan(source.request)[-1].artefact
        if found is not None:
            path = found.directory / (source.output or "")
            inputs[role] = source_of(Resolved(found, path)).sha256
    if len(inputs) == len(request.inputs):
        parameters = msgspec.to_builtins(request.parameters)
        subject = _subject(request.stage.name, parameters, inputs)
        expected[subject] = (request.stage.version, parameters)


def _others(
    artefacts: Iterable[Artefact],
    expected: Mapping[_Subject, tuple[int, dict[str, Any]]],
    used: set[str],
) -> list[report.Others]:
    """Runs about the same as a cell's that were made otherwise, counted by how they differ."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for artefact in artefacts:
        record = artefact.manifest.record
        wanted = expected.get(_subject(record.stage, record.parameters, record.inputs))
        if wanted is None or artefact.id in used:
            continue
        why = _difference(record.stage_version, record.parameters, *wanted)
        about = _subject_text(record.stage, record.parameters)
        groups.setdefault((record.stage, about, why), []).append(artefact.id)
    return [
        report.Others(stage=stage, about=about, why=why, ids=tuple(ids))
        for (stage, about, why), ids in sorted(groups.items())
    ]


def _difference(
    version: int, parameters: Mapping[str, Any], wanted_version: int, wanted: Mapping[str, Any]
) -> str:
    if version != wanted_version:
        return f"version {version} of the stage instead of {wanted_version}"
    found, sought = dict(flat(parameters)), dict(flat(wanted))
    names = sorted(n for n in found | sought if found.get(n) != sought.get(n))
    parts = [f"{n} {found.get(n, 'unset')} instead of {sought.get(n, 'unset')}" for n in names]
    if not parts:
        return "other inputs"
    return ", ".join(parts[:4]) + (f" and {len(parts) - 4} more" if len(parts) > 4 else "")
