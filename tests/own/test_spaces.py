"""Which spaces an environment may have, what ``irl envs check`` finds, and whose mistakes are named."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import irlcli
from irlcli.data.demonstrations import read_demonstrations
from irlcli.envs.adapted import Adapted
from irlcli.envs.registry import resolve
from irlcli.envs.vector import VectorWorlds
from irlcli.errors import StageFailed, UsageError
from irlcli.interventions import parse_setting
from irlcli.rl.rollout import roll_out
from irlcli.store import Store

RANDOM = ("evaluate", "--random", "--env", "cart.toml", "--profile", "smoke", "--quiet")
COLLECT = ("collect-experts", "--env", "cart.toml", "--profile", "smoke", "--quiet")
ONE = ("--intervention", "mass=2x")
SPACES = "gymnasium.spaces."
OBSERVATIONS = "gymnasium.spaces.Box(-10.0, 10.0, (2,), np.float32)"
ACTIONS = "gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)"
RETURNED = "return np.clip([self.position, self.speed], -10.0, 10.0).astype(np.float32)"
DERAILED = """derailed = self.np_random.uniform() < 0.02
        reward = -100.0 if derailed else 1.0"""
FORCE = "float(np.clip(action, -1.0, 1.0)[0])"


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (OBSERVATIONS, f"{SPACES}Dict(x={SPACES}Discrete(2))", "in Dict"),
        (OBSERVATIONS, f"{SPACES}Discrete(3)", "in Discrete"),
        (OBSERVATIONS, f"{SPACES}Box(0, 1, (64, 65))", "of 4160 numbers"),
        (ACTIONS, f"{SPACES}MultiBinary(3)", "in MultiBinary"),
        (ACTIONS, f"{SPACES}Box(-np.inf, np.inf, (1,))", "without finite bounds"),
        (ACTIONS, f"{SPACES}Box(0, 3, (1,), np.int64)", "in a Box of int64"),
        (ACTIONS, f"{SPACES}Discrete(3)", "are discrete, not as env.actions says"),
        ("mass_scale=1.0", "weight=1.0", "keyword argument 'mass_scale'"),
        ("import numpy as np", "import numpy as np\nimport nothing_here", "'nothing_here'"),
        ('"Cart-v0"', '"Cart-v1"', "env.id"),
        ("self.drag = drag", "raise RuntimeError('no drag\\ntoday')", "RuntimeError: no drag"),
        (f"observation_space = {OBSERVATIONS}", "", "no attribute 'observation_space'"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(bench, old, new, named):
    bench.edit(bench.module, old, new)
    done = bench.irl(*RANDOM, *ONE)
    error, *rest = done.err.splitlines()
    assert (done.code, done.out) == (2, "") and named in error, done.err
    assert len(rest) == 1 and rest[0].startswith("hint: ")
    assert not list(Store("runs").artefacts())


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (
            "reward = 1.0",
            "raise KeyError('wheel')\n        reward = 1.0",
            "raised KeyError: 'wheel'",
        ),
        (
            "reward = 1.0",
            "raise AssertionError('\\nno wheel')\n        reward = 1.0",
            "raised AssertionError: no wheel",
        ),
        (
            "def _observation",
            "def close(self):\n        raise RuntimeError('stuck')\n\n    def _observation",
            "close() raised RuntimeError: stuck",
        ),
        ("reward = 1.0", "reward = np.nan", "returned the reward nan"),
        (RETURNED, "return np.zeros(3, np.float32)", "observation of size 3, but its space has"),
        (RETURNED, "return np.array([np.inf, 0], np.float32)", "is not finite"),
    ],
)
def test_what_an_environment_does_wrong_is_named_as_its_own(bench, old, new, named):
    bench.edit(bench.module, old, new)
    for workers in ("1", "2"):
        done = bench.irl(*COLLECT, *ONE, "--workers", workers)
        error = done.err.splitlines()[0]
        assert done.code == 1 and "cart: " in error and named in error, done.err


class Counter(gymnasium.Env):
    """Returns one array in every step, which counts the steps."""

    observation_space = gymnasium.spaces.Box(-10.0, 10.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    info: ClassVar = {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seen = np.zeros(1, np.float32) if not hasattr(self, "seen") else self.seen
        self.seen[:] = 0
        return self.seen, {}

    def step(self, action):
        self.seen += 1
        return self.seen, 0.0, False, False, self.info


def test_an_observation_keeps_its_numbers_in_the_steps_that_follow():
    world = Adapted(Counter(), "counter")
    seen = [world.reset(seed=0)[0]] + [world.step(np.zeros(1, np.float32))[0] for _ in range(2)]
    assert np.concatenate(seen).tolist() == [0, 1, 2]


def test_a_final_observation_is_not_that_of_the_next_episode():
    worlds = VectorWorlds([Counter()], max_episode_steps=2)
    worlds.reset([0])
    worlds.step(np.zeros((1, 1)))
    _, _, (end,) = worlds.step(np.zeros((1, 1)))
    assert end.final_observation.tolist() == [2]


def test_a_reward_wrapper_sees_both_ends_of_a_step():
    world = irlcli.RewardWrapper(Counter(), lambda obs, act, next_obs, done: (next_obs - obs)[:, 0])
    world.reset(seed=0)
    assert [world.step(np.zeros(1, np.float32))[1] for _ in range(2)] == [1.0, 1.0]


def test_an_action_has_the_type_and_the_bounds_of_its_space():
    class Exact(Counter):
        action_space = gymnasium.spaces.Box(-0.1, 0.1, (1, 2), np.float64)

        def step(self, action):
            assert self.action_space.contains(action)
            self.taken = action
            return super().step(action)

    exact = Exact()
    world = Adapted(exact, "exact")
    world.reset(seed=0)
    world.step(world.action_space.high)
    world.step(np.array([-3.0, 0.05], np.float32))
    assert exact.taken.tolist() == [[-0.1, pytest.approx(0.05)]]


@pytest.mark.parametrize(
    ("space", "kind", "action"),
    [
        (ACTIONS, "continuous", [0.0]),
        (f"{SPACES}Box(0.5, 1.0, (1,), np.float32)", "continuous", [0.5]),
        (f"{SPACES}Box(-1.0, -0.5, (1,), np.float32)", "continuous", [-0.5]),
        (f"{SPACES}Discrete(3)", "discrete", 0),
    ],
)
def test_the_idle_agent_stays_within_the_bounds(bench, space, kind, action):
    bench.edit(bench.module, ACTIONS, space)
    bench.edit(bench.module, FORCE, "float(np.ravel(action)[0])")
    bench.edit(bench.toml, '"continuous"', f'"{kind}"')
    env = resolve("cart.toml").name
    (episode,) = roll_out(env, parse_setting(env, "mass=2x"), "idle", 1, 0, "test")
    assert all(taken == action for taken in episode.actions.tolist())


def test_an_environment_cannot_change_the_action_of_its_caller():
    class Scaling(Counter):
        def step(self, action):
            action *= 0.5
            return super().step(action)

    world, action = Adapted(Scaling(), "scaling"), np.ones(1, np.float32)
    world.reset(seed=0)
    world.step(action)
    assert action.tolist() == [1.0]


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        (("text", 0.0, False, False, {}), "an observation that is no array"),
        (({"a": 1}, 0.0, False, False, {}), "an observation that is no array"),
        (([[1, 2], [3]], 0.0, False, False, {}), "an observation that is no array"),
        (([1], 0.0, [False, True], False, {}), "a terminated that is not true or false"),
        (([1], 0.0, np.nan, False, {}), "a terminated that is not true or false"),
        (([1], 0.0, False, "no", {}), "a truncated that is not true or false"),
        (([1], 0.0, False, [False, True], {}), "a truncated that is not true or false"),
        (([1], np.inf, False, False, {}), "the reward inf"),
        (([1], -1e39, False, False, {}), "the reward -1e+39"),
        (([1], 0.0, False, False, None), "an info that is no dictionary"),
        (([1], 0.0, False, False, {"progress": None}), "is not a finite number"),
        (([1], 0.0, False, False, {"progress": np.inf}), "is not a finite number"),
        (([1], 0.0, False, False, {"progress": np.ones(2)}), "is not a finite number"),
    ],
)
def test_what_a_step_returns_is_checked_at_once(returned, named):
    class Odd(Counter):
        def step(self, action):
            return returned

    world = Adapted(Odd(), "odd")
    world.reset(seed=0)
    with pytest.raises(StageFailed, match=re.escape(named)) as caught:
        world.step(np.zeros(1))
    assert caught.value.message.startswith("odd: step() returned")


@pytest.mark.parametrize("true", [True, 1, 1.0, np.True_, np.array([True])])
def test_the_end_of_an_episode_is_true_or_false_in_any_type(true):
    class Ending(Counter):
        def step(self, action):
            return [1], 0.0, true, np.logical_not(true), {}

    world = Adapted(Ending(), "ending")
    world.reset(seed=0)
    assert world.step(np.zeros(1))[2:4] == (True, False)


def test_an_environment_that_exits_is_named():
    class Exiting(Counter):
        def step(self, action):
            raise SystemExit(3)

    world = Adapted(Exiting(), "exiting")
    world.reset(seed=0)
    with pytest.raises(StageFailed, match="exiting: step\\(\\) raised SystemExit: 3"):
        world.step(np.zeros(1))


def test_a_progress_is_a_number_and_an_error_is_text():
    class Telling(Counter):
        info: ClassVar = {"progress": np.float32(0.5), "error": ValueError("fell"), "other": 1}

    world = Adapted(Telling(), "telling")
    world.reset(seed=0)
    *_, truncated, info = world.step(np.zeros(1))
    assert info == {"progress": 0.5, "error": "fell", "other": 1}
    assert truncated


def test_a_step_that_reports_an_error_may_return_values_that_are_not_finite():
    class Diverging(Counter):
        def step(self, action):
            return [np.nan], np.inf, False, False, {"error": "diverged"}

    world = Adapted(Diverging(), "diverging")
    started, _ = world.reset(seed=0)
    observation, reward, _, truncated, info = world.step(np.zeros(1))
    assert (observation.tolist(), reward, truncated) == (started.tolist(), 0.0, True)
    assert info["error"] == "diverged"


@pytest.mark.parametrize("none", [None, False, 0, "", np.False_, [], {}])
def test_an_error_that_says_nothing_is_none(none):
    class Quiet(Counter):
        info: ClassVar = {"error": none}

    world = Adapted(Quiet(), "quiet")
    world.reset(seed=0)
    *_, truncated, info = world.step(np.zeros(1))
    assert info == {"error": None} and not truncated


def test_flat_observations_and_actions_of_any_shape(bench):
    bench.edit(bench.module, OBSERVATIONS, f"{SPACES}Box(-10, 10, (2, 1), np.float64)")
    bench.edit(bench.module, RETURNED, "return np.array([[self.position], [self.speed]])")
    bench.edit(bench.module, ACTIONS, f"{SPACES}Box(-1.0, 1.0, (1, 1), np.float64)")
    bench.edit(bench.module, FORCE, "float(action[0, 0])")
    done = bench.irl(*COLLECT, *ONE, "--name", "demos")
    assert done.code == 0, done.err
    demos = read_demonstrations(Store("runs").resolve("demos").artefact.directory)
    first, _ = demos.trajectories["mass=2x"]
    assert first.observations.shape[1] == 2 and first.actions.shape[1] == 1
    learned = bench.irl("train-airl", "--demos", "demos", "--profile", "smoke", "--quiet")
    assert learned.code == 0, learned.err


def test_discrete_actions_that_begin_at_another_number(bench):
    bench.edit(bench.module, ACTIONS, f"{SPACES}Discrete(3, start=-1)")
    bench.edit(bench.module, FORCE, "{-1: -1, 0: 0, 1: 1}[action]")
    bench.edit(bench.toml, '"continuous"', '"discrete"')
    done = bench.irl(*COLLECT, *ONE, "--name", "demos")
    assert done.code == 0, done.err
    demos = read_demonstrations(Store("runs").resolve("demos").artefact.directory)
    assert {int(a) for t in demos.trajectories["mass=2x"] for a in t.actions} == {0, 1, 2}


def test_what_an_environment_prints_is_no_data(bench):
    for old in ("self.drag = drag", "reward = 1.0", "super().reset(seed=seed)"):
        bench.edit(bench.module, old, f"print('hello')\n        {old}")
    bench.edit(bench.module, "import numpy as np", "import numpy as np\nprint('imported')")
    for words in ((*RANDOM, *ONE), ("envs", "check", "cart.toml")):
        done = bench.irl(*words, "--json")
        assert done.code == 0 and json.loads(done.out), done.err
        assert "hello" in done.err


@pytest.mark.parametrize("words", [RANDOM, COLLECT], ids=["evaluate", "collect-experts"])
def test_an_episode_that_ends_on_an_error_is_named(bench, words):
    bench.edit(bench.module, "> 5.0, False, {}", '> 5.0, False, {"error": "it fell over"}')
    done = bench.irl(*words, *ONE)
    assert done.code == 0, done.err
    assert "warning: mass=2x, episode 0: it fell over" in done.err


FELL = "info = {{'error': 'it fell over'}} if {} else {{}}\n        reward = -1.0"


def breaks(bench, when):
    """Let a step fail ``when``. Every other one earns -1."""
    bench.edit(bench.module, "reward = 1.0 - abs(self.position)", FELL.format(when))
    bench.edit(bench.module, "> 5.0, False, {}", "> 5.0, False, info")


def test_means_leave_out_episodes_that_an_error_stopped(bench):
    """On every later run, too: their table says how many there were."""
    breaks(bench, "self.position > 0.9")
    # Some of the others end early.
    bench.edit(bench.module, "abs(self.position) > 5.0", "self.position < -0.9")
    line = ("train-airl", "--demos", "demos", "--method", "erm", "--name", "learned")
    assert bench.irl(*COLLECT, "--intervention", "mass=1x,2x", "--name", "demos").code == 0
    assert bench.irl(*line, "--profile", "smoke", "--quiet").code == 0
    words = ("evaluate", "--random", *ONE, "--episodes", "12", "--reward", "learned")
    made = json.loads(bench.irl(*words, "--json").out)
    again = bench.irl(*words)
    assert "fell over" not in again.err
    directory = Path("runs", made["id"])
    episodes = pd.read_parquet(directory / "episodes.parquet")
    whole = episodes[episodes["error"] == ""]
    assert set(episodes["error"]) == {"", "it fell over"} and 0 < whole["terminated"].mean() < 1
    (measured,) = json.loads((directory / "summary.json").read_text())["settings"]
    assert (measured["episodes"], measured["stopped"]) == (12, 12 - len(whole))
    for name, column in (
        ("mean_return", "true_return"),
        ("mean_learned_return", "learned_return"),
        ("mean_length", "length"),
        ("terminated", "terminated"),
    ):
        assert measured[name] == pytest.approx(whole[column].mean())
        assert measured[name] != pytest.approx(episodes[column].mean())
    header, row = again.err.splitlines()[-2:]
    assert "stopped by an error" in header and row.endswith(f"{12 - len(whole)} of 12")


def test_an_assessment_leaves_out_episodes_that_an_error_stopped(bench):
    """Episode k of all policies is compared, so it is left out for all."""
    breaks(bench, "self.position > 0.9")
    line = ("train-airl", "--demos", "demos", "--method", "erm", "--name", "learned")
    assert bench.irl(*COLLECT, "--intervention", "mass=1x,2x", "--name", "demos").code == 0
    assert bench.irl(*line, "--profile", "smoke", "--quiet").code == 0
    more = ("--name", "assessed", "--set", "evaluation.episodes=12")
    done = bench.irl("assess", "learned", *more, "--profile", "smoke")
    assert done.code == 0 and "are left out: an error stopped them" in done.err, done.err
    directory = Store("runs").resolve("assessed").artefact.directory
    bank = pd.read_parquet(directory / "bank.parquet")
    assert (bank["terminated"] | (bank["length"] == 50)).all()
    left_out = json.loads((directory / "assessment.json").read_text())["left_out"]
    numbers = bank.groupby(["setting", "policy"])["episode"].agg(tuple)
    assert numbers.nunique() == 1 and len(numbers.iloc[0]) == 12 - left_out


def test_if_an_error_stopped_all_episodes_their_means_are_kept(bench):
    breaks(bench, "True")
    words = ("evaluate", "--idle", "--env", "cart.toml", *ONE, "--episodes", "2", "--json")
    (row,) = json.loads(bench.irl(*words).out)["returns"]
    assert (row["mean"], row["episodes_per_seed"], row["stopped_episodes"]) == (-1.0, 2, 2)


def test_an_error_ends_an_episode_and_progress_may_begin_later(bench):
    bench.edit(bench.module, "self.speed = 0.0", "self.speed = 0.0\n        self.steps = 0")
    bench.edit(
        bench.module,
        "reward = 1.0",
        "self.steps += 1\n"
        "        info = {'progress': 1.5} if self.steps > 1 else {}\n"
        "        info |= {'error': 'it fell over'} if self.steps == 3 else {}\n"
        "        reward = 1.0",
    )
    bench.edit(bench.module, "> 5.0, False, {}", "> 5.0, False, info")
    env = resolve("cart.toml").name
    (episode,) = roll_out(env, parse_setting(env, "mass=2x"), "idle", 1, 0, "test")
    assert (len(episode), episode.truncated, episode.error) == (3, True, "it fell over")
    assert episode.progress == 3.0


def test_the_example_passes_every_check(bench):
    done = bench.irl("envs", "check", "cart.toml")
    assert done.code == 0 and {line[:4] for line in done.out.splitlines()} == {"PASS"}
    assert not (bench.directory / "runs").exists()


@pytest.mark.parametrize(
    ("old", "new", "failed", "named"),
    [
        ("/ self.mass", "", "mass: it changes episodes", "are equal"),
        ("_scale=1.0, drag", "_scale=5.0, drag", "mass: 1x is the default", "a default of 1"),
        ("reset(seed=seed)", "reset()", "gymnasium's check_env", "seed"),
        (
            "self.np_random.uniform(-1.0, 1.0)",
            "np.random.default_rng().uniform()",
            "equal seeds give equal episodes",
            "differ",
        ),
        (
            "self.drag = drag",
            "self.drag = drag\n        assert drag < 2, 'too much'",
            "drag: its bounds can be made",
            "too much",
        ),
        (
            "mass_scale=1.0",
            "mass_scale_=1.0",
            "mass: its bounds can be made",
            "mass_scale=0.1 (knobs.mass.argument)",
        ),
        ("self.drag = drag", "raise ValueError('\\nbroken')", "it can be made", "broken"),
        (
            "self.position = self",
            "import warnings\n        warnings.warn('')\n        assert seed is None, '\\nseeded'\n"
            "        self.position = self",
            "it can be made",
            "seeded",
        ),
        ("self.drag = drag", "raise SystemExit(3)", "it can be made", "SystemExit"),
        (
            "reward = 1.0",
            "raise SystemExit(3)\n        reward = 1.0",
            "it can be made",
            "SystemExit",
        ),
        (RETURNED, "return 'text'", "it can be made", "no array"),
        ("5.0, False", "5.0, True", "it can be made", "set max_episode_steps = 1 in [env]"),
        (
            "self.speed = 0.0",
            "self.speed = getattr(self, 'speed', 0.0)",
            "equal seeds give equal episodes",
            "the second after others",
        ),
        (
            "self.drag = drag",
            "Cart.drag = drag",
            "drag: it changes episodes",
            "when worlds of other settings exist",
        ),
    ],
)
def test_checks_find_what_is_wrong(bench, old, new, failed, named):
    if "mass_scale" in old:
        bench.edit(bench.module, "1.0 * mass_scale", "1.0")
    bench.edit(bench.module, old, new)
    done = bench.irl("envs", "check", "cart.toml")
    lines = done.out.splitlines()
    assert done.code == 1 and "checks of cart failed" in done.err
    assert named in lines[lines.index(f"FAIL  {failed}") + 1]
    assert failed in done.err and lines[-1] not in done.err
    if failed.endswith("its bounds can be made"):
        # The knob's other checks would fail alike.
        assert sum(failed.partition(":")[0] in line for line in lines if line[:4] == "FAIL") == 1


@pytest.mark.parametrize(
    ("old", "new", "verdict", "named"),
    [
        ("def symmetries", "def symmetries", "PASS", ""),
        ("[1.0, -1.0]", "[1.0, -2.0]", "FAIL", "no group"),
        ("def symmetries", "def mirrored", "FAIL", "symmetries"),
    ],
)
def test_declared_symmetries_are_checked(bench, old, new, verdict, named):
    bench.declare_symmetries()
    bench.edit(bench.module, old, new)
    assert "cart:symmetries" in bench.irl("envs", "show", "cart.toml").out
    lines = bench.irl("envs", "check", "cart.toml").out.splitlines()
    assert named in lines[lines.index(f"{verdict}  its symmetries") + 1]


def test_what_declared_symmetries_print_goes_to_stderr(bench):
    bench.declare_symmetries()
    bench.edit(bench.module, "    both = ", "    print('turned')\n    both = ")
    done = bench.irl("envs", "check", "cart.toml", "--json")
    assert json.loads(done.out) and "turned" in done.err


def test_a_knob_that_extends_the_observation_must_say_so(bench):
    bench.edit(bench.module, "drag=0.1,", "drag=None,")
    bench.edit(
        bench.module,
        "self.drag = drag",
        "self.drag = 0.1 if drag is None else drag\n        if drag is not None:\n"
        f"            self.observation_space = {SPACES}Box(-10.0, 10.0, (3,), np.float32)",
    )
    bench.edit(
        bench.module,
        RETURNED,
        "seen = [self.position, self.speed, self.drag][: self.observation_space.shape[0]]\n"
        "        return np.clip(seen, -10.0, 10.0).astype(np.float32)",
    )
    done = bench.irl("envs", "check", "cart.toml")
    assert done.code == 1 and "observed = true" in done.out
    bench.edit(bench.toml, 'argument = "drag"', 'argument = "drag"\nobserved = true')
    again = bench.irl("envs", "check", "cart.toml")
    assert again.code == 0, again.out


def test_an_observed_knob_must_change_something_too(bench):
    """With it an observation has an entry more, whatever its value."""
    bench.edit(
        bench.module,
        "self.drag = drag",
        f"self.drag = 0.1\n        self.observation_space = {SPACES}Box(-10.0, 10.0, (2 + bool(drag),))",
    )
    bench.edit(bench.module, "drag=0.1,", "drag=None,")
    bench.edit(
        bench.module,
        RETURNED,
        "seen = [self.position, self.speed, 0.0][: self.observation_space.shape[0]]\n"
        "        return np.clip(seen, -10.0, 10.0).astype(np.float32)",
    )
    bench.edit(bench.toml, 'argument = "drag"', 'argument = "drag"\nobserved = true')
    bench.edit(bench.toml, "low = 0.0", "low = 0.1")
    done = bench.irl("envs", "check", "cart.toml")
    lines = done.out.splitlines()
    assert "are equal" in lines[lines.index("FAIL  drag: it changes episodes") + 1]


FORCES = "self.action_space = gymnasium.spaces.Box(-mass_scale, mass_scale, (1,), np.float32)"
LONGER = (
    "self.observation_space = gymnasium.spaces.Box(-10.0, 10.0, (int(mass_scale),), np.float32)"
)
# Trains in 1x and 2x, and transfers to 4x.
TABLE = """
[cart]
title = "The cart"
rows = ["cart.toml.mass"]
methods = ["erm"]
seeds = [0]
measures = ["transfer"]
"""
ENTRIES = "return np.full(self.observation_space.shape, self.position / 10, np.float32)"


@pytest.mark.parametrize(
    ("spaces", "observed", "named"),
    [
        (FORCES, False, "has actions in Box(-2.0, 2.0, (1,), float32) with mass=2x, in"),
        (LONGER, True, "has 2 numbers in an observation with mass=2x, 3 with mass=3x"),
    ],
)
def test_settings_with_other_spaces_are_not_used_together(bench, spaces, observed, named):
    """Each alone has an expert; demonstrations and rewards would mix them."""
    bench.edit(bench.module, "self.drag = drag", f"self.drag = drag\n        {spaces}")
    if observed:
        bench.edit(bench.module, RETURNED, ENTRIES)
        bench.edit(
            bench.toml, 'argument = "mass_scale"', 'argument = "mass_scale"\nobserved = true'
        )
        bench.edit(bench.toml, "low = 0.1", "low = 1.0")
    assert bench.irl(*COLLECT, *ONE, "--name", "one").code == 0
    done = bench.irl(*COLLECT, "--intervention", "mass=2x,3x", "--name", "demos")
    error, hint = done.err.splitlines()[-2:]
    assert done.code == 2 and named in error and hint.startswith("hint: "), done.err
    expert = json.loads(bench.irl("lineage", "one", "--json").out)["inputs"][0]["from"]["id"]
    scored = bench.irl(
        "evaluate", "--policy", expert, "--episodes", "1", "--intervention", "mass=3x"
    )
    assert scored.code == 2 and ("actions in" in scored.err or "observation" in scored.err)
    both = ("--env", "cart.toml", "--intervention", "mass=2x,3x")
    bench.irl("export", "demos", "one", "--to", "parquet:one.parquet")
    table = pq.read_table("one.parquet")
    twice = pa.concat_tables([table, table])
    for name, values in (
        ("setting", ["mass=2x"] * len(table) + ["mass=3x"] * len(table)),
        ("episode", [*range(2 * len(table))]),
    ):
        place = twice.schema.get_field_index(name)
        twice = twice.set_column(place, name, pa.array(values))
    pq.write_table(twice, "both.parquet")
    recorded = bench.irl("import", "both.parquet", *both, "--setting-column", "setting")
    assert recorded.code == 2 and ("actions in" in recorded.err or "observation" in recorded.err)
    # Before the expert of 3x is trained.
    assert "3x" not in bench.irl("ls", "--stage", "train-expert").out
    Path("tables.toml").write_text(TABLE)
    kind = "numbers in an observation" if observed else "has actions in"
    for command in (["run"], ["run", "--dry-run"], ["plan"]):
        line = [*command, "cart", "--experiments", "tables.toml", "--profile", "smoke"]
        table = bench.irl(*line)
        assert table.code == 2 and kind in table.err and "with mass=1x" in table.err, table.err
    with pytest.raises(UsageError, match=kind):
        irlcli.Lab("runs", profile="smoke").plan("cart", experiments="tables.toml")
    assert "1x" not in bench.irl("ls", "--stage", "train-expert").out
    checked = bench.irl("envs", "check", "cart.toml")
    assert (
        checked.code == 1 and ("has actions in" if not observed else "numbers in an") in checked.out
    )


class Limited(gymnasium.Env):
    """Ends its episodes after three steps, as ``flags`` (terminated, truncated) say."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, flags, info):
        self.flags, self.info = flags, info

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        flags = self.flags if self.steps == 3 else (False, False)
        return np.zeros(1, np.float32), 0.0, *flags, self.info if self.steps == 3 else {}


@pytest.mark.parametrize(
    ("limit", "flags", "info", "refused"),
    [
        (4, (False, True), {}, True),
        (3, (False, True), {}, False),
        (4, (True, False), {}, False),
        (4, (True, True), {}, False),
        (4, (False, True), {"error": "it fell over"}, False),
    ],
)
def test_a_shorter_time_limit_than_the_descriptions_is_refused(limit, flags, info, refused):
    world, action = Adapted(Limited(flags, info), "limited", limit), np.zeros(1, np.float32)
    for _ in range(2):
        world.reset(seed=0)
        assert not any(any(world.step(action)[2:4]) for _ in range(2))
        with pytest.raises(UsageError) if refused else contextlib.nullcontext() as failed:
            assert any(world.step(action)[2:4])
        if refused:
            assert "after 3 of 4 steps" in failed.value.message
            assert "max_episode_steps = 3" in failed.value.hint


@pytest.mark.parametrize(("reward", "warned"), [(-100.0, True), (100.0, False)])
def test_demonstrations_that_fail_are_warned_of(bench, reward, warned):
    """One of them ends after five steps; whether that is a failure, its return says."""
    assert bench.irl(*COLLECT, *ONE, "--name", "demos").code == 0
    assert bench.irl("export", "demos", "demos", "--to", "parquet:own.parquet").code == 0
    table = pq.read_table("own.parquet")
    length = int(np.argmax(np.asarray(table["truncated"]) | np.asarray(table["terminated"]))) + 1
    ended = {
        "terminated": [False] * 4 + [True],
        "truncated": [False] * 5,
        "reward": [reward] * 5,
    }
    first = table.slice(0, 5)
    for name, values in ended.items():
        place = first.schema.get_field_index(name)
        first = first.set_column(place, first.schema.field(name), pa.array(values))
    pq.write_table(pa.concat_tables([first, table.slice(length)]), "other.parquet")
    done = bench.irl("import", "other.parquet", "--env", "cart.toml", *ONE, "--name", "own")
    assert done.code == 0, done.err
    done = bench.irl("train-airl", "--demos", "own", "--method", "erm", "--profile", "smoke")
    assert done.code == 0, done.err
    assert ("demonstrations in mass=2x end early and earn less" in done.err) == warned
    # Nobody knows whether imported actions were sampled.
    assert "demonstrations.deterministic" not in done.err


@pytest.mark.parametrize("sampled", [True, False])
def test_demonstrations_that_fail_are_compared_with_the_other_kind(bench, sampled):
    """A cart that derails by chance, which costs it all that it earned."""
    bench.edit(bench.module, "reward = 1.0 - abs(self.position)", DERAILED)
    bench.edit(bench.module, "abs(self.position) > 5.0", "derailed")
    demos = ("--set", "demonstrations.episodes=8", "--name", "demos")
    choice = () if sampled else ("--set", "demonstrations.deterministic=true")
    done = bench.irl(*COLLECT, *ONE, *demos, *choice)
    assert done.code == 0, done.err
    done = bench.irl("train-airl", "--demos", "demos", "--method", "erm", "--profile", "smoke")
    assert done.code == 0 and "of 8 demonstrations in mass=2x end early" in done.err, done.err
    other = "true" if sampled else "false"
    assert f"--set demonstrations.deterministic={other}" in done.err


def test_ends_that_look_like_falls_are_warned_of(bench):
    """With a shared absorbing state, demonstrations that end early look like falls."""
    bench.edit(bench.module, "reward = 1.0 - abs(self.position)", DERAILED)
    bench.edit(bench.module, "abs(self.position) > 5.0", "derailed")
    wanted = ("train-airl", "--method", "erm", "--profile", "smoke", "--demos", "demos")
    shared = ("--set", "airl.shaping=false", "--set", "airl.shared_absorbing=true")
    for whole, options, warned in (
        ("false", (), False),
        ("false", shared, True),
        ("true", shared, False),
    ):
        done = bench.irl(
            *(*COLLECT, *ONE, "--episodes", "8", "--name", "demos"),
            *("--set", f"demonstrations.full_length={whole}"),
        )
        assert done.code == 0, done.err
        done = bench.irl(*wanted, *options)
        assert done.code == 0, done.err
        assert (
            "8 demonstrations in mass=2x end early: with airl.shared_absorbing" in done.err
        ) == warned


def test_only_demonstrations_of_full_length(bench):
    """Those that end early are left out, and others are recorded in their place."""
    bench.edit(bench.module, "reward = 1.0 - abs(self.position)", DERAILED.replace("0.02", "0.03"))
    bench.edit(bench.module, "abs(self.position) > 5.0", "derailed")
    wanted = (*COLLECT, *ONE, "--episodes", "8", "--json")

    def recorded(*more):
        done = bench.irl(*wanted, *more)
        assert done.code == 0, done.err
        path = json.loads(done.out)["path"]
        found = re.search(r"only (\d+) of (\d+) episodes of the expert in mass=2x", done.err)
        return pq.read_table(f"{path}/episodes.parquet").to_pandas(), found

    every, _ = recorded()
    whole, kept_of = recorded("--set", "demonstrations.full_length=true")
    # 50 steps pass without derailing in 22 % of cases.
    last, tried = map(int, kept_of.groups())
    assert 8 <= last < tried / 2 and tried % 8 == 0
    assert 0 < every["terminated"].sum() < 8
    assert len(whole) == 8 and set(whole["length"]) == {50} and whole["seed"].is_unique
    kept = every[every["length"] == 50]
    assert whole["seed"][: len(kept)].tolist() == kept["seed"].tolist()


def test_an_expert_whose_episodes_all_end_early_has_none_of_full_length(irl, tmp_path):
    line = ["collect-experts", "--env", "lunar-lander", "--intervention", "bounce=0.1"]
    line += ["--profile", "smoke", "--set", "demonstrations.full_length=true"]
    done = irl(*line, "--store", tmp_path / "runs")
    assert done.code == 1 and "0 of 40 episodes" in done.err and "full_length" in done.err, done.err
    # Progress says that the first of the forty found none, too.
    assert "0/2 episodes  bounce=0.1 full length in 0 of 2" in done.err


def test_actions_in_other_units_and_a_time_limit_written_as_an_end_are_warned_of(bench):
    made = bench.irl(*COLLECT, *ONE, "--name", "demos")
    assert made.code == 0, made.err
    assert bench.irl("export", "demos", "demos", "--to", "parquet:own.parquet").code == 0
    table = pq.read_table("own.parquet")
    plain = bench.irl("import", "own.parquet", "--env", "cart.toml", *ONE)
    assert plain.code == 0 and "warning" not in plain.err
    actions = [[1000.0 * a for a in row] for row in table["action"].to_pylist()]
    ends = pa.array(np.asarray(table["terminated"]) | np.asarray(table["truncated"]))
    for name, column in (("action", pa.array(actions)), ("terminated", ends)):
        table = table.set_column(table.schema.get_field_index(name), name, column)
    pq.write_table(table, "other.parquet")
    done = bench.irl("import", "other.parquet", "--env", "cart.toml", *ONE)
    assert done.code == 0, done.err
    far = sum(abs(row[0]) > 10.0 for row in actions)
    assert far and f"as far out as their bounds: {far} of {len(table)} steps" in done.err
    limited = int(np.asarray(table["truncated"]).sum())
    assert limited and f"{limited} of {limited} episodes are terminated in the last" in done.err


def test_a_mistake_in_the_environments_code_is_named_by_its_line(bench):
    bench.edit(bench.module, "reward = 1.0", "reward = self.prize")
    line = next(
        i for i, text in enumerate(bench.module.read_text().splitlines(), 1) if "prize" in text
    )
    done = bench.irl(*RANDOM, *ONE)
    assert done.code == 1 and f"cart.py, line {line})" in done.err, done.err


def test_a_module_that_cannot_be_imported_is_not_blamed_on_a_knob(bench):
    bench.module.write_text(bench.module.read_text() + '\nraise RuntimeError("module")\n')
    done = bench.irl(*RANDOM, *ONE)
    assert done.code == 2 and "cart cannot be imported: RuntimeError: module" in done.err, done.err
    assert "cart.py, line " in done.err and "mass_scale" not in done.err


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (
            "self._observation(), reward, abs(self.position) > 5.0, {}",
            "returned 4 values, not (obs",
        ),
        ("None", "returned NoneType, not (obs"),
        ('self._observation(), "much", False, False, {}', "the reward 'much': it must be a number"),
    ],
)
def test_a_step_that_returns_something_else(bench, returned, said):
    old = "self._observation(), reward, abs(self.position) > 5.0, False, {}"
    bench.edit(bench.module, old, returned)
    done = bench.irl(*RANDOM, *ONE)
    assert done.code == 1 and said in done.err, done.err


def test_every_form_of_a_knob_is_made_at_its_bounds(bench):
    """The cart's constructor takes a number; a range gives it two."""
    forms = 'argument = "drag"\nforms = ["absolute"'
    bench.edit(bench.toml, forms, forms + ', "range"')
    done = bench.irl("envs", "check", "cart.toml")
    assert done.code == 1 and "FAIL  drag: its bounds can be made" in done.out, done.out
