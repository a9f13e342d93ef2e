"""The robots through the real command line: workers, progress, goals, pictures, bad input."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.tensors import load_policy_file
from irlcli.store import Store


@pytest.fixture(scope="module")
def chains(tmp_path_factory, run_irl):
    """The Reacher's chain with one worker and with two, by the command line: two stores."""
    base = tmp_path_factory.mktemp("robots")
    for workers in ("1", "2"):
        common = ["--store", str(base / workers), "--profile", "smoke", "--quiet"]
        common += ["--workers", workers, "--name"]
        for arguments in (
            ["collect-experts", "--env", "reacher", "--intervention", "gravity", *common, "demos"],
            ["train-airl", "--demos", "demos", "--method", "irm", *common, "airl"],
            ["transfer", "--reward", "airl", "--ood", "gravity", *common, "moved"],
            ["evaluate", "--policy", "moved", *common, "score"],
        ):
            done = run_irl(arguments)
            assert done.code == 0, done.err
    return base


def test_the_number_of_workers_changes_no_byte(chains):
    one, two = Store(chains / "1"), Store(chains / "2")
    assert one.names() == two.names()
    assert one.ids() == two.ids() and len(one.ids()) == 6
    assert not two.verify(two.ids()).damaged
    assert {a.provenance()["workers"] for a in two.artefacts()} == {2}


def test_progress_stands_beside_the_return(chains, irl):
    done = irl("report", "returns", "score", "--store", chains / "1")
    assert done.code == 0 and "progress" in done.out.splitlines()[0]
    assert "reacher gravity=4x" in done.out


def test_a_robots_reward_is_assessed(chains, irl, tmp_path):
    store = tmp_path / "runs"
    shutil.copytree(chains / "1", store, symlinks=True)
    common = ["--store", store, "--profile", "smoke", "--quiet"]
    done = irl("assess", "airl", "--ood", "gravity", *common, "--json")
    assert done.code == 0, done.err
    assessment = json.loads(done.out)["assessment"]
    bank = assessment["bank"]
    kinds = {"idle", "random", "clone", "student", "reused", "retrained"}
    assert {e["kind"] for e in bank} == kinds and len(bank) == 11
    assert all(e["progress"] is not None for e in bank)
    # The Reacher's true reward is a function of what is observed.
    assert 0.0 < assessment["settings"][0]["epic"] < 1.0 and assessment["epic_missing"] == ""


@pytest.mark.parametrize(
    ("env", "intervention", "ood"),
    [("ant", "leg-length=1x,2x", "3x"), ("half-cheetah", "goal-y", "goal-y")],
)
def test_walkers_go_through_the_chain(tmp_path, irl, env, intervention, ood):
    common = ["--store", tmp_path, "--profile", "smoke", "--quiet", "--name"]
    for section in ("expert", "airl", "transfer"):
        common[:0] = ["--set", f"{section}.ppo.n_steps=64", "--set", f"{section}.total_steps=256"]
    for arguments in (
        ["collect-experts", "--env", env, "--intervention", intervention, *common, "demos"],
        ["train-airl", "--demos", "demos", "--method", "erm", *common, "airl"],
        ["transfer", "--reward", "airl", "--ood", ood, *common, "moved"],
    ):
        done = irl(*arguments)
        assert done.code == 0, done.err
    done = irl("transfer", "--reward", "airl", "--ood", "mass=2x", *common, "other")
    if env == "ant":
        assert done.code == 0, done.err
    else:
        refused = [done]
        refused.append(irl("evaluate", "--policy", "moved", "--ood", "mass=2x", *common[:-1]))
        refused.append(
            irl("play", "moved", "--ood", "mass=2x", "--store", tmp_path, "--out", "x.gif")
        )
        for done in refused:
            assert done.code == 2
            assert "half-cheetah mass=2x" in done.err and "different observations" in done.err
            assert "hint: name a setting of goal-y or direction" in done.err
            assert "RUN" not in done.err
        # An expert with a goal and the cue's hints have observations of one size.
        line = ["collect-experts", "--env", env, *common[:-1], "--dry-run", "--intervention"]
        plain = irl(*line, "goal-y=0", "--expert", "goal-y=0=moved")
        assert plain.code == 0, plain.err
        for setting in ("mass=2x", "cue-strength=0.8"):
            done = irl(*line, setting, "--expert", f"{setting}=moved")
            assert done.code == 2 and "different observations" in done.err


def test_a_cloned_student_keeps_the_moments_of_the_demonstrations(chains, irl, tmp_path):
    store = tmp_path / "runs"
    shutil.copytree(chains / "1", store, symlinks=True)
    line = ["train-airl", "--demos", "demos", "--method", "erm", "--set", "airl.bc_epochs=1"]
    done = irl(*line, "--store", store, "--profile", "smoke", "--quiet")
    assert done.code == 0, done.err
    policy, _ = load_policy_file(Path(done.out.strip()) / "policy.pt")
    counts = [v for name, v in policy.state_dict().items() if name.endswith("normaliser.count")]
    demos = read_demonstrations(Store(store).resolve("demos").artefact.directory)
    steps = sum(len(t) for episodes in demos.trajectories.values() for t in episodes)
    assert counts and {float(count) for count in counts} == {float(steps)}


@pytest.mark.parametrize(("value", "same"), [("true", False), ("false", True)])
def test_an_evaluation_acts_as_it_is_asked_to(chains, irl, tmp_path, value, same):
    """With ``deterministic`` by the policy's mean; otherwise, and by default, by samples."""
    store = tmp_path / "runs"
    shutil.copytree(chains / "1", store, symlinks=True)
    line = ["evaluate", "--policy", "moved", "--store", store, "--profile", "smoke", "--quiet"]
    found = []
    for more in ([], ["--set", f"evaluation.deterministic={value}"]):
        done = irl(*line, *more)
        assert done.code == 0, done.err
        found.append((Path(done.out.split()[0]) / "summary.json").read_text())
    assert (found[0] == found[1]) == same


def test_a_reward_learned_with_symmetries(tmp_path, irl):
    """Only the discriminator's samples change: the Ant's four turns with a goal, none with its legs too."""
    small = [f"{section}.ppo.n_steps=64" for section in ("expert", "airl")]
    small += [f"{section}.total_steps=256" for section in ("expert", "airl")]
    common = ["--store", tmp_path, "--profile", "smoke", "--quiet"]
    common += [word for item in small for word in ("--set", item)]
    parts = ["--set", "airl.logit=f", "--set", "airl.symmetries=true"]
    train = ["train-airl", "--demos", "demos", "--method", "erm"]
    goal = ["collect-experts", "--env", "ant", "--intervention", "goal-y", "--name", "demos"]
    done = irl(*goal, *common)
    # Rounds of 128 steps, episodes of 1000.
    assert done.code == 0 and "no episode ended in the first round" in done.err
    for words in ([], parts[:2], parts):
        done = irl(*train, *common, *words)
        assert done.code == 0, done.err
    rewards = [a for a in Store(tmp_path).artefacts() if a.manifest.record.stage == "train-airl"]
    assert len(rewards) == 3
    assert len({(a.directory / "reward.pt").read_bytes() for a in rewards}) == 3
    done = irl(*train, *common, *parts[2:])
    assert done.code == 2 and "airl.symmetries needs airl.logit = f" in done.err
    both = ["--setting", "goal-y=0,leg-length=2x", "--setting", "goal-y=-900,leg-length=2x"]
    done = irl("collect-experts", "--env", "ant", *both, *common, "--name", "demos")
    assert done.code == 0, done.err
    done = irl(*train, *common, *parts)
    assert (
        done.code == 2 and "no symmetry of ant holds in all of goal-y=0,leg-length=2x" in done.err
    )


def test_play_draws_the_settings_side_by_side(chains, irl, tmp_path):
    file = tmp_path / "moved.gif"
    arguments = ["play", "moved", "--store", chains / "1", "--ood", "2x,0.5x", "--steps", "12"]
    done = irl(*arguments, "--out", file)
    assert done.code == 0, done.err
    assert done.out == f"{file}\n"
    with Image.open(file) as gif:
        assert gif.n_frames == 5 and gif.width == 3 * 320
        gif.seek(4)
        picture = np.array(gif.convert("RGB")).astype(int)
    left, middle = picture[16:, :320], picture[16:, 320:640]
    assert left.std() > 1.0
    assert (left != middle).any()
    assert (picture[:16, :320] != picture[:16, 320:640]).any()


def test_play_refuses_a_damaged_policy(chains, irl, tmp_path):
    store = tmp_path / "runs"
    shutil.copytree(chains / "1", store, symlinks=True)
    path = Store(store).resolve("moved").artefact.directory / "policy.pt"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    done = irl("play", "moved", "--store", store, "--out", tmp_path / "x.gif")
    assert done.code == 4 and "hint:" in done.err
    assert not (tmp_path / "x.gif").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["play", "moved", "--out", "x.avi"], ".gif"),
        (["play", "moved", "--out", "no/x.gif"], "no/x.gif cannot be written"),
        (["play", "moved", "--ood", "mass=2x", "--out", "x.gif"], "no intervention 'mass'"),
        (["play", "score", "--out", "x.gif"], "holds no policy.pt"),
        (
            ["train-airl", "--demos", "demos", "--set", "airl.ppo.use_sde=true"],
            "gSDE's noise lasts several steps",
        ),
        (
            ["collect-experts", "--env", "ant", "--setting", "mass=2x", "--setting", "goal-y=900"],
            "different observations",
        ),
        (
            [
                *("train-airl", "--demos", "demos", "--set", "airl.symmetries=true"),
                *("--profile", "smoke"),
            ],
            "airl.symmetries: reacher has no symmetries",
        ),
        (
            [
                *("collect-experts", "--env", "lunar-lander", "--intervention", "bounce=0.1"),
                *("--profile", "smoke", "--set", "expert.ppo.use_sde=true"),
            ],
            "ppo.use_sde needs continuous actions",
        ),
        (["evaluate", "--idle", "--env", "reacher", "--ood", "gravity=21x"], "between 0x and 20x"),
        (["evaluate", "--idle", "--env", "ant", "--ood", "friction=1"], "as triple"),
        (
            ["evaluate", "--idle", "--env", "ant", "--ood", "gravity=2x"],
            "'gravity' belongs to mujoco-ant",
        ),
        (["evaluate", "--idle", "--env", "reacher", "--ood", "gravity", "--workers", "0"], "0"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(chains, irl, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    done = irl(*arguments, "--store", chains / "1")
    assert done.code in (2, 3) and done.out == ""
    assert said in done.err and "hint:" in done.err and "Traceback" not in done.err
