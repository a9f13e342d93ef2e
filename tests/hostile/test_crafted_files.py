"""Crafted demonstrations, tensor files and settings: refused by name, within bounded memory."""

import io
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from chains import assert_refused, run_many

from irlcli.data.demonstrations import EPISODES, STEPS, read_demonstrations
from irlcli.data.descriptions import Assessment, convert
from irlcli.data.tensors import (
    RefusedCode,
    from_bytes,
    load_policy_file,
    load_reward_file,
    to_bytes,
)
from irlcli.errors import IntegrityError


def declare_many_rows(directory: Path) -> None:
    """250 kB that declare 268 million rows."""
    path = directory / STEPS
    table = pa.table({"a": pa.array([0.0]).take(pa.array([0] * (1 << 20)))})
    with pq.ParquetWriter(path, table.schema, compression="zstd") as writer:
        writer.write_table(pa.concat_tables([table] * 16).combine_chunks(), row_group_size=1 << 24)
    for _ in range(4):
        footer, again = pq.read_metadata(path), pq.read_metadata(path)
        footer.append_row_groups(again)
        footer.write_metadata_file(path)
    assert pq.read_metadata(path).num_rows == 1 << 28 and path.stat().st_size < 1 << 20


def long_setting(directory: Path) -> None:
    """A text of 8 MB in a few kilobytes."""
    path = directory / EPISODES
    table = pq.read_table(path)
    column = table.schema.get_field_index("setting")
    texts = pa.array(["a" * (8 << 20)] * len(table))
    pq.write_table(
        table.set_column(column, table.schema.field(column), texts), path, compression="zstd"
    )
    assert path.stat().st_size < 1 << 20


def nested(directory: Path) -> None:
    path = directory / STEPS
    kind = pa.float32()
    for _ in range(40):
        kind = pa.list_(pa.struct([("x", kind)]))
    table = pq.read_table(path)
    column = table.schema.get_field_index("obs")
    pq.write_table(table.set_column(column, "obs", pa.nulls(len(table), kind)), path)


def one_wide_row(directory: Path) -> None:
    """A list of 22 million numbers in one cell, in a column that is not read."""
    path = directory / EPISODES
    table = pq.read_table(path)
    column = table.schema.get_field_index("intervention")
    values = pa.array(np.zeros(22_000_000))
    offsets = pa.array([0] * len(table) + [len(values)], pa.int32())
    cells = pa.ListArray.from_arrays(offsets, values)
    pq.write_table(
        table.set_column(column, table.schema.field(column).with_nullable(False), cells), path
    )


def pipe_instead(name: str):
    def change(directory: Path) -> None:
        (directory / name).unlink()
        os.mkfifo(directory / name)

    return change


def endless(directory: Path) -> None:
    (directory / EPISODES).unlink()
    (directory / EPISODES).symlink_to("/dev/zero")


def huge(directory: Path) -> None:
    os.truncate(directory / STEPS, 1 << 40)


def aborting_footer(directory: Path) -> None:
    """A histogram of repetition levels with one bin too many.

    ``RowGroupMetaData.column`` of pyarrow 26 aborts the process on it.
    """
    data = (directory / EPISODES).read_bytes()
    start = end = data.rindex(b"<)&") + 3
    for _ in range(2):  # the bins, numbers of variable length
        while data[end] & 0x80:
            end += 1
        end += 1
    size = int.from_bytes(data[-8:-4], "little") + 1
    (directory / EPISODES).write_bytes(
        data[: start - 1]
        + b"6"
        + data[start:end]
        + b"\0"
        + data[end:-8]
        + size.to_bytes(4, "little")
        + data[-4:]
    )


def endless_episode(directory: Path) -> None:
    table = pq.read_table(directory / EPISODES)
    lengths = pa.array([1 << 30] * len(table), table.schema.field("length").type)
    changed = table.set_column(table.schema.get_field_index("length"), "length", lengths)
    pq.write_table(changed, directory / EPISODES)


DATASETS = {
    "aborting": aborting_footer,
    "endless-episode": endless_episode,
    "rows": declare_many_rows,
    "text": long_setting,
    "nested": nested,
    "steps-pipe": pipe_instead(STEPS),
    "episodes-pipe": pipe_instead(EPISODES),
    "endless": endless,
    "huge": huge,
}


TOML = {
    "dotted": ".".join(["a"] * 20_000) + " = 1",
    "tables": "[" + ".".join(["airl"] * 20_000) + "]",
    "inline": "x = " + "{a=" * 600,
    "arrays": "[airl]\nhidden = " + "[" * 1500,
    "integer": "[airl]\ntotal_steps = " + "9" * 1900,
    "hexadecimal": "[airl]\ntotal_steps = 0x" + "f" * 1900,
    "worlds": "[airl.ppo]\nn_envs = 1_000_000_000",
    "date": "[airl]\ntotal_steps = 1979-05-27",
    "escapes": '"\\u001b[2J\\nerror: x" = 1',
    "long name": "a" * 1990 + " = 1",
    "long value": f"[airl]\nactivation = '{'b' * 1900}'",
    "list for a table": "airl = [1]",
    "interventions": "[interventions]\nbounce = 3",
}


def test_hostile_datasets_and_settings_take_bounded_memory(smoke_store, tmp_path):
    """Bombs, pipes and endless files are refused by name; one process stays under 600 MiB."""
    lines, expected = [], []
    before = sorted(tmp_path.parent.rglob("*"))
    for kind, change in DATASETS.items():
        directory = tmp_path / f"dataset-{kind}"
        directory.mkdir()
        for name in (STEPS, EPISODES):
            shutil.copyfile(smoke_store.path / smoke_store.demos / name, directory / name)
        change(directory)
        lines.append(["train-airl", "--demos", directory])
        expected.append((4, directory.name))
    for kind, text in TOML.items():
        (tmp_path / f"{kind}.toml").write_text(text)
        lines.append(["train-airl", "--demos", "demos", "--settings", tmp_path / f"{kind}.toml"])
        expected.append((2, f"{kind}.toml"))
    os.mkfifo(tmp_path / "pipe.toml")
    with open(tmp_path / "sparse.toml", "wb") as file:
        file.truncate(1 << 40)
    for path in (tmp_path / "pipe.toml", tmp_path / "sparse.toml", Path("/dev/zero")):
        lines.append(["train-airl", "--demos", "demos", "--settings", path])
        expected.append((2, path.name))
    made = sorted(tmp_path.parent.rglob("*"))
    common = ["--dry-run", "--store", smoke_store.path]
    results, peak = run_many([[*line, *common] for line in lines])
    for result, (code, named) in zip(results, expected, strict=True):
        assert_refused(result, code, named)
    assert peak < 600 << 10
    assert sorted(tmp_path.parent.rglob("*")) == made and made != before  # Nothing was written.


def test_a_tensor_that_claims_a_huge_shape(smoke_store, tmp_path):
    """Four bytes viewed as 2**40 numbers: refused for its shape and never copied."""
    data = from_bytes((smoke_store.path / smoke_store.airl / "reward.pt").read_bytes())
    name = next(iter(data["state"]))
    data["state"][name] = torch.zeros(1).expand(1 << 20, 1 << 20)
    (tmp_path / "wide.pt").write_bytes(to_bytes(data))
    with pytest.raises(IntegrityError, match=r"wide\.pt"):
        load_reward_file(tmp_path / "wide.pt")


def test_a_wide_cell_in_an_unread_column_takes_no_memory(smoke_store, tmp_path):
    for name in (STEPS, EPISODES):
        shutil.copyfile(smoke_store.path / smoke_store.demos / name, tmp_path / name)
    one_wide_row(tmp_path)
    before = pa.total_allocated_bytes()
    demos = read_demonstrations(tmp_path)
    assert len(demos.trajectories) == 2
    assert pa.total_allocated_bytes() - before < 10 << 20


def test_zip_entries_larger_than_the_file_are_refused_before_they_are_unpacked(monkeypatch):
    """Torch itself unpacks them."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(64 << 20))
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("unpacked"))
    with pytest.raises(ValueError, match="larger than the file"):
        from_bytes(buffer.getvalue())


def test_functions_in_tensor_files_are_named_and_not_called():
    with pytest.raises(RefusedCode, match="PosixPath"):
        from_bytes(to_bytes({"x": Path("/")}))


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
@pytest.mark.parametrize("kind", ["reward", "policy"])
def test_numbers_that_are_not_finite_are_refused(smoke_store, tmp_path, kind, number):
    data = from_bytes((smoke_store.path / smoke_store.airl / f"{kind}.pt").read_bytes())
    next(iter(data["state"].values())).view(-1)[0] = number
    (tmp_path / "file.pt").write_bytes(to_bytes(data))
    with pytest.raises(IntegrityError, match=r"file\.pt.* not finite"):
        {"reward": load_reward_file, "policy": load_policy_file}[kind](tmp_path / "file.pt")


def test_an_assessment_without_the_agents_that_its_verdicts_need():
    number, none = {"mean": 1.0, "error": None}, {"policies": 1, "spearman": None, "pearson": None}
    verdict = {"policy": "p", "true_regret": number, "learned_gap": number, "clear": True}
    place = {"setting": "mass=1x", "overall": none, "lower_half": none}
    document = {
        "env": "ant",
        "reward": {"method": "erm", "seed": 0, "settings": ["mass=1x"]},
        "settings": [place | {"retrained": [verdict | {"verdict": "matches the expert"}]}],
        "pooled": None,
        "bank": [],
    }
    with pytest.raises(IntegrityError, match=r"a\.json.* no expert"):
        convert(document, Assessment, "a.json")
