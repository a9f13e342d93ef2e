"""Wrong command lines: each gets an exit code, the name of what is wrong, and a hint."""

from __future__ import annotations

from pathlib import Path

import pytest
from answers import LANDER, arguments, assert_answered, snapshot

from irlcli.envs import registry
from irlcli.envs.spec import EnvironmentSpec, Knob

WRONG = [
    # What to do
    ("nonsense", 2, "nonsense"),
    ("collect-expert", 2, "collect-expert"),
    ("ls --colour", 2, "--colour"),
    ("ls surplus", 2, "surplus"),
    ("show", 2, "ref"),
    ("show airl moved", 2, "unexpected argument: moved"),
    ("collect-experts --env lunar-landr", 2, "'lunar-landr'"),
    ("show .", 3, "'.' is a directory, not an artefact"),
    ("evaluate --policy moved --episodes 1.5", 2, "'1.5' is not a whole number"),
    (
        "transfer --reward airl --ood friction=0.1,engine-power=2x",
        2,
        "two knobs, friction and engine-power",
    ),
    ("report", 2, "REPORT"),
    ("report returns", 2, "name at least one evaluation"),
    ("report table9 score", 2, "table9"),
    ("report figure2 --profile smoke", 3, "figure2"),
    ("report control --profile smoke --dry-run", 3, "control"),
    ("report returns score --out x", 2, "--out"),
    ("report returns score --set airl.penalty_weight=3", 2, "--set"),
    ("report returns score --dry-run", 2, "--dry-run"),
    ("report returns score --profile smoke", 2, "--profile"),
    ("report returns score --from nowhere", 2, "--from"),
    ("report table2 --from nowhere", 2, "--from"),
    ("report table2 --workers 7", 2, "--workers"),
    ("report table2 --profile smoke", 2, "--profile"),
    (f"evaluate --idle {LANDER} --tensorboard ''", 2, "--tensorboard"),
    # Environments and interventions
    (
        "collect-experts --env lunar-lander --intervention bounce=0.1 --intervention friction=0.2",
        2,
        "--intervention is given twice",
    ),
    ("evaluate --idle --env lunar-lander --ood 1.5x", 2, "'1.5x' names no knob of lunar-lander"),
    ("collect-experts", 2, "--env"),
    ("collect-experts --env lunar-lander", 2, "--intervention"),
    ("collect-experts --env moon --intervention engine-power=1x", 2, "'moon'"),
    ("collect-experts --env lunar-landr --intervention engine-power=1x", 2, "'lunar-landr'"),
    ("collect-experts --env ../lunar-lander --intervention bounce=1", 2, "../lunar-lander"),
    ("collect-experts --env lunar-lander --intervention engine-powr=1x", 2, "'engine-powr'"),
    ("collect-experts --env lunar-lander --intervention span=1x", 2, "'span'"),
    ("collect-experts --env lunar-lander --intervention engine-power=fast", 2, "'fast'"),
    ("collect-experts --env lunar-lander --intervention engine-power=2", 2, "'2'"),
    ("collect-experts --env lunar-lander --intervention engine-power=-1x", 2, "'-1x'"),
    ("collect-experts --env lunar-lander --intervention engine-power=1e99x", 2, "'1e99x'"),
    ("collect-experts --env lunar-lander --intervention bounce=nan", 2, "'nan'"),
    (
        "collect-experts --env lunar-lander --intervention engine-power=1x,1.0x",
        2,
        "engine-power=1x",
    ),
    ("collect-experts --env lunar-lander --intervention engine-power=1x,", 2, "''"),
    ("collect-experts --env lunar-lander --intervention ''", 2, "--intervention is empty"),
    ("transfer --reward airl --ood 1x,2x", 2, "'1x,2x'"),
    ("transfer --reward airl --ood 0x", 2, "'0x'"),
    ("transfer --reward airl --setting bounce=0.1 --setting bounce=0.5", 2, "2 settings"),
    ("transfer --reward airl --setting bounce=0.1,0.5", 2, "'bounce=0.1,0.5' names 2 settings"),
    ("transfer --reward airl --setting bounce=0.1 --ood 2x", 2, "--ood and --setting"),
    ("transfer --reward airl --setting bounce=0.1,bounce=0.2", 2, "sets bounce twice"),
    ("evaluate --policy airl --setting wind=2x", 2, "'wind'"),
    ("evaluate --policy airl --ood 2x --setting engine-power=2x", 2, "engine-power=2x twice"),
    ("transfer --reward airl --ood leg-length=2x", 2, "'leg-length'"),
    (
        "collect-experts --env half-cheetah --intervention leg-length=1,1x",
        2,
        "leg-length=1 twice, once as leg-length=1x",
    ),
    ("collect-experts --env ant --intervention direction=10,10..10", 2, "direction=10 twice"),
    ("collect-experts --env gridworld --intervention blocked", 2, "no ID values of 'blocked'"),
    ("transfer --reward airl --ood ''", 2, "engine-power="),
    ("evaluate --policy airl --ood ''", 2, "engine-power="),
    ("evaluate --policy airl --intervention ''", 2, "engine-power="),
    ("evaluate --idle --env lunar-lander --ood ''", 2, "--ood is empty"),
    ("evaluate --idle --env lunar-lander --intervention ''", 2, "--intervention is empty"),
    (f"evaluate --expert --trained-in '' {LANDER}", 2, "--trained-in is empty"),
    (f"evaluate --expert --trained-in , {LANDER}", 2, "--trained-in is empty"),
    ("evaluate --policy airl --ood slow", 2, "'slow'"),
    ("evaluate --policy airl --env moon", 2, "'moon'"),
    ("evaluate --policy airl --env test-world", 2, "test-world"),
    ("transfer --reward airl --ood 1.5x --env test-world", 2, "belongs to lunar-lander"),
    # Numbers
    (f"collect-experts {LANDER} --episodes 0", 2, "--episodes 0"),
    (f"collect-experts {LANDER} --episodes -3", 2, "--episodes -3"),
    (f"collect-experts {LANDER} --episodes many", 2, "'many'"),
    (f"collect-experts {LANDER} --episodes 1,2", 2, "2 episode counts"),
    (f"collect-experts {LANDER} --episodes ''", 2, "--episodes"),
    (f"collect-experts {LANDER} --episodes 1_0", 2, "'1_0'"),
    (f"collect-experts {LANDER} --trust", 2, "--trust"),
    (f"collect-experts {LANDER} --seed -1", 2, "-1"),
    (f"collect-experts {LANDER} --seed x", 2, "x"),
    (f"collect-experts {LANDER} --seed 1.5", 2, "1.5"),
    (f"evaluate --idle {LANDER} --episodes 0", 2, "--episodes"),
    ("train-airl --demos demos --penalty-weight nan", 2, "penalty"),
    ("train-airl --demos demos --penalty-weight inf", 2, "penalty"),
    ("train-airl --demos demos --penalty-weight -1", 2, "penalty"),
    ("train-airl --demos demos --method erm --penalty-weight 3", 2, "erm has no penalty"),
    ("train-airl --demos demos --penalty-weight 3", 2, "erm has no penalty"),
    ("gc --grace-days -1", 2, "-1"),
    ("gc --grace-days nan", 2, "nan"),
    # Settings
    ("train-airl --demos demos --method irn", 2, "'irn'"),
    ("train-airl --demos demos --grouping by-colour", 2, "'by-colour'"),
    ("train-airl --demos demos --penalty irmv2", 2, "'irmv2'"),
    ("train-airl --demos demos --penalty closed-form", 2, "'closed-form'"),
    ("train-airl --demos demos --method irm --penalty none --penalty-weight 3", 2, "no penalty"),
    ("train-airl --demos demos --set airl.learner=gial", 2, "'gial'"),
    ("train-airl --demos demos --from {tmp}", 2, "{tmp}"),
    ("train-airl --demos demos --from {tmp}/absent", 3, "absent"),
    ("train-airl --demos demos --profile huge", 2, "'huge'"),
    ("train-airl --demos demos --set airl.penalty_wieght=3", 2, "airl.penalty_wieght"),
    (
        "train-airl --demos demos --set airl.rounds=3 --set airl.rounds=4",
        2,
        "--set airl.rounds is given twice",
    ),
    (
        "train-airl --demos demos --method irm --choose-penalty 1,2 --set airl.penalty_weight=7",
        2,
        "--set airl.penalty_weight=7 and --choose-penalty both set lambda",
    ),
    (
        "plan table1 --choose-penalty 1,2 --set airl.penalty_weight=7",
        2,
        "--set airl.penalty_weight=7 and --choose-penalty both set lambda",
    ),
    ("train-airl --demos demos --set nonsense", 2, "'nonsense'"),
    ("train-airl --demos demos --set airl=3", 2, "'airl=3'"),
    ("train-airl --demos demos --set airl.penalty_weight.x=3", 2, "airl.penalty_weight.x"),
    ("train-airl --demos demos --set airl.penalty_weight=lots", 2, "airl.penalty_weight=lots"),
    ("train-airl --demos demos --set airl.learning_rate=inf", 2, "airl.learning_rate"),
    ("train-airl --demos demos --set airl.ppo.n_envs=3", 2, "airl.ppo.n_envs = 3"),
    ("train-airl --demos demos --set airl.ppo.n_envs=0", 2, "airl.ppo.n_envs"),
    ("train-airl --demos demos --set airl.actions=executed", 2, "needs continuous actions"),
    ("train-airl --demos demos --set airl.actions=clipped", 2, "airl.actions"),
    ("train-airl --demos demos --settings absent.toml", 3, "absent.toml"),
    ("train-airl --demos demos --settings {tmp}", 2, "{tmp}"),
    ("train-airl --demos demos --settings {tmp}/broken.toml", 2, "broken.toml"),
    ("train-airl --demos demos --settings {tmp}/unknown.toml", 2, "unknown.toml"),
    ("train-airl --demos demos --settings {tmp}/hostile.toml", 2, "hostile.toml"),
    (f"collect-experts {LANDER} --tensorboard {{tmp}}/broken.toml", 2, "is not a directory"),
    (f"collect-experts {LANDER} --tensorboard {{tmp}}/broken.toml/x", 2, "is not a directory"),
    # Agents
    ("evaluate", 2, "no agents"),
    ("evaluate --random --idle", 2, "2 agents"),
    ("evaluate --policy airl --expert", 2, "2 agents"),
    ("evaluate --random", 2, "--random"),
    ("evaluate --expert --env lunar-lander", 2, "--expert"),
    (f"evaluate --idle --trained-in bounce {LANDER}", 2, "--trained-in"),
    ("evaluate --policy airl --trained-in bounce", 2, "--trained-in"),
    ("evaluate --reward airl", 2, "no agents"),
    ("evaluate --idle --reward airl", 2, "--idle"),
    ("evaluate --idle --reward airl --ood 2x --env ant", 2, "ant"),
    ("evaluate --idle --reward airl --ood slow", 2, "'slow'"),
    ("evaluate --policy airl --reward moved", 2, "reward.pt"),
    ("evaluate --policy airl --reward demos", 2, "reward.pt"),
    ("evaluate --policy airl --reward airl/policy.pt", 2, "'airl/policy.pt'"),
    (f"evaluate --expert --trained-in bonce {LANDER}", 2, "bonce"),
    (f"evaluate --expert --trained-in bounce {LANDER} --name both", 2, "'both'"),
    ("evaluate --policy airl --ood 2x --intervention bounce=1", 2, "--ood and --intervention"),
    (f"evaluate --expert {LANDER},1.25x --name both", 2, "'both'"),
    ("run demo --cluster slurm --detach --out found", 2, "--detach waits for none"),
    # References of the wrong kind
    ("transfer --reward moved/policy.pt --ood 2x", 2, "'moved/policy.pt'"),
    ("transfer --reward airl/policy.pt --ood 2x", 2, "'airl/policy.pt'"),
    ("transfer --reward airl/metrics.parquet --ood 2x", 2, "metrics.parquet"),
    ("evaluate --policy airl/reward.pt", 2, "'airl/reward.pt'"),
    ("train-airl --demos airl", 2, "'airl'"),
    ("train-airl --demos score", 2, "'score'"),
    ("train-airl --demos demos/steps.parquet", 2, "demos/steps.parquet"),
    ("report returns demos", 2, "'demos'"),
    ("report returns score airl", 2, "'airl'"),
    ("report returns {tmp}/broken.toml", 2, "broken.toml"),
    # References to nothing, or to too much
    ("transfer --reward moved --ood 2x", 2, "reward.pt"),
    ("evaluate --policy score", 2, "policy.pt"),
    ("evaluate --policy demos", 2, "policy.pt"),
    ("transfer --reward nothing --ood 2x", 3, "'nothing'"),
    ("transfer --reward airl/reward.tp --ood 2x", 3, "'reward.tp'"),
    ("transfer --reward airl/../STORE --ood 2x", 3, "../STORE"),
    ("transfer --reward {tmp} --ood 2x", 3, "{tmp}"),
    ("train-airl --demos nothing", 3, "'nothing'"),
    ("show no/such/path", 3, "no/such/path"),
    ("show {prefix}", 3, "ambiguous"),
    ("show ab", 3, "'ab'"),
    ("show ''", 3, "''"),
    ("show {tmp}/broken.toml", 3, "broken.toml"),
    ("lineage nothing", 3, "'nothing'"),
    ("verify nothing", 3, "'nothing'"),
    ("verify ''", 3, "''"),
    ("report returns nothing", 3, "'nothing'"),
    ("name nothing best", 3, "'nothing'"),
    # Names
    ("name airl abc", 2, "'abc'"),
    ("name airl 'a b'", 2, "'a b'"),
    ("name airl ../x", 2, "'../x'"),
    (f"evaluate --random {LANDER} --name 'a b'", 2, "'a b'"),
    (f"evaluate --random {LANDER} --name abc --dry-run", 2, "'abc'"),
    # Malformed values and surplus words
    ("--versoin", 2, "--versoin"),
    ("ls --json=yes", 2, "--json"),
    ("collect-experts --env ''", 2, "unknown environment ''"),
    ("collect-experts --env ant", 2, "--intervention"),
    ("collect-experts --env gridworld --intervention path-group=4", 2, "'4'"),
    ("collect-experts --env gridworld --intervention path-group=1.5", 2, "'1.5'"),
    ("collect-experts --env gridworld --intervention blocked=1x", 2, "'1x'"),
    ("collect-experts --env ant --intervention friction=1:2", 2, "'1:2'"),
    ("collect-experts --env ant --intervention friction=1:2:99", 2, "'1:2:99'"),
    ("collect-experts --env ant --intervention direction=10..-10", 2, "'10..-10'"),
    ("collect-experts --env ant --intervention direction=0..999", 2, "'0..999'"),
    ("collect-experts --env ant --intervention gravity=1x", 2, "'gravity'"),
    ("collect-experts --env reacher --intervention gravity=1", 2, "'1'"),
    ("collect-experts --env reacher --intervention gravity==1x", 2, "'=1x'"),
    ("collect-experts --env reacher --intervention gravity=1xx", 2, "'1xx'"),
    ("collect-experts --env reacher --intervention gravity=2x;3x", 2, "'2x;3x'"),
    (
        "collect-experts --env reacher --intervention gravity=1x --episodes 9999999999999999999",
        2,
        "9,999",
    ),
    (
        "collect-experts --env reacher --intervention gravity=1x --episodes 60000,60000",
        2,
        "2 episode",
    ),
    (
        "collect-experts --env reacher --intervention gravity=1x,2x --episodes 60000,60000",
        2,
        "120,000",
    ),
    ("collect-experts --env reacher --intervention gravity=1x --episodes 1.5", 2, "'1.5'"),
    ("train-maxent --demos demos", 2, "lunar-lander"),
    ("train-maxent --demos airl", 2, "'airl'"),
    ("train-maxent --demos mazes", 3, "'mazes'"),
    ("evaluate --idle --env gridworld --intervention path-group=1", 2, "gridworld"),
    ("evaluate --random --env gridworld --ood blocked", 2, "gridworld"),
    ("evaluate --expert --env gridworld --ood blocked", 2, "gridworld"),
    ("evaluate --policy airl --workers 0", 2, "--workers"),
    ("evaluate --policy airl --workers two", 2, "two"),
    ("evaluate --policy airl --set evaluation.episodes=0", 2, "evaluation.episodes"),
    ("evaluate --policy airl --set evaluation.deterministic=maybe", 2, "evaluation.deterministic"),
    ("train-airl --demos demos --set airl.ppo.n_envs=100000", 2, "n_envs"),
    ("train-airl --demos demos --set airl.ppo.n_steps=100000000", 2, "n_steps"),
    ("train-airl --demos demos --set airl.hidden=[9000]", 2, "airl.hidden"),
    ("train-airl --demos demos --set airl.hidden=[[]]", 2, "airl.hidden"),
    ("train-airl --demos demos --set airl.ppo.use_sde=true", 2, "use_sde"),
    ("train-airl --demos demos --set airl.ppo.gamma=1", 2, "gamma"),
    ("train-airl --demos demos --set =3", 2, "'=3'"),
    ("train-airl --demos demos --set .=3", 2, "'.=3'"),
    ("train-airl --demos demos --state-only --no-state-ony", 2, "--no-state-ony"),
    ("train-airl --demos demos --profile ''", 2, "''"),
    ("train-airl --demos ''", 3, "''"),
    ("transfer --reward airl --ood default=1", 2, "'default'"),
    ("transfer --reward airl --ood x", 2, "'x'"),
    ("transfer --reward score --ood 2x", 2, "reward.pt"),
    ("transfer --reward airl/ --ood engine-power=", 2, "engine-power="),
    ("play moved", 2, "--out"),
    ("play moved --out {tmp}/x.txt", 2, "x.txt"),
    ("play moved --out {tmp}/none/x.gif --steps 1", 2, "x.gif"),
    ("play moved --out {tmp}/x.gif --steps 0", 2, "--steps"),
    ("play moved --out {tmp}/x.gif --ood leg-length=2x", 2, "'leg-length'"),
    ("play airl/reward.pt --out {tmp}/x.gif", 2, "reward.pt"),
    ("play demos --out {tmp}/x.gif", 2, "policy.pt"),
    ("play nothing --out {tmp}/x.gif", 3, "'nothing'"),
    ("report figure2 score", 2, "figure2"),
    ("report figure2 --set figure2.seeds=1", 2, "figure2.seeds"),
    ("report figure2 --set figure2.episodes=[1,2]", 2, "counts"),
    ("report returns airl/policy.pt", 2, "airl/policy.pt"),
    ("name airl ''", 2, "''"),
    ("name airl manifest.json/..", 2, "'manifest.json/..'"),
    ("name airl", 2, "name"),
    ("show airl/manifest.jsn", 3, "manifest.jsn"),
    ("verify a b", 2, "b"),
    ("gc --grace-days soon", 2, "'soon' is not a number"),
    ("lineage", 2, "ref"),
]


@pytest.fixture
def wrong_files(tmp_path) -> Path:
    directory = tmp_path / "files"
    directory.mkdir()
    (directory / "broken.toml").write_text("[airl\nmethod = 'irm'")
    (directory / "unknown.toml").write_text("[airl]\nmethd = 'irm'")
    (directory / "hostile.toml").write_text("x = " + "[" * 5000)
    return directory


@pytest.fixture
def second_environment(monkeypatch):
    """Another environment, known by name only, for what belongs to another one."""
    knob = Knob("span", ("multiplier",), 0.0, 9.0, "a span")
    world = EnvironmentSpec("test-world", "test:World", "test/World-v0", 10, {"span": knob})
    monkeypatch.setitem(registry.ENVIRONMENTS, "test-world", world)


@pytest.mark.parametrize(("text", "code", "named"), WRONG, ids=[case[0][:70] for case in WRONG])
def test_wrong_command_lines(irl, store_copy, wrong_files, second_environment, text, code, named):
    if "{prefix}" in text:  # a twin that makes the first digits of the reward's id ambiguous
        (store_copy.path / (store_copy.airl[:8] + "0" * 8)).mkdir()
    words = {"tmp": str(wrong_files), "prefix": store_copy.airl[:8]}
    line = arguments(text.format(**words), store_copy.path)
    before = snapshot(store_copy.path), sorted(wrong_files.iterdir())
    first = assert_answered(irl(*line), code, named.format(**words))
    again = assert_answered(irl(*line, "--json"), code, named.format(**words), as_json=True)
    assert first == again
    # Nothing was made, moved or lost.
    assert (snapshot(store_copy.path), sorted(wrong_files.iterdir())) == before


def test_a_reference_that_looks_like_an_option(irl, smoke_store):
    result = irl("show", "--store", smoke_store.path, "--", "--json")
    assert_answered(result, 3, "'--json'", as_json=True)
