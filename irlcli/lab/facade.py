"""The stages of the command line as methods, for a notebook or a script."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Unpack

from irlcli.configs.load import overridden
from irlcli.envs import registry
from irlcli.lab.arguments import (
    Configs,
    Overrides,
    fixed,
    joined,
    listed,
    merged,
    number,
    overrides,
    plainly,
    text_of,
    texts,
    whole,
    words,
)
from irlcli.lab.display import console
from irlcli.lab.stored import Evaluations, PlannedTable, Stored
from irlcli.requests import assess as assessment
from irlcli.requests import collect, train
from irlcli.requests import evaluate as evaluation
from irlcli.requests import tables as planning
from irlcli.requests import transfer as retraining
from irlcli.requests.session import StageSession
from irlcli.stages.base import Request

Ref = Stored | str | Path


class Lab:
    """A store, and how to fill it: each method runs the stage of the command of the same name.

    Arguments are the command's options, and the artefacts are the same: what a command made is a
    hit here, and the reverse. A stage shows its progress, in a notebook below the cell. Interrupted
    (Ctrl-C, or Interrupt in a notebook), it saves a checkpoint and raises
    :class:`irlcli.errors.Interrupted`; the same call resumes.

    Args:
        store: directory of the store; the first artefact creates it.
        profile: ``smoke``, ``standard`` or ``paper``.
        settings: TOML file that overrides the profile.
        set: other hyperparameters: ``{"airl.penalty_weight": 30}``, or ``["airl.penalty_weight=30"]``.
        from_: other stores, directories or URLs, to copy missing artefacts from.
        workers: processes that step environments.
        wait: wait while another process makes the same artefact, instead of raising
            :class:`irlcli.errors.Busy`.
        quiet: show warnings only.

    Raises:
        UsageError: an unknown profile or field. Every method raises :class:`irlcli.errors.IrlError`: its
            subclasses stand for the command line's exit codes.
    """

    @plainly
    def __init__(
        self,
        store: str | Path = "runs",
        *,
        profile: str = "standard",
        settings: str | Path | None = None,
        set: Overrides = (),
        from_: str | Path | Sequence[str | Path] = (),
        workers: int = 1,
        wait: bool = True,
        quiet: bool = False,
    ):
        # A notebook may change its working directory.
        self.store = Path(fixed(store))
        self.profile = profile
        self.settings = None if settings is None else fixed(settings)
        self.set = overrides(set)
        overridden(self.set)
        self.sources = [fixed(source) for source in listed(from_)]
        self.workers = whole("workers", workers, 1)
        self.wait = wait
        self._console = console(quiet)
        self._session({}, [])

    def __repr__(self) -> str:
        return f"irlcli.Lab({str(self.store)!r}, profile={self.profile!r})"

    @plainly
    def artefact(self, ref: Ref) -> Stored:
        """The artefact that ``ref`` names: a path, a name, or an id prefix of 3 or more digits."""
        with self._at_work({}, []) as session:
            return Stored(session, session.artefact(self._ref(ref)))

    @plainly
    def collect_experts(
        self,
        env: str | Path,
        intervention: str | Sequence[str] | None = None,
        *,
        setting: str | Sequence[str] = (),
        expert: Mapping[str, Ref] | None = None,
        trust: bool = False,
        episodes: int | Sequence[int] | None = None,
        seed: int = 0,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Stored:
        """Train an expert per setting and record its demonstrations.

        Args:
            env: environment, or a TOML file that describes one.
            intervention: ``engine-power=1x,1.25x``, or a knob for its training values in the settings file.
            setting: settings of several knobs, each ``mass=2x,friction=0.5``.
            expert: experts of settings, instead of training them: policies, or ``.zip`` files of
                stable-baselines3, which need ``trust``: loading runs the code in them.
            episodes: of every setting, or of each.
            seed: of the recorded episodes.
            name: to give the artefact.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        options = self._options(locals())
        options["expert"] = [f"{where}={self._ref(who)}" for where, who in (expert or {}).items()]
        options["episodes"] = joined(episodes)
        with self._at_work(configs, words("collect-experts", options)) as session:
            stored = self._run(session, collect.collect_experts(session, **options), name)
            collect.warn_of_missed_bars(session, collect.summary(session, stored._artefact))
            return stored

    @plainly
    def import_demonstrations(
        self,
        recordings: str | Path | Sequence[str | Path],
        env: str | Path,
        intervention: str | Sequence[str] | None = None,
        *,
        setting: str | Sequence[str] = (),
        setting_column: str | None = None,
        cut: bool = False,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Stored:
        """Demonstrations that were recorded elsewhere, as an artefact (``irl import``).

        Args:
            recordings: ``FILE.parquet``, ``minari:DATASET``, or a directory of imitation's
                trajectories; one for all settings, or one per setting.
            env, intervention, setting: in which they were recorded.
            setting_column: column, or key of an episode's metadata, that names its setting; by
                default ``setting`` if there are several.
            cut: cut long episodes, accept those without an end, leave out empty ones.
            name: to give the artefact.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        options = self._options(locals())
        sources = [text_of(source) for source in listed(options.pop("recordings"))]
        with self._at_work(configs, words("import", options, *sources)) as session:
            request = collect.import_demonstrations(session, recordings=sources, **options)
            return self._run(session, request, name)

    @plainly
    def train_airl(
        self,
        demos: Ref,
        method: str | None = None,
        *,
        grouping: str | None = None,
        penalty: str | None = None,
        penalty_weight: float | None = None,
        choose_penalty: Sequence[float] | str | None = None,
        select: str | None = None,
        state_only: bool | None = None,
        env: str | Path | None = None,
        seed: int = 0,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Stored:
        """Learn a reward and a student policy from demonstrations.

        Args:
            demos: demonstrations.
            method: ``erm``, ``irm``, ...: a grouping and a penalty, which can also be given.
            penalty_weight: lambda.
            choose_penalty: candidates for lambda, compared in a setting left out of training, or
                ``own`` for the penalty's.
            select: round to keep: ``last``, or the best on ``episodes`` or in a setting.
            state_only: reward g(s) instead of g(s, a).
            env: TOML file of the environment, for demonstrations outside the store.
            seed: of everything random.
            name: to give the artefact.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        options = self._options(locals())
        with self._at_work(configs, words("train-airl", options)) as session:
            request = train.train_airl(session, **options, name=name)
            assert request is not None  # A lab has no dry run.
            return self._run(session, request, name)

    @plainly
    def train_maxent(
        self,
        demos: Ref,
        method: str | None = None,
        *,
        grouping: str | None = None,
        penalty: str | None = None,
        penalty_weight: float | None = None,
        l2: float | None = None,
        features: str | None = None,
        seed: int = 0,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Stored:
        """Learn a reward from demonstrations in a gridworld, exactly.

        Args:
            demos, method, grouping, penalty, penalty_weight, seed, name, configs: as for
                :meth:`train_airl`.
            l2: weight decay.
            features: ``learned`` or ``linear``.
        """
        options = self._options(locals())
        with self._at_work(configs, words("train-maxent", options)) as session:
            return self._run(session, train.train_maxent(session, **options), name)

    @plainly
    def transfer(
        self,
        reward: Ref,
        ood: str | Sequence[str] | None = None,
        *,
        intervention: str | Sequence[str] | None = None,
        setting: str | Sequence[str] = (),
        algorithm: str | None = None,
        start: str = "scratch",
        env: str | Path | None = None,
        seed: int = 0,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Stored:
        """Train a new policy on a frozen reward in one setting.

        Args:
            reward: a learned reward.
            ood, intervention, setting: the setting; one of them. ``ood="3x"`` is a value of the
                knob that the reward was learned with.
            algorithm: retraining algorithm.
            start: ``scratch``, or ``student``: the policy trained while the reward was learned.
            env: TOML file of the environment, for a reward outside the store.
            seed: of everything random.
            name: to give the artefact.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        options = self._options(locals())
        with self._at_work(configs, words("transfer", options)) as session:
            return self._run(session, retraining.transfer(session, **options), name)

    @plainly
    def evaluate(
        self,
        policy: Ref | None = None,
        ood: str | Sequence[str] | None = None,
        *,
        expert: bool = False,
        trained_in: str | Sequence[str] | None = None,
        random: bool = False,
        idle: bool = False,
        reward: Ref | None = None,
        intervention: str | Sequence[str] | None = None,
        setting: str | Sequence[str] = (),
        env: str | Path | None = None,
        episodes: int | None = None,
        seed: int = 0,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Evaluations:
        """Measure the return of a policy, an expert or a baseline.

        Args:
            policy: a policy, or an artefact with one. Or one of ``expert=True`` (the expert of each
                setting), ``random=True`` and ``idle=True``.
            ood, intervention, setting: settings; by default those the policy was trained in.
            trained_in: with ``expert``: the experts of these settings, each in every setting named.
            reward: a learned reward that also scores the episodes.
            env: the environment of experts and baselines.
            episodes: per setting.
            seed: of the episodes.
            name: to give the artefact.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        options = self._options(locals())
        options["episodes"] = None if episodes is None else whole("episodes", episodes, 1)
        with self._at_work(configs, words("evaluate", options)) as session:
            requests = evaluation.evaluate(session, **options, name=name)
            session.warn_before(requests)
            return Evaluations([Stored(session, a) for a in session.run(requests, name)])

    @plainly
    def assess(
        self,
        reward: Ref,
        ood: str | Sequence[str] | None = None,
        *,
        intervention: str | Sequence[str] | None = None,
        setting: str | Sequence[str] = (),
        demos: Ref | None = None,
        env: str | Path | None = None,
        episodes: int | None = None,
        seed: int = 0,
        name: str | None = None,
        **configs: Unpack[Configs],
    ) -> Stored:
        """Measure how well a learned reward ranks policies of mixed quality.

        Args:
            reward: a learned reward.
            ood, intervention, setting: settings; by default those the reward was learned in.
            demos: demonstrations to clone for the bank; by default the reward's own.
            env: TOML file of the environment, for a reward outside the store.
            episodes: of each policy.
            seed: of the episodes, and of the clone's training.
            name: to give the artefact.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        options = self._options(locals())
        options["episodes"] = None if episodes is None else whole("episodes", episodes, 1)
        ref = options.pop("reward")
        with self._at_work(configs, words("assess", options, ref)) as session:
            return self._run(session, assessment.assess(session, reward=ref, **options)[0], name)

    @plainly
    def plan(
        self,
        table: str,
        *,
        seeds: int | Sequence[int] | None = None,
        methods: str | Sequence[str] | None = None,
        rows: str | Path | Sequence[str | Path] | None = None,
        choose_penalty: Sequence[float] | str | None = None,
        until: str | None = None,
        only: str | None = None,
        tag: str | None = None,
        experiments: str | Path | None = None,
        **configs: Unpack[Configs],
    ) -> PlannedTable:
        """Which steps of a table exist or are missing, and why. Nothing is computed or written.

        Args:
            table: ``table1``, ...
            seeds, methods, rows: a subset of the table's.
            choose_penalty: candidates for lambda, or ``own``.
            until: last phase: ``experts``, ``demos``, ``rewards``, ``transfers`` or ``returns``.
            only: one step and what it needs.
            tag: what the names of the steps begin with; by default the profile.
            experiments: TOML file with tables, instead of ``settings/experiments.toml``.
            configs: ``profile``, ``settings`` and ``set`` of this call.
        """
        chosen = planning.TableChoice(
            table,
            joined(seeds),
            joined(methods),
            joined(rows),
            joined(choose_penalty),
            until,
            only,
            tag,
            None if experiments is None else Path(experiments),
        )
        with self._at_work(configs, [], read_only=True) as session:
            plan = planning.open_plan(session, chosen)
            planning.check_tag(session, chosen, plan.table)
            if only is None:
                planning.check_worlds(plan)
            return PlannedTable(table, planning.steps_of(plan, session.console.warn))

    def _session(
        self, configs: Configs, line: Sequence[str], read_only: bool = False
    ) -> StageSession:
        """A session for one call, which artefacts record as the command ``line``."""
        settings = configs.get("settings", self.settings)
        asked = overrides(configs.get("set", ()))
        session = StageSession(
            self.store,
            self._console,
            profile=configs.get("profile", self.profile),
            file=None if settings is None else Path(settings),
            overrides=merged(self.set, asked),
            asked=asked,
            sources=self.sources,
            command=(),
            wait=self.wait,
            workers=self.workers,
            read_only=read_only,
        )
        places = ["--store", str(self.store)]
        places += [word for source in self.sources for word in ("--from", source)]
        session.command = [*line, *session.config_words(), *places]
        return session

    @contextmanager
    def _at_work(
        self, configs: Configs, line: Sequence[str], read_only: bool = False
    ) -> Iterator[StageSession]:
        with registry.apart():
            session = self._session(configs, line, read_only)
            with session.reading():
                yield session

    def _run(self, session: StageSession, request: Request, name: str | None) -> Stored:
        session.warn_before([request])
        return Stored(session, session.run([request], name)[0])

    def _options(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """A method's arguments, its ``locals()``, as the command's options take them."""
        options = {}
        for name, value in given.items():
            if name in ("self", "name", "configs"):
                continue
            if name in ("demos", "policy", "reward"):
                value = None if value is None else self._ref(value)
            elif name in ("env", "intervention", "ood", "trained_in", "choose_penalty"):
                value = joined(value)
            elif name == "setting":
                value = texts("setting", value)
            elif name in ("penalty_weight", "l2"):
                value = number(name, value)
            elif name == "seed":
                value = whole(name, value)
            options[name] = value
        return options

    def _ref(self, ref: Ref) -> str:
        if not isinstance(ref, Stored):
            return text_of(ref)
        return ref.id if ref.path.parent == self.store else str(ref.path)
