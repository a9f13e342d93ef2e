"""Artefacts of one stage that differ in how they were made have different labels."""

import itertools

import msgspec
import pytest

from irlcli import labels
from irlcli.configs import AIRLConfig, MaxEntConfig, TransferConfig
from irlcli.controls.methods import LabelMethod, MapMethod
from irlcli.data.descriptions import Subject
from irlcli.report.returns import agent_name
from irlcli.stages.sweep_maxent import SweepVariant
from irlcli.store import KeyRecord

WAYS = [
    {},
    {"ceiling": 0.9},
    {"ceiling": 0.8},
    {"algorithm": "sac"},
    {"algorithm": "sac", "ceiling": 0.9},
]


def transfer(from_student=False, **config):
    parameters = {
        "environment": {"name": "ant"},
        "setting": "mass=4x",
        "seed": 0,
        "transfer": msgspec.to_builtins(TransferConfig(**config)),
    }
    inputs = {"reward": "a"} | ({"start": "b"} if from_student else {})
    return KeyRecord("transfer", 1, parameters, inputs)


def all_differ(texts):
    return len(set(texts)) == len(texts)


def test_policies_that_were_retrained_differently_have_different_labels():
    ways = [(student, way) for student, way in itertools.product((False, True), WAYS)]
    records = [transfer(student, **way) for student, way in ways]
    assert all_differ([labels.describe(record) for record in records])
    names = [
        agent_name(Subject(agent="transfer", env="ant", from_student=student, **way), "mass=4x")
        for student, way in ways
    ]
    assert all_differ(names)
    for record, name in zip(records, names, strict=True):
        how = labels.retrained_as(record)
        assert how in labels.describe(record) and how in name


def test_a_student_is_not_zero_shot_where_its_round_was_selected():
    student = Subject(agent="student", env="ant", settings=("mass=1x",), selected_in="mass=2x")
    names = [agent_name(student, f"mass={value}") for value in ("1x", "2x", "3x")]
    assert all_differ(names) and [("zero-shot" in name) for name in names] == [False, False, True]


def test_the_label_of_an_evaluation_tells_how_its_policy_was_retrained():
    plain, bounded = transfer(), transfer(ceiling=0.9)
    score = KeyRecord("evaluate", 1, {"env": "ant", "settings": ["mass=4x"]}, {"policy": "p"})
    assert labels.origin(score, {"p": plain}) != labels.origin(score, {"p": bounded})


def test_the_label_of_an_evaluation_tells_under_which_ceiling_it_scored():
    parameters = {"env": "ant", "settings": ["mass=4x"]}
    inputs = {"policy": "p", "reward": "r"}
    plain, bounded = (
        KeyRecord("evaluate", 1, parameters | more, inputs) for more in ({}, {"ceiling": 0.9})
    )
    assert labels.origin(plain, {}) != labels.origin(bounded, {})


@pytest.mark.parametrize("weight", [1.0, 0.1, 1e-5, 1e6])
def test_names_tell_close_weights_apart(weight):
    close = weight * (1 + 1e-9)
    for variant in (SweepVariant, MapMethod):
        names = [
            str(variant(grouping="per-setting", penalty="irmv1", penalty_weight=w))
            for w in (weight, close)
        ]
        assert all_differ(names)
    assert all_differ([str(LabelMethod(penalty="irmv1", weight=w)) for w in (weight, close)])
    airl = msgspec.to_builtins(AIRLConfig(grouping="per-setting", penalty="irmv1"))
    assert all_differ([labels.learned(airl | {"penalty_weight": w}) for w in (weight, close)])


def test_plans_and_listings_describe_rewards_alike():
    """Defaults are left out; whatever else distinguishes a reward is in its label."""
    plain = labels.learned(msgspec.to_builtins(AIRLConfig()))
    changed = [
        labels.learned(msgspec.to_builtins(AIRLConfig(**change)))
        for change in (
            {"penalty": "irmv1", "grouping": "per-setting"},
            {"penalty": "irmv1", "grouping": "per-setting", "penalty_weight": 3.0},
            {"select": "episodes"},
            {"bc_epochs": 30},
            {"challenger": {"life": 3}},
        )
    ]
    assert plain == "erm" and all_differ([plain, *changed])
    l2 = labels.learned(msgspec.to_builtins(MaxEntConfig(l2=0.1)))
    assert l2 == "erm l2 0.1"


def test_profiles_show_in_the_budget():
    assert labels.budget(transfer(total_steps=32_768).parameters) == "32,768 steps"
    assert labels.budget({"total_steps": 1_000_000, "ppo": {}}) == "1,000,000 steps"
    assert labels.budget({"evaluation": {"episodes": 20}}) == "20 episodes"
    assert labels.budget({"episodes": [10, 3]}) == "10, 3 episodes"


def test_parameters_of_any_form_have_a_label():
    for odd in ({"transfer": 3}, {"airl": [1], "seed": None}, {"settings": {"a": 1}}, {}):
        record = KeyRecord("transfer", 1, odd, {})
        assert isinstance(labels.describe(record), str) and labels.budget(odd) == ""
