"""A store with the chain of a gridworld, and the states that interrupted stages leave."""

import functools
import shutil
from pathlib import Path
from typing import Any

import pytest
from chains import CHAIN, GRIDWORLD, SMOKE

from irlcli.data.tensors import from_bytes
from irlcli.experiments import provenance, runner
from irlcli.store import Store
from irlcli.store.durable import remove
from irlcli.store.scratch import Scratch


@pytest.fixture(scope="session")
def maze_store(tmp_path_factory, run_irl) -> Path:
    """Gridworld demonstrations and a MaxEnt reward, made with ``--profile smoke``."""
    store = tmp_path_factory.mktemp("mazes") / "runs"
    for line in GRIDWORLD:
        done = run_irl([*line, *SMOKE, "--quiet", "--store", str(store)])
        assert done.code == 0, done.err
    return store


def first_state(run_irl, store: Path, name: str, line: list[str]) -> dict[str, Any]:
    """The state of the first checkpoint of ``line``, which makes the artefact ``name`` anew."""
    made = Store(store).resolve(name).artefact
    (store / ".keys" / made.manifest.record.key).unlink()
    remove(made.directory)
    saved = []
    save = Scratch.save

    def kept(scratch: Scratch, data: bytes) -> None:
        saved.append(data)
        save(scratch, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Scratch, "save", kept)
        # Stages of the smoke profile end sooner than in the usual time between two checkpoints.
        patch.setattr(runner, "Runner", functools.partial(runner.Runner, checkpoint_seconds=0.0))
        done = run_irl([*line, *SMOKE, "--quiet", "--store", str(store)])
    assert done.code == 0, done.err
    _, state = provenance.decode(saved[0])
    return from_bytes(state)


@pytest.fixture(scope="session")
def transfer_state(smoke_store, copied, tmp_path_factory, run_irl) -> dict[str, Any]:
    """The state of a policy that has been retrained for a round."""
    store = copied(smoke_store.path, tmp_path_factory.mktemp("interrupted") / "runs")
    return first_state(run_irl, store, smoke_store.transfer, CHAIN[2])


@pytest.fixture(scope="session")
def maxent_state(maze_store, tmp_path_factory, run_irl) -> dict[str, Any]:
    """The state of a gridworld's reward that has been learned for a few iterations."""
    store = tmp_path_factory.mktemp("interrupted") / "mazes"
    shutil.copytree(maze_store, store, symlinks=True)
    return first_state(run_irl, store, "maxent", GRIDWORLD[1])
