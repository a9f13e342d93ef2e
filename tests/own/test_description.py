"""The TOML file that describes an environment: what is read, and how mistakes are answered."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.envs.own import from_document
from irlcli.envs.spec import Code
from irlcli.errors import IrlError, UsageError

CODE = Code("0" * 64, None, None)
FILE = Path("/nowhere/hopper.toml")

WORDS = st.from_regex(r"[A-Za-z][A-Za-z0-9_-]{0,10}", fullmatch=True)
NUMBERS = st.floats(-1e6, 1e6)


def _with_whole_bounds(knob):
    if knob.get("whole"):
        knob |= {"low": float(round(knob["low"])), "high": float(round(knob["high"]))}
    return knob


KNOB = st.fixed_dictionaries(
    {
        "argument": st.from_regex(r"[a-z][a-z_]{0,8}", fullmatch=True).filter(
            lambda text: text.isidentifier()
        ),
        "forms": st.lists(
            st.sampled_from(["multiplier", "absolute", "triple", "range"]), min_size=1, unique=True
        ),
        "low": st.floats(-1e6, 0.0),
        "high": st.floats(0.0, 1e6),
    },
    optional={
        "description": st.text(max_size=10),
        "whole": st.booleans(),
        "observed": st.booleans(),
    },
).map(_with_whole_bounds)
DOCUMENT = st.fixed_dictionaries(
    {
        "env": st.fixed_dictionaries(
            {
                "id": st.just("hopper:Hopper-v0"),
                "max_episode_steps": st.integers(1, 10_000),
                "actions": st.sampled_from(["discrete", "continuous"]),
            },
            optional={
                "name": WORDS.filter(lambda name: name not in ("ant", "reacher", "gridworld")),
                # Upper case, so that none is the argument of a knob.
                "arguments": st.dictionaries(st.sampled_from("ABC"), NUMBERS | st.booleans()),
                "files": st.lists(st.sampled_from(["a.xml", "b/*.json"])),
                "symmetries": st.booleans(),
            },
        ),
        "knobs": st.dictionaries(WORDS.filter(lambda name: name != "default"), KNOB, max_size=4),
    }
)


def read(document):
    return from_document(document, "hopper.toml", FILE, CODE)


@given(DOCUMENT)
def test_a_description_reads_back_from_what_travels_with_results(document):
    spec = read(document)
    travelled = json.loads(json.dumps(spec.own.document))
    again = from_document(travelled, "artefact 1", None, CODE)
    assert again.own.document == spec.own.document
    assert again._replace(own=None) == spec._replace(own=None)
    assert spec.name == document["env"].get("name", "hopper")
    for name, knob in document["knobs"].items():
        assert spec.knobs[name].argument == knob["argument"]
        assert spec.knobs[name].forms == tuple(knob["forms"])


ANY = st.recursive(
    st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(document=DOCUMENT, value=ANY, place=st.data())
def test_any_value_in_any_place_is_read_or_refused_with_a_hint(document, value, place):
    sections = [document, document["env"], document["knobs"], *document["knobs"].values()]
    section = place.draw(st.sampled_from(sections))
    section[place.draw(st.sampled_from([*section, "new"]))] = value
    try:
        read(document)
    except IrlError as error:
        assert isinstance(error, UsageError) and error.hint
        assert "\n" not in error.message and error.message.startswith("hopper.toml: ")


# What is changed in the example's file, the exit code, and what the message names.
WRONG = [
    ("[env]", "[evn]", 2, "unknown section 'evn'", "did you mean 'env'"),
    ('id = "cart:Cart-v0"', "", 2, "env.id is missing", "module:EnvId"),
    ('id = "cart:Cart-v0"', "id = 3", 2, "env.id: expected text", "own-environments"),
    ('id = "cart:Cart-v0"', 'id = "c art:Cart-v0"', 2, "'c art:Cart-v0'", "module:EnvId"),
    ('id = "cart:Cart-v0"', 'id = "crat:Cart-v0"', 3, "no module 'crat'", "crat.py"),
    ('id = "cart:Cart-v0"', 'entry_point = "Cart"', 2, "env.entry_point: 'Cart'", "module:Class"),
    (
        'id = "cart:Cart-v0"',
        'id = "cart:Cart-v0"\nname = "ant"',
        2,
        "'ant' is the name of another",
        "name",
    ),
    # Of settings/control.toml, which belongs to no environment.
    (
        'id = "cart:Cart-v0"',
        'id = "cart:Cart-v0"\nname = "control"',
        2,
        "'control' is the name of another",
        "name",
    ),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\nname = "a b"', 2, "'a b'", "letters"),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\nfiles = ["**.xml"]', 2, "'**.xml'", "*.xml"),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\nfiles = ["."]', 2, "'.'", "*.xml"),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\nfiles = ["x.xml"]', 3, "'x.xml'", "relative"),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\nfiles = ["../x"]', 2, "'../x'", "below"),
    ("[env]", "[env]\nsymmetries = 1", 2, "env.symmetries", "own-environments"),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\nfoo = 1', 2, "'env.foo'", "known: "),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\narguments.a = nan', 2, "env.arguments.a", "num"),
    ('id = "cart:Cart-v0"', 'id = "cart:Cart-v0"\narguments.drag = 1', 2, "knobs.drag", "omit"),
    (
        'id = "cart:Cart-v0"',
        'id = "cart:Cart-v0"\narguments.models = ["./cart.toml"]',
        2,
        "names the file ./cart.toml",
        "env.files",
    ),
    ("max_episode_steps = 50", "max_episode_steps = 0", 2, "env.max_episode_steps", "own-"),
    (
        "max_episode_steps = 50",
        "max_episode_steps = 2147483648",
        2,
        "env.max_episode_steps",
        "own-",
    ),
    (
        'actions = "continuous"',
        'actions = "both"',
        2,
        "env.actions",
        "one of: discrete, continuous",
    ),
    ("[knobs.mass]", "[knobs.1mass]", 2, "'1mass'", "a letter first"),
    ('argument = "mass_scale"', "", 2, "knobs.mass.argument is missing", "[knobs.mass]"),
    ('argument = "mass_scale"', 'argument = "mass-scale"', 2, "'mass-scale'", "constructor"),
    ('forms = ["multiplier"]', 'forms = ["times"]', 2, "knobs.mass.forms", "absolute, multiplier"),
    ("low = 0.1", "low = 11.0", 2, "low = 11 is above high = 10", "swap"),
    ("low = 0.1", "low = 0.1\nwhole = true", 2, "knobs.mass: whole = true, but low = 0.1", "whole"),
    ("low = 0.1", "low = nan", 2, "knobs.mass.low", "own-environments"),
    (
        'id = ["1x", "2x"]',
        'id = ["1x", "20x"]',
        2,
        "mass='20x' is out of range",
        "between 0.1x and 10x",
    ),
    ("[interventions.mass]", "[interventions.wind]", 2, "no intervention 'wind'", "mass"),
    ("[airl.ppo]", "[airl.pop]", 2, "unknown field 'airl.pop'", "ppo"),
    ("[profiles.smoke.airl]", "[profiles.quick.airl]", 2, "profiles.quick", "smoke"),
    ("total_steps = 80_000", "total_steps = 0", 2, "total_steps", "for example"),
    ("low = 0.1", "low = ", 2, "is not valid TOML", "settings/"),
    ("low = 0.1", "low = 0.1x", 2, "is not valid TOML", "quotes"),
]


@pytest.mark.parametrize(("old", "new", "code", "named", "hint"), WRONG, ids=[w[1] for w in WRONG])
def test_a_mistake_in_the_file_is_one_clear_line(bench, old, new, code, named, hint):
    bench.edit(bench.toml, old, new)
    done = bench.irl("collect-experts", "--env", "cart.toml", "--intervention", "mass", "--dry-run")
    error, *rest = done.err.splitlines()
    assert (done.code, done.out) == (code, ""), done.err
    assert error.startswith("error: ") and named in error
    assert len(rest) == 1 and rest[0].startswith("hint: ") and hint in rest[0]
    assert not (bench.directory / "runs").exists()


@pytest.mark.parametrize(
    ("env", "code", "named"),
    [
        ("nothing.toml", 3, "no file nothing.toml"),
        (".", 2, "unknown environment '.'"),
        ("cart", 2, "unknown environment 'cart'"),
        ("ant.py", 2, "unknown environment 'ant.py'"),
    ],
)
def test_an_environment_that_does_not_exist(bench, env, code, named):
    done = bench.irl("collect-experts", "--env", env, "--intervention", "mass")
    assert done.code == code and named in done.err.splitlines()[0]
