"""Wrong command lines and hostile files through the real entry point.

Every mistake gets one ``error:`` line that names the thing, a ``hint:`` line, the right exit code,
no traceback, and an empty stdout (with ``--json``: one document that says the same).
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import pickle
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from irlcli import interventions
from irlcli.errors import IrlError
from irlcli.experiments import provenance
from irlcli.store import Store

LANDER = "--env lunar-lander --intervention engine-power=1x"
_STAGES = ("collect-experts", "train-airl", "transfer", "evaluate")


def assert_answered(result, code: int, named: str, as_json: bool = False) -> str:
    """What every error owes the person who made it; returns the error line."""
    assert "Traceback" not in result.err
    assert "this is a defect" not in result.err, result.err
    assert result.code == code, result.err
    lines = result.err.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert len(errors) == 1, result.err
    assert named in errors[0]
    assert len(errors[0]) < 1000
    assert lines[-1].startswith("hint: ") and lines[-1] != "hint: ", result.err
    if as_json:
        document = json.loads(result.out)  # exactly one
        assert (document["kind"], document["exit_code"]) == ("error", code)
        assert named in document["message"] and document["hint"]
        assert isinstance(document["version"], int)
    else:
        assert result.out == ""
    return errors[0]


def arguments(text: str, store: Path) -> list[str]:
    """A command line against ``store``, with the budgets of the smoke profile."""
    words = shlex.split(text)
    if words and words[0] in _STAGES and "--profile" not in words:
        words += ["--profile", "smoke"]
    if "--store" not in words and words and not words[0].startswith("-"):
        words += ["--store", str(store)]
    return words


def snapshot(store: Path) -> set[str]:
    """Every file of a store but its locks, which even readers may create."""
    return {
        str(p.relative_to(store))
        for p in store.rglob("*")
        if ".locks" not in p.parts and p.is_file()
    }


# Command lines that are wrong in themselves

WRONG = [
    # What to do
    ("nonsense", 2, "nonsense"),
    ("collect-expert", 2, "collect-expert"),
    ("ls --colour", 2, "--colour"),
    ("ls surplus", 2, "surplus"),
    ("show", 2, "ref"),
    ("report", 2, "kind"),
    ("report returns", 2, "refs"),
    ("report table9 score", 2, "table9"),
    # Environments and interventions
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
    ("collect-experts --env lunar-lander --intervention ''", 2, "''"),
    ("transfer --reward airl --ood 1x,2x", 2, "'1x,2x'"),
    ("transfer --reward airl --ood 0x", 2, "'0x'"),
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
    ("evaluate --idle --env lunar-lander --ood ''", 2, "''"),
    ("evaluate --idle --env lunar-lander --intervention ''", 2, "''"),
    ("evaluate --policy airl --ood slow", 2, "'slow'"),
    ("evaluate --policy airl --env moon", 2, "'moon'"),
    ("evaluate --policy airl --env test-world", 2, "test-world"),
    ("transfer --reward airl --ood 1.5x --env test-world", 2, "learned in lunar-lander"),
    # Numbers
    (f"collect-experts {LANDER} --episodes 0", 2, "0 episodes"),
    (f"collect-experts {LANDER} --episodes -3", 2, "-3 episodes"),
    (f"collect-experts {LANDER} --episodes many", 2, "'many'"),
    (f"collect-experts {LANDER} --episodes 1,2", 2, "2 episode counts"),
    (f"collect-experts {LANDER} --episodes ''", 2, "--episodes"),
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
    ("train-airl --demos demos --method gail", 2, "--method"),
    ("train-airl --demos demos --profile huge", 2, "'huge'"),
    ("train-airl --demos demos --set airl.penalty_wieght=3", 2, "airl.penalty_wieght"),
    ("train-airl --demos demos --set nonsense", 2, "'nonsense'"),
    ("train-airl --demos demos --set airl=3", 2, "'airl=3'"),
    ("train-airl --demos demos --set airl.penalty_weight.x=3", 2, "airl.penalty_weight.x"),
    ("train-airl --demos demos --set airl.penalty_weight=lots", 2, "airl.penalty_weight=lots"),
    ("train-airl --demos demos --set airl.learning_rate=inf", 2, "airl.learning_rate"),
    ("train-airl --demos demos --set airl.ppo.n_envs=3", 2, "3 worlds"),
    ("train-airl --demos demos --set airl.ppo.n_envs=0", 2, "airl.ppo.n_envs"),
    ("train-airl --demos demos --set airl.actions=executed", 2, "needs continuous actions"),
    ("train-airl --demos demos --set airl.actions=clipped", 2, "airl.actions"),
    ("train-airl --demos demos --settings absent.toml", 2, "absent.toml"),
    ("train-airl --demos demos --settings {tmp}", 2, "{tmp}"),
    ("train-airl --demos demos --settings {tmp}/broken.toml", 2, "broken.toml"),
    ("train-airl --demos demos --settings {tmp}/unknown.toml", 2, "unknown.toml"),
    ("train-airl --demos demos --settings {tmp}/hostile.toml", 2, "hostile.toml"),
    (f"collect-experts {LANDER} --tensorboard {{tmp}}/broken.toml", 2, "is no directory"),
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
    ("evaluate --policy airl --reward moved", 3, "reward.pt"),
    ("evaluate --policy airl --reward demos", 3, "reward.pt"),
    ("evaluate --policy airl --reward airl/policy.pt", 2, "'airl/policy.pt'"),
    (f"evaluate --expert --trained-in bonce {LANDER}", 2, "bonce"),
    (f"evaluate --expert --trained-in bounce {LANDER} --name both", 2, "'both'"),
    ("evaluate --policy airl --ood 2x --intervention bounce=1", 2, "--ood and --intervention"),
    (f"evaluate --expert {LANDER},1.25x --name both", 2, "'both'"),
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
    ("transfer --reward moved --ood 2x", 3, "reward.pt"),
    ("evaluate --policy score", 3, "policy.pt"),
    ("evaluate --policy demos", 3, "policy.pt"),
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
    knob = interventions.Knob("span", ("multiplier",), 0.0, 9.0, "a span")
    world = interventions.Environment("test-world", "test/World-v0", 10, {"span": knob})
    monkeypatch.setitem(interventions.ENVIRONMENTS, "test-world", world)


@pytest.mark.parametrize(("text", "code", "named"), WRONG, ids=[case[0][:70] for case in WRONG])
def test_wrong_command_lines(irl, store_copy, wrong_files, second_environment, text, code, named):
    if "{prefix}" in text:  # a twin that makes the first digits of the reward's id ambiguous
        (store_copy.path / (store_copy.airl[:8] + "0" * 8)).mkdir()
    words = {"tmp": str(wrong_files), "prefix": store_copy.airl[:8]}
    line = arguments(text.format(**words), store_copy.path)
    before = snapshot(store_copy.path)
    first = assert_answered(irl(*line), code, named.format(**words))
    again = assert_answered(irl(*line, "--json"), code, named.format(**words), as_json=True)
    assert first == again
    assert snapshot(store_copy.path) == before  # nothing was made, moved or lost


def test_without_arguments(irl):
    """Nothing asked for: the help, whole and on stdout, as with --help."""
    result = irl()
    assert (result.code, result.err) == (0, "")
    assert result.out == irl("--help").out and "collect-experts" in result.out


# Damaged artefacts


def flip_last(path: Path) -> None:
    data = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


def halve(path: Path) -> None:
    path.chmod(0o644)
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize("damage", [flip_last, halve, Path.unlink])
@pytest.mark.parametrize(
    ("field", "file", "text"),
    [
        ("airl", "reward.pt", "transfer --reward airl --ood 1.75x"),
        ("airl", "reward.json", "transfer --reward airl --ood 1.75x"),
        ("airl", "policy.json", "evaluate --policy airl --ood 1.75x"),
        ("airl", "manifest.json", "show airl"),
        ("airl", "provenance.json", "show airl"),
        ("airl", "metrics.parquet", "verify airl"),
        ("demos", "steps.parquet", "train-airl --demos demos --seed 5"),
        ("demos", "manifest.json", "lineage moved"),
        ("expert", "policy.pt", f"collect-experts {LANDER} --seed 5"),
        ("transfer", "policy.pt", "evaluate --policy moved --ood 1.75x"),
        ("evaluation", "summary.json", "report returns score"),
        ("evaluation", "manifest.json", "ls"),
        ("evaluation", "manifest.json", "gc"),
    ],
)
def test_damaged_artefacts(irl, store_copy, field, file, text, damage):
    id16 = getattr(store_copy, field)
    damage(store_copy.path / id16 / file)
    result = irl(*arguments(text, store_copy.path), "--json")
    assert_answered(result, 4, id16, as_json=True)


@pytest.mark.parametrize("damage", [flip_last, halve])
def test_damage_is_repaired_by_running_the_same_commands(irl, store_copy, damage):
    damage(store_copy.path / store_copy.transfer / "policy.pt")
    line = arguments("verify", store_copy.path)
    result = irl(*line)
    assert_answered(result, 4, store_copy.transfer)
    assert "irl transfer --reward airl/reward.pt" in result.err  # the command that repairs it
    again = irl(*arguments("transfer --reward airl/reward.pt --ood 1.5x", store_copy.path))
    assert Path(again.out.strip()).name == store_copy.transfer
    assert irl(*line).code == 0


# Foreign files


def torch_zip(path: Path, pickled: bytes, extra: dict[str, bytes] | None = None) -> Path:
    """An archive as torch.save lays it out, around any pickle."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/byteorder", "little")
        archive.writestr("archive/version", "3\n")
        for name, data in (extra or {}).items():
            archive.writestr(f"archive/{name}", data)
    return path


class Mark:
    """Creates ``path`` if somebody unpickles it."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return (os.system, (f"touch {shlex.quote(str(self.path))}",))


def hostile_pickles(marker: Path) -> dict[str, bytes]:
    mark = Mark(marker)
    inside = {"kind": "reward", "schema": 1, "description": mark, "state": {}}
    command = f"open({str(marker)!r}, 'w').close()"
    return {
        "bare": pickle.dumps(mark),
        "old protocol": pickle.dumps(mark, protocol=0),
        "inside": pickle.dumps(inside),
        "eval": b"cbuiltins\neval\n(V" + command.encode() + b"\ntR.",
        "getattr": b"cbuiltins\ngetattr\n(cos\nsystem\nV__call__\ntR(Vtouch "
        + str(marker).encode()
        + b"\ntR.",
    }


@pytest.mark.parametrize(
    "option", ["transfer --ood 1.75x --reward", "evaluate --ood 1.75x --policy"]
)
@pytest.mark.parametrize("kind", hostile_pickles(Path("x")))
@pytest.mark.parametrize("packed", [True, False], ids=["zip", "raw"])
def test_no_code_in_a_file_is_run(irl, store_copy, tmp_path, option, kind, packed):
    marker, path = tmp_path / "marker", tmp_path / "hostile.pt"
    data = hostile_pickles(marker)[kind]
    if packed:
        torch_zip(path, data)
    else:
        path.write_bytes(data)
    before = snapshot(store_copy.path)
    assert_answered(irl(*arguments(f"{option} {path}", store_copy.path)), 4, "hostile.pt")
    assert not marker.exists()
    assert snapshot(store_copy.path) == before


def test_the_hostile_files_would_run_code_where_pickles_are_trusted(tmp_path):
    """Otherwise the tests above would prove nothing."""
    for kind, data in hostile_pickles(tmp_path / "marker").items():
        pickle.loads(data)
        assert (tmp_path / "marker").exists(), kind
        (tmp_path / "marker").unlink()


@pytest.mark.parametrize("kind", hostile_pickles(Path("x")))
def test_no_code_in_a_checkpoint_is_run(irl, store_copy, tmp_path, kind):
    """A checkpoint is as writable as the rest of the store; one that is no good is not for ever."""
    record = Store(store_copy.path).get(store_copy.transfer).manifest.record
    (store_copy.path / ".keys" / record.key).unlink()
    header = provenance.Header(
        schema=provenance.SCHEMA,
        stage=record.stage,
        stage_version=record.stage_version,
        libraries=provenance.libraries(),
        attempts=(),
    )
    state = torch_zip(tmp_path / "x", hostile_pickles(tmp_path / "marker")[kind]).read_bytes()
    with Store(store_copy.path).working_on(record.key, wait=False) as scratch:
        scratch.save(header.encode(state))
    text = "transfer --reward airl --ood 1.5x --set transfer.total_steps=2048"
    result = irl(*arguments(text, store_copy.path))
    assert not (tmp_path / "marker").exists()
    assert "the checkpoint cannot be used" in result.err
    assert "this is a defect" not in result.err, result.err
    if result.code != 0:
        assert_answered(result, 4, "checkpoint")


NETWORK = {
    "observation_size": 8,
    "action_size": 4,
    "discrete": True,
    "state_only": False,
    "hidden": [32, 32],
    "activation": "tanh",
    "gamma": 0.99,
}


def description(**changes) -> bytes:
    """A reward file of no parameters that describes itself as ``changes`` say."""
    origin = {"env": "lunar-lander", "settings": ["engine-power=1x"], "method": "erm", "seed": 0}
    # Sound but for the changes, so that each of them is what is refused.
    origin |= {"network": NETWORK, "scale": 1.0, "airl": {"fixed_horizon": True}}
    origin = {name: value for name, value in {**origin, **changes}.items() if value is not Ellipsis}
    return tensor_file(description=json.dumps(origin))


def tensor_file(**changes) -> bytes:
    value = {"kind": "reward", "schema": 1, "description": "{}", "state": {}}
    value = {name: item for name, item in {**value, **changes}.items() if item is not Ellipsis}
    return pickle.dumps(value, protocol=2)


def doubling(depth: int) -> list:
    """Few bytes as a pickle, 2**depth elements when printed."""
    value: list = []
    for _ in range(depth):
        value = [value, value]
    return value


CRAFTED = {
    "not a dict": pickle.dumps([1, 2], protocol=2),
    "no kind": tensor_file(kind=...),
    "no state": tensor_file(state=...),
    "state is a list": tensor_file(state=[1]),
    "newer schema": tensor_file(schema=2),
    "schema is text": tensor_file(schema="1"),
    "kind that prints as megabytes": tensor_file(kind=doubling(20)),
    "schema that prints as megabytes": tensor_file(schema=doubling(20)),
    "description is bytes": tensor_file(description=7),
    "description is a list": tensor_file(description="[]"),
    "description is cut": tensor_file(description='{"env": "lunar-'),
    "description is deep": tensor_file(description="[" * 100_000),
    "empty description": tensor_file(description="{}"),
    "no env": description(env=...),
    "env is a list": description(env=[]),
    "no settings": description(settings=...),
    "settings are empty": description(settings=[]),
    "settings are numbers": description(settings=[1]),
    "settings are text": description(settings="engine-power=1x"),
    "settings of another environment": description(settings=["leg-length=2x"]),
    "network without layers": description(network={"hidden": []}),
    "network with code": description(network={"observation_size": "__import__('os')"}),
    "network is a list": description(network=[]),
    "scale is zero": description(scale=0.0),
    "no scale": description(scale=...),
    "no fixed_horizon": description(airl={}),
    "empty pickle": b"",
    "stack underflow": b"\x80\x02R.",
    "missing memo": b"\x80\x02h\x05.",
    "nothing but stop": b"\x80\x02.",
    "unhashable key": b"\x80\x02}]K\x01s.",
    "cut": tensor_file()[:-5],
}


@pytest.mark.parametrize("name", CRAFTED)
def test_crafted_reward_files(irl, store_copy, tmp_path, name):
    """Tensor files without tensors or without sense: named, refused, nothing printed at length."""
    path = torch_zip(tmp_path / "crafted.pt", CRAFTED[name])
    result = irl(*arguments(f"transfer --reward {path} --ood 1.75x", store_copy.path))
    assert "crafted.pt" in assert_answered(result, result.code, "")
    assert result.code in (2, 4)


def test_a_reward_of_an_unknown_environment(irl, store_copy, tmp_path):
    path = torch_zip(tmp_path / "moon.pt", description(env="moon", settings=["gravity=1x"]))
    result = irl(*arguments(f"transfer --reward {path} --ood 1.75x", store_copy.path))
    assert "'moon'" in assert_answered(result, result.code, "'moon'")
    assert result.code in (2, 4)


@pytest.fixture(scope="session")
def archive_path(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "fuzzed.pt"


OPCODES = b"\x80\x02}q\x00(X\x04\x00\x00\x00kindK\x01u.R\x85\x86)]ebhcN\x88aos0123\n"


@settings(max_examples=150, deadline=None)
@given(
    data=st.lists(st.sampled_from(list(OPCODES)), max_size=30).map(bytes)
    | st.binary(max_size=60)
    | st.sampled_from(sorted(CRAFTED.values())).flatmap(
        lambda good: st.tuples(st.integers(0, max(0, len(good) - 1)), st.integers(0, 255)).map(
            lambda change: good[: change[0]] + bytes([change[1]]) + good[change[0] + 1 :]
        )
    )
)
def test_fuzz_tensor_files(archive_path, data):
    """Whatever the pickle says, only errors with a hint and an exit code come of it."""
    from irlcli.data.tensors import load_policy_file, load_reward_file

    torch_zip(archive_path, b"\x80\x02" + data)
    for load in (load_reward_file, load_policy_file):
        with pytest.raises(IrlError) as caught:
            load(archive_path)
        assert "fuzzed.pt" in caught.value.message


@settings(max_examples=60, deadline=None)
@given(at=st.floats(0, 1), bit=st.integers(0, 7), cut=st.booleans())
def test_fuzz_a_real_reward_file(smoke_store, archive_path, at, bit, cut):
    """Flipped or cut anywhere: refused by name, or read (a flip in a tensor cannot be seen)."""
    from irlcli.data.tensors import load_reward_file

    data = bytearray((smoke_store.path / smoke_store.airl / "reward.pt").read_bytes())
    index = int(at * (len(data) - 1))
    data[index] ^= 1 << bit
    archive_path.write_bytes(data[:index] if cut else data)
    try:
        model, origin = load_reward_file(archive_path)
    except IrlError as error:
        assert "fuzzed.pt" in error.message
    else:
        assert not cut and origin.env == "lunar-lander" and model.g is not None


def test_files_that_are_no_tensor_files(irl, store_copy, tmp_path):
    reward = (store_copy.path / store_copy.airl / "reward.pt").read_bytes()
    foreign = {
        "empty.pt": b"",
        "text.pt": b"hello",
        "zeros.pt": bytes(1000),
        "cut.pt": reward[: len(reward) // 2],
        "headless.pt": reward[100:],
        "parquet.pt": (store_copy.path / store_copy.demos / "steps.parquet").read_bytes(),
    }
    for name, data in foreign.items():
        (tmp_path / name).write_bytes(data)
        for option in ("transfer --ood 1.75x --reward", "evaluate --ood 1.75x --policy"):
            line = arguments(f"{option} {tmp_path / name}", store_copy.path)
            assert_answered(irl(*line), 4, name)


def test_zip_bomb(irl, store_copy, tmp_path):
    """300 KB that unpack to 300 MB: refused for what they declare, unpacked by nobody."""
    path = tmp_path / "bomb.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(300 << 20))
    assert path.stat().st_size < 1 << 20
    result = irl(*arguments(f"transfer --reward {path} --ood 2x", store_copy.path))
    assert_answered(result, 4, "bomb.pt")


def test_huge_file(irl, store_copy, tmp_path):
    with open(tmp_path / "huge.pt", "wb") as file:
        file.truncate(1 << 40)
    result = irl(*arguments(f"transfer --reward {tmp_path / 'huge.pt'} --ood 2x", store_copy.path))
    assert_answered(result, 4, "huge.pt")


def test_foreign_kinds_are_told_apart(irl, store_copy, tmp_path):
    """The same files outside the store: taken as what they are, refused as what they are not."""
    for name in ("reward.pt", "policy.pt"):
        shutil.copy(store_copy.path / store_copy.airl / name, tmp_path / name)
    reward, policy = tmp_path / "reward.pt", tmp_path / "policy.pt"
    for text, named in (
        (f"transfer --reward {policy} --ood 2x", "policy.pt"),
        (f"evaluate --policy {reward} --ood 2x", "reward.pt"),
    ):
        assert_answered(irl(*arguments(text, store_copy.path)), 2, named)
    for text in (
        f"transfer --reward {reward} --ood 1.5x",
        f"transfer --reward {tmp_path} --ood 1.5x",
    ):
        planned = irl(*arguments(text, store_copy.path), "--dry-run")
        assert planned.code == 0 and planned.out.startswith("HIT")  # an input counts by content


# Foreign demonstrations


@pytest.fixture
def foreign_demos(store_copy, tmp_path) -> Path:
    directory = tmp_path / "foreign"
    directory.mkdir()
    for name in ("steps.parquet", "episodes.parquet", "summary.json"):
        shutil.copy(store_copy.path / store_copy.demos / name, directory / name)
        (directory / name).chmod(0o644)
    return directory


def rewrite_steps(directory: Path, change) -> None:
    path = directory / "steps.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def retag(directory: Path, **changes) -> None:
    path = directory / "episodes.parquet"
    table = pq.read_table(path)
    tags = json.loads(table.schema.metadata[b"irlcli"])
    metadata = {b"irlcli": json.dumps({**tags, **changes}).encode()}
    pq.write_table(table.replace_schema_metadata(metadata), path)


def flat_column(name: str):
    def change(table: pa.Table) -> pa.Table:
        index = table.schema.get_field_index(name)
        return table.set_column(index, name, pa.array([0.5] * len(table), pa.float32()))

    return change


def text_column(name: str):
    def change(table: pa.Table) -> pa.Table:
        index = table.schema.get_field_index(name)
        return table.set_column(index, name, pa.array(["x"] * len(table)))

    return change


def deep_metadata(directory: Path) -> None:
    path = directory / "episodes.parquet"
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({b"irlcli": b"[" * 100_000}), path)


SPOILED = {
    "no steps": lambda d: (d / "steps.parquet").unlink(),
    "no episodes": lambda d: (d / "episodes.parquet").unlink(),
    "steps cut": lambda d: halve(d / "steps.parquet"),
    "episodes cut": lambda d: halve(d / "episodes.parquet"),
    "steps empty": lambda d: os.truncate(d / "steps.parquet", 0),
    "steps are text": lambda d: (d / "steps.parquet").write_bytes(b"t,obs\n1,2\n" * 50),
    "steps are a directory": lambda d: (
        (d / "steps.parquet").unlink(),
        (d / "steps.parquet").mkdir(),
    ),
    "a row too few": lambda d: rewrite_steps(d, lambda t: t.slice(1)),
    "no rows": lambda d: rewrite_steps(d, lambda t: t.slice(0, 0)),
    "no rewards": lambda d: rewrite_steps(d, lambda t: t.drop_columns(["reward"])),
    "flat observations": lambda d: rewrite_steps(d, flat_column("obs")),
    "textual observations": lambda d: rewrite_steps(d, text_column("obs")),
    "textual actions": lambda d: rewrite_steps(d, text_column("action")),
    "textual rewards": lambda d: rewrite_steps(d, text_column("reward")),
    "float actions": lambda d: rewrite_steps(d, flat_column("action")),
    "newer schema": lambda d: retag(d, schema=2),
    "schema is text": lambda d: retag(d, schema="1"),
    "env is a list": lambda d: retag(d, env=["lunar-lander"]),
    "deep metadata": deep_metadata,
    "a link beside": lambda d: (d / "link").symlink_to("/etc/passwd"),
    "a fifo beside": lambda d: os.mkfifo(d / "fifo"),
    "an odd name beside": lambda d: (d / "a\\b").write_bytes(b""),
}


@pytest.mark.parametrize("kind", SPOILED)
def test_spoiled_foreign_demonstrations(irl, store_copy, foreign_demos, kind):
    SPOILED[kind](foreign_demos)
    result = irl(*arguments(f"train-airl --demos {foreign_demos} --seed 5", store_copy.path))
    assert_answered(result, 4, "foreign")


def test_sound_foreign_demonstrations(irl, store_copy, foreign_demos):
    """The control of the test above."""
    line = arguments(f"train-airl --demos {foreign_demos} --method irm", store_copy.path)
    planned = irl(*line, "--dry-run")
    assert planned.code == 0 and planned.out.startswith("HIT")


# Hand-made artefacts: sound by their digests, senseless inside


@pytest.mark.parametrize(
    ("stage", "files", "parameters", "text"),
    [
        ("evaluate", {"summary.json": b"{}"}, {}, "report returns {id}"),
        ("evaluate", {"summary.json": b"[]"}, {}, "report returns {id}"),
        ("evaluate", {"summary.json": b"{"}, {}, "report returns {id}"),
        ("evaluate", {"summary.json": b'{"policy":{},"settings":[]}'}, {}, "report returns {id}"),
        (
            "evaluate",
            {"summary.json": b'{"policy":{"agent":"x"},"settings":[]}'},
            {},
            "report returns {id}",
        ),
        ("evaluate", {"other": b""}, {}, "report returns {id}"),
        ("collect-experts", {"a": b""}, {}, "train-airl --demos {id}"),
        ("collect-experts", {"a": b""}, {"env": [], "settings": 3}, "train-airl --demos {id}"),
        (
            "train-airl",
            {"reward.pt": b"", "reward.json": b"[]"},
            {},
            "transfer --reward {id} --ood 2x",
        ),
        (
            "train-airl",
            {"reward.pt": b"", "reward.json": b"{}"},
            {},
            "transfer --reward {id} --ood 2x",
        ),
        ("train-airl", {"reward.pt": b""}, {}, "transfer --reward {id} --ood 2x"),
        (
            "train-airl",
            {"policy.pt": b"", "policy.json": b'{"env":1}'},
            {},
            "evaluate --policy {id}",
        ),
    ],
)
def test_senseless_artefacts_are_refused(irl, empty_store, publish, stage, files, parameters, text):
    made = publish(empty_store, files, stage=stage, parameters=parameters).artefact
    result = irl(*arguments(text.format(id=made.id), empty_store.root))
    assert_answered(result, result.code, "")
    assert result.code in (2, 3, 4)


@pytest.mark.parametrize(
    "parameters",
    [{"settings": 5}, {"airl": 3}, {"setting": {"a": [1]}}, {"env": ["x"]}, {"agent": "\x1b[2J"}],
)
def test_senseless_parameters_do_not_break_listing(irl, store_copy, publish, parameters):
    made = publish(Store(store_copy.path), parameters=parameters).artefact
    for text in ("ls", "ls --json", f"lineage {made.id}", "gc"):
        result = irl(*arguments(text, store_copy.path))
        assert result.code == 0, result.err
        assert text == "gc" or made.id in result.out
        assert "\x1b" not in result.out  # nor drive the terminal


def test_lineage_of_an_artefact_that_holds_its_own_input(irl, empty_store, publish):
    """Equal files are one content: ancestry by content can lead back to where it began."""
    first = publish(empty_store, {"f": b"same"}).artefact
    sha = first.output("f").sha256
    second = publish(empty_store, {"f": b"same", "g": b"x"}, inputs={"reward": sha}).artefact
    result = irl(*arguments(f"lineage {second.id}", empty_store.root))
    assert result.code == 0, result.err
    assert second.id in result.out


# Stores


@pytest.mark.parametrize("text", ["ls", "show airl", f"evaluate --idle {LANDER}", "verify", "gc"])
@pytest.mark.parametrize(
    ("kind", "code", "named"),
    [
        ("file", 2, "not a directory"),
        ("foreign", 4, "no store"),
        ("newer", 4, "format 7"),
        ("damaged", 4, "STORE"),
        ("too long", 2, "aaaa"),
        ("below a file", 2, "notes"),
    ],
)
def test_places_that_are_no_store(irl, tmp_path, kind, code, named, text):
    place = tmp_path / "place"
    match kind:
        case "file":
            place.write_text("x")
        case "foreign":
            place.mkdir()
            (place / "thesis.tex").write_text("x")
        case "newer":
            place.mkdir()
            (place / "STORE").write_text('{"format": 7}')
        case "damaged":
            place.mkdir()
            (place / "STORE").write_text("{")
        case "too long":
            place = tmp_path / ("a" * 300)
        case "below a file":
            (tmp_path / "notes").write_text("x")
            place = tmp_path / "notes" / "runs"
    before = sorted(tmp_path.rglob("*"))
    assert_answered(irl(*arguments(text, place), "--json"), code, named, as_json=True)
    assert sorted(tmp_path.rglob("*")) == before


def test_reading_a_store_that_is_not_there_makes_none(irl, tmp_path):
    for text in ("ls", "verify", "gc", "gc --delete"):
        result = irl(*arguments(text, tmp_path / "absent"))
        assert_answered(result, 3, f"no store at {tmp_path / 'absent'}")
    assert not (tmp_path / "absent").exists()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.EIO])
@pytest.mark.parametrize("call", ["fsync", "rename", "link", "replace"])
def test_full_or_read_only_disk(irl, store_copy, monkeypatch, call, number):
    """The kernel refuses one call: a named error, nothing published, and a rerun completes."""

    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    line = arguments(f"evaluate --idle {LANDER} --episodes 1", store_copy.path)
    before = Store(store_copy.path).ids()
    with monkeypatch.context() as patch:
        patch.setattr(os, call, refuse)
        result = irl(*line)
    assert_answered(result, 1, os.strerror(number))
    assert irl(*arguments("verify", store_copy.path)).code == 0
    again = irl(*line)
    assert again.code == 0
    assert len(Store(store_copy.path).ids()) == len(before) + 1


def test_a_full_disk_is_the_failure_of_the_stage_that_met_it(irl, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    Store(tmp_path / "runs").create()
    monkeypatch.setattr(os, "fsync", refuse)
    line = f"evaluate --expert {LANDER} --set expert.total_steps=64 --profile smoke"
    result = irl(*arguments(line, tmp_path / "runs"))
    stage = "train-expert lunar-lander engine-power=1x seed 0"
    assert_answered(result, 1, f"error: {stage}: {os.strerror(errno.ENOSPC)}")
    assert "if there is one" in result.err


# Through a real process

IRL = [sys.executable, "-m", "irlcli"]
_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH, _PR_CAPBSET_DROP = 1, 2, 24


def obey_permissions() -> None:
    """In the child: permission bits bind root, too, once these capabilities are gone."""
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
            if libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), "prctl")


def small_files_only() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))


class Done:
    """A finished process, in the form of ``run_main``'s results."""

    def __init__(self, line: list[str], **options):
        done = subprocess.run([*IRL, *line], capture_output=True, text=True, timeout=120, **options)
        self.code, self.out, self.err = done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    ("text", "code", "named"),
    [
        ("collect-experts --env lunar-landr --intervention bounce=1", 2, "'lunar-landr'"),
        ("show nothing", 3, "'nothing'"),
        ("report returns demos --json", 2, "'demos'"),
        ("nonsense", 2, "nonsense"),
    ],
)
def test_in_a_process(smoke_store, text, code, named):
    done = Done(arguments(text, smoke_store.path))
    assert_answered(done, code, named, as_json="--json" in text)


def test_in_a_process_the_store_comes_from_the_environment(tmp_path):
    (tmp_path / "STORE").write_text('{"format": 9}')
    done = Done(["ls"], env={**os.environ, "IRL_STORE": str(tmp_path)})
    assert_answered(done, 4, "format 9")


def test_hostile_reward_in_a_process(smoke_store, tmp_path):
    path = torch_zip(tmp_path / "hostile.pt", hostile_pickles(tmp_path / "marker")["bare"])
    done = Done(arguments(f"transfer --reward {path} --ood 2x --dry-run", smoke_store.path))
    assert_answered(done, 4, "hostile.pt")
    assert not (tmp_path / "marker").exists()


def test_a_fifo_is_no_tensor_file(store_copy, tmp_path):
    """Opening it would wait for a writer that never comes."""
    os.mkfifo(tmp_path / "pipe.pt")
    line = arguments(f"transfer --reward {tmp_path / 'pipe.pt'} --ood 2x", store_copy.path)
    try:
        done = subprocess.run([*IRL, *line], capture_output=True, text=True, timeout=30)
    except subprocess.TimeoutExpired:
        pytest.fail("hangs on a named pipe")
    assert done.returncode in (2, 3, 4) and "pipe.pt" in done.stderr


@pytest.mark.parametrize("kind", ["network", "bytearray"])
def test_small_files_take_no_large_memory(store_copy, tmp_path, kind):
    """A description of a huge network, a pickle that asks for a huge buffer: a kilobyte each."""
    if kind == "network":
        data = description(network=NETWORK | {"hidden": [9000, 9000]})
    else:
        data = b"\x80\x02cbuiltins\nbytearray\nJ" + (800 << 20).to_bytes(4, "little") + b"\x85R."
    path = torch_zip(tmp_path / "greedy.pt", data)
    line = arguments(f"transfer --reward {path} --ood 2x", store_copy.path)
    # Peak memory as the process itself sees it: what wait4 tells includes its parent before exec.
    code = (
        "import re, sys\n"
        "from irlcli.cli.main import main\n"
        "try:\n    main()\n"
        "finally:\n"
        "    status = open('/proc/self/status').read()\n"
        "    print(re.search(r'VmHWM:\\s*(\\d+) kB', status)[1])\n"
    )
    done = subprocess.run([sys.executable, "-c", code, *line], capture_output=True, text=True)
    assert done.returncode == 4, done.stderr
    assert "greedy.pt" in done.stderr
    assert int(done.stdout) < 600 << 10  # KiB; torch alone takes about half of it


@pytest.fixture
def read_only(store_copy):
    directories = [store_copy.path, *(p for p in store_copy.path.iterdir() if p.is_dir())]
    for path in directories:
        path.chmod(0o555)
    for path in (store_copy.path / ".locks").iterdir():
        path.chmod(0o444)
    yield store_copy
    for path in directories:
        path.chmod(0o755)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (f"evaluate --idle {LANDER}", "ermission denied"),
        ("name airl better", "ermission denied"),
        ("gc --delete --grace-days 0", "ermission denied"),
    ],
)
def test_read_only_store(read_only, text, named):
    before = snapshot(read_only.path)
    done = Done(arguments(text, read_only.path), preexec_fn=obey_permissions)
    assert_answered(done, 1, named)
    assert snapshot(read_only.path) == before


def test_read_only_store_can_be_read(read_only):
    for text in ("transfer --reward airl/reward.pt --ood 1.5x --name moved", "verify"):
        done = Done(arguments(text, read_only.path), preexec_fn=obey_permissions)
        assert done.code == 0, done.err


def test_damage_in_a_read_only_store_is_still_damage(read_only):
    flip_last(read_only.path / read_only.evaluation / "summary.json")
    for text in ("report returns score", "verify"):
        done = Done(arguments(text, read_only.path), preexec_fn=obey_permissions)
        assert_answered(done, 4, read_only.evaluation)


def test_unreadable_store(store_copy):
    store_copy.path.chmod(0)
    try:
        done = Done(arguments("ls", store_copy.path), preexec_fn=obey_permissions)
    finally:
        store_copy.path.chmod(0o755)
    assert_answered(done, done.code, str(store_copy.path))
    assert done.code in (1, 2)


def test_file_size_limit(store_copy):
    """A quota at the system-call boundary: writes beyond it fail with EFBIG."""
    line = arguments(f"evaluate --idle {LANDER} --episodes 1", store_copy.path)
    done = Done(line, preexec_fn=small_files_only)
    assert_answered(done, 1, "evaluate")
    store = Store(store_copy.path)
    assert store.verify(store.ids()) == {}


@pytest.fixture
def hold():
    """Hold a lock in another process, as one at work does."""
    children = []

    def holding(path: Path, shared: bool = False) -> int:
        script = (
            "import sys; from pathlib import Path; from irlcli.store.lock import locked\n"
            f"with locked(Path(sys.argv[1]), shared={shared}):\n"
            "    print('held', flush=True); sys.stdin.read()"
        )
        child = subprocess.Popen(
            [sys.executable, "-c", script, str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        children.append(child)
        assert child.stdout.readline() == b"held\n"
        return child.pid

    yield holding
    for child in children:
        child.communicate()


def test_busy(irl, store_copy, hold):
    key = Store(store_copy.path).get(store_copy.transfer).manifest.record.key
    (store_copy.path / ".keys" / key).unlink()
    pid = hold(store_copy.path / ".locks" / key)
    text = "transfer --reward airl --ood 1.5x --no-wait"
    line = arguments(text, store_copy.path)
    assert_answered(irl(*line), 75, f"process {pid}")
    assert_answered(Done([*line, "--json"]), 75, f"process {pid}", as_json=True)


def test_gc_while_the_store_is_used(irl, store_copy, hold):
    hold(store_copy.path / ".locks" / "gc", shared=True)
    before = snapshot(store_copy.path)
    line = arguments("gc --delete --grace-days 0", store_copy.path)
    assert_answered(irl(*line), 75, f"the store {store_copy.path}")
    assert snapshot(store_copy.path) == before
    assert irl(*arguments("gc --grace-days 0", store_copy.path)).code == 0  # a dry run reads only


def test_using_the_store_while_gc_runs(irl, store_copy, hold):
    pid = hold(store_copy.path / ".locks" / "gc")
    line = arguments(f"evaluate --idle {LANDER} --no-wait", store_copy.path)
    assert_answered(irl(*line), 75, f"process {pid}")


def test_a_stage_that_fails_is_named(irl, tmp_path):
    text = f"collect-experts {LANDER} --set expert.ppo.learning_rate=1e30"
    result = irl(*arguments(text, tmp_path / "runs"))
    assert_answered(result, 1, "train-expert lunar-lander engine-power=1x seed 0: ")
    assert "not finite" in result.err and not Store(tmp_path / "runs").ids()


def test_a_name_that_moves_says_what_it_leaves(irl, store_copy):
    result = irl(*arguments("name airl demos", store_copy.path))
    assert result.code == 0
    assert f"warning: demos no longer names {store_copy.demos}" in result.err
    again = irl(*arguments("name airl demos", store_copy.path))
    assert again.code == 0 and again.err == ""


def test_an_unknown_stage_lists_those_there_are(irl, store_copy):
    result = irl(*arguments("ls --stage train-ariel", store_copy.path))
    assert (result.code, result.out) == (0, "")
    assert "'train-ariel'" in result.err and "train-airl, " in result.err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_with_a_checkpoint(irl, tmp_path, number):
    store = tmp_path / "runs"
    text = f"collect-experts {LANDER} --set expert.total_steps=50_000_000"
    line = arguments(text, store)
    process = subprocess.Popen(
        [*IRL, *line], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    shown = []
    for row in process.stderr:
        shown.append(row)
        if " steps " in row:
            process.send_signal(number)
            break
    out, rest = process.communicate(timeout=120)

    class Result:
        code, err = process.returncode, "".join(shown) + rest

    Result.out = out
    assert_answered(Result, 130, "checkpoint")
    planned = irl(*line, "--dry-run")
    assert planned.code == 0 and planned.out.startswith("RESUME")


def test_a_closed_pipe_is_quiet(smoke_store):
    line = arguments("show airl", smoke_store.path)
    process = subprocess.Popen([*IRL, *line], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert (process.wait(), err) == (141, b"")
