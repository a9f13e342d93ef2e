"""Tensor files: round trips, equal bytes, and files that do not fit are named."""

import shutil
from typing import Any, ClassVar

import pytest
import torch

from irlcli.data.tensors import (
    fitting,
    from_bytes,
    load,
    load_policy_file,
    load_reward_file,
    to_bytes,
)
from irlcli.errors import IntegrityError, NewerFormat, StageFailed, UsageError
from irlcli.experiments.runner import Silent
from irlcli.stages.base import Job
from irlcli.stages.running import run_training

LOADERS = {"reward": load_reward_file, "policy": load_policy_file}


@pytest.fixture(params=LOADERS)
def file(request, smoke_store, tmp_path):
    """A copy of a learned reward, and of its student, outside the store; and its loader."""
    path = tmp_path / f"{request.param}.pt"
    shutil.copyfile(smoke_store.path / smoke_store.airl / path.name, path)
    return path, LOADERS[request.param]


def change(path, **fields):
    path.write_bytes(to_bytes({**from_bytes(path.read_bytes()), **fields}))


def test_tensors_numbers_and_texts_round_trip():
    value = {"a": torch.arange(6.0).reshape(2, 3), "b": [1, 2.5, "x", None], "c": {"d": True}}
    read = from_bytes(to_bytes(value))
    assert torch.equal(read.pop("a"), value["a"]) and read == {"b": value["b"], "c": value["c"]}


def test_equal_contents_are_equal_bytes():
    """Tensors in other memory, and views of larger ones that are saved as their own."""
    values = [torch.arange(6.0), torch.arange(3.0).repeat(2) + torch.tensor([0, 0, 0, 3, 3, 3])]
    assert to_bytes(values[0]) == to_bytes(values[1])


def test_a_file_outside_the_store_describes_itself(file):
    path, loader = file
    loaded, description = loader(path)
    assert description.env == "lunar-lander"
    assert description.settings == ("engine-power=1x", "engine-power=1.25x")
    state = from_bytes(path.read_bytes())["state"]
    assert all(torch.equal(tensor, state[name]) for name, tensor in loaded.state_dict().items())


def test_the_kind_of_a_file_is_checked(file):
    path, _ = file
    other = {"reward": "policy", "policy": "reward"}[path.stem]
    with pytest.raises(UsageError, match=f"is a {path.stem}, not a {other}"):
        load(path, other)
    change(path, kind="picture")
    with pytest.raises(IntegrityError, match="unknown kind"):
        load(path, path.stem)


def test_a_newer_schema_is_named(file):
    path, loader = file
    change(path, schema=99)
    with pytest.raises(NewerFormat, match="99"):
        loader(path)


def test_tensors_that_do_not_fit_the_description_are_refused(file):
    path, loader = file
    state = from_bytes(path.read_bytes())["state"]
    name, tensor = next(iter(state.items()))
    for wrong in ({}, {**state, name: torch.zeros(7, 7)}, {**state, "more": tensor}):
        change(path, state=wrong)
        with pytest.raises(IntegrityError, match="do not fit its description"):
            loader(path)


def test_a_flipped_bit_in_a_loose_file_is_found(tmp_path):
    """Torch itself does not compare the archive's checksums."""
    data = bytearray(to_bytes({"weights": torch.arange(1000, dtype=torch.float64)}))
    place = bytes(data).index(torch.arange(1000, dtype=torch.float64).numpy().tobytes())
    data[place + 100] ^= 1
    with pytest.raises(ValueError, match="checksum"):
        from_bytes(bytes(data))


@pytest.mark.parametrize(
    ("raised", "reported"),
    [
        (KeyError("model"), IntegrityError),
        (MemoryError(), MemoryError),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory"), MemoryError),
        (StageFailed("a worker process died", "run the same command again"), StageFailed),
    ],
)
def test_only_a_checkpoint_that_does_not_fit_is_called_so(tmp_path, raised, reported):
    """Too little memory says nothing about the checkpoint."""
    with pytest.raises(reported), fitting(tmp_path):
        raise raised


class LongTraining:
    """As much of a training as :func:`run_training` asks for: the metrics of very many rounds."""

    ROW: ClassVar[dict] = {
        "round": 10**6,
        "setting": "mass=0.5x",
        "true_return": 1 / 3,
        "progress": float("nan"),
    }

    def __init__(self, rows: int):
        self.rows = [self.ROW] * rows
        self.steps = self.planned_steps = 1

    def state_dict(self) -> dict[str, Any]:
        return {"steps": 1}

    def load_state_dict(self, state: dict[str, Any], rows: list[dict]) -> None:
        assert state == {"steps": 1}
        self.rows = rows

    def run(self, after_round, warn) -> list[dict]:
        after_round(self, self.rows[-1:])
        return self.rows


class Saved:
    """Checkpoints in memory."""

    data: bytes | None = None

    def load(self) -> bytes | None:
        return self.data

    def discard(self, reason: str) -> None:
        raise AssertionError(reason)

    def offer(self, state) -> None:
        self.data = state()


def test_the_metrics_of_a_long_run_fit_into_its_checkpoint(tmp_path):
    """Paper budgets of many settings and rounds: the index of a tensor file is capped at 4 MiB."""
    saved = Saved()
    job = Job(None, {}, tmp_path / "key" / "out", saved, Silent())
    rows = run_training(job, LongTraining(100_000))
    assert len(saved.data) > 8 << 20
    restored = run_training(job, LongTraining(0))
    assert len(restored) == len(rows) and repr(restored[-1]) == repr(LongTraining.ROW)


def test_a_checkpoint_larger_than_a_foreign_file_may_be_is_read():
    """Nothing unpacks to more than was read, so its size alone is no reason to refuse it."""
    state = {"past": torch.zeros((257 << 20) // 8, dtype=torch.float64)}
    data = to_bytes(state)
    del state
    assert len(from_bytes(data)["past"]) == (257 << 20) // 8


def test_running_out_of_memory_says_nothing_about_a_file(irl, store_copy, tmp_path, monkeypatch):
    def exhausted(*_, **__):
        raise MemoryError

    data = to_bytes({"x": torch.zeros(3)})
    monkeypatch.setattr(torch, "load", exhausted)
    with pytest.raises(MemoryError):
        from_bytes(data)
    (tmp_path / "reward.pt").write_bytes(data)
    result = irl(
        *("transfer", "--reward", tmp_path / "reward.pt", "--ood", "2x"),
        *("--store", store_copy.path),
    )
    assert result.code == 1
    assert "error: out of memory" in result.err and "hint: " in result.err
    assert "defect" not in result.err and "not a file of a reward" not in result.err
