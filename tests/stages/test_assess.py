"""``irl assess`` on LunarLander, through the real command line."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import torch

from irlcli.cli.assess import print_assessment
from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.descriptions import (
    Agreement,
    Assessed,
    Assessment,
    BankEntry,
    Measured,
    RewardOrigin,
)
from irlcli.data.tensors import load_policy_file, load_reward_file
from irlcli.store import Store

SMOKE = ["--profile", "smoke", "--quiet"]
LADDER = [f"clone, noise {noise}" for noise in (0.0, 0.1, 0.25, 0.5, 0.75)]


@pytest.fixture(scope="module")
def assessed(smoke_store, copied, tmp_path_factory, run_irl):
    """A copy of the smoke store with an assessment in the settings trained in, and the document."""
    path = copied(smoke_store.path, tmp_path_factory.mktemp("assess") / "runs")
    line = ["assess", "airl", "--store", str(path), *SMOKE, "--json", "--name", "assessed"]
    done = run_irl(line)
    assert done.code == 0, done.err
    return path, json.loads(done.out)


def policies(document, setting):
    return [e["policy"] for e in document["assessment"]["bank"] if e["setting"] == setting]


def test_the_bank_in_distribution(assessed):
    _, document = assessed
    assert [s["setting"] for s in document["assessment"]["settings"]] == [
        "engine-power=1x",
        "engine-power=1.25x",
    ]
    found = policies(document, "engine-power=1x")
    experts = ["expert of engine-power=1.25x", "expert of engine-power=1x"]
    assert found == ["idle", "random", *LADDER, "student", *experts]
    kinds = {
        e["policy"]: e["kind"]
        for e in document["assessment"]["bank"]
        if e["setting"] == "engine-power=1x"
    }
    assert [kinds[name] for name in experts] == ["reused", "expert"]


def test_its_numbers_are_those_of_evaluations(assessed, irl):
    """The same episodes: starts, actions, true and learned returns."""
    path, document = assessed
    bank = {(e["policy"], e["setting"]): e for e in document["assessment"]["bank"]}
    for policy, agent in (("student", ["--policy", "airl"]), ("idle", ["--idle"])):
        line = ["evaluate", *agent, "--reward", "airl", "--intervention", "engine-power=1.25x"]
        done = irl(*line, "--store", path, *SMOKE, "--json")
        (row,) = json.loads(done.out)["returns"]
        entry = bank[policy, "engine-power=1.25x"]
        assert entry["true"]["mean"] == pytest.approx(row["mean"])
        assert entry["learned"]["mean"] == pytest.approx(row["mean_learned_return"])


@pytest.mark.parametrize("dry", [False, True])
def test_a_damaged_reward_is_refused_before_the_bank_acts(irl, store_copy, dry):
    path = store_copy.path / store_copy.airl / "reward.pt"
    path.chmod(0o644)
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    before = set(store_copy.path.iterdir())
    done = irl("assess", "airl", "--store", store_copy.path, *SMOKE, *["--dry-run"][:dry])
    assert done.code == 4 and store_copy.airl in done.err
    now = set(store_copy.path.iterdir())
    assert now == (before if dry else before - {path.parent})


def test_epic_is_not_available_and_the_output_says_why(assessed, irl):
    path, document = assessed
    assessment = document["assessment"]
    assert all(s["epic"] is None for s in assessment["settings"])
    assert "the hull touches the ground" in assessment["epic_missing"]
    shown = irl("assess", "airl", "--store", path, *SMOKE).err
    assert f"no EPIC distance: {assessment['epic_missing']}" in shown


def test_what_it_prints(assessed, irl):
    """A lander makes no progress, and nothing was retrained in the settings trained in."""
    path, _ = assessed
    shown = irl("assess", "airl", "--store", path, *SMOKE).err
    header = next(line for line in shown.splitlines() if line.startswith("setting"))
    assert "true return" in header and "progress" not in header
    again = f"irl transfer --reward airl --setting engine-power=1x {' '.join(SMOKE[:2])}"
    assert f"`{again} --store {path}`" in shown


def test_progress_is_printed_where_a_robot_makes_some(capsys):
    entry = {"kind": "idle", "true": Measured(mean=1.0, error=None)}
    entry["learned"] = entry["true"]
    bank = tuple(
        BankEntry(policy=name, setting="mass=4x", progress=progress, **entry)
        for name, progress in (("idle", None), ("expert", 43.25))
    )
    one = Agreement(policies=2, spearman=None, pearson=None)
    ranked = Assessed(setting="mass=4x", overall=one, lower_half=one)
    reward = RewardOrigin(method="erm", seed=0, settings=("mass=2x",))
    print_assessment(
        Assessment(env="ant", reward=reward, settings=(ranked,), pooled=None, bank=bank)
    )
    header, *lines = capsys.readouterr().err.splitlines()
    at = header.index("progress")
    assert {line.split()[1]: line[at:].split()[0] for line in lines[:2]} == {
        "idle": "-",
        "expert": "43.2",
    }


def test_each_artefact_is_announced_once(assessed, irl):
    path, _ = assessed
    done = irl("assess", "airl", "--store", path, "--profile", "smoke")
    announced = [line for line in done.err.splitlines() if line.startswith("HIT")]
    assert announced and len(set(announced)) == len(announced)
    assert sum(line.startswith("HIT clone") for line in announced) == 1


def test_its_files(assessed):
    path, document = assessed
    artefact = Store(path).resolve("assessed").artefact
    names = {o.path for o in artefact.manifest.outputs}
    assert names == {"assessment.json", "bank.parquet", "scatter.png", "scatter.svg"}
    rows = pd.read_parquet(artefact.directory / "bank.parquet")
    means = rows.groupby(["policy", "setting"])[["true_return", "learned_return"]].mean()
    for e in document["assessment"]["bank"]:
        mean = means.loc[e["policy"], e["setting"]]
        assert mean["true_return"] == pytest.approx(e["true"]["mean"])
        assert mean["learned_return"] == pytest.approx(e["learned"]["mean"])


def test_a_second_call_computes_nothing(assessed, irl):
    path, document = assessed
    before = Store(path).ids()
    plan = irl("assess", "airl", "--store", path, *SMOKE, "--dry-run").out.splitlines()
    assert {line.split()[0] for line in plan} == {"HIT"}
    again = irl("assess", "airl", "--store", path, *SMOKE, "--json")
    assert json.loads(again.out)["id"] == document["id"] and Store(path).ids() == before


def test_another_reward_of_the_same_demonstrations_shares_the_bank(assessed, irl):
    """Only its student has to act."""
    path, _ = assessed
    made = irl("train-airl", "--demos", "demos", "--method", "erm", "--store", path, *SMOKE)
    plan = irl("assess", made.out.strip(), "--store", path, *SMOKE, "--dry-run").out
    missing = [line.split(": ")[0] for line in plan.splitlines() if not line.startswith("HIT")]
    assert [line.split()[1:3] for line in missing] == [
        ["record", "student"],
        ["record", "student"],
        ["assess", "lunar-lander"],
    ]


def test_a_policy_retrained_on_the_reward_is_judged_where_the_expert_is_known(assessed, irl):
    path, _ = assessed
    line = ["assess", "airl", "--ood", "1.5x", "--store", path, *SMOKE]
    done = irl(*line, "--json")
    retrained = f"retrained {Store(path).resolve('moved').artefact.id[:8]}"
    assert retrained in policies(json.loads(done.out), "engine-power=1.5x")
    assert done.err.startswith("warning: no expert of engine-power=1.5x with this config")
    (place,) = json.loads(done.out)["assessment"]["settings"]
    assert place["retrained"] == [] and place["expert_minus_idle"] is None
    expert = ["--expert", "--env", "lunar-lander", "--intervention", "engine-power=1.5x"]
    assert irl("evaluate", *expert, "--store", path, *SMOKE).code == 0
    done = irl(*line, "--json")
    assert done.err == ""
    (place,) = json.loads(done.out)["assessment"]["settings"]
    (split,) = place["retrained"]
    assert split["policy"] == retrained
    means = {e["policy"]: e for e in json.loads(done.out)["assessment"]["bank"]}
    best, earned = means["expert of engine-power=1.5x"], means[retrained]
    regret = best["true"]["mean"] - earned["true"]["mean"]
    gap = best["learned"]["mean"] - earned["learned"]["mean"]
    assert split["true_regret"]["mean"] == pytest.approx(regret)
    assert split["learned_gap"]["mean"] == pytest.approx(gap)
    shown = irl(*line)
    weak = best["true"]["mean"] <= means["random"]["true"]["mean"]
    assert (split["verdict"] is None) == weak
    assert (weak or split["verdict"] in shown.err) and "Spearman" in shown.err
    assert ("there is no verdict" in shown.err) == weak


def test_expert_minus_idle_counts_absorbing_steps(assessed):
    """The learned return of an episode that ends early goes on to the horizon of 1000 steps."""
    _, document = assessed
    bank = {(e["policy"], e["setting"]): e["learned"] for e in document["assessment"]["bank"]}
    for place in document["assessment"]["settings"]:
        setting = place["setting"]
        gap = bank[f"expert of {setting}", setting]["mean"] - bank["idle", setting]["mean"]
        assert place["expert_minus_idle"]["mean"] == pytest.approx(gap / 1000)


def test_a_policy_trained_under_a_ceiling_is_judged_under_it(assessed, irl):
    """The learned gap, once more from the recorded steps."""
    path, _ = assessed
    here = ["--intervention", "engine-power=1x", "--store", path, *SMOKE]
    done = irl("transfer", "--reward", "airl", "--set", "transfer.ceiling=0.3", *here)
    assert done.code == 0, done.err
    done = irl("assess", "airl", *here, "--json")
    (split,) = json.loads(done.out)["assessment"]["settings"][0]["retrained"]
    artefact = Store(path).resolve(json.loads(done.out)["id"]).artefact
    model, origin = load_reward_file(Store(path).resolve("airl").artefact.directory / "reward.pt")
    level = origin.quantiles[30]

    def learned(policy, of):
        sha = artefact.manifest.record.inputs[f"engine-power=1x {policy}"]
        recorded = read_demonstrations(Store(path).index().holders(sha)[0].directory)
        return np.mean([of(t) for t in recorded.trajectories["engine-power=1x"]])

    def bounded(t):
        with torch.no_grad():
            states, actions = torch.as_tensor(t.observations), torch.as_tensor(t.actions)
            steps = model.reward(states[:-1], model.encode(actions)).clamp(max=level).sum()
            final, _ = model.absorbing_reward(states[-1:])
        rest = (1000 - len(t)) * t.terminated * final.clamp(max=level)
        return float(steps + rest) / origin.scale

    def discounted(t):
        """The absorbing state's series g + gamma g + ... begins a step after the last one."""
        with torch.no_grad():
            states, actions = torch.as_tensor(t.observations), torch.as_tensor(t.actions)
            steps = model.reward(states[:-1], model.encode(actions)).clamp(max=level)
            final, _ = model.absorbing_reward(states[-1:])
        series = gamma ** len(t) / (1 - gamma) * t.terminated * final.clamp(max=level)
        return float(gamma ** torch.arange(len(t)) @ steps + series) / origin.scale

    # Here the expert earns more than the random agent, so there is a verdict.
    assert split["verdict"] in irl("assess", "airl", *here).err
    (policy,) = (a for a in Store(path).artefacts() if a.id[:8] == split["policy"].split()[1])
    gamma = policy.manifest.record.parameters["transfer"]["ppo"]["gamma"]
    assert split["ceiling"] == 0.3
    for name, of in (("learned_gap", bounded), ("discounted_gap", discounted)):
        gap = learned("expert of engine-power=1x", of) - learned(split["policy"], of)
        assert split[name]["mean"] == pytest.approx(gap, rel=1e-4, abs=1e-3), name


def test_the_clone_imitates(assessed):
    """It tells the demonstrated action better than always naming the most frequent one would."""
    path, _ = assessed
    store = Store(path)
    (made,) = (a for a in store.artefacts() if a.manifest.record.stage == "clone")
    policy, description = load_policy_file(made.directory / "policy.pt")
    assert description.agent == "clone"
    demos = read_demonstrations(store.resolve("demos").artefact.directory)
    episodes = [t for group in demos.trajectories.values() for t in group]
    states = np.concatenate([t.observations[:-1] for t in episodes])
    actions = np.concatenate([t.actions for t in episodes])
    chosen = policy.act(states, deterministic=True)
    common = np.bincount(actions).max() / len(actions)
    assert (chosen == actions).mean() > common


def test_the_clone_can_be_evaluated_like_any_policy(assessed, irl):
    path, document = assessed
    (made,) = (a for a in Store(path).artefacts() if a.manifest.record.stage == "clone")
    line = ["evaluate", "--policy", made.id, "--intervention", "engine-power=1x"]
    done = irl(*line, "--store", path, *SMOKE, "--json")
    (row,) = json.loads(done.out)["returns"]
    entries = document["assessment"]["bank"]
    (entry,) = (e for e in entries if (e["policy"], e["setting"]) == (LADDER[0], "engine-power=1x"))
    assert row["agent"] == "clone" and row["mean"] == pytest.approx(entry["true"]["mean"])
    assert (
        "evaluate clone of engine-power=1x" in irl(*line, "--store", path, *SMOKE, "--dry-run").out
    )


def test_a_reward_without_its_store_has_noisy_clones_only_with_demos(smoke_store, irl, tmp_path):
    shutil.copy(smoke_store.path / smoke_store.airl / "reward.pt", tmp_path)
    store = tmp_path / "runs"
    line = ["assess", tmp_path / "reward.pt", "--intervention", "engine-power=1x", *SMOKE]
    alone = irl(*line, "--store", store, "--dry-run")
    assert "no noisy clones" in alone.err and "--demos" in alone.err
    assert "clone" not in alone.out and "record idle" in alone.out
    demos = smoke_store.path / smoke_store.demos
    given = irl(*line, "--store", store, "--demos", demos, "--dry-run")
    assert "no noisy clones" not in given.err and given.out.count("BLOCKED record clone") == 5


def test_an_expert_of_another_store_is_used(smoke_store, irl, tmp_path):
    shutil.copy(smoke_store.path / smoke_store.airl / "reward.pt", tmp_path)
    line = ["assess", tmp_path / "reward.pt", "--intervention", "engine-power=1x", *SMOKE]
    line += ["--store", tmp_path / "runs", "--dry-run"]
    assert "no expert of engine-power=1x" in irl(*line).err
    found = irl(*line, "--from", smoke_store.path)
    assert "no expert" not in found.err
    assert "FOUND   train-expert lunar-lander engine-power=1x seed 0" in found.out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["demos"], 2, "holds no reward.pt"),
        (["moved"], 2, "holds no reward.pt"),
        (["airl/policy.pt"], 2, "not a reward"),
        (["airl", "--ood", "leg-length=2x"], 2, "'leg-length'"),
        (["airl", "--ood", "1.5x", "--intervention", "bounce"], 2, "both name settings"),
        (["airl", "--demos", "airl"], 2, "not a dataset of demonstrations"),
        (["airl", "--set", "assessment.noise=[2]"], 2, "assessment.noise"),
        (["nothing"], 3, "'nothing' names no artefact"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(smoke_store, irl, words, code, said):
    done = irl("assess", *words, "--store", smoke_store.path, *SMOKE)
    assert done.code == code, done.err
    assert said in done.err and "hint:" in done.err and "Traceback" not in done.err
    assert done.out == "" and "RUN" not in done.err


def test_tabular_rewards_are_refused(irl, tmp_path):
    common = ["--store", tmp_path, *SMOKE]
    irl(
        "collect-experts",
        "--env",
        "gridworld",
        "--intervention",
        "path-group",
        *common,
        "--name",
        "d",
    )
    irl("train-maxent", "--demos", "d", "--method", "erm", *common, "--name", "maxent")
    done = irl("assess", "maxent", *common)
    assert done.code == 2 and "MaxEnt IRL" in done.err and "hint:" in done.err


def test_demonstrations_with_other_observations_are_refused_before_the_clone(irl, store_copy):
    common = ["--store", store_copy.path, *SMOKE]
    cue = ["--env", "lunar-lander", "--intervention", "cue-strength=0.9,0.8", "--episodes", "1"]
    assert irl("collect-experts", *cue, *common, "--name", "cue").code == 0
    done = irl("assess", "airl", "--demos", "cue", *common)
    assert (done.code, done.out) == (2, "") and "different observations" in done.err
    assert "hint:" in done.err
