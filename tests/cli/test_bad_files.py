"""Foreign files as rewards, policies and demonstrations: refused by name, never executed."""

from __future__ import annotations

import json
import os
import pickle
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from answers import IRL, Done, arguments, assert_answered, halve, snapshot
from hypothesis import given, settings
from hypothesis import strategies as st

from irlcli.data.demonstrations import read_demonstrations
from irlcli.data.streaming import write_demonstrations
from irlcli.envs.registry import environment
from irlcli.errors import IrlError
from irlcli.experiments import provenance
from irlcli.interventions import parse_setting
from irlcli.store import Store
from irlcli.trajectories import Trajectory


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
    ("line", "file"),
    [
        ("train-airl --demos mine", "episodes.parquet"),
        ("transfer --ood 1.75x --reward mine", "reward.pt"),
        ("evaluate --ood 1.75x --policy mine", "policy.pt"),
    ],
)
def test_a_directory_of_the_working_directory_is_no_artefact(
    irl, store_copy, tmp_path, monkeypatch, line, file
):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    Path("mine", "notes.txt").touch()
    done = irl(*arguments(line, store_copy.path))
    assert_answered(done, 3, f"'mine' is neither an artefact nor a directory with {file}")


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
    record = Store(store_copy.path).resolve(store_copy.transfer).artefact.manifest.record
    (store_copy.path / ".keys" / record.key).unlink()
    header = provenance.Header(
        schema=provenance.SCHEMA,
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
    "shaping": True,
}


def description(**changes) -> bytes:
    """A reward file of no parameters that describes itself as ``changes`` say."""
    origin = {"env": "lunar-lander", "settings": ["engine-power=1x"], "method": "erm", "seed": 0}
    # Sound but for the changes, so that each of them is what is refused.
    origin |= {"network": NETWORK, "scale": 1.0, "quantiles": [0.0] * 101}
    origin |= {"airl": {"fixed_horizon": True}}
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
    # Planning reads the description and no tensor, whose absence would be refused as well.
    line = f"transfer --reward {path} --ood 1.75x --dry-run"
    result = irl(*arguments(line, store_copy.path))
    assert "crafted.pt" in assert_answered(result, result.code, "")
    assert result.code in (2, 4)


def test_a_sound_description_is_planned_with(irl, store_copy, tmp_path):
    path = torch_zip(tmp_path / "sound.pt", description())
    line = f"transfer --reward {path} --ood 1.75x"
    assert irl(*arguments(f"{line} --dry-run", store_copy.path)).code == 0
    assert_answered(irl(*arguments(line, store_copy.path)), 4, "sound.pt")


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


# In a process of its own


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


def test_the_description_of_a_huge_network_takes_no_large_memory(store_copy, tmp_path):
    data = description(network=NETWORK | {"hidden": [9000, 9000]})
    path = torch_zip(tmp_path / "greedy.pt", data)
    line = arguments(f"transfer --reward {path} --ood 2x", store_copy.path)
    # Peak memory as the process itself sees it: wait4's includes the parent's before exec.
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


def unknown_action(table: pa.Table) -> pa.Table:
    """The last action of the last setting is the fifth of four."""
    actions = [*table["action"].to_pylist()[:-1], 4]
    index = table.schema.get_field_index("action")
    return table.set_column(index, table.schema.field(index), pa.array(actions))


def beyond_the_time_limit(directory: Path) -> None:
    demos = read_demonstrations(directory)
    steps = environment(demos.env).max_episode_steps + 1
    long = Trajectory(
        observations=np.zeros((steps + 1, 8), np.float32),
        actions=np.zeros(steps, np.int64),
        rewards=np.zeros(steps),
        terminated=True,
        truncated=False,
        seed=0,
    )
    groups = [(parse_setting(demos.env, text), [long] * 2) for text in demos.trajectories]
    write_demonstrations(directory, demos.env, groups, demos.metadata)


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
    "newer schema": lambda d: retag(d, schema=3),
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


@pytest.mark.parametrize("line", ["train-airl", "train-airl --select episodes", "assess airl"])
@pytest.mark.parametrize(
    "spoil, named",
    [
        (lambda d: rewrite_steps(d, unknown_action), "actions below 0 or above 3"),
        (beyond_the_time_limit, "1001 steps exceeds the horizon of 1000"),
    ],
)
def test_demonstrations_that_do_not_fit(irl, store_copy, foreign_demos, line, spoil, named):
    """They are learned from, held out to select by, and cloned."""
    spoil(foreign_demos)
    result = irl(*arguments(f"{line} --demos {foreign_demos}", store_copy.path))
    assert_answered(result, 4, named)


def test_sound_foreign_demonstrations(irl, store_copy, foreign_demos):
    """The control of the test above."""
    line = arguments(f"train-airl --demos {foreign_demos} --method irm", store_copy.path)
    planned = irl(*line, "--dry-run")
    assert planned.code == 0 and planned.out.startswith("HIT")
