"""An environment of one's own through the real command line, and what its results remember of it."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import irlcli
from irlcli.data.demonstrations import read_demonstrations
from irlcli.envs import registration, registry
from irlcli.envs.registration import make
from irlcli.envs.registry import resolve
from irlcli.errors import NotFound, StageFailed
from irlcli.interventions import Setting, env_kwargs, parse_setting
from irlcli.rl.rollout import roll_out
from irlcli.store import Store

SMOKE = ("--profile", "smoke", "--quiet")
IDLE = ("evaluate", "--idle", "--intervention", "mass=2x", *SMOKE)


def status(bench, *words) -> str:
    """HIT, RUN, ... of the last step of a command's plan."""
    done = bench.irl(*words, "--dry-run")
    assert done.code == 0, done.err
    return done.out.splitlines()[-1].split()[0]


def made(bench, *words) -> str:
    """The id of what a command made."""
    done = bench.irl(*words)
    assert done.code == 0, done.err
    return done.out.strip().rpartition("/")[2]


def test_the_chain_needs_the_file_only_once(bench):
    demos = ("collect-experts", "--env", "cart.toml", "--setting", "drag=0.5,mass=2x")
    made(bench, *demos, "--intervention", "mass=1x", "--name", "demos", *SMOKE)
    made(bench, "train-airl", "--demos", "demos", "--method", "irm", "--name", "irm", *SMOKE)
    made(bench, "transfer", "--reward", "irm", "--ood", "mass=4x", "--name", "moved", *SMOKE)
    scored = made(bench, "evaluate", "--policy", "moved", "--reward", "irm", *SMOKE)
    shown = bench.irl("report", "returns", scored)
    assert shown.code == 0 and "cart mass=4x" in shown.out + shown.err
    # The settings of the file travelled too: 800 steps are its smoke profile.
    record = Store("runs").resolve("moved").artefact.manifest.record
    assert record.parameters["transfer"]["total_steps"] == 800
    assert record.parameters["environment"]["own"]["knobs"] == {"mass": "mass_scale"}
    # A hint names a file only where there is one, so it can be run as it is.
    assessed = bench.irl("assess", "irm", "--ood", "mass=2x", *SMOKE)
    (retrain,) = re.findall("`irl (transfer .*?)`", assessed.err)
    assert status(bench, *shlex.split(retrain)) == "RUN"
    assert "evaluate --expert --env FILE.toml --setting mass=2x" in assessed.err
    with_file = bench.irl("assess", "irm", "--ood", "mass=2x", "--env", "cart.toml", *SMOKE)
    assert with_file.err.count("--env cart.toml") == 2
    # Elsewhere the module is missing, and the file brings it back.
    again = ("transfer", "--reward", "irm", "--ood", "mass=4x", *SMOKE)
    assert status(bench, *again) == "HIT"
    elsewhere = bench.directory.parent
    sys.path = [place for place in sys.path if place != str(bench.directory)]
    sys.modules.pop("cart", None)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(elsewhere)
        away = (*again, "--store", "bench/runs")
        lost = bench.irl(*away)
        assert lost.code == 3 and "no module 'cart'" in lost.err and "PYTHONPATH" in lost.err
        registry.forget()
        with pytest.raises(NotFound, match="no module 'cart'"):
            irlcli.load_reward("irm", store="bench/runs")
        assert status(bench, *away, "--env", "bench/cart.toml") == "HIT"
        reward = irlcli.load_reward("irm", store="bench/runs", env="bench/cart.toml")
        assert reward.settings == ("mass=1x", "drag=0.5,mass=2x")
        # So do recordings that come back into a store of another directory.
        recorded = read_demonstrations(Store("bench/runs").resolve("demos").artefact.directory)
        away_from = ("--store", "bench/runs", "--to", "parquet:demos.parquet")
        assert bench.irl("export", "demos", "demos", *away_from).code == 0
        file = ("demos.parquet", "--env", "bench/cart.toml")
        own = ("--intervention", "mass=1x", "--setting", "drag=0.5,mass=2x")
        copied = made(bench, "import", *file, *own, "--store", "other", "--quiet")
        found = read_demonstrations(Store("other").resolve(copied).artefact.directory)
        assert found.env == "cart"
        for text, group in recorded.trajectories.items():
            for one, other in zip(group, found.trajectories[text], strict=True):
                assert (one.observations == other.observations).all()
                assert (one.actions == other.actions).all()
        unknown = bench.irl("import", *file, "--intervention", "mass=1x,4x", "--store", "other")
        assert unknown.code == 2 and "is not one of mass=1x, mass=4x" in unknown.err, unknown.err
    # A copy outside the store does not describe its environment.
    shutil.copy(Store("runs").resolve("irm/reward.pt").path, "copied.pt")
    foreign = ("transfer", "--reward", "copied.pt", "--ood", "mass=4x", *SMOKE)
    unknown = bench.irl(*foreign)
    assert unknown.code == 4 and "unknown environment 'cart'" in unknown.err
    assert "--env" in unknown.err
    assert status(bench, *foreign, "--env", "cart.toml") == "HIT"
    export = ("export", "reward", "copied.pt", "--to", "torch-export:copied.pt2")
    assert bench.irl(*export).code == 4
    exported = bench.irl(*export, "--env", "cart.toml")
    assert exported.code == 0 and (bench.directory / "copied.pt2").exists(), exported.err
    # Other code is named, and refused unless the user names the file.
    bench.edit(bench.module, "0.1 * self.speed", "0.2 * self.speed")
    other = bench.irl(*again)
    assert other.code == 2 and "the code of cart is not" in other.err and "--env" in other.err
    assert status(bench, *again, "--env", "cart.toml") == "RUN"
    # Nor is other code imported by a command that plans nothing.
    sys.modules.pop("cart", None)
    registration._imported.clear()
    bench.edit(bench.module, "import gymnasium", "open('mark', 'w')\nimport gymnasium")
    played = bench.irl("play", "moved", "--out", "moved.gif")
    assert played.code == 2 and "--env" in played.err
    assert not (bench.directory / "mark").exists()


def test_a_profile_that_the_file_does_not_have_is_named(bench):
    line = ("collect-experts", "--env", "cart.toml", "--intervention", "mass", "--dry-run")
    warned = [bench.irl(*line, "--profile", p).err for p in ("smoke", "standard", "paper")]
    assert warned[0] == warned[1] == ""
    assert warned[2].count("\n") == 1 and "cart.toml has no [profiles.paper]" in warned[2]


def test_only_what_can_change_a_result_changes_the_key(bench):
    idle = (*IDLE, "--env", "cart.toml")
    made(bench, *idle)
    knob = '[knobs.gust]\nargument = "gust"\nforms = ["absolute"]\nlow = 0\nhigh = 1\n'
    for path, old, new, expected in (
        (bench.toml, "max_episode_steps = 50", "# a comment\nmax_episode_steps = 50", "HIT"),
        (bench.toml, "high = 10.0", "high = 20.0", "HIT"),
        (bench.toml, "mass of the cart", "its mass", "HIT"),
        (bench.toml, "total_steps = 80_000", "total_steps = 90_000", "HIT"),
        (bench.toml, "[interventions.mass]", f"{knob}[interventions.mass]", "HIT"),
        (bench.toml, 'argument = "drag"', 'argument = "brake"', "HIT"),
        (bench.toml, 'actions = "continuous"', "", "HIT"),
        (bench.toml, "[env]", "[env]\nsymmetries = true", "HIT"),
        (bench.toml, 'argument = "mass_scale"', 'argument = "drag"', "RUN"),
        (bench.toml, "max_episode_steps = 50", "max_episode_steps = 51", "RUN"),
        (bench.toml, '"cart:Cart-v0"', '"cart:Cart-v0"\nname = "wagon"', "RUN"),
        (bench.toml, '"cart:Cart-v0"', '"cart:Cart-v0"\narguments.drag_ = 1', "RUN"),
        (bench.toml, '"cart:Cart-v0"', '"cart:Cart-v0"\nfiles = ["cart.toml"]', "RUN"),
        (bench.module, "A cart on a rail", "A cart on rails", "RUN"),
    ):
        before = path.read_text()
        bench.edit(path, old, new)
        assert status(bench, *idle) == expected, new
        path.write_text(before)
    assert status(bench, *idle) == "HIT"
    shutil.copytree(bench.directory, bench.directory / "copy")
    sys.path.remove(str(bench.directory))
    sys.modules.pop("cart", None)
    for name in ("cart.py", "cart.toml"):
        (bench.directory / name).unlink()
    assert status(bench, *IDLE, "--env", "copy/cart.toml") == "HIT"


def test_a_reward_learned_with_the_symmetries_of_the_module(bench):
    bench.declare_symmetries()
    made(
        bench,
        "collect-experts",
        "--env",
        "cart.toml",
        "--intervention",
        "mass",
        "--name",
        "demos",
        *SMOKE,
    )
    plain = ("train-airl", "--demos", "demos", "--set", "airl.logit=f", *SMOKE)
    train = (*plain, "--set", "airl.symmetries=true")
    with_images = made(bench, *train)
    assert made(bench, *plain) != with_images
    assert status(bench, *train) == "HIT"
    bench.edit(bench.toml, "symmetries = true", "symmetries = false")
    done = bench.irl(*train, "--env", "cart.toml", "--seed", "1")
    assert done.code == 2 and "cart has no symmetries" in done.err


def test_a_process_does_not_mix_two_versions_of_a_module(bench):
    idle = (*IDLE, "--env", "cart.toml")
    made(bench, *idle)
    bench.edit(bench.module, "0.1 * self.speed", "0.2 * self.speed")
    stale = bench.irl(*idle)
    assert stale.code == 1 and "changed since this process imported it" in stale.err
    assert [a.manifest.record.stage for a in Store("runs").artefacts()] == ["evaluate"]


def test_random_actions_are_independent_of_the_first_start(bench):
    resolve("cart.toml")
    (acted,) = roll_out("cart", Setting(), "random", 1, 0, "evaluate")
    with closing(make("cart", Setting())) as world:
        world.reset(seed=acted.seed)
        drawn = world.unwrapped.np_random.uniform(-1.0, 1.0, len(acted) - 1)
    assert abs(np.corrcoef(acted.actions[1:, 0], drawn)[0, 1]) < 0.9


def test_workers_make_the_same_bytes(bench):
    collect = ("collect-experts", "--env", "cart.toml", "--intervention", "mass=1x", *SMOKE)
    one = made(bench, *collect, "--store", "one")
    assert made(bench, *collect, "--store", "two", "--workers", "2") == one


def test_the_experts_table_has_rows_of_own_environments(bench):
    plan = ("plan", "experts", "--profile", "smoke", "--json")
    planned = bench.irl(*plan, "--rows", "cart.toml")
    assert planned.code == 0, planned.err
    names = {step["name"] for step in json.loads(planned.out)["steps"]}
    wanted = [f"mass.expert.{x}" for x in ("1x", "2x", "4x")]
    wanted += [f"drag.expert.{x}" for x in ("0.1", "0.5", "1")]
    assert {f"smoke.cart.{step}" for step in wanted} <= names
    assert all(name.startswith("smoke.cart.") for name in names)
    assert bench.irl(*plan, "--rows", "carts").code == 2
    # A value that is written with an exponent is part of a name as well.
    bench.edit(bench.toml, "high = 10.0", "high = 1e20")
    bench.edit(bench.toml, 'ood = ["4x"]', 'ood = ["1e16x"]')
    large = bench.irl(*plan, "--rows", "cart.toml.mass")
    assert large.code == 0 and "smoke.cart.mass.expert.1e16x" in large.out, large.err


def test_planning_and_hits_load_nothing_heavy(bench):
    made(bench, *IDLE, "--env", "cart.toml")
    code = (
        "import sys\n"
        f"sys.argv = ['irl', *{[*IDLE, '--env', 'cart.toml']!r}]\n"
        "from irlcli.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as stop:\n    assert not stop.code\n"
        "print({'cart', 'gymnasium', 'numpy', 'torch'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"id": "os:Cart-v0"},
        {"whole": ["mass"]},
        {"max_episode_steps": 7},
        {"name": "wagon"},
    ],
)
def test_provenance_that_contradicts_the_key_is_refused(bench, publish, change):
    made_there = Store("runs").resolve(made(bench, *IDLE, "--env", "cart.toml")).artefact
    described = made_there.provenance()["environment"]
    parameters = json.loads(json.dumps(made_there.manifest.record.parameters))
    key = parameters["environment"]
    (key if change.keys() & key.keys() else key["own"]).update(change)
    shutil.rmtree("runs")
    published = publish(
        Store("runs"), stage="evaluate", parameters=parameters, environment=described
    )
    done = bench.irl("report", "returns", published.artefact.id)
    assert ("describes another environment than its key" in done.err) == bool(change), done.err
    # What was published holds no evaluation, which is noticed where the environment is the key's.
    assert done.code == (4 if change else 2)


def test_an_artefact_that_does_not_describe_its_environment_is_refused(bench, publish):
    record = (
        Store("runs").resolve(made(bench, *IDLE, "--env", "cart.toml")).artefact.manifest.record
    )
    shutil.rmtree("runs")
    published = publish(Store("runs"), stage="evaluate", parameters=record.parameters)
    done = bench.irl("report", "returns", published.artefact.id)
    assert done.code == 4 and "does not describe its environment" in done.err, done.err
    assert "--env" in done.err


def test_a_lab_takes_the_environment_from_each_artefact(bench):
    """Demonstrations of one cart, then of another: the first keep theirs, as on the command line."""
    own = ("--env", "cart.toml", "--intervention", "mass=1x,2x", *SMOKE)
    first = made(bench, "collect-experts", *own)
    lab = irlcli.Lab("runs", profile="smoke")
    assert lab.collect_experts("cart.toml", "mass=1x,2x").id == first
    bench.edit(bench.toml, "max_episode_steps = 50", "max_episode_steps = 40")
    second = lab.collect_experts("cart.toml", "mass=1x,2x")
    reward = lab.train_airl(first)
    assert status(bench, "train-airl", "--demos", first, "--method", "erm", *SMOKE) == "HIT"
    made_in = [lab.artefact(ref).parameters["environment"] for ref in (second, reward)]
    assert [environment["max_episode_steps"] for environment in made_in] == [40, 50]
    # Reading one leaves nothing behind for the next.
    for stored in (second, reward, second):
        assert not stored.to_pandas().empty
    lab.collect_experts("cart.toml", "mass=1x,2x")
    # What a method returned, and a path to its file in a store that is not named.
    for ref in (reward.id, reward, reward.output("reward.pt").absolute()):
        registry.forget()
        assert irlcli.load_reward(ref).settings == ("mass=1x", "mass=2x")
    lab.evaluate(idle=True, env="cart.toml", intervention="mass=2x").to_pandas()
    lab.evaluate(policy=reward).to_pandas()
    second.to_pandas()


def test_two_environments_may_share_a_module_and_read_different_files(bench):
    for name in ("a", "b"):
        (bench.directory / f"{name}.xml").write_text(name)
        text = bench.toml.read_text().replace(
            "[env]", f'[env]\nname = "{name}"\nfiles = ["{name}.xml"]'
        )
        (bench.directory / f"{name}.toml").write_text(text)
    lab = irlcli.Lab("runs", profile="smoke", quiet=True)
    made = [
        lab.evaluate(idle=True, env=f"{name}.toml", intervention="mass=2x")[0]
        for name in ("a", "b", "a")
    ]
    assert made[0].id == made[2].id != made[1].id
    bench.edit(bench.module, "1.0 - abs", "2.0 - abs")
    with pytest.raises(StageFailed, match="changed since this process imported it"):
        lab.evaluate(idle=True, env="b.toml", intervention="mass=2x", seed=1)


def test_a_whole_number_reaches_the_constructor_as_an_int(bench):
    bench.edit(bench.toml, 'argument = "drag"', 'argument = "drag"\nwhole = true')
    bench.edit(bench.toml, 'id = ["0.1", "0.5"]', 'id = ["0", "2"]')
    bench.edit(bench.module, "self.drag = drag", "self.drag = len(range(drag))")
    bench.edit(bench.module, "drag=0.1", "drag=1")
    one = ("--env", "cart.toml", "--intervention", "drag=2", "--profile", "smoke")
    done = bench.irl("evaluate", "--idle", *one)
    assert done.code == 0, done.err
    bench.edit(bench.toml, 'forms = ["absolute"]', 'forms = ["absolute", "range"]')
    env = resolve("cart.toml").name
    (given,) = env_kwargs(env, parse_setting(env, "drag=1..2")).values()
    assert given == (1, 2) and {type(x) for x in given} == {int}


def test_whether_a_knob_takes_whole_numbers_is_in_the_key(bench):
    """1 // 2 and 1 / 2 differ: an int and a float may make other environments."""
    bench.edit(bench.toml, 'id = ["0.1", "0.5"]', 'id = ["0", "2"]')
    one = ("evaluate", "--idle", "--env", "cart.toml", "--profile", "smoke")
    assert bench.irl(*one, "--intervention", "drag=1").code == 0
    assert bench.irl(*one, "--intervention", "mass=2x").code == 0
    bench.edit(bench.toml, 'argument = "drag"', 'argument = "drag"\nwhole = true')
    assert status(bench, *one, "--intervention", "drag=1") == "RUN"
    assert status(bench, *one, "--intervention", "mass=2x") == "HIT"


def test_seeds_share_a_row_however_many_settings_each_was_evaluated_in(bench):
    common = ("--profile", "smoke", "--quiet")
    both = ("--env", "cart.toml", "--intervention", "mass=1x,2x")
    assert bench.irl("collect-experts", *both, "--name", "demos", *common).code == 0
    more = {0: (), 1: ("--setting", "drag=0.5")}
    for seed, settings in more.items():
        learn = ("train-airl", "--demos", "demos", "--seed", seed, "--name", f"erm-{seed}")
        assert bench.irl(*learn, *common).code == 0
        measure = ("evaluate", "--policy", f"erm-{seed}", "--setting", "mass=4x", *settings)
        assert bench.irl(*measure, "--name", f"score-{seed}", *common).code == 0
    rows = json.loads(bench.irl("report", "returns", "score-0", "score-1", "--json").out)["rows"]
    seeds = {row["setting"]: len(row["returns"]) for row in rows}
    assert len(rows) == 2 and seeds == {"mass=4x": 2, "drag=0.5": 1}


def test_what_a_user_resolved_keeps_its_name(bench, smoke_store):
    """Calls take environments from what they name, and leave the names as they were."""
    cart = registry.resolve("cart.toml")
    irlcli.load_reward("airl", store=smoke_store.path)
    lab = irlcli.Lab(smoke_store.path, profile="smoke")
    assert lab.artefact("demos").to_pandas()["setting"].nunique() == 2
    assert registry.environment("cart") is cart


def test_an_environment_without_pictures_is_named_by_irl_play(bench):
    bench.edit(bench.module, ", render_mode=None", "")
    bench.edit(bench.module, "        self.render_mode = render_mode\n", "")
    both = ("--env", "cart.toml", "--intervention", "mass=1x,2x", "--profile", "smoke", "--quiet")
    assert bench.irl("collect-experts", *both, "--name", "demos").code == 0
    expert = json.loads(bench.irl("lineage", "demos", "--json").out)["inputs"][0]["from"]["id"]
    done = bench.irl("play", expert, "--out", "x.gif")
    assert done.code == 2 and "draws no pictures" in done.err and "env.arguments" not in done.err


def test_artefacts_of_two_environments_of_one_name_are_not_combined(bench):
    own = ("--env", "cart.toml", "--intervention", "mass=1x,2x", *SMOKE)
    learned = []
    for steps in (50, 40):
        bench.edit(bench.toml, "max_episode_steps = 50", f"max_episode_steps = {steps}")
        demos = made(bench, "collect-experts", *own)
        learned.append(made(bench, "train-airl", "--demos", demos, "--method", "erm", *SMOKE))
    mixed = bench.irl("evaluate", "--policy", learned[0], "--reward", learned[1], *SMOKE)
    assert mixed.code == 2 and "another version of 'cart'" in mixed.err and learned[1] in mixed.err
    alone = bench.irl("evaluate", "--policy", learned[0], "--reward", learned[0], *SMOKE)
    assert alone.code == 0, alone.err


def test_an_id_may_lack_its_version(bench):
    bench.edit(bench.toml, "max_episode_steps = 50\n", "")
    bench.edit(bench.module, '"Cart-v0", Cart', '"Cart-v0", Cart, max_episode_steps=7')
    bench.edit(bench.toml, '"cart:Cart-v0"', '"cart:Cart"')
    idle = made(bench, *IDLE, "--env", "cart.toml")
    record = Store("runs").resolve(idle).artefact.manifest.record
    assert record.parameters["environment"]["max_episode_steps"] == 7


def test_an_environment_that_draws_nothing_is_not_played(bench):
    own = ("--env", "cart.toml", "--intervention", "mass=1x", *SMOKE)
    demos = made(bench, "collect-experts", *own)
    learned = made(bench, "train-airl", "--demos", demos, "--method", "erm", *SMOKE)
    played = bench.irl("play", learned, "--out", "cart.gif")
    assert played.code == 2 and "draws no pictures" in played.err and "render" in played.err
    assert not Path("cart.gif").exists()


def test_a_step_that_needs_a_traceback_names_the_command_that_shows_it(bench):
    """Steps of `irl run` are processes of their own, whose tracebacks it does not show."""
    example = Path(__file__).parent.parent.parent / "examples" / "own-environment"
    shutil.copy(example / "tables.toml", "tables.toml")
    # In the held-out mass only the second world fails, so that the settings can be compared.
    broken = (
        "Cart.heavy = getattr(Cart, 'heavy', 0) + (mass_scale == 4)\n        self.drag = drag / "
    )
    bench.edit(bench.module, "self.drag = drag", f"{broken}(Cart.heavy < 2)")
    done = bench.irl("run", "cart", "--experiments", "tables.toml", *SMOKE, "--until", "experts")
    assert done.code == 2
    hint = next(line for line in done.err.splitlines() if "--debug" in line)
    shown = bench.irl(*shlex.split(hint.split("`")[1])[1:])
    assert "ZeroDivisionError" in shown.err and "self.drag = drag / (Cart.heavy < 2)" in shown.err


def test_a_hit_that_holds_an_older_description_is_named(bench):
    line = ("collect-experts", "--env", "cart.toml", "--intervention", "mass=1x,2x", *SMOKE)
    assert "another description" not in bench.irl(*line, "--name", "demos").err
    assert "another description" not in bench.irl(*line, "--name", "demos").err
    bench.edit(bench.toml, "[profiles.smoke.airl]", "[profiles.smoke.airl]\nlearning_rate = 0.01")
    done = bench.irl(*line, "--name", "demos")
    assert done.code == 0 and "holds another description of cart" in done.err
    learned = ("train-airl", "--demos", "demos", "--method", "erm", *SMOKE)
    assert "another description" not in bench.irl(*learned).err
