"""Wrong command lines: the exit code, and a message that names the wrong word."""

import json
import shlex

import pytest

SMOKE = ["--profile", "smoke"]

WRONG = [
    ("--versoin", 2, "--versoin"),
    ("ls --json=yes", 2, "--json"),
    ("collect-experts --env ''", 2, "--intervention"),
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
    ("transfer --reward score --ood 2x", 3, "reward.pt"),
    ("transfer --reward airl/ --ood engine-power=", 2, "engine-power="),
    ("play moved", 2, "--out"),
    ("play moved --out {tmp}/x.txt", 2, "x.txt"),
    ("play moved --out {tmp}/none/x.gif --steps 1", 2, "x.gif"),
    ("play moved --out {tmp}/x.gif --steps 0", 2, "--steps"),
    ("play moved --out {tmp}/x.gif --ood leg-length=2x", 2, "'leg-length'"),
    ("play airl/reward.pt --out {tmp}/x.gif", 2, "reward.pt"),
    ("play demos --out {tmp}/x.gif", 3, "policy.pt"),
    ("play nothing --out {tmp}/x.gif", 3, "'nothing'"),
    ("report figure2 score", 2, "figure2"),
    ("report figure2 --set figure2.seeds=1", 2, "figure2.seeds"),
    ("report figure2 --set figure2.episodes=[1,2]", 2, "counts"),
    ("report returns airl/policy.pt", 2, "airl/policy.pt"),
    ("name airl ''", 2, "''"),
    ("name airl manifest.json/..", 2, "'manifest.json/..'"),
    ("name airl", 2, "name"),
    ("show airl/manifest.jsn", 3, "manifest.jsn"),
    ("show -- --json", 3, "'--json'"),
    ("verify a b", 2, "b"),
    ("gc --grace-days soon", 2, "soon"),
    ("lineage", 2, "ref"),
]


@pytest.mark.parametrize(("text", "code", "named"), WRONG, ids=[case[0][:70] for case in WRONG])
def test_wrong_command_lines(irl, smoke_store, tmp_path, text, code, named):

    words = shlex.split(text.format(tmp=tmp_path))
    at = words.index("--") if "--" in words else len(words)
    profile = SMOKE if words[0] in ("evaluate", "transfer", "train-airl", "collect-experts") else []
    profile = [] if "--profile" in words else profile
    words[at:at] = [*profile, *(["--store", str(smoke_store.path)] if words[0][0] != "-" else [])]
    done = irl(*words)
    if "--json" not in words:
        assert (done.code, done.out) == (code, "")
        (message,) = (line for line in done.err.splitlines() if line.startswith("error: "))
        assert named in message and "Traceback" not in done.err
        assert done.err.splitlines()[-1].startswith("hint: ")
        done = irl(*words[:at], "--json", *words[at:])
    document = json.loads(done.out)
    assert (done.code, document["kind"], document["exit_code"]) == (code, "error", code)
    assert named in document["message"] and document["hint"]
    assert list(tmp_path.iterdir()) == []
