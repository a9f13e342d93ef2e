"""The example environment in a directory of its own, as a user would work with it."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from irlcli.envs import registration, registry

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "own-environment"


# The cart's mirror image moves as the cart does.
SYMMETRIES = """

def symmetries(settings):
    from irlcli.symmetries import Symmetries

    both = np.array([1.0, -1.0], np.float32)[:, None, None]
    return Symmetries(both * np.eye(2, dtype=np.float32), both)
"""


class Bench(NamedTuple):
    """A directory with ``cart.toml`` and ``cart.py`` in it, where ``irl`` is run.

    ``irl("ls")`` is a new process to the registry; the store is ``runs`` in the directory.
    """

    directory: Path
    irl: Callable

    @property
    def toml(self) -> Path:
        return self.directory / "cart.toml"

    @property
    def module(self) -> Path:
        return self.directory / "cart.py"

    def edit(self, path: Path, old: str, new: str) -> None:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def declare_symmetries(self) -> None:
        self.module.write_text(self.module.read_text() + SYMMETRIES)
        self.edit(self.toml, "[env]", "[env]\nsymmetries = true")


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A process that has imported no environment from outside the package."""
    registry.forget()
    modules = set(sys.modules)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registration, "_imported", {})
    yield
    registry.forget()
    import gymnasium

    gymnasium.registry.pop("Cart-v0", None)
    for name in set(sys.modules) - modules:
        file = getattr(sys.modules[name], "__file__", None) or ""
        if file.startswith(str(Path.cwd())) or name == "cart":
            del sys.modules[name]


@pytest.fixture
def bench(tmp_path, monkeypatch, fresh, run_irl) -> Bench:
    """The example, copied."""
    directory = tmp_path / "bench"
    directory.mkdir()
    for name in ("cart.toml", "cart.py"):
        shutil.copy(EXAMPLE / name, directory / name)
    monkeypatch.chdir(directory)
    monkeypatch.delenv("IRL_STORE", raising=False)

    def irl(*words: str):
        registry.forget()
        return run_irl([str(word) for word in words])

    return Bench(directory, irl)
