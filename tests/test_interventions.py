"""The intervention grammar: what is read, what it prints as, and how mistakes are answered."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.envs.registration import make
from irlcli.envs.registry import ENVIRONMENTS, environment
from irlcli.envs.spec import EnvironmentSpec, Knob
from irlcli.errors import IrlError, UsageError, suggest
from irlcli.interventions import (
    Setting,
    Value,
    check_distinct,
    check_observed,
    covers,
    env_kwargs,
    knob_of,
    overlap,
    parse_setting,
    parse_settings,
    parse_value,
    same,
)

LANDER = "lunar-lander"
WORLD = "test-world"
_FORMS = {
    "double": Knob("double", ("multiplier",), -1e300, 1e300, "a multiplier"),
    "plain": Knob("plain", ("absolute",), -1e300, 1e300, "an absolute value"),
    "three": Knob("three", ("triple",), -1e300, 1e300, "a triple"),
    "span": Knob("span", ("range",), -1e300, 1e300, "a range"),
    "mixed": Knob("mixed", ("multiplier", "absolute"), 0.0, 10.0, "two forms"),
}


@pytest.fixture(autouse=True, scope="module")
def world():
    """An environment with a knob of every form, so that the whole grammar can be tried."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENVIRONMENTS, WORLD, EnvironmentSpec(WORLD, "", "test/World-v0", 10, _FORMS))
        yield


@pytest.mark.parametrize(
    ("knob", "text", "kind", "numbers", "printed"),
    [
        ("double", "2x", "multiplier", (2.0,), "2x"),
        ("double", "1.25x", "multiplier", (1.25,), "1.25x"),
        ("double", "+2.0x", "multiplier", (2.0,), "2x"),
        ("double", "2.x", "multiplier", (2.0,), "2x"),
        ("double", ".5x", "multiplier", (0.5,), "0.5x"),
        ("double", "1e-3x", "multiplier", (0.001,), "0.001x"),
        ("double", "1E2x", "multiplier", (100.0,), "100x"),
        ("double", " 2x ", "multiplier", (2.0,), "2x"),
        ("double", "-0x", "multiplier", (0.0,), "0x"),
        ("plain", "0.5", "absolute", (0.5,), "0.5"),
        ("plain", "-900", "absolute", (-900.0,), "-900"),
        ("plain", "007", "absolute", (7.0,), "7"),
        ("plain", "0.1", "absolute", (0.1,), "0.1"),
        ("plain", "1e-320", "absolute", (1e-320,), "1e-320"),
        (
            "plain",
            "123456789012345678",
            "absolute",
            (1.2345678901234568e17,),
            "1.2345678901234568e+17",
        ),
        ("three", "1.5:0.1:0.1", "triple", (1.5, 0.1, 0.1), "1.5:0.1:0.1"),
        ("three", "2:0:-0.0", "triple", (2.0, 0.0, 0.0), "2:0:0"),
        ("span", "-10..0", "range", (-10.0, 0.0), "-10..0"),
        ("span", "0.5..1.5", "range", (0.5, 1.5), "0.5..1.5"),
        ("span", "3..3", "range", (3.0, 3.0), "3..3"),
        ("mixed", "0.5", "absolute", (0.5,), "0.5"),
        ("mixed", "0.5x", "multiplier", (0.5,), "0.5x"),
    ],
)
def test_values(knob, text, kind, numbers, printed):
    value = parse_value(WORLD, knob, text)
    assert value == Value(kind, numbers)
    assert str(value) == printed
    assert all(math.copysign(1, x) > 0 for x in value.numbers if x == 0)  # no negative zero


@pytest.mark.parametrize("kind", ["double", "plain", "three", "span"])
@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "x",
        "abc",
        "1,5",
        "1 5",
        "0x10",
        "1_000",
        "--1",
        "+-1",
        "1e",
        "e5",
        ".",
        "nan",
        "inf",
        "-inf",
        "1:2",
        "1:2:3:4",
        "1:2:",
        "1..",
        "..1",
        "1..2..3",
        "2xx",
        "x2",
        "2X",
        "1x:2x:3x",
        "½",
        "1\n2",
        "1;2",
        "1x2",
        "None",
        "True",
        "[1]",
        "1j",
        "９x9",
        "\0",
    ],
)
def test_what_is_no_value_is_named_with_an_example(kind, text):
    with pytest.raises(UsageError) as caught:
        parse_value(WORLD, kind, text)
    assert repr(text.strip()) in caught.value.message
    assert kind in caught.value.message
    assert f"{kind}=" in caught.value.hint


@pytest.mark.parametrize(
    ("knob", "text"),
    [("double", "2"), ("plain", "2x"), ("three", "2"), ("span", "-10"), ("mixed", "1:2:3")],
)
def test_the_wrong_form_is_named(knob, text):
    with pytest.raises(UsageError) as caught:
        parse_value(WORLD, knob, text)
    assert " as " in caught.value.message and repr(text) in caught.value.message
    for kind in _FORMS[knob].forms:
        assert kind in caught.value.message
    assert "write it like" in caught.value.hint


@pytest.mark.parametrize(
    ("knob", "text"),
    [
        ("engine-power", "0x"),
        ("engine-power", "-1x"),
        ("engine-power", "0.01x"),
        ("engine-power", "1000x"),
        ("engine-power", "1e400x"),
        ("bounce", "1.0000001"),
        ("bounce", "-0.1"),
        ("bounce", "-1e-300"),
        ("friction", "11"),
        ("friction", "1e308"),
        ("friction", "-1"),
        ("friction", "9" * 400),
    ],
)
def test_absurd_values_are_refused_with_the_range(knob, text):
    with pytest.raises(UsageError, match="out of range") as caught:
        parse_value(LANDER, knob, text)
    assert repr(text) in caught.value.message
    assert " and " in caught.value.hint and knob in caught.value.hint


@pytest.mark.parametrize("text", ["1e400", "-1e400"])
@pytest.mark.parametrize("form", ["double={}x", "plain={}", "three=1:{}:1", "span=-1e400..1e400"])
def test_numbers_beyond_floats_are_refused(form, text):
    with pytest.raises(UsageError, match="out of range"):
        parse_settings(WORLD, form.format(text))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "''"),
        ("engine-power", "'engine-power'"),
        ("engine-power=", "'engine-power='"),
        ("=1x", "'=1x'"),
        (" = ", "' = '"),
        ("engine-power=1x,", "''"),
        ("engine-power=,1x", "''"),
        ("engine-power=1x,,2x", "''"),
        ("engine-power=1x;2x", "'1x;2x'"),
        ("engine-power==1x", "'=1x'"),
        ("engine-power=1x=2x", "'1x=2x'"),
        ("engine-power=1x,bounce=0.5", "engine-power and bounce"),
        ("engine-power=1x,1x", "engine-power=1x"),
        ("engine-power=1x,1.0x", "engine-power=1x"),
        ("bounce=0,-0", "bounce=0"),
        ("engine_power=1x", "engine_power"),
        ("ENGINE-POWER=1x", "ENGINE-POWER"),
        ("leg-length=2x", "leg-length"),
        ("engine-power=1", "'1'"),
        ("bounce=0.5x", "'0.5x'"),
    ],
)
def test_malformed_settings_name_the_thing_and_hint(text, named):
    with pytest.raises(UsageError) as caught:
        parse_settings(LANDER, text)
    assert named in caught.value.message
    assert caught.value.hint
    assert "\n" not in caught.value.message + caught.value.hint


def test_values_of_two_knobs_are_refused_and_the_hint_shows_the_setting_of_both():
    with pytest.raises(UsageError, match="two knobs, plain and double") as caught:
        parse_settings(WORLD, "plain=1, double=2x")
    assert "--setting plain=1,double=2x" in caught.value.hint


def test_a_knob_that_is_named_twice_is_refused_and_the_hint_writes_it_once():
    with pytest.raises(UsageError, match="names plain twice") as caught:
        parse_settings(WORLD, "plain=1,plain=2")
    assert caught.value.hint.endswith("plain=VALUE,VALUE")


@pytest.mark.parametrize("value", ["0.5", "2", "yes"])
def test_a_switch_that_is_not_0_or_1_is_refused_with_a_value_that_works(value):
    with pytest.raises(UsageError, match=f"terminate-when-unhealthy='{value}'") as caught:
        parse_settings("mujoco-hopper", f"terminate-when-unhealthy={value}")
    assert "must be 0 or 1" in caught.value.hint or "=1" in caught.value.hint


def test_settings_keep_their_order():
    settings = parse_settings(LANDER, " engine-power = 2x, 1x ,1.5x")
    assert [str(s) for s in settings] == ["engine-power=2x", "engine-power=1x", "engine-power=1.5x"]


@pytest.mark.parametrize(
    ("name", "meant"), [("lunar-landr", "lunar-lander"), ("lunarlander", "lunar-lander")]
)
def test_unknown_environment_is_suggested(name, meant):
    for ask in (
        environment,
        lambda n: parse_settings(n, "bounce=1"),
        lambda n: parse_setting(n, "default"),
    ):
        with pytest.raises(UsageError, match=name) as caught:
            ask(name)
        assert f"did you mean '{meant}'" in caught.value.hint


def test_unknown_knob_is_suggested():
    with pytest.raises(UsageError, match="engine-powr") as caught:
        knob_of(LANDER, "engine-powr")
    assert "did you mean 'engine-power'" in caught.value.hint


def test_a_hint_without_known_names_says_so():
    assert suggest("gain", []) == "known: none"


def test_knob_of_another_environment_names_its_owner():
    with pytest.raises(UsageError, match="'span'") as caught:
        parse_settings(LANDER, "span=-1..1")
    assert WORLD in caught.value.hint and "engine-power" in caught.value.hint


def test_one_setting():
    assert parse_setting(LANDER, "default") == Setting()
    assert parse_setting(LANDER, "bounce=0.5") == Setting((("bounce", Value("absolute", (0.5,))),))
    with pytest.raises(UsageError, match="2 settings, but one") as caught:
        parse_setting(LANDER, "bounce=0.1,0.5")
    assert caught.value.hint


def test_arguments_of_the_environment():
    assert env_kwargs(LANDER, Setting()) == {}
    assert env_kwargs(LANDER, parse_setting(LANDER, "engine-power=2x")) == {"engine_power": 2.0}
    assert env_kwargs(WORLD, parse_setting(WORLD, "three=1:2:3")) == {"three": (1.0, 2.0, 3.0)}


NUMBERS = st.floats(-1e300, 1e300)
VALUES = {
    "double": NUMBERS.map(lambda x: (x,)),
    "plain": NUMBERS.map(lambda x: (x,)),
    "three": st.tuples(NUMBERS, NUMBERS, NUMBERS),
    "span": st.tuples(NUMBERS, NUMBERS).map(lambda pair: tuple(sorted(pair))),
}


@given(st.sampled_from(sorted(VALUES)).flatmap(lambda k: st.tuples(st.just(k), VALUES[k])))
def test_what_is_printed_reads_back(case):
    """Settings are stored in their printed form, so it must lose not a single bit."""
    knob, numbers = case
    value = Value(_FORMS[knob].forms[0], tuple(x + 0.0 for x in numbers))
    setting = Setting(((knob, value),))
    assert parse_setting(WORLD, str(setting)) == setting
    assert str(parse_setting(WORLD, str(setting))) == str(setting)


SEVERAL = st.dictionaries(st.sampled_from(sorted(VALUES)), st.none(), min_size=1).flatmap(
    lambda chosen: st.fixed_dictionaries({knob: VALUES[knob] for knob in chosen})
)


@given(numbers=SEVERAL, data=st.data())
def test_a_setting_of_several_knobs_reads_back_in_any_order(numbers, data):
    changes = [
        (knob, Value(_FORMS[knob].forms[0], tuple(x + 0.0 for x in values)))
        for knob, values in numbers.items()
    ]
    written = data.draw(st.permutations([f"{knob}={value}" for knob, value in changes]))
    setting = parse_setting(WORLD, ",".join(written))
    assert setting == Setting(tuple(sorted(changes)))
    assert parse_setting(WORLD, str(setting)) == setting
    assert env_kwargs(WORLD, setting) == {knob: value.argument for knob, value in changes}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("plain=1,plain=2", "sets plain twice, by plain"),
        ("plain=1,double=", "not an intervention"),
        ("plain=1,other=2", "no intervention 'other'"),
        ("plain=1,2,double=2x", "values of two knobs, plain and double"),
        ("plain=1,2,other=2x", "no intervention 'other'"),
        ("=1,plain=2", "not an intervention"),
        ("plain=1,default", "not an intervention value"),
    ],
)
def test_a_bad_setting_of_several_knobs_is_refused(text, message):
    with pytest.raises(UsageError, match=message) as caught:
        parse_setting(WORLD, text)
    assert caught.value.hint


def test_two_knobs_of_one_argument_are_refused_in_one_setting(monkeypatch):
    knobs = {**_FORMS, "twin": _FORMS["plain"]}
    spec = EnvironmentSpec(WORLD, "", "test/World-v0", 10, knobs)
    monkeypatch.setitem(ENVIRONMENTS, WORLD, spec)
    with pytest.raises(UsageError, match="sets plain twice, by plain and twin"):
        parse_setting(WORLD, "plain=1,twin=2")


def test_a_setting_of_many_knobs_has_a_bound(monkeypatch):
    """It is a column of datasets and a part of names."""
    knobs = {f"knob-{i}": Knob(f"k{i}", ("absolute",), 0.0, 1.0, "") for i in range(60)}
    spec = EnvironmentSpec(WORLD, "", "test/World-v0", 10, knobs)
    monkeypatch.setitem(ENVIRONMENTS, WORLD, spec)
    few, many = (",".join(f"{knob}=0.5" for knob in [*knobs][:n]) for n in (30, 60))
    assert str(parse_setting(WORLD, few)).count("=") == 30
    with pytest.raises(UsageError, match="more than 400 characters"):
        parse_setting(WORLD, many)


@pytest.mark.parametrize("whole", [True, False])
def test_a_whole_number_reaches_the_environment_as_an_int(monkeypatch, whole):
    knobs = {"layout": Knob("layout", ("absolute",), 0.0, 9.0, "a layout", whole=whole)}
    spec = EnvironmentSpec(WORLD, "", "test/World-v0", 10, knobs)
    monkeypatch.setitem(ENVIRONMENTS, WORLD, spec)
    (found,) = env_kwargs(WORLD, parse_setting(WORLD, "layout=3")).values()
    assert found == 3 and isinstance(found, int) == whole


@pytest.mark.parametrize("env", ["ant", "half-cheetah"])
def test_two_goals_in_one_setting_are_refused(env):
    with pytest.raises(UsageError, match="adds a goal twice, by direction and goal-y"):
        parse_setting(env, "goal-y=0,direction=10")
    assert parse_setting(env, "goal-y=0,mass=2x").knobs == ("goal-y", "mass")


def test_settings_of_several_knobs_share_worlds_knob_by_knob():
    wide, narrow, beside = (
        parse_setting("ant", text)
        for text in ("mass=2x,direction=-10..0", "direction=-5,mass=2x", "direction=-5,mass=4x")
    )
    assert str(wide) == "direction=-10..0,mass=2x"
    assert covers(wide, narrow) and not covers(narrow, wide)
    assert overlap(wide, narrow) and not overlap(wide, beside)
    assert not overlap(wide, parse_setting("ant", "mass=2x"))


def test_a_multiplier_of_one_is_the_default():
    default, once, both, other = (
        parse_setting("ant", text)
        for text in ("default", "mass=1x", "leg-length=2x,mass=1x", "leg-length=2x")
    )
    for one, equal in ((default, once), (both, other)):
        assert same(one, equal) and overlap(one, equal)
        with pytest.raises(UsageError, match=f"names {one} twice, once as {equal}"):
            check_distinct("the command", [one, equal])
    assert not overlap(once, both)
    check_distinct("the command", [once, both])


def test_a_number_in_two_forms_is_one_world():
    """HalfCheetah's legs of 1 are those of 1x. That this is the default, only the environment knows."""
    absolute, multiple, default = (
        parse_setting("half-cheetah", text) for text in ("leg-length=1", "leg-length=1x", "default")
    )
    assert same(absolute, multiple) and same(multiple, default) and not same(absolute, default)
    assert overlap(absolute, multiple) and not overlap(absolute, default)
    heavy = parse_setting("half-cheetah", "leg-length=1,mass=2x")
    assert same(heavy, parse_setting("half-cheetah", "leg-length=1x,mass=2x"))
    assert not covers(heavy, multiple) and not overlap(heavy, multiple)


GRAMMAR = st.text("0123456789.xe:+-,= \n", max_size=20)


@given(knob=st.sampled_from(sorted(_FORMS)), text=GRAMMAR | st.text(max_size=12))
def test_any_text_is_read_stably_or_refused_with_a_hint(knob, text):
    try:
        settings = parse_settings(WORLD, f"{knob}={text}")
    except IrlError as error:
        assert isinstance(error, UsageError) and error.hint
        assert "\n" not in error.message
        return
    for setting in settings:
        assert parse_setting(WORLD, str(setting)) == setting
        assert all(math.isfinite(x) for _, value in setting.changes for x in value.numbers)


@given(env=st.text(max_size=10), text=st.text(max_size=20))
def test_any_environment_and_text(env, text):
    for ask in (parse_settings, parse_setting):
        with pytest.raises(UsageError) as caught:
            ask(env, text)
        assert caught.value.hint


def test_what_a_knob_says_of_observations_is_so():
    for env in ("ant", "half-cheetah", "lunar-lander"):
        known = ENVIRONMENTS[env].knobs
        sizes = {}
        for name, knob in known.items():
            value = {"triple": "1:1:1", "multiplier": "1x"}.get(knob.forms[0], "1")
            made = make(env, parse_setting(env, f"{name}={value}"))
            sizes.setdefault(knob.observed, set()).add(made.observation_space.shape)
            made.close()
        made = make(env, parse_setting(env, "default"))
        sizes[""].add(made.observation_space.shape)
        made.close()
        assert all(len(shapes) == 1 for shapes in sizes.values())
        (plain,) = sizes.pop("")
        assert sizes and all(shapes != {plain} for shapes in sizes.values())


@pytest.mark.parametrize(
    ("one", "other", "covered", "shared"),
    [
        ("-10..0", "-5", True, True),
        ("-10..0", "0", True, True),
        ("-10..0", "-5..-1", True, True),
        ("-10..0", "-5..5", False, True),
        ("-10..0", "0..5", False, False),
        ("-10..0", "10", False, False),
        ("10", "10..10", True, True),
        ("10", "10..12", False, True),
        ("10", "11", False, False),
    ],
)
def test_a_range_holds_the_worlds_between_its_ends(one, other, covered, shared):
    a, b = (parse_setting("ant", f"direction={value}") for value in (one, other))
    assert covers(a, b) == covered
    assert overlap(a, b) == overlap(b, a) == shared
    friction = parse_setting("ant", "friction=2:0.6:0.6")
    assert not covers(a, friction) and not covers(friction, a) and not overlap(a, friction)
    assert covers(friction, friction) and covers(Setting(), Setting())


@pytest.mark.parametrize(
    ("trained", "wanted", "fits"),
    [
        ("goal-y=0", "goal-y=900", True),
        ("goal-y=0", "direction=10", True),
        ("mass=2x", "leg-length=3x", True),
        ("mass=2x", "default", True),
        ("goal-y=0", "default", False),
        ("goal-y=0", "mass=2x", False),
        ("default", "direction=10", False),
        ("cue-strength=0.8", "cue-strength=0.1", True),
        ("cue-strength=0.8", "mass=2x", False),
        # Of equal size, but a goal is no cue.
        ("cue-strength=0.8", "goal-y=0", False),
        ("goal-y=0", "cue-strength=0.8", False),
    ],
)
def test_a_goal_or_cue_that_the_policy_cannot_see_is_refused(trained, wanted, fits):
    places = [parse_setting("half-cheetah", wanted)]
    if fits:
        check_observed("half-cheetah", [trained], places)
        return
    with pytest.raises(UsageError, match="different observations") as caught:
        check_observed("half-cheetah", [trained], places)
    alike = {"goal-y=0": "goal-y or direction", "cue-strength=0.8": "cue-strength"}
    assert caught.value.hint.endswith(alike.get(trained, "mass or friction or leg-length"))


def test_every_setting_must_have_the_observations_that_were_learned():
    places = [parse_setting("half-cheetah", text) for text in ("mass=2x", "goal-y=0")]
    with pytest.raises(UsageError, match="goal-y=0 and default have different observations"):
        check_observed("half-cheetah", ["default"], places)


def test_the_hint_names_all_that_must_be_observed():
    trained, wanted = "cue-strength=0.9,goal-y=3", parse_setting("half-cheetah", "goal-y=8")
    with pytest.raises(UsageError) as caught:
        check_observed("half-cheetah", [trained], [wanted])
    assert caught.value.hint.endswith("cue-strength, together with goal-y or direction")
