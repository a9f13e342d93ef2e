"""Labels of artefacts and plans, and flags of single commands."""

import json
import shutil
from types import SimpleNamespace

import pytest

from irlcli import labels
from irlcli.cli import console, jobs
from irlcli.errors import UsageError
from irlcli.experiments import provenance
from irlcli.store import Store

SMOKE = ["--profile", "smoke"]
TRAIN = ["train-airl", "--demos", "demos", "--method", "irm", "--name", "airl"]
TRANSFER = ["transfer", "--reward", "airl/reward.pt", "--ood", "1.5x", "--name", "moved"]


def test_labels_tell_kinds_of_challengers_apart():
    found = [
        labels.learned({"grouping": "pooled", "penalty": "none", "challenger": challenger})
        for challenger in ({"life": 0}, {"life": 9}, {"life": 9, "per_setting": True})
    ]
    assert "challengers" not in found[0]
    endings = ("with challengers", "with challengers per setting")
    assert [label.partition(" (")[2] for label in found[1:]] == [f"{end})" for end in endings]


def test_labels_tell_rewards_learned_with_symmetries_apart():
    assert labels.learned({"symmetries": True}) == "(with symmetries)"
    assert labels.learned({"symmetries": False}) == ""


def test_labels_tell_means_of_rounds_apart():
    averaged = {"averaged_rounds": 30}
    last, equal, weighted = (
        labels.learned({"grouping": "pooled", "penalty": "none"} | mean)
        for mean in ({}, averaged, averaged | {"averaged_by": "learning-rate"})
    )
    assert "mean" not in last
    assert equal.endswith(" (mean of 30 rounds)")
    assert weighted.endswith(" (mean of 30 rounds by learning rate)")


def test_what_else_sets_a_reward_apart_is_a_list():
    several = {"grouping": "pooled", "l2": 0.01, "bc_epochs": 3, "symmetries": True}
    assert labels.learned(several).endswith(" l2 0.01 (from a clone, with symmetries)")


def test_a_run_says_which_steps_resume(capsys):
    shown = jobs.PlainJobs(console.TerminalConsole())
    shown.line("standard.step", "RESUME train-airl erm seed 0")
    assert "RESUME standard.step" in capsys.readouterr().err


def test_a_job_shows_its_progress_once_a_minute(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr("irlcli.cli.jobs.time", SimpleNamespace(monotonic=lambda: now))
    shown = jobs.PlainJobs(console.TerminalConsole())
    shown.start("step")
    for now in (30.0, 61.0, 90.0, 122.0):
        shown.line("step", f"  stage: {now:.0f}/200 rounds")
    assert capsys.readouterr().err.splitlines() == [
        "RUN step",
        "  step: 61/200 rounds",
        "  step: 122/200 rounds",
    ]


def test_ls_shows_the_method_behind_transfers_and_evaluations(irl, store_copy):
    """Method and lambda come from the reward: their own parameters have neither."""
    listed = irl("ls", "--store", store_copy.path).out
    (transfer,) = (row for row in listed.splitlines() if store_copy.transfer in row)
    (score,) = (row for row in listed.splitlines() if store_copy.evaluation in row)
    record = Store(store_copy.path).resolve(store_copy.airl).artefact.manifest.record
    made = record.parameters["airl"]
    learned = f"of train-airl irm lambda {made['penalty_weight']:g} seed 0"
    assert learned in transfer
    assert f"of transfer seed 0 {learned}" in score
    shutil.rmtree(store_copy.path / store_copy.airl)
    assert "lambda" not in irl("ls", "--store", store_copy.path).out  # No longer known.


def test_listings_tell_how_policies_were_retrained_and_for_how_long(irl, store_copy, publish):
    """Three transfers on one reward, which differ in nothing but that."""
    store = Store(store_copy.path)
    made = store.resolve(store_copy.transfer).artefact.manifest.record
    config = made.parameters["transfer"]
    changes = [({"ceiling": 0.9}, {}), ({}, {"start": "0" * 64}), ({"total_steps": 4096}, {})]
    for number, (changed, start) in enumerate(changes):
        publish(
            store,
            {"policy.pt": bytes([number])},
            stage="transfer",
            parameters=made.parameters | {"transfer": config | changed},
            inputs=made.inputs | start,
        )
    listed = irl("ls", "--stage", "transfer", "--store", store.root, "--json").out
    found = json.loads(listed)["artefacts"]
    assert len({(item["about"], item["budget"]) for item in found}) == 4
    lines = irl("ls", "--stage", "transfer", "--store", store.root).out.splitlines()
    assert len({line.partition(" ")[2] for line in lines}) == len(lines)
    own = [irl("lineage", item["id"], "--store", store.root).out for item in found]
    assert len({text.splitlines()[0].partition(" ")[2] for text in own}) == 4


@pytest.mark.parametrize(
    ("parameters", "shown"),
    [
        ({"total_steps": 800, "ppo": {"n_envs": 8, "n_steps": 1024}}, "8,192 steps"),
        (
            {
                "airl": {
                    "total_steps": 9,
                    "ppo": {"n_envs": 2, "n_steps": 2, "rollouts_per_round": 2},
                }
            },
            "16 steps",
        ),
        (
            {
                "transfer": {
                    "algorithm": "sac",
                    "total_steps": 8,
                    "restarts": 3,
                    "sac": {"n_envs": 4, "n_steps": 2},
                }
            },
            "24 steps",
        ),
        ({"total_steps": 800, "ppo": {"n_envs": "many", "n_steps": 0}}, "800 steps"),
    ],
)
def test_listed_steps_are_whole_rounds(parameters, shown):
    assert labels.budget(parameters) == shown


def test_plans_tell_how_a_policy_is_retrained(irl, smoke_store):
    line = [*TRANSFER[:-2], *SMOKE, "--dry-run", "--store", smoke_store.path]
    ways = ([], ["--start", "student"], ["--set", "transfer.ceiling=0.9"])
    plans = [irl(*line, *way).out.splitlines()[-1].partition(":")[0][8:] for way in ways]
    assert len(set(plans)) == 3


def test_the_label_of_a_transfer_names_the_method_of_its_reward(irl, store_copy, tmp_path):
    """Otherwise transfers of two methods would share a label and a TensorBoard directory."""
    plan = irl(*TRANSFER, *SMOKE, "--seed", "9", "--dry-run", "--store", store_copy.path).out
    assert "seed 9" in plan and "irm lambda" in plan
    shutil.copy(store_copy.path / store_copy.airl / "reward.pt", tmp_path)
    line = ["transfer", "--reward", tmp_path / "reward.pt", "--ood", "1.5x", "--seed", "9"]
    assert irl(*line, *SMOKE, "--dry-run", "--store", store_copy.path).out == plan


def test_labels_of_evaluations_distinguish_policies(irl, store_copy, tmp_path):
    place = ["--dry-run", "--store", store_copy.path]
    line = ["evaluate", "--expert", "--trained-in", "engine-power=1x,1.25x"]
    plan = irl(*line, "--env", "lunar-lander", "--ood", "engine-power=1.5x", *SMOKE, *place).out
    for own in ("1x", "1.25x"):
        assert f"evaluate expert of engine-power={own} in lunar-lander engine-power=1.5x" in plan
    plan = irl("evaluate", "--policy", "airl", "--ood", "1.5x", *SMOKE, *place).out
    assert "evaluate student irm of seed 0 in lunar-lander engine-power=1.5x seed 0" in plan
    store = Store(store_copy.path)
    makers = (a for a in store.artefacts() if a.manifest.record.stage == "train-expert")
    for expert in makers:
        own = expert.manifest.record.parameters["setting"]
        plan = irl("evaluate", "--policy", expert.id, "--ood", "1.5x", *SMOKE, *place).out
        assert f"evaluate expert of {own} in lunar-lander engine-power=1.5x seed 0" in plan


def test_settings_that_differ_in_their_cue_have_one_expert(irl, tmp_path):
    line = ["evaluate", "--expert", "--trained-in", "cue-strength=0.9,0.8", *SMOKE, "--dry-run"]
    line += ["--env", "lunar-lander", "--ood", "cue-strength=0.1", "--store", tmp_path / "runs"]
    done = irl(*line)
    assert done.code == 0, done.err
    expert, evaluation = done.out.splitlines()
    assert "train-expert lunar-lander engine-power=1x" in expert
    assert "evaluate expert of engine-power=1x in lunar-lander cue-strength=0.1" in evaluation


def test_state_only_can_be_switched_off(irl, smoke_store, tmp_path):
    (tmp_path / "on.toml").write_text("[airl]\nstate_only = true")
    plans = [
        irl(*TRAIN, *SMOKE, *flags, "--dry-run", "--store", smoke_store.path).out
        for flags in (
            [],
            ["--settings", tmp_path / "on.toml", "--no-state-only"],
            ["--settings", tmp_path / "on.toml"],
            ["--state-only"],
        )
    ]
    assert plans[0] == plans[1] and plans[0].startswith("HIT")
    assert plans[2] == plans[3] and plans[2].startswith("RUN")


def test_help_explains_the_default_seed_of_demonstrations(irl):
    assert "always 0" in " ".join(irl("collect-experts", "--help").out.split())


def test_a_missing_tensorboard_is_reported_before_training(monkeypatch, irl, store_copy, tmp_path):
    import importlib.util

    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "tensorboard" else found(name)
    )
    line = [*TRAIN, *SMOKE, "--seed", "8", "--tensorboard", tmp_path / "logs"]
    done = irl(*line, "--store", store_copy.path)
    assert (done.code, done.out) == (2, "")
    assert "pip install tensorboard" in done.err and "RUN" not in done.err
    with pytest.raises(UsageError):
        console.TerminalConsole(tensorboard=tmp_path)


def test_tensorboard_is_told_of_a_training_with_a_long_label(tmp_path):
    pytest.importorskip("tensorboard")
    terminal = console.TerminalConsole(quiet=True, tensorboard=tmp_path)
    for key in ("a" * 64, "b" * 64):
        terminal.start("train-airl ant " + ", ".join(f"mass={i}x" for i in range(200)), False, key)
        terminal.scalars(1, {"return": 1.0})
        terminal.close()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_command_that_trains_nothing_says_that_tensorboard_has_nothing(irl, tmp_path):
    pytest.importorskip("tensorboard")
    line = ["evaluate", "--idle", "--env", "lunar-lander", "--setting", "default", *SMOKE]
    done = irl(*line, "--store", tmp_path / "runs", "--tensorboard", tmp_path / "logs")
    assert done.code == 0 and f"nothing was written to {tmp_path / 'logs'}" in done.err


def test_show_names_libraries_that_have_changed_since(irl, smoke_store, monkeypatch):
    line = ["show", "airl", "--store", smoke_store.path]
    same = irl(*line, "--json")
    assert json.loads(same.out)["other_versions"] == []
    present = provenance.libraries()
    monkeypatch.setattr(provenance, "libraries", lambda: {**present, "torch": "99.0"})
    text = f"torch {present['torch']} (now 99.0)"
    other = irl(*line, "--json")
    assert json.loads(other.out)["other_versions"] == [text]


def test_evaluations_print_their_returns_as_json(irl, store_copy):
    line = ["evaluate", "--policy", "moved", "--ood", "1.5x", *SMOKE, "--store", store_copy.path]
    document = json.loads(irl(*line, "--json").out)
    reported = json.loads(
        irl("report", "returns", "score", "--store", store_copy.path, "--json").out
    )
    assert document["id"] == store_copy.evaluation
    assert document["returns"] == reported["rows"] and len(document["returns"]) == 1


def test_gc_says_what_an_unused_evaluation_was_made_from(irl, store_copy):
    store = Store(store_copy.path)
    assert irl("unname", "*", "--store", store_copy.path).code == 0
    done = irl("gc", "--grace-days", "0", "--store", store_copy.path)
    assert done.code == 0, done.err
    lines = dict(line.split(maxsplit=1) for line in done.out.splitlines())
    evaluated = [a for a in store.artefacts() if "policy" in a.manifest.record.inputs]
    assert evaluated and all(" of train-" in lines[a.id] for a in evaluated)


def test_trainings_with_one_label_have_runs_of_their_own_in_tensorboard(irl, store_copy, tmp_path):
    for rate in ("0.001", "0.002"):
        line = [*TRAIN, *SMOKE, "--seed", "8", "--set", f"airl.learning_rate={rate}"]
        done = irl(*line, "--tensorboard", tmp_path / "logs", "--store", store_copy.path)
        assert done.code == 0, done.err
    runs = list((tmp_path / "logs").iterdir())
    assert len(runs) == 2 and all(len(list(run.glob("events*"))) == 1 for run in runs)
