"""The requests behind each row of a table: named tasks, and the cells of the report they fill.

A task's name is that of its row and what it makes::

    ROW.expert.VALUE  ROW.demos  ROW.METHOD.SEED  ROW.METHOD.SEED.transfer
    ROW.expert-returns  ROW.random-returns  ROW.idle-returns     in the unseen setting
    ROW.expert.VALUE.returns                                     in the expert's own setting
    ROW.expert.VALUE.reused-returns  ....reused-id-returns       in the unseen one, in all trained
    ROW.METHOD.SEED.zero-shot-returns  ....id-returns  ....transfer-returns  ....expert-by-reward
    ROW.METHOD.SEED.from-student  ....from-student-returns
    ROW.METHOD.SEED.transfer-id.VALUE  ....transfer-id.VALUE-returns
    ROW.METHOD.SEED.transfer-1  ....transfer-1-returns  ...      further retrainings
    ROW.VARIANT.METHOD.SEED...                                   of tables with variants
    ROW.METHOD.SEED.choice                                       lambda, with --choose-penalty
    ROW.METHOD.SEED.choice.LAMBDA.without-VALUE  ....returns     its trials
    ROW.METHOD.SEED.cue
    ROW.clone  ROW.bank.POLICY.VALUE  ROW.METHOD.SEED.bank.POLICY.VALUE  ROW.METHOD.SEED.assess
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import msgspec

from irlcli import labels
from irlcli.data import descriptions
from irlcli.envs.registry import environment
from irlcli.errors import UsageError
from irlcli.experiments.bank import Policies, bank
from irlcli.experiments.status import Lookup
from irlcli.experiments.tables import Row
from irlcli.experiments.variants import ConfigOf
from irlcli.interventions import Setting, listed_settings
from irlcli.methods import method
from irlcli.report.agents import IN_DISTRIBUTION, RETRAINED
from irlcli.report.parameters import (
    ASSESS,
    CUE,
    EXPERT_BY_REWARD,
    EXPERT_LEARNING,
    REWARD_LEARNING,
    TRANSFER_LEARNING,
    Cell,
    has_held_out,
)
from irlcli.stages import (
    assess,
    choose_penalty,
    clone,
    collect_experts,
    evaluate,
    measure_cue,
    train_airl,
    train_expert,
    transfer,
)
from irlcli.stages.base import From, Request, Source
from irlcli.store import file_digest, read_json

Phase = Literal["experts", "demos", "rewards", "transfers", "returns"]
PHASES: tuple[Phase, ...] = get_args(Phase)
# A reward's first policy is retrained with the reward's own seed, the next ones with seeds this far
# apart.
_NEXT_RETRAINING = 1000


class Task(NamedTuple):
    """A named request.

    Attributes:
        phase: which of the phases it belongs to.
        cell: the cell of the report that it fills, if it fills one.
        curves: stages whose metrics the report draws, by their part of the input's role.
    """

    name: str
    phase: Phase
    request: Request
    cell: Cell | None = None
    curves: Mapping[str, Request] = {}


class RewardRun(NamedTuple):
    """One reward of a row, and all that is made with it.

    Attributes:
        agent: the method or the variant, as the report's cells call it.
        shared: the part of the steps' names that all seeds share.
        config_of: the configs of the variant.
    """

    agent: str
    method: str
    seed: int
    shared: str
    config_of: ConfigOf

    @property
    def name(self) -> str:
        """What the names of its steps begin with."""
        return f"{self.shared}.{self.method}.{self.seed}"


class Chosen(NamedTuple):
    """Candidates for lambda, ``own`` for those of each penalty, and where the chosen one is found."""

    candidates: Sequence[float] | Literal["own"]
    lookup: Lookup


def choice_made(choice: Request, lookup: Lookup) -> descriptions.PenaltyChoice | None:
    """What ``choice`` led to; None if it was not made yet, or if its file is damaged."""
    made = lookup(choice).artefact
    path = lookup.file(choice, "choice.json")
    if made is None or path is None:
        return None
    if file_digest(path) != made.output("choice.json").sha256:
        # What needs it reports the damage when it reads the file.
        return None
    return descriptions.convert(read_json(path), descriptions.PenaltyChoice, path)


class _RowRequests:
    """The requests about the experts of one row, each made once."""

    def __init__(self, row: Row, config_of: ConfigOf):
        self.row = row
        self.config = config_of(row.env, None)
        if row.knob not in self.config.interventions:
            own = environment(row.env).own
            file = f"settings/{row.env}.toml" if own is None else own.source
            raise UsageError(
                f"the settings of {row.env} list no values of {row.knob!r}",
                f"add [interventions.{row.knob}] to {file}",
            )
        self.listed = self.config.interventions[row.knob]
        self.trained, self.unseen = (
            listed_settings(row.env, row.knob, values)
            for values in (self.listed.id, self.listed.ood)
        )
        self._experts: dict[Setting, Request] = {}

    def cell(self, *args: Any, **kwargs: Any) -> Cell:
        return Cell(self.row.name, *args, **kwargs)

    def expert(self, setting: Setting) -> Request:
        if setting not in self._experts:
            self._experts[setting] = train_expert.demonstrator(self.row.env, setting, self.config)
        return self._experts[setting]

    def returns(
        self,
        settings: Sequence[Setting],
        policy: Request | None,
        agent: Literal["policy", "random", "idle"] = "policy",
        reward: Request | None = None,
        policy_label: str = "",
        reward_label: str = "",
        ceiling: float | None = None,
    ) -> Request:
        return evaluate.request(
            self.row.env,
            settings,
            self.config.evaluation,
            None if policy is None else From(policy, "policy.pt"),
            agent,
            policy_label=policy_label,
            reward=None if reward is None else From(reward, "reward.pt"),
            reward_label=reward_label,
            ceiling=ceiling,
        )

    def expert_tasks(self, settings: Sequence[Setting]) -> Iterator[Task]:
        for setting in settings:
            yield Task(f"{self.row}.expert.{_value(setting)}", "experts", self.expert(setting))

    def own_returns(self, setting: Setting) -> tuple[str, Request]:
        """Name and request of an expert's returns in its own setting."""
        only = self.unseen == (setting,)
        name = "expert-returns" if only else f"expert.{_value(setting)}.returns"
        label = f"expert of {setting}"
        request = self.returns([setting], self.expert(setting), policy_label=label)
        return f"{self.row}.{name}", request


class _Learned(NamedTuple):
    """What a method learned, a reward or only a clone, with what its tasks depend on.

    A clone has no ``label``: its policy is measured by the true reward only.

    Attributes:
        requests: of its row, under its own configs.
        demos, learned: what it is learned from, and what learns it.
        measures: of the table.
    """

    requests: _RowRequests
    demos: Request
    learned: Request
    run: RewardRun
    measures: Sequence[str]

    @property
    def curves(self) -> dict[str, Request]:
        """What a cell shows of the reward learning; cloning has no curve."""
        return {REWARD_LEARNING: self.learned} if self.learned.stage.name == "train-airl" else {}

    @property
    def label(self) -> str:
        return train_airl.reward_label(self.learned.parameters.airl, self.run.seed)

    def cell(self, measure: str, setting: str = "", **kwargs: Any) -> Cell:
        return self.requests.cell(self.run.agent, measure, self.run.seed, setting, **kwargs)


def comparison(
    row: Row,
    measures: Sequence[str],
    retrainings: int,
    runs: Sequence[RewardRun],
    config_of: ConfigOf,
    chosen: Chosen,
) -> Iterator[Task]:
    """The tasks of a row that compares ``runs``; each after what it needs.

    Each reward is retrained ``retrainings`` times.

    Raises:
        UsageError: the settings list no values of the knob, or not one unseen one; or a config is
            contradictory.
    """
    requests = _RowRequests(row, config_of)
    trained, unseen = requests.trained, requests.unseen
    if not trained or len(unseen) != 1:
        raise UsageError(
            f"{row}: settings to train in: {len(trained)}, held out: {len(unseen)}",
            "a row needs at least one to train in and exactly one held out",
        )
    yield from requests.expert_tasks([*trained, *(unseen if has_held_out(measures) else ())])
    demos = collect_experts.request(row.env, trained, requests.config, 0, requests.listed.episodes)
    yield Task(f"{row}.demos", "demos", demos)
    yield from _without_reward(requests, measures)
    under = {config_of: requests}
    for run in runs:
        try:
            if run.config_of not in under:
                under[run.config_of] = _RowRequests(row, run.config_of)
            yield from _run(under[run.config_of], demos, run, measures, retrainings, chosen)
        except UsageError as error:
            hint = error.hint
            if run.agent != run.method:
                hint += "; a variant's own values win over --set"
            raise UsageError(f"{row}, {run.agent}: {error.message}", hint) from None


def _without_reward(requests: _RowRequests, measures: Sequence[str]) -> Iterator[Task]:
    """What the experts, the random and the idle agent earn.

    The held-out setting and its expert belong to a table only if a measure is taken there.
    """
    row, trained, unseen = requests.row, requests.trained, requests.unseen
    held_out, setting = has_held_out(measures), str(unseen[0])
    if held_out:
        for agent in ("random", "idle"):
            cell = requests.cell(agent, "ood", setting=setting)
            request = requests.returns(unseen, None, agent)
            yield Task(f"{row}.{agent}-returns", "returns", request, cell)
        name, request = requests.own_returns(unseen[0])
        yield Task(name, "returns", request, requests.cell("expert", "ood", setting=setting))
    measured = {"ood": unseen} if held_out else {}
    in_distribution = not set(IN_DISTRIBUTION).isdisjoint(measures)
    if in_distribution:
        measured["id"] = trained
    for e in trained:
        expert, label = requests.expert(e), f"expert of {e}"
        if in_distribution:
            name, request = requests.own_returns(e)
            yield Task(name, "returns", request, requests.cell("expert", "id", setting=str(e)))
        # If one expert demonstrates in every setting, reusing it would repeat the setting's own.
        if expert == requests.expert(unseen[0]):
            continue
        for measure, settings in measured.items():
            name = f"{row}.expert.{_value(e)}.reused{'-id' * (measure == 'id')}-returns"
            request = requests.returns(settings, expert, policy_label=label)
            yield Task(name, "returns", request, requests.cell("reused", measure, setting=str(e)))


def _run(
    requests: _RowRequests,
    demos: Request,
    run: RewardRun,
    measures: Sequence[str],
    retrainings: int,
    chosen: Chosen,
) -> Iterator[Task]:
    """One method or variant with one seed: the reward, and what its policies earn."""
    env, trained = requests.row.env, requests.trained
    if not method(run.method).learns_reward:
        cloned = clone.request(From(demos), env, trained, requests.config, run.seed)
        yield Task(run.name, "rewards", cloned)
        yield from _imitation(_Learned(requests, demos, cloned, run, measures))
        return
    airl = run.config_of(env, run.method).airl_of(trained)
    basis = {}
    if chosen.candidates and airl.penalty != "none":
        choice = choose_penalty.request(
            From(demos),
            env,
            trained,
            airl,
            requests.config.evaluation,
            chosen.candidates,
            run.seed,
        )
        yield from _choice(f"{run.name}.choice", choice)
        made = choice_made(choice, chosen.lookup)
        if made is not None:
            airl = msgspec.structs.replace(airl, penalty_weight=made.chosen)
        basis = {"penalty choice": From(choice, "choice.json")}
    learned = train_airl.request(From(demos), env, trained, airl, run.seed, basis)
    yield Task(run.name, "rewards", learned)
    reward = _Learned(requests, demos, learned, run, measures)
    yield from _imitation(reward)
    retrained: dict[assess.Entry, From] = {}
    for measure in (measure for measure in RETRAINED if measure in measures):
        for retraining in range(retrainings):
            for setting in trained if measure == "transfer-id" else requests.unseen:
                moved = _retraining(reward, measure, setting, retraining)
                yield from _retrained(reward, moved, measure, setting, retraining)
                entry = assess.Entry(
                    policy=_known_as(measure, retraining),
                    kind="from-student" if measure == "from-student" else "retrained",
                    setting=str(setting),
                    ceiling=moved.parameters.transfer.ceiling,
                    gamma=moved.parameters.transfer.algorithm_config.gamma,
                )
                retrained[entry] = From(moved, "policy.pt")
    if "transfer" in measures:
        yield _expert_by_reward(reward)
    if CUE in measures:
        request = measure_cue.request(
            From(learned, "reward.pt"), From(demos), env, trained, reward.label
        )
        yield Task(f"{run.name}.cue", "returns", request, reward.cell(CUE), reward.curves)
    if ASSESS in measures:
        yield from _assessment(reward, retrained)


def _imitation(reward: _Learned) -> Iterator[Task]:
    """What the policy earns that was trained on the demonstrations: a student, or a clone."""
    requests, run = reward.requests, reward.run
    label = f"{reward.learned.stage.name} {run.agent} of seed {run.seed}"
    for measure, settings in (("zero-shot", requests.unseen), ("id", requests.trained)):
        if measure in reward.measures:
            request = requests.returns(settings, reward.learned, policy_label=label)
            name = f"{run.name}.{measure}-returns"
            yield Task(name, "returns", request, reward.cell(measure), reward.curves)


def _expert_by_reward(reward: _Learned) -> Task:
    """The learned return of the unseen setting's expert."""
    requests = reward.requests
    (setting,) = requests.unseen
    request = requests.returns(
        [setting],
        requests.expert(setting),
        reward=reward.learned,
        policy_label=f"expert of {setting}",
        reward_label=reward.label,
        ceiling=requests.config.transfer_of(setting).ceiling,
    )
    cell = reward.cell(EXPERT_BY_REWARD, str(setting))
    return Task(f"{reward.run.name}.expert-by-reward", "returns", request, cell)


def _assessment(reward: _Learned, retrained: Mapping[assess.Entry, From]) -> Iterator[Task]:
    """The bank of a row's policies, and how well the reward ranks them.

    It has the unseen setting only where another measure does.
    """
    requests, run = reward.requests, reward.run
    row, trained, unseen = requests.row, requests.trained, requests.unseen
    settings = [*trained, *(unseen if has_held_out(reward.measures) else ())]
    imitation = clone.request(From(reward.demos), row.env, trained, requests.config)
    yield Task(f"{run.shared}.clone", "returns", imitation)
    experts = {str(e): From(requests.expert(e), "policy.pt") for e in settings}
    policies = Policies(
        clone=From(imitation, "policy.pt"),
        student=From(reward.learned, "policy.pt"),
        reused={str(e): experts[str(e)] for e in trained},
        experts=experts,
        retrained=retrained,
    )
    members = bank(row.env, settings, requests.config, policies)
    for entry, recorded in members.items():
        own = entry.kind in ("student", "retrained", "from-student")
        owner = run.name if own else run.shared
        # The sign stays: it tells the expert of goal-y=-900 from that of goal-y=900.
        policy = entry.policy.replace(f"{row.knob}=", "").replace("+", "")
        policy = re.sub(r"[ ,:]+", "-", policy)
        yield Task(f"{owner}.bank.{policy}.{_value(entry.setting)}", "returns", recorded)
    request = assess.request(From(reward.learned, "reward.pt"), row.env, members, reward.label)
    yield Task(f"{run.name}.assess", "returns", request, reward.cell(ASSESS), reward.curves)


def _known_as(measure: str, retraining: int) -> str:
    """A retrained policy's name in a bank; no two in one setting share it."""
    name = "retrained from the student" if measure == "from-student" else "retrained"
    return f"{name} {retraining + 1}" if retraining else name


def _retraining(reward: _Learned, measure: str, setting: Setting, retraining: int) -> Request:
    """A policy trained on the reward in ``setting``."""
    return transfer.request(
        From(reward.learned, "reward.pt"),
        reward.requests.row.env,
        setting,
        reward.requests.config.transfer_of(setting),
        reward.run.seed + retraining * _NEXT_RETRAINING,
        reward.label,
        From(reward.learned, "policy.pt") if measure == "from-student" else None,
    )


def _retrained(
    reward: _Learned, moved: Request, measure: str, setting: Setting, retraining: int
) -> Iterator[Task]:
    """The policy of ``moved``, and what it earns in ``setting``, by the reward too."""
    in_distribution = measure == "transfer-id"
    cell = reward.cell(measure, str(setting) if in_distribution else "", retraining=retraining)
    name = f"{reward.run.name}.{measure}"
    name += f".{_value(setting)}" if in_distribution else ""
    # No dot: the policy of 0 that is retrained again is not that of 0.1.
    name += f"-{retraining}" if retraining else ""
    yield Task(name, "transfers", moved)
    config = moved.parameters.transfer
    how = labels.retrained(
        config.algorithm, config.ceiling, measure == "from-student", config.restarts
    )
    request = reward.requests.returns(
        [setting],
        moved,
        reward=reward.learned,
        policy_label=f"transfer {cell.agent} {how}".strip() + f" of seed {moved.parameters.seed}",
        reward_label=reward.label,
        # Learned returns are compared for this measure only.
        ceiling=config.ceiling if measure == "transfer" else None,
    )
    first = measure == "transfer" and not retraining
    own = {TRANSFER_LEARNING: moved} if first else {}
    yield Task(f"{name}-returns", "returns", request, cell, reward.curves | own)


def _choice(name: str, choice: Request) -> Iterator[Task]:
    """The choice of lambda, after the rewards learned for it and what their students earn."""
    for measured in map(made_by, choice.inputs.values()):
        learned = made_by(measured.inputs["policy"])
        left_out = _value(measured.parameters.settings[0])
        weight = repr(learned.parameters.airl.penalty_weight).removesuffix(".0").replace("+", "")
        trial = f"{name}.{weight}.without-{left_out}"
        yield Task(trial, "rewards", learned)
        yield Task(f"{trial}.returns", "rewards", measured)
    yield Task(name, "rewards", choice)


def experts(row: Row, config_of: ConfigOf) -> Iterator[Task]:
    """The experts of a row's settings, and what they, the random and the idle agent earn there."""
    requests = _RowRequests(row, config_of)
    for measure, settings in (("id", requests.trained), ("ood", requests.unseen)):
        if not settings:
            continue
        yield from requests.expert_tasks(settings)
        for agent in ("random", "idle"):
            name = f"{row}.{agent}{'-id' * (measure == 'id')}-returns"
            request = requests.returns(settings, None, agent)
            yield Task(name, "returns", request, requests.cell(agent, measure))
        for setting in settings:
            name, request = requests.own_returns(setting)
            cell = requests.cell("expert", measure, setting=str(setting))
            yield Task(name, "returns", request, cell, {EXPERT_LEARNING: requests.expert(setting)})


def made_by(source: Source | From) -> Request:
    """The request that makes an input."""
    assert isinstance(source, From)
    return source.request


def _value(setting: Setting | str) -> str:
    """A setting's value as a part of a name."""
    return str(setting).partition("=")[2].replace(":", "_").replace("+", "")
