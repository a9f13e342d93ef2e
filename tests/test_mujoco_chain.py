"""The MuJoCo robots through the real command line: the chain, bad input, a missing library."""

import json
import sys

import pytest
import torch

from irlcli.data.tensors import load_reward_file
from irlcli.envs.mujoco.spec import MUJOCO_ROBOTS
from irlcli.learners.reward_model import absorbed
from irlcli.store import Store

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install '.[mujoco]'")

HOPPER = "mujoco-hopper"
SMALL = [
    part
    for section in ("expert", "airl", "transfer")
    for field in ("ppo.n_steps=64", "total_steps=256")
    for part in ("--set", f"{section}.{field}")
]


@pytest.fixture(scope="module")
def chain(tmp_path_factory, run_irl):
    """The Hopper's chain, by the command line: a store."""
    store = tmp_path_factory.mktemp("mujoco") / "runs"
    common = ["--store", str(store), "--profile", "smoke", "--quiet", "--name"]
    for arguments in (
        ["collect-experts", "--env", HOPPER, "--intervention", "mass", *SMALL, *common, "demos"],
        ["train-airl", "--demos", "demos", "--method", "irm", *SMALL, *common, "airl"],
        ["transfer", "--reward", "airl", "--ood", "mass", *SMALL, *common, "moved"],
        ["evaluate", "--policy", "moved", *common, "score"],
    ):
        done = run_irl(arguments)
        assert done.code == 0, done.err
    return store


def test_the_chain_runs_and_reports_progress(chain, irl):
    done = irl("report", "returns", "score", "--store", chain)
    assert done.code == 0 and "progress" in done.out.splitlines()[0]
    assert "mujoco-hopper mass=1.5x" in done.out
    library = Store(chain).resolve("score").artefact.provenance()["libraries"]["mujoco"]
    assert library is not None


def test_a_reward_may_share_one_absorbing_state(chain, irl):
    common = ["--store", chain, "--profile", "smoke", "--quiet"]
    shared = ["--set", "airl.shared_absorbing=true"]
    train = ["train-airl", "--demos", "demos", "--method", "irm", *SMALL, *common, *shared]
    done = irl(*train, "--name", "shared")
    assert done.code == 0, done.err
    done = irl(
        "transfer", "--reward", "shared", "--ood", "mass", *SMALL, *common, "--name", "on-shared"
    )
    assert done.code == 0, done.err
    assert "with a shared absorbing state" in irl("lineage", "on-shared", "--store", chain).out
    model, description = load_reward_file(
        Store(chain).resolve("shared").artefact.directory / "reward.pt"
    )
    finals = torch.randn(10, description.network.observation_size)
    rewards = absorbed(model, finals)
    # Rows of a batch are rounded differently.
    assert torch.allclose(rewards, rewards[0], atol=1e-6)
    done = irl(*train, "--set", "airl.shaping=true")
    assert done.code == 2 and "airl.shared_absorbing needs airl.shaping = false" in done.err


def random_returns(irl, store, env: str, setting: str) -> dict:
    common = ["--profile", "smoke", "--store", store, "--json", "--quiet"]
    done = irl("evaluate", "--random", "--env", env, "--setting", setting, *common)
    assert done.code == 0, done.err
    return json.loads(done.out)


def test_whether_a_fall_ends_an_episode_is_a_setting(chain, irl):
    lengths = {}
    for value in (0, 1):
        found = random_returns(irl, chain, HOPPER, f"mass=2x,terminate-when-unhealthy={value}")
        summary = json.loads((chain / found["id"] / "summary.json").read_text())
        lengths[value] = summary["settings"][0]["mean_length"]
    assert lengths[1] < 200 and lengths[0] == 1000


def test_training_goes_on_when_a_simulation_becomes_unstable(tmp_path, irl, monkeypatch):
    monkeypatch.chdir(tmp_path)
    setting = "actuator-strength=10x,mass=0.1x"
    done = irl(
        *("collect-experts", "--env", "mujoco-half-cheetah", "--setting", setting, *SMALL),
        *("--profile", "smoke", "--store", "runs"),
    )
    assert done.code == 0, done.err
    assert f"warning: {setting}, world 0, round 0: the simulation is unstable" in done.err
    assert "the episode ended there and training continues" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("mass=0x", "mass=0x' is out of range"),
        ("mass=-1x", "between 0.1x and 10x"),
        ("mass=2", "takes mass as multiplier"),
        ("leg-length=4x", "between 0.2x and 3x"),
        ("terminate-when-unhealthy=0.5", "is not a whole number"),
        ("bounce=1", "no intervention 'bounce'"),
    ],
)
def test_impossible_bodies_are_refused(tmp_path, irl, setting, said):
    done = irl("evaluate", "--idle", "--env", HOPPER, "--ood", setting, "--store", tmp_path)
    assert done.code == 2 and done.out == "" and "hint:" in done.err
    assert said.replace("mass=0x'", "mass='0x'") in done.err


@pytest.mark.parametrize("robot", [spec.name for spec in MUJOCO_ROBOTS])
def test_a_missing_library_is_one_line_with_the_command_that_installs_it(
    tmp_path, irl, monkeypatch, robot
):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    arguments = ["--env", robot, "--intervention", "mass=1x", "--store", tmp_path]
    planned = irl("collect-experts", *arguments, "--dry-run")
    assert planned.code == 0 and "RUN" in planned.out
    done = irl("collect-experts", *arguments, "--profile", "smoke")
    assert done.code == 1 and done.out == ""
    error, hint = done.err.splitlines()[-2:]
    assert error.endswith(f": {robot} needs MuJoCo, which is not installed")
    assert hint == "hint: in irlcli's checkout: pip install '.[mujoco]'"


def test_a_broken_library_is_one_line_too(tmp_path, irl, monkeypatch):
    """MuJoCo reads MUJOCO_GL when it is imported, and raises what OpenGL's bindings raise."""

    def broken(name):
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setattr("irlcli.envs.registration.import_module", broken)
    done = irl("evaluate", "--idle", "--env", HOPPER, "--ood", "mass=1x", "--store", tmp_path)
    assert done.code == 1 and "which cannot be imported: 'NoneType' object" in done.err
    assert "Traceback" not in done.err


def test_pybullet_robots_say_what_works_without_pybullet(tmp_path, irl, monkeypatch):
    monkeypatch.setitem(sys.modules, "irlcli.envs.bullet.engine", None)
    done = irl("evaluate", "--idle", "--env", "reacher", "--ood", "gravity=2x", "--store", tmp_path)
    assert done.code == 1 and done.out == ""
    assert "reacher needs PyBullet, which is not installed" in done.err
    assert "hint: use Python 3.11" in done.err and "--env mujoco-ant" in done.err
