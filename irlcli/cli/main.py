"""The command line: parse, call the runner, print. Heavy libraries load only where work is done."""

import gc as garbage_collector
import inspect
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from irlcli.cli import console as out
from irlcli.errors import IntegrityError, Interrupted, IrlError, NotFound, StageFailed, UsageError

_REPORTS = "returns, experts, table1, figure2, figure3, figure4, table2"
_COMMANDS: dict[str, tuple[Callable, bool]] = {}

Ref = Annotated[str, typer.Argument(help="Artefact: path, name, or id prefix of 3+ digits.")]
Seed = Annotated[int, typer.Option(min=0, help="Everything random derives from it.")]
Name = Annotated[str | None, typer.Option(help="Name to give the artefact.")]
Env = Annotated[str | None, typer.Option(help="Environment, e.g. lunar-lander.")]


class Session:
    """The options every command has, and what they lead to."""

    def __init__(
        self,
        store: Path,
        as_json: bool,
        profile: str = "standard",
        settings: Path | None = None,
        overrides: Sequence[str] = (),
        dry_run: bool = False,
        wait: bool = True,
        quiet: bool = False,
        tensorboard: Path | None = None,
        workers: int = 1,
    ):
        from irlcli.configs import check_profile
        from irlcli.store import Store

        check_profile(profile)
        self.console = out.TerminalConsole(quiet, tensorboard)
        self.store = Store(store, self.console.warn)
        self.as_json = as_json
        self.profile = profile
        self.settings_file = settings
        self.overrides = list(overrides)
        self._dry_run = dry_run
        self._wait = wait
        self._workers = workers

    def reading(self):
        """Keep gc away for as long as a command looks at artefacts."""
        return self.store.in_use(self._wait, partial(self.console.wait, "the store"))

    def settings(self, env: str, flags: dict[str, Any] | None = None):
        """Settings of ``env`` under this session's options."""
        from irlcli.configs import load_config

        return load_config(env, self.profile, self.settings_file, self.overrides, flags)

    def deliver(
        self, requests: Sequence[Any], name: str | None = None, table: str | None = None
    ) -> list[Any]:
        """Run requests (or plan them, with --dry-run) and print one line for each.

        With --json, ``table`` is the JSON output that is printed with the artefact.
        """
        if name is not None:
            # Before the work, not after it.
            self.store.check_name(name)
        runner = self._runner()
        if self._dry_run:
            self._print_plan([step for request in requests for step in runner.plan(request)])
            return []
        artefacts = []
        # The store may be new: what is made now must not be collected before it has its name.
        self.store.create()
        with self.reading():
            try:
                for request in requests:
                    artefacts.append(runner.run(request))
            finally:
                self.console.close()
            if name is not None:
                self.name(name, artefacts[0])
        for artefact in artefacts:
            record = artefact.manifest.record
            if self.as_json:
                out.print_json(
                    "artefact",
                    {
                        "id": artefact.id,
                        "path": str(artefact.directory),
                        "stage": record.stage,
                        "name": name,
                        "outputs": [o.path for o in artefact.manifest.outputs],
                        **({} if table is None else {"report": self._read(artefact, table)}),
                    },
                )
            else:
                out.print_data(str(artefact.directory))
        return artefacts

    def name(self, name: str, artefact: Any) -> None:
        """Let ``name`` stand for ``artefact``, and say what loses it: gc may take that now."""
        before = self.store.set_name(name, artefact)
        if before is not None:
            self.console.warn(f"{name} no longer names {before}")

    def _read(self, artefact: Any, output: str) -> Any:
        from irlcli.store import read_json

        return read_json(self.store.open(artefact, output))

    def prepare(self, request: Any, then: str) -> Any | None:
        """The artefact of ``request``, unprinted; with --dry-run, None if ``then`` has to wait."""
        from irlcli.experiments.runner import Step

        runner = self._runner()
        if not self._dry_run:
            try:
                return runner.run(request)
            finally:
                self.console.close()
        steps = runner.plan(request)
        if steps[-1].artefact is None:
            self._print_plan([*steps, Step("BLOCKED", then, f"waits for {request.label}")])
        return steps[-1].artefact

    def _runner(self) -> Any:
        from irlcli.experiments.runner import Runner

        command = ["irl", *sys.argv[1:]]
        return Runner(self.store, self.console, self._wait, command, workers=self._workers)

    def _print_plan(self, steps: Sequence[Any]) -> None:
        if self.as_json:
            plan = [{"status": s.status, "request": s.label, "why": s.why} for s in steps]
            out.print_json("plan", {"steps": plan})
            return
        for step in steps:
            out.print_data(f"{step.status:8}{step.label}: {step.why}")


def command(name: str, runs: bool = True, reads: bool = True) -> Callable:
    """Register a command whose first argument is the :class:`Session` of the common options.

    Commands that run stages (``runs``) also take the options that only concern these. While one
    that ``reads`` is at work, nothing is collected.
    """

    def register(function: Callable) -> Callable:
        _COMMANDS[name] = (_reading(function) if reads else function, runs)
        return function

    return register


def _reading(function: Callable) -> Callable:
    @wraps(function)
    def guarded(session: Session, **values: Any) -> None:
        with session.reading():
            function(session, **values)

    return guarded


def _common_options(runs: bool) -> list[inspect.Parameter]:
    def option(name: str, default: Any, type_: Any, help_: str, *flags: str, **more: Any):
        annotation = Annotated[type_, typer.Option(*flags, help=help_, **more)]
        return inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
        )

    common = [
        option("store", Path("runs"), Path, "Artefact store.", "--store", envvar="IRL_STORE"),
        option("as_json", False, bool, "Versioned JSON on stdout.", "--json"),
        option("debug", False, bool, "Show tracebacks.", "--debug"),
    ]
    if runs:
        common += [
            option("profile", "standard", str, "smoke, standard or paper.", "--profile"),
            option("settings", None, Path | None, "TOML file over the profile.", "--settings"),
            option("overrides", [], list[str], "FIELD=VALUE, repeatable.", "--set"),
            option("dry_run", False, bool, "Say what would be done.", "--dry-run"),
            option("wait", True, bool, "Wait for a process making the same.", "--wait/--no-wait"),
            option("workers", 1, int, "Processes that step environments.", "--workers", min=1),
            option("quiet", False, bool, "No progress on stderr.", "--quiet"),
            option("tensorboard", None, Path | None, "Mirror metrics here.", "--tensorboard"),
        ]
    return common


def _with_common_options(function: Callable, runs: bool) -> Callable:
    """``function`` as typer should see it: the session's options in place of the session."""
    common = _common_options(runs)
    own = [
        p.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for p in list(inspect.signature(function).parameters.values())[1:]
    ]

    def run(**values: Any) -> None:
        # Read by main() from the arguments: an error may come before they are parsed.
        del values["debug"]
        session = Session(**{p.name: values.pop(p.name) for p in common if p.name in values})
        function(session, **values)

    run.__signature__ = inspect.Signature([*own, *common])
    run.__annotations__ = {p.name: p.annotation for p in [*own, *common]}
    run.__doc__ = function.__doc__
    return run


@command("collect-experts")
def collect_experts(
    session: Session,
    env: Annotated[str, typer.Option(help="Environment, e.g. lunar-lander.")],
    intervention: Annotated[
        str, typer.Option(help="KNOB=VALUE,VALUE; KNOB alone takes its ID values from settings/.")
    ],
    episodes: Annotated[
        str | None,
        typer.Option(help="Per setting: 10, or 1,3,10 for three. By default those of settings/."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Of the recorded episodes. An expert's own seed is always 0.")
    ] = 0,
    name: Name = None,
) -> None:
    """Train an expert in each setting and record its demonstrations."""
    from irlcli.stages import collect_experts

    config = session.settings(env)
    settings = _settings(env, config, intervention, "id")
    listed = config.interventions.get(intervention)
    if episodes is not None:
        counts = _counts(episodes)
    else:
        counts = listed.episodes if listed is not None else ()
    request = collect_experts.request(env, settings, config, seed, counts)
    for artefact in session.deliver([request], name):
        _warn_of_missed_bars(session, artefact, config.expert.bar)


def _warn_of_missed_bars(session: Session, artefact: Any, bar: float | None) -> None:
    from irlcli.data.descriptions import Collected
    from irlcli.experiments.references import output

    summary = output(session.store, artefact, "summary.json", Collected)
    for row in summary.settings:
        if bar is not None and row.mean_return < bar:
            session.console.warn(
                f"the expert of {summary.env} {row.setting} misses its bar: mean true "
                f"return {row.mean_return:.0f} over {row.episodes} episodes, bar {bar:.0f}"
            )


@command("train-airl")
def train_airl(
    session: Session,
    demos: Annotated[str, typer.Option(help="Demonstrations: an artefact.")],
    method: Annotated[
        str | None, typer.Option(help="erm, erm-balanced, irm or irm-shuffled.")
    ] = None,
    penalty_weight: Annotated[float | None, typer.Option(help="lambda of IRM.")] = None,
    choose_penalty: Annotated[
        str | None,
        typer.Option(help="Candidates for lambda, e.g. 0.1,1,10: leave one setting out."),
    ] = None,
    select: Annotated[
        str | None, typer.Option(help="Round to keep: last, or best on episodes or on SETTING.")
    ] = None,
    state_only: Annotated[
        bool | None, typer.Option("--state-only/--no-state-only", help="g(s), or g(s, a).")
    ] = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Learn a reward and a student policy from demonstrations."""
    import msgspec

    from irlcli.experiments.references import demonstrations
    from irlcli.experiments.runner import source_of
    from irlcli.interventions import parse_setting
    from irlcli.stages import choose_penalty as choice
    from irlcli.stages import train_airl
    from irlcli.store import Resolved, read_json

    source, env, settings = demonstrations(session.store, demos)
    flags = {
        "airl.method": method,
        "airl.penalty_weight": penalty_weight,
        "airl.select": str(parse_setting(env, select)) if "=" in (select or "") else select,
        "airl.state_only": state_only,
    }
    airl = session.settings(env, flags).airl
    parsed = [parse_setting(env, text) for text in settings]
    _check_penalised(airl.method, penalty_weight)
    # Before the choice of lambda, which takes long.
    train_airl.request(source, env, parsed, airl, seed)
    basis = {}
    if choose_penalty is not None:
        if penalty_weight is not None:
            raise UsageError("--penalty-weight and --choose-penalty both set lambda", "give one")
        weights = _numbers("--choose-penalty", choose_penalty)
        request = choice.request(source, env, parsed, airl, weights, seed)
        chosen = session.prepare(request, "train-airl")
        if chosen is None:
            return
        path = session.store.open(chosen, "choice.json")
        made = msgspec.convert(read_json(path), choice.Choice)
        session.console.say(f"lambda {made.chosen:g} did best of {choose_penalty} ({path})")
        airl = msgspec.structs.replace(airl, penalty_weight=made.chosen)
        basis["penalty choice"] = source_of(Resolved(chosen, path))
    session.deliver([train_airl.request(source, env, parsed, airl, seed, basis)], name)


def _check_penalised(method: str, penalty_weight: float | None) -> None:
    from irlcli.configs import PENALISED

    if penalty_weight is not None and method not in PENALISED:
        raise UsageError(
            f"--penalty-weight {penalty_weight:g}: {method} has no penalty",
            f"give --method {' or '.join(PENALISED)}, or leave it away",
        )


def _numbers(flag: str, text: str) -> list[float]:
    import msgspec

    from irlcli.configs import NonNegative

    try:
        return msgspec.convert(text.split(","), list[NonNegative], strict=False)
    except msgspec.ValidationError:
        raise UsageError(
            f"{flag} {text!r} is no list of numbers from 0 up", "write 0.1,1,10"
        ) from None


@command("train-maxent")
def train_maxent(
    session: Session,
    demos: Annotated[str, typer.Option(help="Demonstrations in a gridworld: an artefact.")],
    method: Annotated[str | None, typer.Option(help="erm, erm-balanced or irm.")] = None,
    penalty: Annotated[str | None, typer.Option(help="irmv1 or closed-form.")] = None,
    penalty_weight: Annotated[float | None, typer.Option(help="lambda of IRM.")] = None,
    l2: Annotated[float | None, typer.Option(help="Weight decay.")] = None,
    features: Annotated[str | None, typer.Option(help="learned or linear.")] = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Learn a reward from demonstrations in a gridworld, exactly."""
    from irlcli.experiments.references import demonstrations
    from irlcli.interventions import check_tabular, parse_setting
    from irlcli.stages import train_maxent

    source, env, settings = demonstrations(session.store, demos)
    check_tabular(env, "train-maxent", wanted=True)
    flags = {
        "maxent.method": method,
        "maxent.penalty": penalty,
        "maxent.penalty_weight": penalty_weight,
        "maxent.l2": l2,
        "maxent.features": features,
    }
    config = session.settings(env, flags)
    _check_penalised(config.maxent.method, penalty_weight)
    parsed = [parse_setting(env, text) for text in settings]
    request = train_maxent.request(source, env, parsed, _unseen(env, config), config.maxent, seed)
    artefacts = session.deliver([request], name)
    if artefacts and not session.as_json:
        _print_quality(session, artefacts[0])


def _unseen(env: str, config: Any) -> list[Any]:
    """Every OOD setting that the settings file names."""
    from irlcli.interventions import parse_setting

    return [
        parse_setting(env, f"{knob}={value}")
        for knob, values in config.interventions.items()
        for value in values.ood
    ]


def _print_quality(session: Session, artefact: Any) -> None:
    from irlcli.data.descriptions import Quality
    from irlcli.experiments.references import output

    measures = ("goal_probability", "true_return", "value_difference", "rank_correlation")
    quality = output(session.store, artefact, "quality.json", Quality)
    rows = [
        [
            row.setting + ("" if row.seen else " (unseen)"),
            *("-" if getattr(row, m) is None else f"{getattr(row, m):.2f}" for m in measures),
            f"{row.log_likelihood:.1f}",
        ]
        for row in quality.settings
    ]
    columns = ["setting", *(m.replace("_", " ") for m in measures), "log-likelihood"]
    out.print_table(columns, rows, stderr=True)


@command("transfer")
def transfer(
    session: Session,
    reward: Annotated[str, typer.Option(help="A learned reward: reward.pt or its artefact.")],
    ood: Annotated[
        str, typer.Option(help="Setting: VALUE, KNOB=VALUE, or KNOB for its OOD value.")
    ],
    env: Env = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Train a new policy on a frozen reward in an unseen setting."""
    from irlcli.experiments.references import tensor_file
    from irlcli.stages import transfer

    source, origin = tensor_file(session.store, reward, "reward")
    _same_env(reward, origin.env, env)
    config = session.settings(origin.env)
    settings = _settings(origin.env, config, ood, "ood", origin)
    if len(settings) != 1:
        names = ", ".join(str(s) for s in settings)
        raise UsageError(
            f"--ood {ood!r} names {len(settings)} settings: {names}", "transfer to one"
        )
    learned = _learned_text(origin)
    request = transfer.request(source, origin.env, settings[0], config.transfer, seed, learned)
    session.deliver([request], name)


def _learned_text(origin: Any) -> str:
    """How a reward was learned, for the label of what stands on it."""
    import msgspec

    return _joined([*_method(msgspec.to_builtins(origin.airl)), f"seed {origin.seed}"])


@command("evaluate")
def evaluate(
    session: Session,
    policy: Annotated[str | None, typer.Option(help="policy.pt or its artefact.")] = None,
    expert: Annotated[bool, typer.Option("--expert", help="The expert of each setting.")] = False,
    trained_in: Annotated[
        str | None,
        typer.Option(help="With --expert: those of KNOB=VALUE,... or KNOB (ID values), in each."),
    ] = None,
    random: Annotated[bool, typer.Option("--random", help="Uniformly random actions.")] = False,
    idle: Annotated[bool, typer.Option("--idle", help="Does nothing.")] = False,
    reward: Annotated[
        str | None, typer.Option(help="Also what this learned reward pays: reward.pt or artefact.")
    ] = None,
    ood: Annotated[
        str | None,
        typer.Option(help="VALUE,... of the policy's knob, KNOB=VALUE,... or KNOB (OOD values)."),
    ] = None,
    intervention: Annotated[
        str | None, typer.Option(help="KNOB=VALUE,..., or KNOB (ID values).")
    ] = None,
    env: Env = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="Per setting.")] = None,
    seed: Seed = 0,
    name: Name = None,
) -> None:
    """Measure the return of a policy, an expert, or the random or idle agent."""
    agents = [policy is not None, expert, random, idle]
    if sum(agents) != 1:
        raise UsageError(
            f"{sum(agents) or 'no'} agents are named where one is needed",
            "give one of --policy REF, --expert, --random, --idle",
        )
    if ood is not None and intervention is not None:
        raise UsageError("--ood and --intervention both name settings", "give one of them")
    if trained_in is not None and not expert:
        raise UsageError("--trained-in says which experts, and none is evaluated", "add --expert")
    where = (intervention, "id") if ood is None else (ood, "ood")
    learned = None if reward is None else _reward(session, reward, env)
    if policy is not None:
        artefacts = _evaluate_policy(session, policy, where, env, episodes, seed, learned, name)
    else:
        agent = "expert" if expert else "random" if random else "idle"
        artefacts = _evaluate_agent(
            session, agent, trained_in, where, env, episodes, seed, learned, name
        )
    if artefacts and not session.as_json:
        from irlcli.experiments.references import by_own_reward, evaluation

        own = reward is not None and by_own_reward(artefacts[0], session.store.index())
        # Of one policy, or of one expert for each setting: nothing is pooled.
        made = [(evaluation(session.store, a.id)[1], {}, own) for a in artefacts]
        _print_returns(session, made, stderr=True)


class _Reward(NamedTuple):
    """A reward that an evaluation measures by."""

    ref: str
    source: Any
    origin: Any

    @property
    def arguments(self) -> dict[str, Any]:
        """Those of ``evaluate.request``."""
        return {"reward": self.source, "reward_label": _learned_text(self.origin)}


def _reward(session: Session, ref: str, env: str | None) -> _Reward:
    from irlcli.experiments.references import tensor_file

    source, origin = tensor_file(session.store, ref, "reward")
    _same_env(ref, origin.env, env)
    return _Reward(ref, source, origin)


def _evaluate_policy(session, policy, where, env, episodes, seed, learned, name):
    from irlcli.experiments.references import tensor_file
    from irlcli.interventions import check_observed, parse_setting
    from irlcli.stages import evaluate

    source, origin = tensor_file(session.store, policy, "policy")
    _same_env(policy, origin.env, env)
    config = session.settings(origin.env, {"evaluation.episodes": episodes})
    if where[0] is not None:
        settings = _settings(origin.env, config, *where, origin)
    else:
        settings = [parse_setting(origin.env, s) for s in origin.settings]
    by = {}
    if learned is not None:
        _same_env(learned.ref, learned.origin.env, origin.env)
        check_observed(origin.env, learned.origin.settings, settings)
        by = learned.arguments
    who = f"expert of {', '.join(origin.settings)}"
    if origin.agent != "expert":
        who = _joined([origin.agent, origin.method, f"of seed {origin.seed}"])
    request = evaluate.request(
        origin.env, settings, config.evaluation, source, seed=seed, policy_label=who, **by
    )
    return session.deliver([request], name)


def _evaluate_agent(session, agent, trained_in, where, env, episodes, seed, learned, name):
    from irlcli.interventions import check_observed
    from irlcli.stages import evaluate, train_expert
    from irlcli.stages.base import From

    origin, by = None, {}
    if learned is not None:
        origin, by = learned.origin, learned.arguments
        env = origin.env
    if env is None or where[0] is None:
        missing = "--env ENV " if env is None else ""
        raise UsageError(
            f"--{agent} does not say where",
            f"add {missing}--intervention KNOB=VALUE,VALUE or --ood",
        )
    config = session.settings(env, {"evaluation.episodes": episodes})
    settings = _settings(env, config, *where, origin)
    if agent != "expert":
        request = evaluate.request(env, settings, config.evaluation, agent=agent, seed=seed, **by)
        return session.deliver([request], name)
    if trained_in is None:
        wanted = [(setting, [setting]) for setting in settings]
    else:
        wanted = [(own, settings) for own in _settings(env, config, trained_in, "id")]
        for own, measured in wanted:
            check_observed(env, [str(own)], measured)
    if name is not None and len(wanted) > 1:
        raise UsageError(
            f"--name {name!r} cannot stand for {len(wanted)} evaluations",
            "evaluate the expert of one setting at a time to name it",
        )
    requests = [
        evaluate.request(
            env,
            measured,
            config.evaluation,
            From(train_expert.request(env, own, 0, config.expert_of(own)), "policy.pt"),
            seed=seed,
            policy_label=f"expert of {own}",
            **by,
        )
        for own, measured in wanted
    ]
    return session.deliver(requests, name)


def _counts(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--episodes {text!r} is no list of counts", "write 10, or 1,3,10 for three settings"
        ) from None


def _same_env(ref: str, learned: str, wanted: str | None) -> None:
    if wanted is not None and wanted != learned:
        from irlcli.envs.registry import environment

        environment(wanted)
        raise UsageError(
            f"{ref!r} was learned in {learned}, not in {wanted}",
            "rewards and policies do not fit another environment's observations",
        )


def _settings(env: str, config: Any, text: str, kind: str, origin: Any = None) -> Sequence[Any]:
    """The settings that ``text`` names.

    ``knob=3x,4x``; a knob alone stands for the values listed for it (``kind`` id or ood) in the
    settings file; ``3x,4x`` alone belongs to the knob that ``origin`` was trained with.

    Raises:
        UsageError: they name none, or one whose observations are not those of ``origin``.
    """
    from irlcli.interventions import check_observed

    found = _named_settings(env, config, text, kind, origin)
    if origin is not None:
        check_observed(env, origin.settings, found)
    return found


def _named_settings(env, config, text, kind, origin):
    from irlcli.envs.registry import environment
    from irlcli.interventions import knob_of, parse_settings

    if "=" in text:
        return parse_settings(env, text)
    if text in config.interventions:
        values = getattr(config.interventions[text], kind)
        if not values:
            raise UsageError(
                f"the settings list no {kind.upper()} values of {text!r}",
                f"write {text}=VALUE,VALUE",
            )
        return parse_settings(env, f"{text}={','.join(values)}")
    if origin is None or text in environment(env).knobs or text[:1].isalpha():
        knob_of(env, text)
        raise UsageError(f"{text!r} names no value", f"write {text}=VALUE,VALUE")
    knob, equals, _ = origin.settings[0].partition("=")
    if not equals:
        raise UsageError(f"{text!r} names no knob", "write KNOB=VALUE")
    return parse_settings(env, f"{knob}={text}")


@command("play", runs=False)
def play(
    session: Session,
    policy: Annotated[str, typer.Argument(help="policy.pt or its artefact.")],
    file: Annotated[Path, typer.Option("--out", help="GIF to write.")],
    ood: Annotated[
        str | None, typer.Option(help="VALUE,... of the policy's knob, KNOB=VALUE,... or KNOB.")
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="At most this many.")] = 300,
    seed: Seed = 0,
) -> None:
    """Draw a policy in the settings it was trained in, and in those of --ood beside them."""
    from irlcli.experiments.references import tensor_file
    from irlcli.interventions import parse_setting

    source, origin = tensor_file(session.store, policy, "policy")
    env = origin.env
    settings = [parse_setting(env, text) for text in origin.settings]
    if ood is not None:
        added = _settings(env, session.settings(env), ood, "ood", origin)
        settings += [setting for setting in added if setting not in settings]
    if file.suffix.lower() != ".gif":
        raise UsageError(f"{str(file)!r} does not end in .gif", "a GIF is what can be written")
    if not file.parent.is_dir():
        raise UsageError(
            f"{file.parent} is not a directory: {file} cannot be written there", "make it first"
        )

    from irlcli.data.tensors import load_policy_file
    from irlcli.report.animation import write_gif

    path = source.path
    if source.artefact is not None:
        path = session.store.open(source.artefact, path.name)
    player, _ = load_policy_file(path)
    try:
        write_gif(file, player, env, settings, steps, seed)
    except OSError as error:
        raise UsageError(
            f"{file} cannot be written: {error.strerror or error}", "name another file with --out"
        ) from None
    if session.as_json:
        played = {"path": str(file), "env": env, "settings": [str(s) for s in settings]}
        out.print_json("play", played)
    else:
        out.print_data(str(file))


@command("ls", runs=False)
def ls(
    session: Session,
    stage: Annotated[str | None, typer.Option(help="Only this stage.")] = None,
) -> None:
    """List the artefacts."""
    _check_there(session)
    names: dict[str, list[str]] = {}
    for name, id16 in session.store.names().items():
        names.setdefault(id16, []).append(name)
    index = session.store.index()
    makers = {
        o.sha256: a.manifest.record for a in index.artefacts.values() for o in a.manifest.outputs
    }
    found = [
        {
            "id": a.id,
            "stage": a.manifest.record.stage,
            "names": names.get(a.id, []),
            "about": _about(a.manifest.record.parameters) + _origin(a.manifest.record, makers),
            "bytes": sum(o.size for o in a.manifest.outputs),
        }
        for a in index.artefacts.values()
        if stage is None or a.manifest.record.stage == stage
    ]
    found.sort(key=lambda item: (item["stage"], item["about"], item["id"]))
    if stage is not None and not found:
        there = sorted({a.manifest.record.stage for a in index.artefacts.values()})
        session.console.warn(f"no artefact is of stage {stage!r}; there are: {', '.join(there)}")
    if session.as_json:
        out.print_json("artefacts", {"artefacts": found, "newer": sorted(index.newer)})
        return
    rows = [[f["id"], f["stage"], f["about"], ", ".join(f["names"])] for f in found]
    if rows:
        out.print_table(["id", "stage", "about", "names"], rows)


def _check_there(session: Session) -> None:
    """A mistyped store would look like a sound, empty one."""
    if not session.store.root.exists():
        raise NotFound(
            f"there is no store at {session.store.root}",
            "name another with --store or IRL_STORE; what makes an artefact makes the store",
        )


def _about(parameters: dict[str, Any]) -> str:
    """The parameters that tell one artefact of a stage from another.

    Any artefact has parameters, also one that somebody made up: nothing is taken for granted.
    """
    settings = parameters.get("settings")
    parts = [parameters.get("kind"), parameters.get("env"), parameters.get("agent")]
    parts += settings if isinstance(settings, list) else [parameters.get("setting")]
    return _joined([*parts, *_learned(parameters)])


def _learned(parameters: dict[str, Any]) -> list[Any]:
    """Method, lambda and seed of a stage that has them."""
    learner = parameters.get("airl") or parameters.get("maxent")
    parts = _method(learner) if isinstance(learner, dict) else []
    return [*parts, f"seed {parameters['seed']}" if "seed" in parameters else None]


def _method(learner: dict[str, Any]) -> list[Any]:
    """The method of a reward, and lambda if the method has one."""
    from irlcli.configs import PENALISED

    method, weight = learner.get("method"), learner.get("penalty_weight")
    select = learner.get("select", "last")
    return [
        method,
        learner.get("penalty") if method in PENALISED else None,
        f"lambda {_number(weight)}" if method in PENALISED else None,
        f"selecting by {select}" if select != "last" else None,
        "from a clone" if "bc_epochs" in learner else None,
    ]


def _number(value: Any) -> Any:
    return f"{value:g}" if isinstance(value, (int, float)) else value


def _origin(record: Any, makers: dict[str, Any]) -> str:
    """What an evaluation's policy and a transfer's reward came from, if it is in the store.

    ``makers`` has what made each output, by the output's content.
    """
    parts = []
    evaluated_by = record.inputs.get("reward") if record.stage == "evaluate" else None
    for role in ("policy", "reward"):
        maker = makers.get(record.inputs.get(role))
        measures = record.stage == "evaluate" and role == "reward"
        if maker is not None and not measures:
            expert_of = maker.parameters.get("setting") if maker.stage == "train-expert" else None
            parts.append(_joined(["of", maker.stage, expert_of, *_learned(maker.parameters)]))
            record = maker
    if evaluated_by is not None:
        maker = makers.get(evaluated_by)
        learned = _learned(maker.parameters) if maker is not None else ["a file"]
        parts.append(_joined(["by the reward of", *learned]))
    return "".join(f" {part}" for part in parts)


def _joined(parts: Sequence[Any]) -> str:
    text = " ".join(str(p) for p in parts if p and p != "policy")
    return "".join(c if c.isprintable() else "?" for c in text)[:200]


@command("show", runs=False)
def show(session: Session, ref: Ref) -> None:
    """Show an artefact: what made it, from what, and what it holds."""
    import json

    artefact = _artefact(session, ref)
    record = artefact.manifest.record
    value = {
        "id": artefact.id,
        "path": str(artefact.directory),
        "key": record.key,
        **record.as_json(),
        "outputs": {
            o.path: {"size": o.size, "sha256": o.sha256} for o in artefact.manifest.outputs
        },
        "provenance": artefact.provenance(),
    }
    if session.as_json:
        out.print_json("artefact", value)
    else:
        out.print_data(json.dumps(value, indent=2))


@command("lineage", runs=False)
def lineage(session: Session, ref: Ref) -> None:
    """Show everything an artefact was made from, down to the experts."""
    artefact = _artefact(session, ref)
    tree = _lineage(session.store.index(), artefact, ())
    if session.as_json:
        out.print_json("lineage", tree)
        return
    for line in _lineage_lines(tree, ""):
        out.print_data(line)


def _lineage(index: Any, artefact: Any, below: tuple[str, ...]) -> dict[str, Any]:
    record = artefact.manifest.record
    below = (*below, artefact.id)
    inputs = []
    for role, sources in index.parents(artefact).items():
        # Equal files are one content, which what was made of it may hold, too.
        source = next((s for s in sources if s.id not in below), None)
        origin = _lineage(index, source, below) if source is not None else None
        inputs.append({"role": role, "sha256": record.inputs[role], "from": origin})
    about = _about(record.parameters)
    return {"id": artefact.id, "stage": record.stage, "about": about, "inputs": inputs}


def _lineage_lines(node: dict[str, Any], indent: str) -> list[str]:
    lines = [f"{indent}{node['id']}  {node['stage']}  {node['about']}"]
    for item in node["inputs"]:
        if item["from"] is None:
            lines.append(
                f"{indent}  a file that is not in this store, sha256 {item['sha256'][:16]}..."
            )
        else:
            lines += _lineage_lines(item["from"], indent + "  ")
    return lines


@command("verify", runs=False)
def verify(
    session: Session,
    ref: Annotated[str | None, typer.Argument(help="One artefact; all by default.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Compare sizes, hash nothing.")] = False,
) -> None:
    """Check stored bytes against their digests; damaged artefacts go to quarantine."""
    if ref is None:
        _check_there(session)
        ids = session.store.ids()
    else:
        ids = [_artefact(session, ref).id]
    found = session.store.verify(ids, quick)
    newer = [id16 for id16, damage in found.items() if damage.newer]
    damaged = {id16: damage for id16, damage in found.items() if not damage.newer}
    for id16 in newer:
        session.console.warn(f"not checked: {found[id16].problems[0]}")
    checked = len(ids) - len(newer)
    result = {
        "checked": checked,
        "newer": newer,
        "damaged": {
            id16: {
                "problems": damage.problems,
                "command": damage.command,
                "quarantine": str(damage.place) if damage.place is not None else None,
            }
            for id16, damage in damaged.items()
        },
    }
    if damaged:
        for id16, damage in damaged.items():
            for problem in damage.problems:
                print(f"{id16}: {problem}", file=sys.stderr)
            if damage.command:
                print(f"{id16}: was made by: {damage.command}", file=sys.stderr)
        moved = all(damage.place is not None for damage in damaged.values())
        error = IntegrityError(
            f"{len(damaged)} of {checked} artefacts {'were' if moved else 'are'} damaged"
            f"{' and are in quarantine' if moved else ''}: {', '.join(damaged)}",
            "run the commands above again: what is missing is recomputed",
        )
        error.details = result
        raise error
    if ref is None:
        _check_missing(session, result)
    if session.as_json:
        out.print_json("verify", result)
    else:
        out.print_data(f"{_artefacts(checked)} verified")


def _check_missing(session: Session, result: dict[str, Any]) -> None:
    """Fail if a name points to nothing; warn where only the history of something named is gone."""
    missing = session.store.missing(session.store.index(name_newer=False))
    result["missing"] = {
        id16: {"names": lost.names, "made": lost.made, "command": lost.command or None}
        for id16, lost in missing.items()
    }
    for id16, lost in missing.items():
        if lost.names:
            print(lost.text(id16), file=sys.stderr)
            if lost.command:
                print(f"{id16}: was made by: {lost.command}", file=sys.stderr)
        else:
            session.console.warn(lost.text(id16))
    names = sorted(name for lost in missing.values() for name in lost.names)
    if names:
        error = IntegrityError(
            f"{len(names)} of {len(session.store.names())} names point to nothing: "
            f"{', '.join(names)}",
            "run again what made it under the same --name, or give the name to another artefact "
            "(irl name REF NAME)",
        )
        error.details = result
        raise error


def _artefacts(count: int) -> str:
    return "1 artefact" if count == 1 else f"{count} artefacts"


def _runs(count: int) -> str:
    return "1 run" if count == 1 else f"{count} runs"


@command("gc", runs=False, reads=False)
def gc(
    session: Session,
    delete: Annotated[bool, typer.Option("--delete", help="Do it; only shown by default.")] = False,
    grace_days: Annotated[float, typer.Option(min=0, help="Spare what is younger [days].")] = 7.0,
) -> None:
    """Find (and with --delete remove) artefacts that no name leads to."""
    if not grace_days >= 0:
        raise UsageError(f"--grace-days {grace_days} is no number of days", "0 or more")
    _check_there(session)
    grace = grace_days * 86400
    if delete:
        artefacts, work = session.store.collect(grace)
    else:
        with session.reading():
            artefacts, work = session.store.garbage(grace), session.store.stale_work(grace)
    size = sum(o.size for a in artefacts for o in a.manifest.outputs)
    if session.as_json:
        value = {"deleted": delete, "artefacts": [a.id for a in artefacts], "bytes": size}
        out.print_json("gc", {**value, "work": [p.name for p in work]})
        return
    for artefact in artefacts:
        record = artefact.manifest.record
        out.print_data(f"{artefact.id}  {record.stage}  {_about(record.parameters)}")
    for path in work:
        out.print_data(f"{path.name[:16]}  scratch of an interrupted run")
    verb = "removed" if delete else "would be removed (add --delete)"
    found = f"{_artefacts(len(artefacts))}, {size:,} bytes"
    found += f" and scratch of {_runs(len(work))}" if work else ""
    print(f"{found} {verb}", file=sys.stderr)


@command("name", runs=False)
def name(
    session: Session,
    ref: Ref,
    name: Annotated[str, typer.Argument(help="The name; keeps the artefact from gc.")],
) -> None:
    """Name an artefact."""
    artefact = _artefact(session, ref)
    session.name(name, artefact)
    if session.as_json:
        out.print_json("name", {"name": name, "id": artefact.id})
    else:
        out.print_data(str(artefact.directory))


@command("report")
def report(
    session: Session,
    kind: Annotated[str, typer.Argument(help=_REPORTS)],
    refs: Annotated[list[str] | None, typer.Argument(help="Evaluations, for returns.")] = None,
    seeds: Annotated[
        str | None, typer.Option(help="Of the reward learning; 0,1,2,3,4 by default.")
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help="erm,irm,erm-balanced,irm-shuffled by default.")
    ] = None,
    env: Annotated[str | None, typer.Option(help="Only this environment's rows.")] = None,
    choose_penalty: Annotated[
        str | None, typer.Option(help="Candidates for lambda that train-airl chose from.")
    ] = None,
    form: Annotated[
        str | None, typer.Option("--format", help="Of table2: text, markdown or latex.")
    ] = None,
    name: Name = None,
) -> None:
    """Put results side by side: ``irl report returns REF...``, ``irl report table1``."""
    if kind not in _REPORTS.split(", "):
        raise UsageError(f"unknown report {kind!r}", f"known: {_REPORTS}")
    compared = {
        "--seeds": seeds,
        "--methods": methods,
        "--env": env,
        "--choose-penalty": choose_penalty,
    }
    if kind == "experts":
        _refuse(kind, {**compared, "--env": None, "--format": form})
    elif kind in ("returns", "figure2", "table2"):
        _refuse(kind, {**compared, "--format": form if kind != "table2" else None})
    else:
        _refuse(kind, {"--format": form})
    if kind != "returns" and refs:
        raise UsageError(f"{kind} takes no references", "its runs are found by their settings")
    if kind == "returns":
        _refuse(kind, {"--name": name})
        if not refs:
            raise UsageError(
                "no evaluation is named: refs are missing", "irl report returns REF..."
            )
        _report_returns(session, refs)
    elif kind == "figure2":
        _report_figure2(session, name)
    elif kind == "experts":
        _report_experts(session, env, name)
    elif kind == "table2":
        _refuse(
            kind,
            {"--name": name, "--json, which has the values, with --format": form}
            if session.as_json
            else {"--name": name},
        )
        _print_table2(session, form or "text")
    else:
        _report_experiment(session, kind, methods, seeds, env, choose_penalty, name)


def _refuse(kind: str, options: dict[str, Any]) -> None:
    for option, value in options.items():
        if value is not None:
            raise UsageError(f"{kind} takes no {option}", "`irl report --help` says what it is of")


def _report_experiment(
    session: Session,
    kind: str,
    methods: str | None,
    seeds: str | None,
    env: str | None,
    choose_penalty: str | None,
    name: str | None,
) -> None:
    import shlex

    from irlcli.experiments import matrix as experiments
    from irlcli.experiments.runner import Runner
    from irlcli.store import read_json

    chosen = experiments.METHODS if methods is None else tuple(methods.split(","))
    try:
        numbers = tuple(int(seed) for seed in ("0,1,2,3,4" if seeds is None else seeds).split(","))
    except ValueError:
        raise UsageError(f"--seeds {seeds!r} is no list of seeds", "write 0,1,2,3,4") from None
    if min(numbers) < 0:
        raise UsageError(f"--seeds {seeds!r}: no seed -1 or below", "seeds are 0 or more")
    words = _words(session, kind)
    words += ["--seeds", ",".join(map(str, numbers)), "--methods", ",".join(chosen)]
    words += [] if env is None else ["--env", env]
    candidates: Sequence[float] = ()
    if choose_penalty is not None:
        words += ["--choose-penalty", choose_penalty]
        candidates = _numbers("--choose-penalty", choose_penalty)
    request = experiments.request(
        kind,
        Runner(session.store),
        session.settings,
        chosen,
        numbers,
        shlex.join(words),
        env,
        candidates,
    )
    for artefact in session.deliver([request], name, table=f"{kind}.json"):
        if not session.as_json:
            _print_report(read_json(session.store.open(artefact, f"{kind}.json")))


def _words(session: Session, kind: str) -> list[str]:
    """The command line that asks for report ``kind`` under the same settings again."""
    words = ["irl", "report", kind, "--profile", session.profile]
    words += [] if session.settings_file is None else ["--settings", str(session.settings_file)]
    return words + [word for item in session.overrides for word in ("--set", item)]


def _report_experts(session: Session, env: str | None, name: str | None) -> None:
    import shlex

    from irlcli.envs.registry import ENVIRONMENTS
    from irlcli.experiments import matrix as experiments
    from irlcli.experiments.runner import Runner
    from irlcli.interventions import check_tabular
    from irlcli.store import read_json

    words = _words(session, "experts") + ([] if env is None else ["--env", env])
    if env is not None:
        check_tabular(env, "report experts", wanted=False)
    envs = [e.name for e in ENVIRONMENTS.values() if env in (None, e.name) and not e.tabular]
    request = experiments.experts(Runner(session.store), session.settings, shlex.join(words), envs)
    for artefact in session.deliver([request], name, table="experts.json"):
        if not session.as_json:
            _print_report(read_json(session.store.open(artefact, "experts.json")))


def _print_report(report: dict[str, Any]) -> None:
    for table in report["tables"]:
        if table["title"] != "Every cell":
            out.print_table(table["columns"], table["rows"], table["title"], stderr=True)
            print(f"{table['note']}\n" if table["note"] else "", file=sys.stderr)
    for note in report["notes"]:
        print(f"- {note}", file=sys.stderr)


def _print_table2(session: Session, form: str) -> None:
    """Paper Table 2, from the settings files."""
    from irlcli.envs.registry import ENVIRONMENTS
    from irlcli.report.tables import latex_table, markdown_table

    forms = ("text", "markdown", "latex")
    if form not in forms:
        raise UsageError(f"unknown --format {form!r}", f"known: {', '.join(forms)}")
    listed = [
        (env, knob, values)
        for env, environment in ENVIRONMENTS.items()
        if not environment.tabular
        for knob, values in session.settings(env).interventions.items()
    ]
    if session.as_json:
        items = [
            {"env": env, "knob": knob, "id": list(values.id), "ood": list(values.ood)}
            for env, knob, values in listed
        ]
        out.print_json("table2", {"rows": items})
        return
    columns = ["environment", "intervention", "values (ID)", "values (OOD)"]
    rows = [[env, knob, ", ".join(v.id), ", ".join(v.ood)] for env, knob, v in listed]
    if form == "markdown":
        out.print_data(markdown_table(columns, rows).rstrip())
    elif form == "latex":
        out.print_data(latex_table(columns, rows, "Interventional settings").rstrip())
    else:
        out.print_table(columns, rows)


def _report_figure2(session: Session, name: str | None) -> None:
    from irlcli.stages import figure2

    config = session.settings("gridworld")
    settings = _settings("gridworld", config, "path-group", "id")
    request = figure2.request("gridworld", settings, _unseen("gridworld", config), config)
    artefacts = session.deliver([request], name)
    if artefacts and not session.as_json:
        print(session.store.open(artefacts[0], "figure2.md").read_text(), file=sys.stderr, end="")


def _report_returns(session: Session, refs: Sequence[str]) -> None:
    from irlcli.experiments.references import by_own_reward, circumstances, evaluation

    named = [evaluation(session.store, ref) for ref in refs]
    index = session.store.index()
    made = [(s, circumstances(a, index), by_own_reward(a, index)) for a, s in named]
    _print_returns(session, made)


def _print_returns(session: Session, evaluations: Sequence[Any], stderr: bool = False) -> None:
    from irlcli.report.returns import rows

    found = rows(evaluations)
    if session.as_json:
        items = [
            {
                "agent": row.agent,
                "env": row.env,
                "setting": row.setting,
                "returns": list(row.returns),
                "mean": row.mean,
                "std_over_seeds": row.deviation,
                "mean_progress": row.progress,
                "mean_learned_return": row.learned,
                "episodes_per_seed": row.episodes,
            }
            for row in found
        ]
        out.print_json("returns", {"rows": items})
        return
    table = [
        [
            row.agent,
            f"{row.env} {row.setting}",
            f"{row.mean:.1f}",
            "-" if row.deviation is None else f"{row.deviation:.1f}",
            str(len(row.returns)),
            str(row.episodes),
        ]
        for row in found
    ]
    columns = ["agent", "setting", "true return", "sd over seeds", "seeds", "episodes each"]
    more = {"learned return": [r.learned for r in found], "progress": [r.progress for r in found]}
    for place, (column, values) in zip((4, 3), more.items(), strict=True):
        if any(value is not None for value in values):
            columns.insert(place, column)
            for cells, value in zip(table, values, strict=True):
                cells.insert(place, "-" if value is None else f"{value:.1f}")
    out.print_table(columns, table, stderr=stderr)


def _artefact(session: Session, ref: str) -> Any:
    resolved = session.store.resolve(ref)
    if resolved.artefact is None:
        raise NotFound(f"{ref!r} is a file outside the store", "`irl ls` lists the artefacts")
    return resolved.artefact


def build_app(arguments: Sequence[str]) -> typer.Typer:
    """The command line; only the command that ``arguments`` begin with, if they name one.

    Typer inspects every option of every command it holds, which takes longer than a hit.
    """
    app = typer.Typer(
        name="irl",
        help="Invariant reward learning: experts, adversarial IRL, transfer, evaluation.",
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    # A callback keeps it a group of commands when there is only one.
    app.callback()(_top)
    first = arguments[0] if arguments else ""
    for name, (function, runs) in _COMMANDS.items():
        if first not in _COMMANDS or name == first:
            app.command(name)(_with_common_options(function, runs))
    return app


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        out.print_data(f"irlcli {version('irlcli')}")
        raise typer.Exit


def _top(
    version: Annotated[
        bool, typer.Option("--version", help="Print it.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point: exit codes and one-line errors (design: Command line)."""
    try:
        _main()
    except KeyboardInterrupt:
        # A second Ctrl-C, on the way out from the first.
        _fail(Interrupted("interrupted", "run the same command again to go on"), _as_json())


def _main() -> None:
    # Most of a light command is importing, which makes no garbage; the runner switches the
    # collector on again when there is work to do.
    garbage_collector.disable()
    as_json = _as_json()
    out.prepare_streams()
    try:
        # Without arguments, what there is to ask for; typer would call that an error.
        arguments = sys.argv[1:] or ["--help"]
        # Typer catches a KeyboardInterrupt itself and returns its exit code.
        code = build_app(arguments)(arguments, standalone_mode=False)
        if code == Interrupted.exit_code:
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        _fail(Interrupted("interrupted", "run the same command again to go on"), as_json)
    except IrlError as error:
        _fail(error, as_json)
    except MemoryError:
        _fail(StageFailed("out of memory", "nothing is half-written: free some and go on"), as_json)
    except BrokenPipeError:
        out.hang_up()
    except OSError as error:
        if _debugging():
            raise
        where = f": {error.filename}" if error.filename else ""
        hint = "nothing is half-written: mend the cause and run the same command again"
        _fail(StageFailed(f"{error.strerror or error}{where}", hint), as_json)
    except Exception as error:
        if hasattr(error, "format_message"):
            _fail(_usage(error), as_json)
        if _debugging():
            raise
        text = (str(error) or "no message").splitlines()[0]
        _fail(
            StageFailed(
                f"unexpected {type(error).__name__}: {text}",
                "this is a defect: run again with --debug and report the traceback",
            ),
            as_json,
        )


def _usage(error: Any) -> UsageError:
    """A mistake that the argument parser found, as one of ours."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "irl"
    message = error.format_message().replace("\n", " ").rstrip(".")
    return UsageError(message[0].lower() + message[1:], f"`{path} --help` shows what it takes")


def _fail(error: IrlError, as_json: bool) -> None:
    # From here on there is nothing left to interrupt.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _debugging():
        import traceback

        traceback.print_exc()
    try:
        out.print_error(error, as_json)
    finally:
        # Also where nobody reads the message: the code says the same.
        sys.exit(error.exit_code)


def _as_json() -> bool:
    return "--json" in sys.argv


def _debugging() -> bool:
    return "--debug" in sys.argv


if __name__ == "__main__":
    main()
