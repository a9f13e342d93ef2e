"""Config: what wins over what, what is refused, and whether the message names its source."""

from __future__ import annotations

import math
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

from irlcli.configs import PROFILES, Config, PPOConfig, load_config
from irlcli.configs.relevance import relevant_airl, relevant_ppo, relevant_transfer
from irlcli.configs.schema import (
    AIRLConfig,
    ChallengerConfig,
    FromStudentConfig,
    SACConfig,
    TransferConfig,
)
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.errors import NotFound, UsageError
from irlcli.interventions import Setting, parse_setting, parse_settings
from irlcli.store import canonical_json

LANDER = "lunar-lander"
SETTINGS = Path(__file__).parents[2] / "settings"


@pytest.fixture
def toml(tmp_path):
    """A settings file with the given text."""

    def write(text: str | bytes) -> Path:
        path = tmp_path / "mine.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def refused(*args, **kwargs) -> UsageError:
    """The error of loading these, checked for what every one of them owes the reader."""
    with pytest.raises(UsageError) as caught:
        load_config(LANDER, *args, **kwargs)
    assert caught.value.hint
    assert "\n" not in caught.value.message
    return caught.value


# What is shipped


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("env", sorted(ENVIRONMENTS))
def test_every_shipped_profile_loads(env, profile):
    settings = load_config(env, profile)
    canonical_json(msgspec.to_builtins(settings))  # can be part of a key
    for knob, values in settings.interventions.items():
        trained, held_out = (
            {s for v in side for s in parse_settings(env, f"{knob}={v}")}
            for side in (values.id, values.ood)
        )
        assert (trained or held_out) and not trained & held_out
    # A knob may be there for one of the two only, as the gridworld's are.
    knobs = settings.interventions.values()
    assert any(k.id for k in knobs) and any(k.ood for k in knobs)


def test_every_file_is_an_environments_or_the_experiments():
    others = {"experiments", "control"}
    assert {p.stem for p in SETTINGS.glob("*.toml")} - others == set(ENVIRONMENTS)


@pytest.mark.parametrize("path", sorted(SETTINGS.glob("*/*.toml")), ids=lambda p: p.parent.name)
def test_every_shipped_overlay_loads(path):
    assert load_config(path.stem, "standard", [path]) != load_config(path.stem, "standard")


def test_profiles_differ_and_smoke_is_small():
    smoke, standard, paper = (load_config(LANDER, p) for p in PROFILES)
    assert smoke.expert.total_steps < 10_000 < standard.expert.total_steps
    assert paper.expert.ppo.batch_size == 64  # rl-baselines3-zoo
    assert smoke != standard and standard != paper


# Precedence


def test_defaults_file_profile_settings_flags_and_set(toml):
    """defaults < settings file < profile < --settings < flags and --set."""
    assert Config().expert.total_steps == 1_000_000
    assert load_config(LANDER).expert.total_steps == 2_000_000
    assert load_config(LANDER, "smoke").expert.total_steps == 4096
    mine = toml(
        "[expert]\ntotal_steps = 5000\n[airl]\npenalty_weight = 5\ngrouping = 'per-setting'"
    )
    loaded = load_config(LANDER, "smoke", [mine])
    assert (loaded.expert.total_steps, loaded.airl.penalty_weight) == (5000, 5.0)
    loaded = load_config(LANDER, "smoke", [mine], ["expert.total_steps=6000"])
    assert loaded.expert.total_steps == 6000
    loaded = load_config(
        LANDER, "smoke", [mine], [], {"airl.penalty_weight": 7.0, "airl.grouping": None}
    )
    assert (loaded.airl.penalty_weight, loaded.airl.grouping) == (7.0, "per-setting")


def test_a_settings_file_has_profiles_too(toml):
    mine = toml(
        "[profiles.smoke.airl]\npenalty_weight = 3\n"
        "[airl]\npenalty_weight = 5\ngrouping = 'per-setting'"
    )
    loaded = [load_config(LANDER, profile, [mine]).airl for profile in ("smoke", "standard")]
    assert [airl.penalty_weight for airl in loaded] == [3.0, 5.0]
    assert {airl.grouping for airl in loaded} == {"per-setting"}


def test_the_later_set_wins():
    loaded = load_config(LANDER, overrides=["airl.penalty_weight=1", "airl.penalty_weight=2"])
    assert loaded.airl.penalty_weight == 2.0


def test_a_layer_changes_only_what_it_names(toml):
    before = load_config("reacher", "paper")
    after = load_config("reacher", "paper", [toml("[airl.ppo]\nn_envs = 3")])
    assert after.airl.ppo.n_envs == 3
    restored = replace(after.airl.ppo, n_envs=before.airl.ppo.n_envs)
    airl = replace(after.airl, ppo=restored)
    assert replace(after, airl=airl) == before


def test_a_knob_has_experts_of_its_own(toml):
    """Within a layer what is said of the knob wins over ``expert.ppo``; a later layer wins over both."""
    mine = toml(
        "[expert.ppo]\nn_epochs = 3\ngamma = 0.5\n"
        "[interventions.bounce.expert.ppo]\nn_epochs = 7\nuse_sde = true"
    )
    config = load_config(LANDER, "smoke", [mine], ["expert.ppo.gamma=0.25"])
    bounce, power = (
        config.expert_of(parse_settings(LANDER, text)[0])
        for text in ("bounce=0.1", "engine-power=1x")
    )
    assert power == config.expert and not power.ppo.use_sde
    assert (power.ppo.n_epochs, power.ppo.gamma) == (3, 0.25)
    changed = replace(config.expert.ppo, n_epochs=7, use_sde=True)
    assert bounce == replace(config.expert, ppo=changed)
    later = load_config(LANDER, "smoke", [mine], ["expert.ppo.n_epochs=9"])
    assert later.expert_of(parse_settings(LANDER, "bounce=0.1")[0]).ppo.n_epochs == 9


def test_an_empty_file_changes_nothing(toml):
    assert load_config(LANDER, "smoke", [toml("")]) == load_config(LANDER, "smoke")


def test_environment_variables_never_enter(monkeypatch):
    before = load_config(LANDER)
    for name in ("AIRL_METHOD", "IRL_AIRL_METHOD", "IRL_PROFILE", "IRL_SETTINGS", "airl.grouping"):
        monkeypatch.setenv(name, "irm")
    assert load_config(LANDER) == before


@pytest.mark.parametrize("text", ["30", "30.0", "3e1", " 30 ", "+30.0"])
def test_however_written_it_is_one_value_and_so_one_key(toml, text):
    """An int in TOML, a float on the command line: equal settings must give equal artefacts."""
    expected = load_config(LANDER, flags={"airl.penalty_weight": 30.0})
    from_set = load_config(LANDER, overrides=[f"airl.penalty_weight={text}"])
    from_file = load_config(LANDER, files=[toml(f"[airl]\npenalty_weight = {text}")])
    forms = {canonical_json(msgspec.to_builtins(s)) for s in (expected, from_set, from_file)}
    assert len(forms) == 1


@pytest.mark.parametrize(
    ("item", "flags"),
    [
        ("airl.penalty=vrex", {"airl.penalty": "irmv1"}),
        (" airl.dropout = 0.2", {"airl.dropout": 0.5}),
        ("evaluation.episodes=7", {"evaluation.episodes": 5, "airl.penalty": None}),
    ],
)
def test_a_field_that_an_option_sets_to_another_value_is_refused(item, flags):
    """It would be ignored."""
    field = item.partition("=")[0].strip()
    error = refused(overrides=[item], flags=flags)
    assert field in error.message and f"--set {field}" in error.hint
    same = f"{field}={flags[field]}"
    assert load_config(LANDER, overrides=[same], flags=flags) == load_config(LANDER, flags=flags)


def test_names_in_sections_of_one_knob_are_checked(toml):
    for text in ("airl]\npenalty = 'nope'", "transfer]\nalgorithm = 'nope'"):
        error = refused("smoke", [toml(f"[interventions.bounce.{text}")])
        assert "interventions.bounce." in error.message and "nope" in error.message


# --set


@pytest.mark.parametrize(
    ("item", "value"),
    [
        ("airl.penalty_weight=30", 30.0),
        ("airl.penalty_weight = 1e-3", 0.001),
        ("airl.grouping=per-setting", "per-setting"),
        ("airl.grouping='pooled'", "pooled"),
        ('airl.select="leg-length=1x"', "leg-length=1x"),
        ("airl.ppo.log_std_max=none", None),
        ("airl.ppo.log_std_max=-1", -1.0),
        ("airl.state_only=true", True),
        ("airl.hidden=[8, 16]", (8, 16)),
        ("airl.ppo.n_envs=4", 4),
        ("expert.total_steps=1_000", 1000),
        ("expert.bar=-5", -5.0),
    ],
)
def test_set_is_typed_by_its_field(item, value):
    loaded = load_config(LANDER, overrides=[item])
    for name in item.partition("=")[0].strip().split("."):
        loaded = getattr(loaded, name)
    assert loaded == value and type(loaded) is type(value)


@pytest.mark.parametrize(
    ("item", "named", "hint"),
    [
        ("airl.penalty_weight", "has no '='", "--set airl.penalty_weight=VALUE"),
        ("", "has no '='", "--set"),
        ("bc_epochs=2", "'bc_epochs'", "did you mean airl.bc_epochs?"),
        ("airl.actions=samples", "unknown value 'samples'", "one of: sampled, executed"),
        ("=3", "''", "known: "),
        ("airl=3", "group", "airl.grouping"),
        ("airl.ppo=3", "group", "airl.ppo.n_envs"),
        ("airl.penalty_wieght=3", "airl.penalty_wieght", "did you mean airl.penalty_weight?"),
        ("arl.penalty_weight=3", "arl.penalty_weight", "did you mean airl.penalty_weight?"),
        ("airl.ppo.n_env=3", "airl.ppo.n_env", "did you mean airl.ppo.n_envs?"),
        ("airl.penalty_weight.x=3", "airl.penalty_weight", ""),
        ("airl..grouping=pooled", "airl..grouping", "known: "),
        ("interventions.bounce=3", "interventions", "--intervention"),
        ("profiles.smoke=3", "profiles.smoke", "known: "),
        ("airl.grouping=POOLED", "airl.grouping=POOLED", "pooled"),
        ("airl.penalty_weight=abc", "airl.penalty_weight=abc", "10.0"),
        ("airl.penalty_weight=true", "airl.penalty_weight=true", "10.0"),
        ("airl.penalty_weight=", "airl.penalty_weight=", "10.0"),
        ("airl.penalty_weight=-1", "airl.penalty_weight=-1", "10.0"),
        ("airl.state_only=1", "airl.state_only=1", "false"),
        ("airl.state_only=True", "airl.state_only=True", "false"),
        ("airl.hidden=8", "airl.hidden=8", "[32,32]"),
        ("airl.hidden=[8,0]", "airl.hidden=[8,0]", "[32,32]"),
        ("airl.hidden=[[8]]", "airl.hidden", "[32,32]"),
        ("airl.batch_size=7", "airl.batch_size=7", "256"),
        ("airl.ppo.n_envs=0", "airl.ppo.n_envs=0", "16"),
        ("airl.ppo.n_envs=1.5", "airl.ppo.n_envs=1.5", "16"),
        ("airl.ppo.gamma=1", "airl.ppo.gamma=1", "0.999"),
        ("airl.ppo.gamma=-0.1", "airl.ppo.gamma=-0.1", "0.999"),
        ("airl.ppo.learning_rate=0", "airl.ppo.learning_rate=0", "0.001"),
        ("airl.replay_share=1.1", "airl.replay_share=1.1", "0.5"),
        ("expert.total_steps=1e6", "expert.total_steps=1e6", "1000000"),
        ("evaluation.episodes=" + "9" * 30, "evaluation.episodes", "20"),
        ("expert.total_steps=" + "9" * 5000, "expert.total_steps", "1000000"),
        ("airl.hidden=" + "[" * 5000, "airl.hidden", "[32,32]"),
    ],
)
def test_set_refuses_and_names(item, named, hint):
    error = refused(overrides=[item])
    assert named in error.message
    assert hint in error.hint


NON_FINITE = ["nan", "inf", "-inf", "+inf", "-nan"]


@pytest.mark.parametrize("text", NON_FINITE)
@pytest.mark.parametrize(
    "field", ["airl.penalty_weight", "airl.learning_rate", "expert.bar", "transfer.ppo.clip_range"]
)
def test_numbers_that_no_key_can_hold_are_refused(toml, field, text):
    """Later they would break in the middle of a run, with an error that names no setting."""
    assert field in refused(overrides=[f"{field}={text}"]).message
    group, _, name = field.rpartition(".")
    path = toml(f"[{group}]\n{name} = {text}")
    error = refused(files=[path])
    assert str(path) in error.message and field in error.message
    error = refused(flags={field: float(text)})
    assert name.replace("_", "-") in error.message


# Files


@pytest.mark.parametrize(
    "text",
    [
        "[airl",
        "airl = ",
        "a = 1\na = 2",
        "= 1",
        "[airl]\n[airl]",
        b"\xff\xfe",
        b"\0",
        "x = " + "[" * 3000,
        "x = " + "9" * 5000,
    ],
    ids=lambda t: repr(t[:12]),
)
def test_malformed_toml_names_the_file(toml, text):
    path = toml(text)
    error = refused(files=[path])
    assert str(path) in error.message and "TOML" in error.message


@pytest.mark.parametrize(("name", "error"), [("absent.toml", NotFound), (".", UsageError)])
def test_files_that_cannot_be_read(tmp_path, name, error):
    with pytest.raises(error) as caught:
        load_config("lunar-lander", files=[tmp_path / name])
    assert str(tmp_path / name) in caught.value.message and "--settings" in caught.value.hint


@pytest.mark.parametrize(
    ("text", "named", "hint"),
    [
        ("[arl]\ngrouping = 'per-setting'", "'arl'", "did you mean 'airl'"),
        ("[airl]\ngroupng = 'pooled'", "'airl.groupng'", "did you mean 'grouping'"),
        ("[airl.ppo]\nn_env = 3", "'airl.ppo.n_env'", "did you mean 'n_envs'"),
        ("[profiles.smok.airl]\ngrouping = 'per-setting'", "profile 'smok'", "'smoke'"),
        ("[profiles]\nsmoke = 3", "profiles.smoke: expected a table", "[profiles.smoke.airl]"),
        ("profiles = 3", "profiles: expected a table", "[profiles.smoke.airl]"),
        ("airl = 3", "airl: expected a table, found 3", "[airl] with some of: learner"),
        ("airl = []", "airl: expected a table, found []", "[airl]"),
        ("[airl]\nppo = 1", "airl.ppo: expected a table", "[airl.ppo] with some of: n_envs"),
        ("[airl]\ngrouping = 'all'", "airl.grouping", "pooled"),
        ("[airl]\nlearner = 'gial'", "unknown airl.learner 'gial'", "known: airl"),
        ("[airl]\npenalty = 'irmv2'", "airl.penalty: unknown penalty 'irmv2'", "irmv1"),
        ("[airl]\npenalty = 'closed-form'", "airl has no penalty 'closed-form'", "irmv1"),
        ("[transfer]\nalgorithm = 'ppoo'", "'ppoo'", "did you mean 'ppo'"),
        ("[airl]\npenalty_weight = '3'", "airl.penalty_weight", "10.0"),
        ("[airl]\npenalty_weight = 2024-01-01", "airl.penalty_weight", "10.0"),
        ("[airl]\nhidden = [8, 'x']", "airl.hidden", "[32,32]"),
        ("[expert]\ntotal_steps = -1", "expert.total_steps", "1000000"),
        ("[expert]\ntotal_steps = 99999999999999999999999", "expert.total_steps", "1000000"),
        ("interventions = 3", "interventions: expected a table", "[interventions.KNOB]"),
        ("[interventions.bounce]\nid = ['0.1']\nood = ['1.5']", "bounce", "between 0 and 1"),
        ("[interventions.bounce]\nid = ['soft']\nood = ['0.9']", "bounce", "bounce=0.5"),
        ("[interventions.bounce]\nid = [0.1]\nood = ['0.9']", "interventions", ""),
        (
            "[interventions.bounce]\nidd = ['0.1']",
            "'interventions.bounce.idd'",
            "did you mean 'id'",
        ),
        ("[interventions.mine]\nid = ['0.1']", "no intervention 'mine'", "bounce"),
        ("[interventions.bounc]\nid = ['0.1']", "no intervention 'bounc'", "did you mean 'bounce'"),
        ("[interventions.bounce]\nid = ['0.1', '0.90']\nood = ['0.9']", "bounce=0.9", "hold out"),
        ("[interventions.bounce]\nid = ['0.1', '0.10']\nood = ['0.9']", "bounce=0.1 twice", "once"),
        (
            "[interventions.bounce]\nid = ['0.1', '0.5']\nood = ['0.9']\nepisodes = [1, 2, 3]",
            "interventions.bounce.episodes: 3 episode counts for 2",
            "one for each",
        ),
        (
            "[interventions.engine-power]\nid = ['1x']\nood = ['1.0x']",
            "engine-power=1x is both",
            "hold out",
        ),
        (
            "[interventions.bounce.expert.ppo]\nn_epoch = 3",
            "expert.ppo.n_epoch'",
            "did you mean 'n_epochs'",
        ),
        ("[interventions.bounce.expert.ppo]\nn_epochs = 0", "expert.ppo.n_epochs", ""),
        (
            "[interventions.bounce.expert]\nppo = 3",
            "bounce.expert.ppo: expected a table",
            "[interventions.bounce.expert.ppo]",
        ),
        ("[interventions]\nbounce = 3", "interventions.bounce: expected a table", "id, ood"),
        ("[interventions.leg-length]\nid = ['1x']\nood = ['2x']", "leg-length", "bounce"),
    ],
)
def test_a_wrong_file_is_named_with_the_field(toml, text, named, hint):
    path = toml(text)
    error = refused(files=[path])
    assert str(path) in error.message
    assert named in error.message
    assert hint in error.hint


def test_a_table_in_place_of_a_value_that_the_profile_sets_is_named(toml):
    path = toml("[airl]\npenalty_weight = {a = 1}")
    assert load_config(LANDER).airl.penalty_weight == 1.0
    error = refused(files=[path])
    assert str(path) in error.message and "airl.penalty_weight" in error.message


def test_the_layer_at_fault_is_named_not_an_innocent_one(toml):
    """A file may complete what it overrides only in part."""
    path = toml("[interventions.engine-power]\nood = ['2x']")
    assert load_config(LANDER, files=[path]).interventions["engine-power"].ood == ("2x",)
    error = refused(files=[path], flags={"airl.grouping": "all"})
    assert "--grouping" in error.message and "all" in error.message
    assert str(path) not in error.message


def test_a_later_layer_does_not_hide_what_is_wrong(toml):
    path = toml("expert = 3")
    assert str(path) in refused(files=[path], overrides=["expert.total_steps=5000"]).message


def test_flags_are_named_as_they_are_written():
    error = refused(flags={"airl.penalty_weight": -3.0})
    assert "--penalty-weight" in error.message


@pytest.mark.parametrize(
    ("profile", "hint"), [("smoky", "did you mean 'smoke'"), ("", "known: "), ("PAPER", "paper")]
)
def test_unknown_profile(profile, hint):
    error = refused(profile)
    assert repr(profile) in error.message and hint in error.hint


@pytest.mark.parametrize("env", ["lunar-landr", "", "../lunar-lander", "/etc/passwd", "moon"])
def test_unknown_environment_reads_no_file(env):
    with pytest.raises(UsageError) as caught:
        load_config(env)
    assert repr(env) in caught.value.message and "lunar-lander" in caught.value.hint


# Anything at all


@given(st.text(max_size=30) | st.from_regex(r"(airl|expert)\.[a-z_]{1,12}=.{0,12}", fullmatch=True))
def test_any_set_is_taken_or_refused(item):
    try:
        settings = load_config(LANDER, "smoke", overrides=[item])
    except UsageError as error:
        assert error.hint
    else:
        assert isinstance(settings, Config)


FLOAT_FIELDS = [
    "airl.learning_rate",
    "airl.penalty_weight",
    "airl.replay_share",
    "expert.ppo.gamma",
    "expert.ppo.ent_coef",
]


@example("airl.penalty_weight", math.inf)
@example("expert.ppo.gamma", math.nan)
@given(st.sampled_from(FLOAT_FIELDS), st.floats())
def test_what_is_taken_can_be_part_of_a_key(field, x):
    try:
        settings = load_config(LANDER, flags={field: x})
    except UsageError:
        return
    assert math.isfinite(x)
    canonical_json(msgspec.to_builtins(settings))


@given(
    st.binary(max_size=60) | st.text("[]={}.\n'\"airl expt0123456789", max_size=60).map(str.encode)
)
def test_any_file_is_taken_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(data)
    try:
        settings = load_config(LANDER, files=[path])
    except UsageError as error:
        assert str(path) in error.message and error.hint
    else:
        assert isinstance(settings, Config)


def test_challengers_learn_as_retrained_policies_do():
    config = load_config("ant")
    assert config.airl.challenger.ppo == config.transfer.ppo
    changed = load_config("ant", overrides=["transfer.ppo.n_epochs=3"])
    assert changed.airl.challenger.ppo.n_epochs == 3
    own = load_config(
        "ant", overrides=["transfer.ppo.n_epochs=3", "airl.challenger.ppo.n_epochs=5"]
    )
    assert (own.transfer.ppo.n_epochs, own.airl.challenger.ppo.n_epochs) == (3, 5)


def test_a_knobs_challengers_learn_as_its_retrained_policies_do(toml):
    legs, friction = (
        parse_settings("ant", text)[0] for text in ("leg-length=2x", "friction=2:0.6:0.6")
    )
    config = load_config("ant")
    constant = {"learning_rate_schedule": "constant"}
    retrained = replace(config.transfer_of(legs).ppo, **constant)
    assert config.airl_of([legs]).challenger.ppo == retrained
    assert config.airl_of([friction]).challenger.ppo == config.transfer_of(friction).ppo
    # The unchanged world beside it changes no knob; another knob makes it a reward of both.
    assert config.airl_of([Setting(), legs]) == config.airl_of([legs]) != config.airl
    assert config.airl_of([legs, friction]) == config.airl
    heavy = parse_setting("ant", "leg-length=2x,mass=2x")
    assert config.airl_of([heavy]) == config.airl_of([legs])
    assert config.expert_of(heavy) == config.expert_of(legs) != config.expert
    # Without a reward learning of its own, nothing else differs.
    smoke = load_config("ant", profile="smoke")
    own = smoke.airl_of([legs]).challenger
    assert smoke.airl_of([legs]) == replace(smoke.airl, challenger=own)
    # Two whole generations of challengers, and a mean that has as many rounds as it asks for.
    for setting in (friction, legs):
        airl = relevant_airl(config.airl_of([setting]), discrete_actions=False)
        rounds = airl.ppo.rounds(airl.total_steps)
        assert 2 * airl.challenger.life == rounds and airl.averaged_rounds <= rounds
    assert config.airl_of([legs]).challenger.ppo.use_sde
    own = load_config("ant", files=[toml("[airl.challenger.ppo]\nuse_sde = false")])
    assert not own.airl_of([legs]).challenger.ppo.use_sde and own.transfer_of(legs).ppo.use_sde
    assert own.airl_of([legs]).challenger.ppo.activation == "relu"


@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_challengers_at_most_double_the_cost_of_learning(env):
    """In steps and in updates a round, where there are challengers."""
    config = load_config(env)
    for knob, listed in config.interventions.items():
        settings = [parse_settings(env, f"{knob}={value}")[0] for value in listed.id]
        airl = config.airl_of(settings)
        if airl.challenger.life:
            student, ppo = airl.ppo, replace(airl.challenger.ppo, n_envs=airl.ppo.n_envs)
            assert _steps(ppo) <= 2 * _steps(student)
            assert _updates(ppo) <= 2 * _updates(student)


def _steps(ppo):
    return ppo.n_envs * ppo.n_steps * ppo.rollouts_per_round


def _updates(ppo):
    return ppo.n_epochs * _steps(ppo) / min(ppo.batch_size, ppo.n_envs * ppo.n_steps)


def test_a_knob_has_rewards_of_its_own(toml):
    mine = toml("[interventions.bounce.airl]\nbatch_size = 64\n[airl]\nbc_epochs = 7")
    config = load_config(LANDER, files=[mine], overrides=["airl.hidden=[8]"])
    bounce, power = (
        config.airl_of(parse_settings(LANDER, text)) for text in ("bounce=0.1", "engine-power=1x")
    )
    assert power == config.airl and (power.bc_epochs, power.hidden) == (7, (8,))
    assert bounce == replace(power, batch_size=64)


def test_retrained_policies_and_challengers_learn_as_experts_do_unless_the_config_differs():
    config = load_config("ant", overrides=["expert.ppo.n_epochs=3"])
    assert config.transfer.ppo.n_epochs == config.airl.challenger.ppo.n_epochs == 3
    # A knob's own experts, here with gSDE.
    legs = parse_settings("ant", "leg-length=2x")
    falling = {"learning_rate_schedule": "linear"}
    assert config.transfer_of(legs[0]).ppo == replace(config.expert_of(legs[0]).ppo, **falling)
    assert config.airl_of(legs).challenger.ppo == config.expert_of(legs[0]).ppo
    assert config.expert_of(legs[0]).ppo.use_sde and not config.transfer.ppo.use_sde
    config = load_config("ant", overrides=["expert.ppo.n_epochs=3", "transfer.ppo.n_epochs=5"])
    for ppo in (config.transfer.ppo, config.transfer_of(legs[0]).ppo, config.airl.challenger.ppo):
        assert ppo.n_epochs == 5
    assert config.expert.ppo.n_epochs == 3


@pytest.mark.parametrize("env", [n for n, spec in ENVIRONMENTS.items() if not spec.tabular])
def test_retraining_is_as_strong_as_the_experts_training(env):
    """The same steps and the same PPO in every setting, on normalised rewards, but for what docs name.

    Only the control with a cue has a smaller budget, and Ant's legs have a larger one.
    """
    config = load_config(env)
    for knob, values in config.interventions.items():
        if knob == "cue-strength":
            continue
        for setting in parse_settings(env, f"{knob}={','.join((*values.id, *values.ood))}"):
            expert, transfer = config.expert_of(setting), config.transfer_of(setting)
            legs = (env, knob) == ("ant", "leg-length")
            assert transfer.total_steps == (2 if legs else 1) * expert.total_steps
            assert transfer.ppo.normalise_rewards
            own = {"normalise_rewards": True}
            if env == "lunar-lander":
                own |= {"gamma": 0.99, "learning_rate_schedule": "linear"}
            if legs:
                own |= {"learning_rate_schedule": "linear"}
            assert transfer.ppo == replace(expert.ppo, **own)


def test_a_training_without_an_update_is_refused():
    relevant = partial(relevant_transfer, discrete_actions=False, from_student=False)
    sac = TransferConfig(algorithm="sac", total_steps=1000, sac=SACConfig(n_envs=2, n_steps=100))
    begins = [replace(sac.sac, learning_starts=n) for n in (999, 1000)]
    assert relevant(replace(sac, sac=begins[0])).sac == begins[0]
    with pytest.raises(
        UsageError, match=r"leaves no update in transfer\.total_steps, which is 1000"
    ):
        relevant(replace(sac, sac=begins[1]))
    early = replace(sac, restarts=2, restart_steps=200, sac=begins[0])
    with pytest.raises(UsageError, match=r"leaves no update in transfer\.restart_steps"):
        relevant(early)
    with pytest.raises(UsageError, match=r"transfer\.ppo: one world and one step"):
        relevant(TransferConfig(ppo=PPOConfig(n_envs=1, n_steps=1)))
    falling = PPOConfig(n_envs=2, n_steps=100, learning_rate_schedule="linear")
    relevant(TransferConfig(total_steps=201, ppo=falling))
    with pytest.raises(UsageError, match=r"transfer\.total_steps = 200 leaves no update"):
        relevant(TransferConfig(total_steps=200, ppo=falling))
    rounds = TransferConfig(total_steps=1, ppo=replace(falling, learning_rate_schedule="constant"))
    relevant(rounds)
    student = replace(rounds, from_student=FromStudentConfig(total_steps=200))
    with pytest.raises(UsageError, match=r"transfer\.from_student\.total_steps = 200 leaves no"):
        relevant(student, from_student=True)
    with pytest.raises(UsageError, match=r"airl\.total_steps = 200 leaves no update"):
        relevant_airl(AIRLConfig(total_steps=200, ppo=falling), discrete_actions=False)
    # Of a challenger, whose budget is its life.
    for life, rollouts in ((1, 1), (2, 1), (1, 2)):
        ppo = replace(falling, rollouts_per_round=rollouts)
        airl = AIRLConfig(
            logit="f", policy_reward="f", challenger=ChallengerConfig(life=life, ppo=ppo)
        )
        with (
            pytest.raises(UsageError, match=r"airl\.challenger\.life = 1 leaves no update")
            if life * rollouts == 1
            else nullcontext()
        ):
            relevant_airl(airl, discrete_actions=False)


def test_a_knobs_own_retraining_wins_over_the_general_one_and_flags_over_both():
    (legs,) = parse_settings("ant", "leg-length=3x")
    (friction,) = parse_settings("ant", "friction=2:0.6:0.6")
    config = load_config("ant")
    assert config.transfer_of(legs).ppo.use_sde and not config.transfer_of(friction).ppo.use_sde
    plain = load_config("ant", overrides=["transfer.ppo.use_sde=false"])
    assert not plain.transfer_of(legs).ppo.use_sde
    sac = load_config("ant", flags={"transfer.algorithm": "sac"})
    assert {sac.transfer_of(s).algorithm for s in (legs, friction)} == {"sac"}


def test_none_unsets_a_field_that_the_settings_set(toml):
    (friction,) = parse_settings("ant", "friction=1.5:0.1:0.1")
    listed = load_config("ant").airl_of([friction])
    assert listed.averaged_rounds == 30
    for source in (
        {"overrides": ["airl.averaged_rounds=none"]},
        {"files": [toml('[airl]\naveraged_rounds = "none"')]},
    ):
        found = load_config("ant", **source).airl_of([friction])
        assert found == replace(listed, averaged_rounds=msgspec.UNSET)
    with pytest.raises(UsageError, match="expected a whole number"):
        load_config("ant", overrides=["airl.averaged_rounds=some"])


def test_none_in_a_settings_file_removes_what_the_profile_sets(toml):
    assert load_config(LANDER).transfer.ceiling == 0.9
    assert (
        load_config(LANDER, files=[toml('[transfer]\nceiling = "none"')]).transfer.ceiling is None
    )
    lifted = toml(
        '[interventions.bounce]\nid = ["0.1"]\n[interventions.bounce.transfer]\nceiling = "none"'
    )
    (bounce,) = parse_settings(LANDER, "bounce=0.1")
    assert load_config(LANDER).transfer_of(bounce).ceiling == 0.9
    assert load_config(LANDER, files=[lifted]).transfer_of(bounce).ceiling is None
    assert "airl.hidden" in refused(files=[toml('[airl]\nhidden = "none"')]).message
    whole = toml('[interventions.bounce]\nid = ["0.1"]\ntransfer = "none"')
    assert "'none'" in refused(files=[whole]).message


def test_none_unsets_what_another_section_would_pass_on():
    """Retrained policies learn as experts do, and challengers as retrained policies."""
    inherited = load_config(LANDER, "paper").transfer.ppo
    assert inherited.adam_eps == 1e-5
    plain = load_config(LANDER, "paper", overrides=["transfer.ppo.adam_eps=none"])
    assert plain.transfer.ppo == replace(inherited, adam_eps=msgspec.UNSET)
    assert plain.expert.ppo.adam_eps == 1e-5
    challenger = ["airl.challenger.ppo.adam_eps=none"]
    found = load_config(LANDER, "paper", overrides=challenger)
    assert found.airl.challenger.ppo.adam_eps is msgspec.UNSET
    assert found.transfer.ppo.adam_eps == 1e-5


def test_an_eps_that_is_the_default_is_no_other_key():
    plain = relevant_ppo(PPOConfig(), True, "expert.ppo")
    assert relevant_ppo(PPOConfig(adam_eps=1e-8), True, "expert.ppo") == plain
    assert relevant_ppo(PPOConfig(adam_eps=1e-5), True, "expert.ppo") != plain
    assert {load_config(LANDER, p).expert.ppo.adam_eps for p in ("standard", "paper")} == {
        msgspec.UNSET,
        1e-5,
    }


def test_a_cap_on_the_noise_of_gsde_is_refused():
    """gSDE's log standard deviations are of the features' weights, not of the actions."""
    capped = PPOConfig(use_sde=True, log_std_max=-1.0)
    with pytest.raises(UsageError, match=r"expert\.ppo\.log_std_max"):
        relevant_ppo(capped, False, "expert.ppo")


def test_rewards_of_two_knobs_have_the_config_of_the_one_that_has_its_own():
    config = load_config("ant")
    settings = [*parse_settings("ant", "mass=0.5x"), *parse_settings("ant", "friction=2:0.6:0.6")]
    for order in (settings, settings[::-1]):
        assert config.airl_of(order) == config.airl_of(settings[1:]) != config.airl


def test_a_later_count_of_demonstrations_wins_over_a_knobs_own(tmp_path):
    def counts(**options):
        return load_config("ant", **options).interventions["goal-y"].episodes

    assert (counts(), counts(profile="smoke")) == ((10, 3), (2, 1))
    assert counts(overrides=["demonstrations.episodes=4"]) == ()
    file = tmp_path / "mine.toml"
    file.write_text("[demonstrations]\nepisodes = 4\n")
    assert counts(files=[file]) == ()
    file.write_text("[demonstrations]\nepisodes = 4\n[interventions.goal-y]\nepisodes = [5, 1]\n")
    assert counts(files=[file]) == (5, 1)
