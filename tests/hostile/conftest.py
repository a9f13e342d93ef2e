"""A store with the chain of a gridworld."""

from pathlib import Path

import pytest
from chains import GRIDWORLD, SMOKE


@pytest.fixture(scope="session")
def maze_store(tmp_path_factory, run_irl) -> Path:
    """Gridworld demonstrations and a MaxEnt reward, made with ``--profile smoke``."""
    store = tmp_path_factory.mktemp("mazes") / "runs"
    for line in GRIDWORLD:
        done = run_irl([*line, *SMOKE, "--quiet", "--store", str(store)])
        assert done.code == 0, done.err
    return store
