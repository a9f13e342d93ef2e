"""Tensor files: round trips, equal bytes, and files that do not fit are named."""

import shutil

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
