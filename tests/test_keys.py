"""Keys are complete: every field, the physics, the horizon and the versions change them.

For each stage a request is built from a config in which every option is in use. Then each field
of the whole config is changed, one at a time: the key changes if and only if the field belongs to
the stage or to one of its inputs.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args, get_origin

import msgspec
import pytest
from msgspec.structs import replace

from irlcli import stages
from irlcli.configs import Config, InterventionConfig, load_config
from irlcli.configs.relevance import relevant_airl, relevant_maxent
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.errors import UsageError
from irlcli.experiments.bank import Policies, bank
from irlcli.interventions import parse_settings
from irlcli.learners import LEARNERS
from irlcli.penalties import PENALTIES
from irlcli.requests.overrides import behind
from irlcli.rl import ALGORITHMS
from irlcli.stages import (
    assess,
    choose_penalty,
    clone,
    collect_experts,
    control,
    control_labels,
    control_maps,
    evaluate,
    figure2,
    import_demonstrations,
    measure_cue,
    record,
    sweep_maxent,
    train_airl,
    train_expert,
    train_maxent,
    transfer,
)
from irlcli.stages.base import From, Request, Source
from irlcli.store import KeyRecord, digest

# Continuous actions, so that no option is refused; three settings, so that two remain where one
# is left out or selects the round.
ENV, MAZE = "reacher", "gridworld"
SETTINGS = parse_settings(ENV, "gravity=0.5x,1x,2x")
(UNSEEN,) = parse_settings(ENV, "gravity=4x")
PATHS = parse_settings(MAZE, "path-group=1,2,3")
BLOCKED = parse_settings(MAZE, "blocked=1")
CUES = parse_settings("half-cheetah", "cue-strength=0.95,0.8")


def key(request: Request) -> str:
    """The key of ``request``, with every input known by the key of its own request."""
    inputs = {
        role: f"{key(source.request)}/{source.output}"
        if isinstance(source, From)
        else source.sha256
        for role, source in request.inputs.items()
    }
    parameters = msgspec.to_builtins(request.parameters)
    return KeyRecord(request.stage.name, request.stage.version, parameters, inputs).key


def expert(config: Config, seed: int = 0) -> Request:
    return train_expert.request(ENV, SETTINGS[0], seed, config.expert_of(SETTINGS[0]))


def demos(config: Config, seed: int = 0) -> Request:
    return collect_experts.request(ENV, SETTINGS, config, seed)


def tabular_demos(config: Config, seed: int = 0) -> Request:
    return collect_experts.request(MAZE, PATHS, config, seed)


def imported(config: Config, seed: int = 0) -> Request:
    source = Source(Path("demos.parquet"), f"{seed:064}")
    return import_demonstrations.request("parquet", [source], ENV, SETTINGS)


def airl(config: Config, seed: int = 0) -> Request:
    return train_airl.request(From(demos(config)), ENV, SETTINGS, config.airl, seed)


def chosen(config: Config, seed: int = 0) -> Request:
    learned = replace(config.airl, select="episodes")
    return choose_penalty.request(
        From(demos(config)), ENV, SETTINGS, learned, config.evaluation, [1.0, 10.0], seed
    )


def maxent(config: Config, seed: int = 0) -> Request:
    return train_maxent.request(
        From(tabular_demos(config)), MAZE, PATHS, BLOCKED, config.maxent, seed
    )


def sweep(config: Config) -> Request:
    return sweep_maxent.request(MAZE, PATHS, BLOCKED, config)


def figure(config: Config) -> Request:
    return figure2.request(MAZE, PATHS, BLOCKED, config)


def digits(config: Config) -> Request:
    return control_labels.request("coloured digits", config.control.labels)


def unit_test(config: Config) -> Request:
    return control_labels.request("example 2", config.control.labels)


def maps(config: Config) -> Request:
    return control_maps.parts(config.control.maps)["learned"]


def controls(config: Config) -> Request:
    return control.request(config.control)


def retrained(config: Config, seed: int = 0) -> Request:
    reward = From(airl(config), "reward.pt")
    return transfer.request(reward, ENV, UNSEEN, config.transfer, seed)


def by_sac(config: Config, seed: int = 0) -> Request:
    return retrained(with_field(config, "transfer.algorithm", "sac"), seed)


def from_student(config: Config, seed: int = 0) -> Request:
    learned = airl(config)
    return transfer.request(
        From(learned, "reward.pt"),
        ENV,
        UNSEEN,
        config.transfer,
        seed,
        start=From(learned, "policy.pt"),
    )


def score(config: Config, seed: int = 0) -> Request:
    policy = From(retrained(config), "policy.pt")
    return evaluate.request(ENV, [UNSEEN], config.evaluation, policy, seed=seed)


def cloned(config: Config, seed: int = 0) -> Request:
    return clone.request(From(demos(config)), ENV, SETTINGS, config, seed)


def recorded(config: Config, seed: int = 0) -> Request:
    policy = From(retrained(config), "policy.pt")
    return record.request(ENV, UNSEEN, config.evaluation, policy, noise=0.5, seed=seed)


def assessed(config: Config, seed: int = 0) -> Request:
    policies = Policies(
        clone=From(cloned(config), "policy.pt"),
        student=From(airl(config), "policy.pt"),
        reused={str(SETTINGS[0]): From(expert(config), "policy.pt")},
        experts={},
        retrained={
            assess.Entry(policy="retrained", kind="retrained", setting=str(UNSEEN)): From(
                retrained(config), "policy.pt"
            )
        },
    )
    reward = From(airl(config), "reward.pt")
    return assess.request(reward, ENV, bank(ENV, [UNSEEN], config, policies, seed))


def cue_measured(config: Config, seed: int = 0) -> Request:
    reward = From(airl(config, seed), "reward.pt")
    return measure_cue.request(reward, From(demos(config)), "half-cheetah", CUES)


RETRAINING = ["expert", "demonstrations", "airl", "transfer.algorithm", "transfer.ceiling"]
FROM_SCRATCH = [*RETRAINING, "transfer.restarts", "transfer.total_steps"]
RETRAINED = [*FROM_SCRATCH, "transfer.ppo"]
# Stage to its request, and to the sections and fields that its key depends on.
REQUESTS = {
    "train-expert": (expert, ["expert"]),
    "collect-experts": (demos, ["expert", "demonstrations"]),
    "collect-experts tabular": (tabular_demos, ["demonstrations.episodes", "gridworld"]),
    "import": (imported, []),
    "train-airl": (airl, ["expert", "demonstrations", "airl"]),
    "choose-penalty": (chosen, ["expert", "demonstrations", "airl", "evaluation"]),
    "train-maxent": (maxent, ["demonstrations.episodes", "gridworld", "maxent"]),
    "sweep-maxent": (sweep, ["gridworld", "maxent", "figure2"]),
    "figure2": (figure, ["gridworld", "maxent", "figure2"]),
    "control-labels": (digits, ["control.labels"]),
    "control-labels unit test": (
        unit_test,
        [f"control.labels.{n}" for n in ("seeds", "learning_rate", "unit_steps", "unit_samples")],
    ),
    "control-maps": (maps, ["control.maps"]),
    "control": (controls, ["control"]),
    "transfer": (retrained, RETRAINED),
    "transfer by SAC": (
        by_sac,
        [*(field for field in FROM_SCRATCH if field != "transfer.algorithm"), "transfer.sac"],
    ),
    "transfer from the student": (
        from_student,
        [*RETRAINING, "transfer.from_student", "transfer.ppo"],
    ),
    "evaluate": (score, [*RETRAINED, "evaluation"]),
    "clone": (
        cloned,
        [
            *("expert", "demonstrations", "clone", "airl.actions"),
            *(f"airl.ppo.{name}" for name in clone.Network.__struct_fields__),
        ],
    ),
    "record": (recorded, [*RETRAINED, "evaluation"]),
    "assess": (
        assessed,
        [*RETRAINED, "evaluation", "clone", "assessment"],
    ),
    "measure-cue": (cue_measured, ["expert", "demonstrations", "airl"]),
}
# Reports read evaluations that are named one by one; no config field reaches them otherwise.
REPORTS = {"report", "report-experts"}
# AIRL refuses gSDE, so its frequency is not read. Challengers act in the student's worlds. Logits of
# f alone have one scaling. Nothing is averaged.
UNREAD_AIRL = [
    *("airl.ppo.sde_sample_freq", "airl.challenger.ppo.n_envs"),
    *("airl.penalty_scaling", "airl.averaged_by"),
]
# What a stage does not read, whatever the other fields are.
UNREAD = {
    # The bar is for the report of the experts; no episode of this environment terminates.
    "": ["expert.bar", "airl.fixed_horizon", "airl.shared_absorbing"],
    "train-airl": UNREAD_AIRL,
    "transfer": UNREAD_AIRL,
    "transfer by SAC": UNREAD_AIRL,
    # The student's network, and its own schedule of the learning rate.
    "transfer from the student": [
        *UNREAD_AIRL,
        *(f"transfer.ppo.{n}" for n in ("net_arch", "activation", "ortho_init", "log_std_init")),
        *(f"transfer.ppo.{n}" for n in ("normalise_observations", "use_sde", "sde_sample_freq")),
        *(f"transfer.ppo.{n}" for n in ("learning_rate", "learning_rate_schedule")),
    ],
    "evaluate": UNREAD_AIRL,
    "record": UNREAD_AIRL,
    "assess": UNREAD_AIRL,
    "measure-cue": UNREAD_AIRL,
    # Both are replaced: the weight by the candidates, the selection by the request above.
    "choose-penalty": [
        *(*UNREAD_AIRL, "airl.penalty_weight"),
        *("airl.select", "airl.select_episodes"),
    ],
    # The sweep's variants replace these.
    "sweep-maxent": [f"maxent.{n}" for n in ("grouping", "penalty", "penalty_weight", "l2")],
    "figure2": [f"maxent.{n}" for n in ("grouping", "penalty", "penalty_weight", "l2")],
    "control-labels": ["control.labels.unit_steps", "control.labels.unit_samples"],
    # Of other parts of the control.
    "control-maps": [f"control.maps.{n}" for n in ("settings", "spread", "gaps", "choices")],
}
# Challengers need logits without log pi. A mean of rounds has no best round, nor has a training that
# may end early. The reacher has no symmetries.
REFUSED = ["airl.ppo.use_sde", "airl.logit", "airl.averaged_rounds", "airl.plateau_rounds"]
REFUSED += ["airl.symmetries"]
# Beside gSDE.
REFUSED += [f"{part}.ppo.log_std_max" for part in ("expert", "transfer", "airl.challenger")]
# Fields whose type does not tell another valid value.
CHANGED = {
    "expert.bar": 1.0,
    "airl.learner": "other",
    "airl.penalty": "other",
    "airl.select": "episodes",
    "airl.dropout": 0.5,
    **{f"{part}.ppo.adam_eps": 1e-5 for part in ("expert", "transfer", "airl", "airl.challenger")},
    "airl.columns": (-1,),
    "airl.averaged_rounds": 3,
    "airl.averaged_by": "learning-rate",
    "airl.plateau_rounds": 3,
    "airl.symmetries": True,
    "airl.shared_absorbing": True,
    "airl.challenger.per_setting": True,
    "transfer.algorithm": "other",
    "transfer.ceiling": 0.9,
    "transfer.restarts": 3,
    "transfer.restart_steps": 5,
    "transfer.restart_episodes": 7,
    "transfer.sac.tau": 0.1,
    "transfer.sac.ent_coef": 0.1,
    "maxent.penalty": "other",
    "maxent.penalty_warmup_iterations": 10,
    "figure2.episodes": (400, 25, 4),
    "control.labels.strengths": (0.9, 0.7),
    "control.maps.strengths": (0.9, 0.8),
    "control.maps.settings": (2, 4),
    "control.maps.spread": (0.6, 0.95),
    "control.maps.gaps": (0.0, 0.02),
    "control.maps.choices": ((0.9, 0.8, 0.7),),
}


def with_field(struct: Any, path: str, value: Any) -> Any:
    """``struct`` with the field at the dotted ``path`` replaced."""
    name, _, rest = path.partition(".")
    return replace(
        struct, **{name: with_field(getattr(struct, name), rest, value) if rest else value}
    )


def field_of(struct: Any, path: str) -> Any:
    for name in path.split("."):
        struct = getattr(struct, name)
    return struct


def in_use() -> Config:
    """A config in which every option is in use."""
    config = Config()
    for path, value in {
        "expert.ppo.use_sde": True,
        "transfer.ppo.use_sde": True,
        "expert.ppo.sde_sample_freq": 4,
        "transfer.ppo.sde_sample_freq": 4,
        # A multiple of two and of three settings.
        "airl.ppo.n_envs": 12,
        "airl.logit": "f",
        "airl.challenger.life": 3,
        "airl.challenger.ppo.use_sde": True,
        "airl.challenger.ppo.sde_sample_freq": 4,
        "airl.grouping": "per-setting",
        "airl.penalty": "irmv1",
        "airl.select": str(SETTINGS[0]),
        "maxent.grouping": "per-setting",
        "maxent.penalty": "irmv1",
    }.items():
        config = with_field(config, path, value)
    return config


def leaves(kind: type[msgspec.Struct], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted path and type of every field."""
    for field in msgspec.structs.fields(kind):
        path = f"{prefix}{field.name}"
        if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            yield from leaves(field.type, f"{path}.")
        elif path != "interventions":
            yield path, field.type


FIELDS = dict(leaves(Config))


def another(path: str, value: Any) -> Any:
    """A valid value of the field at ``path`` that differs from ``value``."""
    if path in CHANGED:
        return CHANGED[path]
    kind = FIELDS[path]
    while get_origin(kind) not in (None, Literal, tuple) and not isinstance(value, bool):
        # Unwrap Annotated and Optional.
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return next(v for v in get_args(kind) if v != value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, tuple):
        return (*value, 2 * value[-1])
    if value is None:
        return 3
    return value * 2 or 1 if isinstance(value, int) else value / 2 or 0.5


@pytest.fixture(autouse=True)
def a_second_learner_algorithm_and_penalty(monkeypatch):
    monkeypatch.setitem(LEARNERS, "other", LEARNERS["airl"])
    monkeypatch.setitem(ALGORITHMS, "other", ALGORITHMS["ppo"])
    monkeypatch.setitem(PENALTIES, "other", PENALTIES["irmv1"])


@pytest.mark.parametrize("stage", sorted(REQUESTS.keys() - {"figure2", "control"}))
def test_a_stage_reads_the_sections_that_its_key_depends_on(stage):
    """And a few more: the PPO of challengers, the default of demonstrations, the noise of a bank, bars."""
    request, fields = REQUESTS[stage]
    sections = {field.partition(".")[0] for field in fields}
    read = {
        part.partition(".")[0] for made in behind(request(in_use())) for part in made.stage.reads
    }
    assert sections <= read <= sections | {"transfer", "demonstrations", "assessment", "expert"}


def test_every_stage_is_covered():
    modules = [
        importlib.import_module(f"irlcli.stages.{m.name}")
        for m in pkgutil.iter_modules(stages.__path__)
    ]
    names = {module.STAGE.name for module in modules if hasattr(module, "STAGE")}
    assert names == {name.partition(" ")[0] for name in REQUESTS} | REPORTS


@pytest.mark.parametrize("stage", REQUESTS)
def test_a_key_depends_on_exactly_the_fields_that_matter(stage):
    request, sections = REQUESTS[stage]
    config = in_use()
    before = key(request(config))
    unread = [*UNREAD[""], *UNREAD.get(stage, [])]
    wrong = []
    for path in FIELDS:
        matters = any(path == s or path.startswith(f"{s}.") for s in sections)
        changed = with_field(config, path, another(path, field_of(config, path)))
        assert changed != config, path
        try:
            differs = key(request(changed)) != before
        except UsageError:
            assert path in REFUSED
            continue
        if differs != (matters and path not in unread):
            wrong.append(path)
    assert not wrong


# Challengers need logits without log pi.
LOG_PI = {"airl.challenger.life": 0, "airl.logit": "f-log-pi"}
# Config changes, and the fields that they make irrelevant.
PENALTY_FIELDS = ["weight", "warmup_rounds", "ramp_rounds", "scaling", "estimate"]
IRRELEVANT = [
    (expert, {"expert.ppo.use_sde": False}, ["expert.ppo.sde_sample_freq"]),
    (expert, {"expert.ppo.ent_coef": 0.0}, ["expert.ppo.ent_coef_schedule"]),
    (expert, {"expert.ppo.batch_size": 1 << 20}, ["expert.ppo.batch_size"]),
    (retrained, {"transfer.ppo.use_sde": False}, ["transfer.ppo.sde_sample_freq"]),
    (retrained, {"transfer.ppo.ent_coef": 0.0}, ["transfer.ppo.ent_coef_schedule"]),
    (by_sac, {"transfer.sac.net_arch": ()}, ["transfer.sac.activation"]),
    (airl, {"airl.penalty": "none"}, [f"airl.penalty_{name}" for name in PENALTY_FIELDS]),
    (
        airl,
        {"airl.penalty_weight": 0.0},
        ["airl.penalty", *(f"airl.penalty_{name}" for name in PENALTY_FIELDS[1:])],
    ),
    (expert, {"expert.ppo.net_arch": ()}, ["expert.ppo.activation"]),
    (airl, {"airl.hidden": ()}, ["airl.activation", "airl.dropout"]),
    # A ramp of 0 rounds, or of 1.
    (airl, {"airl.penalty_ramp_rounds": 0}, ["airl.penalty_ramp_rounds"]),
    (airl, {"airl.grouping": "pooled"}, ["airl.pairing"]),
    (airl, {"airl.logit": "f"}, ["airl.penalty_scaling"]),
    (airl, {**LOG_PI, "airl.penalty": "vrex"}, ["airl.penalty_scaling"]),
    (airl, {"airl.penalty": "group-dro"}, ["airl.penalty_estimate"]),
    (
        airl,
        {"airl.replay_share": 0.0},
        [
            *("airl.replay_episodes_per_round", "airl.challenger.replay_episodes_per_round"),
            *("airl.replay_capacity", "airl.challenger.replay_capacity"),
        ],
    ),
    (
        airl,
        {"airl.challenger.life": 0},
        [path for path in FIELDS if path.startswith("airl.challenger.")][1:],
    ),
    (airl, {"airl.select": "last"}, ["airl.select_every", "airl.select_episodes"]),
    (airl, {"airl.select": "episodes"}, ["airl.select_episodes"]),
    (airl, {"airl.ppo.ent_coef": 0.0}, ["airl.ppo.ent_coef_schedule"]),
    (
        maxent,
        {"maxent.penalty": "none"},
        ["maxent.penalty_weight", "maxent.penalty_warmup_iterations"],
    ),
    (maxent, {"maxent.penalty_weight": 0.0}, ["maxent.penalty"]),
    (maxent, {"maxent.features": "linear"}, ["maxent.hidden"]),
    (sweep, {"maxent.features": "linear"}, ["maxent.hidden"]),
]


@pytest.mark.parametrize(("request_", "changes", "fields"), IRRELEVANT)
def test_fields_without_influence_do_not_change_the_key(request_, changes, fields):
    config = in_use()
    for path, value in changes.items():
        config = with_field(config, path, value)
    for path in fields:
        changed = with_field(config, path, another(path, field_of(config, path)))
        assert changed != config and key(request_(changed)) == key(request_(config)), path


@pytest.mark.parametrize(
    ("env", "setting", "reads"),
    [
        ("half-cheetah", "mass=2x", False),
        ("mujoco-half-cheetah", "mass=2x", False),
        ("mujoco-hopper", "mass=2x", True),
        ("lunar-lander", "bounce=0.5", True),
    ],
)
def test_absorbing_states_are_in_the_key_where_episodes_terminate(env, setting, reads):
    settings = parse_settings(env, setting)
    keys = set()
    for fixed in (True, False):
        config = load_config(
            env, profile="smoke", overrides=[f"airl.fixed_horizon={fixed}".lower()]
        )
        demonstrations = From(collect_experts.request(env, settings, config, 0))
        keys.add(key(train_airl.request(demonstrations, env, settings, config.airl, 0)))
    assert len(keys) == 1 + reads


def test_gail_has_one_logit_and_one_reward():
    gail = with_field(in_use(), "airl.learner", "gail")
    assert key(airl(gail)) != key(airl(in_use()))
    for path, value in (("shaping", False), ("policy_reward", "g"), ("penalty_scaling", "reward")):
        assert key(airl(with_field(gail, f"airl.{path}", value))) == key(airl(gail)), path
    # AIRL refuses it with challengers, GAIL does not read it.
    assert key(airl(with_field(gail, "airl.logit", "f-log-pi"))) == key(airl(gail))


# Digests of what a key holds of a default config, from before penalties other than IRMv1 came.
GOLDEN = {
    ("pooled", "none"): ("489b53e336110e19", "fa5c363c4b49409e"),
    ("per-setting", "irmv1"): ("11007e30afb89632", "bf44b7280aa5d958"),
    ("balanced", "none"): ("aa779ac15c94d942", "25a942e6d71f4aef"),
    ("shuffled", "irmv1"): ("e7221b12a6ccc1fa", "46b12bfe58d03988"),
}


@pytest.mark.parametrize(("grouping", "penalty"), GOLDEN)
def test_new_options_leave_the_keys_of_old_methods_alone(grouping, penalty):
    """A change here loses every reward that was learned before it."""
    method = {"grouping": grouping, "penalty": penalty}
    configs = (
        relevant_airl(replace(Config().airl, **method), discrete_actions=True),
        relevant_maxent(replace(Config().maxent, **method)),
    )
    found = tuple(digest(msgspec.to_builtins(config))[:16] for config in configs)
    assert found == GOLDEN[grouping, penalty]


def test_no_dropout_is_in_no_key():
    none, half = (with_field(in_use(), "airl.dropout", share) for share in (0.0, 0.5))
    assert key(airl(none)) == key(airl(in_use())) != key(airl(half))


def test_all_columns_are_in_no_key():
    none, last = (with_field(in_use(), "airl.columns", columns) for columns in ((), (-1,)))
    assert key(airl(none)) == key(airl(in_use())) != key(airl(last))


def test_no_symmetries_are_in_no_key():
    settings = parse_settings("ant", "friction=1.5:0.1:0.1,2:0.6:0.6")

    def of_the_ant(config):
        learned = replace(config.airl, select="last")
        return key(train_airl.request(From(demos(config)), "ant", settings, learned))

    none, some = (with_field(in_use(), "airl.symmetries", value) for value in (False, True))
    assert of_the_ant(none) == of_the_ant(in_use()) != of_the_ant(some)


def test_absorbing_states_of_their_own_are_in_no_key():
    settings = parse_settings("mujoco-hopper", "mass=0.75x,1.25x")

    def of_the_hopper(**changed):
        fields = {"airl.select": "last", "airl.shaping": False, **changed}
        config = in_use()
        for name, value in fields.items():
            config = with_field(config, name, value)
        return key(train_airl.request(From(demos(config)), "mujoco-hopper", settings, config.airl))

    with pytest.raises(UsageError, match=r"shared_absorbing needs airl\.shaping = false"):
        of_the_hopper(**{"airl.shared_absorbing": True, "airl.shaping": True})
    none, shared = (of_the_hopper(**{"airl.shared_absorbing": v}) for v in (False, True))
    assert none == of_the_hopper() != shared
    free = {"airl.fixed_horizon": False}
    assert of_the_hopper(**free) == of_the_hopper(**free, **{"airl.shared_absorbing": True})


def test_the_last_round_alone_is_in_no_key():
    last = with_field(in_use(), "airl.select", "last")
    one, three = (with_field(last, "airl.averaged_rounds", rounds) for rounds in (1, 3))
    assert key(airl(one)) == key(airl(last)) != key(airl(three))


def test_rounds_of_equal_weight_are_in_no_key():
    averaged = {
        "airl.select": "last",
        "airl.learning_rate_schedule": "linear",
        "airl.averaged_rounds": 3,
    }
    base = in_use()
    for name, value in averaged.items():
        base = with_field(base, name, value)
    equal, weighted = (
        with_field(base, "airl.averaged_by", by) for by in ("rounds", "learning-rate")
    )
    assert key(airl(equal)) == key(airl(base)) != key(airl(weighted))
    # At a constant rate all rounds weigh the same, and one round alone has no weight.
    for name, value in (("airl.learning_rate_schedule", "constant"), ("airl.averaged_rounds", 1)):
        one, other = (with_field(config, name, value) for config in (weighted, equal))
        assert key(airl(one)) == key(airl(other))


def test_one_challenger_in_all_settings_is_in_no_key():
    name = "airl.challenger.per_setting"
    joint, own = (with_field(in_use(), name, value) for value in (False, True))
    assert key(airl(joint)) == key(airl(in_use())) != key(airl(own))

    assert key(alone(own)) == key(alone(joint))


def alone(config):
    """A reward learned in one setting: the other one selects the round."""
    return train_airl.request(From(demos(config)), ENV, SETTINGS[:2], config.airl)


def test_with_one_setting_the_pairing_of_samples_is_in_no_key():
    config = with_field(in_use(), "airl.grouping", "balanced")
    pooled, matched = (with_field(config, "airl.pairing", p) for p in ("pooled", "matched"))
    assert key(airl(pooled)) != key(airl(matched))
    assert key(alone(pooled)) == key(alone(matched))


def test_training_to_the_end_is_in_no_key():
    last = with_field(in_use(), "airl.select", "last")
    assert key(airl(last)) != key(airl(with_field(last, "airl.plateau_rounds", 10)))


def test_one_restart_is_in_no_key():
    one, two = (with_field(in_use(), "transfer.restarts", count) for count in (1, 2))
    assert key(retrained(one)) == key(retrained(in_use())) != key(retrained(two))
    measured = with_field(two, "transfer.restart_episodes", 7)
    assert key(retrained(measured)) != key(retrained(two))
    default = with_field(two, "transfer.restart_episodes", 100)
    assert key(retrained(default)) == key(retrained(two))
    compared = with_field(two, "transfer.restart_steps", 10)
    assert key(retrained(compared)) != key(retrained(two))
    alone = with_field(compared, "transfer.restarts", 1)
    assert key(retrained(alone)) == key(retrained(one))


def test_no_warm_up_is_in_no_key():
    path = "maxent.penalty_warmup_iterations"
    for request_ in (maxent, sweep):
        none, ten = (with_field(in_use(), path, count) for count in (0, 10))
        assert key(request_(none)) == key(request_(in_use())) != key(request_(ten))


def test_the_scaling_of_logits_with_log_pi_is_in_the_key():
    config = with_field(in_use(), "airl.challenger.life", 0)
    config = with_field(config, "airl.logit", "f-log-pi")
    assert key(airl(config)) != key(airl(with_field(config, "airl.penalty_scaling", "reward")))


def test_without_shaping_g_is_f():
    plain = with_field(in_use(), "airl.shaping", False)
    keys = {key(airl(with_field(plain, "airl.policy_reward", form))) for form in ("f", "g")}
    assert len(keys) == 1


@pytest.mark.parametrize(("request_", "section"), [(airl, "airl"), (maxent, "maxent")])
def test_settings_of_equal_weight_are_one_grouping_without_a_penalty(request_, section):
    config = with_field(in_use(), f"{section}.penalty", "none")
    balanced = with_field(config, f"{section}.grouping", "balanced")
    assert key(request_(config)) == key(request_(balanced))


def test_the_random_and_the_idle_agent_have_no_deterministic_variant():
    config = in_use()
    changed = with_field(config, "evaluation.deterministic", True)
    for agent in ("random", "idle"):
        keys = {
            key(evaluate.request(ENV, [UNSEEN], c.evaluation, agent=agent))
            for c in (config, changed)
        }
        assert len(keys) == 1


@pytest.mark.parametrize("change", ["physics", "max_episode_steps"])
@pytest.mark.parametrize("stage", [s for s in REQUESTS if not s.startswith("control")])
def test_physics_and_horizon_change_every_key(monkeypatch, stage, change):
    request, _ = REQUESTS[stage]
    before = key(request(in_use()))
    for env in (ENV, MAZE):
        spec = ENVIRONMENTS[env]
        changed = spec._replace(**{change: getattr(spec, change) + 1})
        monkeypatch.setitem(ENVIRONMENTS, env, changed)
    assert key(request(in_use())) != before


def makers(request: Request) -> set[str]:
    """The stages that a request and its inputs run."""
    inputs = (source.request for source in request.inputs.values() if isinstance(source, From))
    return {request.stage.name}.union(*map(makers, inputs))


MODULES: list[tuple[ModuleType, str]] = [
    *((m, "STAGE") for m in (train_expert, collect_experts, train_airl, choose_penalty, transfer)),
    *((m, "STAGE") for m in (evaluate, train_maxent, sweep_maxent, figure2)),
    *((m, "STAGE") for m in (control, control_labels, control_maps)),
    *((m, "STAGE") for m in (clone, record, assess, measure_cue)),
    (collect_experts, "TABULAR_STAGE"),
]


@pytest.mark.parametrize("stage", REQUESTS)
def test_the_version_of_a_stage_changes_its_key_and_those_made_from_it(monkeypatch, stage):
    request, _ = REQUESTS[stage]
    original = request(in_use())
    before = key(original)
    for module, name in MODULES:
        old = getattr(module, name)
        with monkeypatch.context() as patch:
            patch.setattr(module, name, old._replace(version=old.version + 1))
            differs = key(request(in_use())) != before
        tabular = not any(env in original.label for env in (ENV, "half-cheetah"))
        runs = old.name in makers(original) and (
            old.name != "collect-experts" or (name == "TABULAR_STAGE") == tabular
        )
        assert differs == runs, name


@pytest.mark.parametrize("stage", ["train-airl", "train-maxent"])
def test_the_version_of_a_penalty_changes_the_keys_of_its_rewards_alone(monkeypatch, stage):
    request, _ = REQUESTS[stage]
    section = "airl" if stage == "train-airl" else "maxent"
    found = {}
    for version in (1, 2):
        of = PENALTIES["vrex"]._replace(version=version)
        monkeypatch.setitem(PENALTIES, "vrex", of)
        for penalty in ("vrex", "irmv1"):
            config = with_field(in_use(), f"{section}.penalty", penalty)
            config = with_field(config, f"{section}.grouping", "per-setting")
            found[penalty, version] = key(request(config))
    assert found["vrex", 1] != found["vrex", 2]
    assert found["irmv1", 1] == found["irmv1", 2]


def test_the_version_of_a_penalty_changes_the_keys_of_the_sweeps_that_fit_it(monkeypatch):
    before = key(sweep(in_use()))
    for penalty, fitted in (("irmv1", True), ("closed-form", True), ("vrex", False)):
        with monkeypatch.context() as patch:
            patch.setitem(PENALTIES, penalty, PENALTIES[penalty]._replace(version=2))
            assert (key(sweep(in_use())) != before) == fitted, penalty


# Their seeds are fields of their configs.
SWEEPS = ("sweep-maxent", "figure2", "control", "control-labels", "control-maps")


@pytest.mark.parametrize("stage", [s for s in REQUESTS if not s.startswith(SWEEPS)])
def test_the_seed_changes_the_key(stage):
    request, _ = REQUESTS[stage]
    assert key(request(in_use(), seed=1)) != key(request(in_use(), seed=0))


def test_what_an_import_is_told_changes_its_key():
    one, two = (Source(Path(name), name * 64) for name in "ab")

    def imported(sources=(one,), form="parquet", settings=SETTINGS[:2], **more):
        return key(import_demonstrations.request(form, sources, ENV, settings, **more))

    plain = imported()
    assert plain == imported([one._replace(path=Path("elsewhere"))])
    others = [
        imported([two]),
        imported([one, two]),
        imported([two, one]),
        imported(form="minari"),
        imported(settings=SETTINGS[1:]),
        imported(setting_column="place"),
        imported(cut=True),
    ]
    assert len({plain, *others}) == 8
    # A source of one setting need not name it, but a column that is named is read.
    assert imported(settings=SETTINGS[:1]) != imported(settings=SETTINGS[:1], setting_column="x")


def test_settings_and_their_order_change_the_key():
    """The order is that of the risks and of the worlds."""
    config = in_use()
    keys = {
        key(train_airl.request(From(demos(config)), ENV, chosen_settings, config.airl))
        for chosen_settings in (SETTINGS, SETTINGS[::-1], SETTINGS[:2])
    }
    assert len(keys) == 3


def test_the_config_of_a_knob_changes_the_keys_of_its_settings_only():
    config = in_use()
    longer = {
        "expert": replace(config.expert, total_steps=2 * config.expert.total_steps),
        "airl": replace(config.airl, actions="executed"),
        "transfer": replace(config.transfer, total_steps=2 * config.transfer.total_steps),
    }
    for knob, differs in (("gravity", True), ("another", False)):
        listed = InterventionConfig(id=(), ood=(), **longer)
        changed = replace(config, interventions={knob: listed})
        assert (key(demos(changed)) != key(demos(config))) == differs
        assert (changed.transfer_of(UNSEEN) != config.transfer_of(UNSEEN)) == differs
        assert (changed.airl_of([UNSEEN]) != config.airl_of([UNSEEN])) == differs
        same = replace(changed, expert=config.expert, demonstrations=config.demonstrations)
        made_alike = clone.request(From(demos(config)), ENV, SETTINGS, same)
        assert (key(made_alike) != key(cloned(config))) == differs


def test_an_evaluation_under_a_ceiling_has_a_key_of_its_own():
    """Without a reward nothing is bounded, and without a ceiling the key has no such field."""
    config = in_use()
    policy, reward = From(retrained(config), "policy.pt"), From(airl(config), "reward.pt")

    def scored(**more):
        return evaluate.request(ENV, [UNSEEN], config.evaluation, policy, **more)

    assert len({key(scored(reward=reward, ceiling=c)) for c in (None, 0.5, 0.9)}) == 3
    assert key(scored(ceiling=0.5)) == key(scored())
    assert "ceiling" not in msgspec.to_builtins(scored(reward=reward).parameters)


def test_a_policy_that_begins_as_the_student_has_a_key_of_its_own():
    config = in_use()
    assert key(from_student(config)) != key(retrained(config))


def test_sac_is_refused_for_discrete_actions_and_for_a_student():
    sac = with_field(Config(), "transfer.algorithm", "sac").transfer
    (bounce,) = parse_settings("lunar-lander", "bounce=0.9")
    learned = From(airl(in_use()), "reward.pt")
    with pytest.raises(UsageError, match="continuous actions") as discrete:
        transfer.request(learned, "lunar-lander", bounce, sac)
    with pytest.raises(UsageError, match="--start student needs PPO") as started:
        transfer.request(learned, ENV, UNSEEN, sac, start=From(airl(in_use()), "policy.pt"))
    assert discrete.value.hint == started.value.hint == "use --algorithm ppo"
