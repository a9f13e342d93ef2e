"""The table of methods: each is complete, has a name to be found by, and a learner that offers it."""

import pytest

from irlcli.cli.complete import maxent_methods
from irlcli.configs import load_config
from irlcli.errors import UsageError
from irlcli.interventions import parse_settings
from irlcli.learners import LEARNERS
from irlcli.methods import METHODS, fields, method_name
from irlcli.penalties import PENALTIES
from irlcli.stages import choose_penalty, train_airl, train_maxent
from irlcli.stages.base import Source

LANDER, MAZE = "lunar-lander", "gridworld"
SETTINGS = parse_settings(LANDER, "engine-power=1x,1.25x,1.5x")
PATHS = parse_settings(MAZE, "path-group=1,2,3")
DEMOS = Source(None, "0" * 64)
ADVERSARIAL = [name for name, method in METHODS.items() if method.learns_reward]
COMPARING = [name for name, m in METHODS.items() if PENALTIES[m.penalty].compares]


def config(name, *overrides):
    # As many worlds as two settings and three can share.
    overrides = ["airl.ppo.n_envs=6", *overrides]
    return load_config(LANDER, "smoke", overrides=overrides, flags=fields(name, "airl"))


@pytest.mark.parametrize("name", METHODS)
def test_a_method_is_made_of_what_is_registered(name):
    method = METHODS[name]
    assert method.learner in LEARNERS or not method.learns_reward
    assert method.penalty in PENALTIES
    if PENALTIES[method.penalty].compares:
        assert method.grouping in ("per-setting", "shuffled")


def test_names_titles_and_colours_tell_methods_apart():
    for field in ("title", "colour"):
        assert len({getattr(method, field) for method in METHODS.values()}) == len(METHODS)


@pytest.mark.parametrize("name", ADVERSARIAL)
def test_what_a_method_trains_has_its_name(name):
    request = train_airl.request(DEMOS, LANDER, SETTINGS, config(name).airl)
    assert train_airl.method_of(request.parameters.airl) == name
    assert request.label.startswith(f"train-airl {name} ")


@pytest.mark.parametrize("name", [name for name, _ in maxent_methods()])
def test_what_a_method_trains_with_maxent_has_its_name(name):
    maxent = load_config(MAZE, "smoke", flags=fields(name, "maxent")).maxent
    request = train_maxent.request(DEMOS, MAZE, PATHS, [], maxent)
    assert train_maxent.describe(request.parameters.maxent).split()[0] == name


def test_a_combination_without_a_name_is_called_by_its_parts():
    assert method_name({"learner": "gail", "grouping": "per-setting", "penalty": "irmv1"}) == (
        "gail per-setting irmv1"
    )
    assert method_name({"grouping": "per-setting", "penalty": "closed-form"}) == (
        "per-setting closed-form"
    )


def test_irm_with_dropout_is_still_irm_and_says_so():
    airl = config("irm", "airl.dropout=0.3").airl
    request = train_airl.request(DEMOS, LANDER, SETTINGS, airl)
    assert train_airl.method_of(request.parameters.airl) == "irm"
    assert "dropping 0.3" in request.label


@pytest.mark.parametrize("name", COMPARING)
def test_one_setting_is_refused_where_settings_are_compared(name):
    with pytest.raises(UsageError, match="needs at least two") as refused:
        train_airl.request(DEMOS, LANDER, SETTINGS[:1], config(name).airl)
    assert METHODS[name].penalty in refused.value.message
    if METHODS[name].penalty in ("vrex", "group-dro"):
        maxent = load_config(MAZE, "smoke", flags=fields(name, "maxent")).maxent
        with pytest.raises(UsageError, match="needs at least two"):
            train_maxent.request(DEMOS, MAZE, PATHS[:1], [], maxent)


@pytest.mark.parametrize("name", [n for n in ADVERSARIAL if METHODS[n].penalty != "none"])
def test_the_lambda_of_every_penalty_is_chosen_by_leaving_a_setting_out(name):
    settings = config(name)
    request = choose_penalty.request(
        DEMOS, LANDER, SETTINGS, settings.airl, settings.evaluation, [1.0, 10.0]
    )
    trained = [made.request.inputs["policy"].request for made in request.inputs.values()]
    assert len(trained) == 2 * 3
    for learned in trained:
        airl = learned.parameters.airl
        assert (airl.penalty, len(learned.parameters.settings)) == (METHODS[name].penalty, 2)
    assert {learned.parameters.airl.penalty_weight for learned in trained} == {1.0, 10.0}


def test_every_penalty_has_as_many_candidates_of_its_own():
    penalised = [n for n in ADVERSARIAL if METHODS[n].penalty != "none"]
    counts = set()
    for name in penalised:
        settings = config(name)
        request = choose_penalty.request(
            DEMOS, LANDER, SETTINGS, settings.airl, settings.evaluation, "own"
        )
        assert request.parameters.weights == PENALTIES[METHODS[name].penalty].candidates
        counts.add(len(request.parameters.weights))
    assert counts == {3}


@pytest.mark.parametrize("name", [*COMPARING, "irm-shuffled"])
def test_two_settings_are_too_few_to_leave_one_out_and_compare_the_others(name):
    settings = config(name)
    arguments = (DEMOS, LANDER, SETTINGS[:2], settings.airl, settings.evaluation, [1.0, 10.0])
    with pytest.raises(UsageError, match="2 settings are too few"):
        choose_penalty.request(*arguments)
