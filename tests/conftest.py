"""Fixtures shared by all tests: a store made by the real chain, and the real command line."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import io
import json
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Mapping
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import settings

from irlcli.cli import main as command_line
from irlcli.store import KeyRecord, Published, Store

# A shell that starts the tests in the background makes them, and their children, deaf to it.
signal.signal(signal.SIGINT, signal.default_int_handler)


def _keep_temporary_files_in_memory() -> None:
    """Stores sync every file, which on a disk takes a fifth of the tests' time."""
    memory = Path("/dev/shm")
    if "TMPDIR" in os.environ or not os.access(memory, os.W_OK):
        return
    # Containers often have 64 MiB.
    if shutil.disk_usage(memory).free > 4 << 30:
        os.environ["TMPDIR"] = tempfile.tempdir = str(memory)


_keep_temporary_files_in_memory()
# How long an example takes depends on who else uses the machine.
settings.register_profile("irlcli", deadline=None)
settings.load_profile("irlcli")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Leave out, and say so, what fails for want of PyBullet: it has no wheels for new Pythons."""
    report = yield
    missing = "needs PyBullet, which is not installed"
    if report.failed and find_spec("pybullet") is None and missing in report.longreprtext:
        report.outcome = "skipped"
        report.longrepr = str(item.path), item.location[1] or 0, "Skipped: needs PyBullet"
    return report


@dataclass(frozen=True)
class SmokeStore:
    """A store with one chain in it. Shared by the whole session: copy it before changing it.

    The fields but ``path`` are ids; the first four are also named ``demos``, ``airl``, ``moved``
    and ``score`` in the store.
    """

    path: Path
    demos: str
    airl: str
    transfer: str
    evaluation: str
    expert: str  # of engine-power=1x


class Result(NamedTuple):
    """What a command line led to."""

    code: int
    out: str
    err: str


def run_main(arguments: list[str]) -> Result:
    """``irl ARGUMENTS`` in this process, through the real entry point."""
    out, err = io.StringIO(), io.StringIO()
    before, code = sys.argv, 0
    sys.argv = ["irl", *arguments]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            command_line.main()
    except SystemExit as stop:
        code = stop.code or 0
    finally:
        sys.argv = before
        # The command line disables it: it makes little garbage before it ends.
        gc.enable()
        # The command line ignores it from its last message on; here the process lives on.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return Result(code, out.getvalue(), err.getvalue())


def pytest_collection_modifyitems(items):
    """The longest files come first: at the end of a parallel run no worker waits for another."""

    def kind(item):
        long = {"torture", "experiments"} & set(item.path.parts)
        return not long, not item.path.stem.endswith("_chain")

    items.sort(key=kind)


@pytest.fixture(scope="session")
def smoke_store(tmp_path_factory: pytest.TempPathFactory) -> SmokeStore:
    """collect-experts, train-airl (irm), transfer and evaluate with ``--profile smoke``."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # the workers of one run share it: the first one builds for all
    ready, store = base / "smoke.json", base / "smoke-store"
    with open(base / "smoke.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not ready.exists():
            ready.write_text(json.dumps(_build_chain(store)))
    return SmokeStore(store, **json.loads(ready.read_text()))


def _build_chain(store: Path) -> dict[str, str]:
    ids: dict[str, str] = {}
    lander = ["--env", "lunar-lander", "--intervention", "engine-power=1x,1.25x"]
    for field, name, arguments in (
        ("demos", "demos", ["collect-experts", *lander]),
        ("airl", "airl", ["train-airl", "--demos", "demos", "--method", "irm"]),
        ("transfer", "moved", ["transfer", "--reward", "airl/reward.pt", "--ood", "1.5x"]),
        ("evaluation", "score", ["evaluate", "--policy", "moved", "--ood", "1.5x"]),
    ):
        common = ["--store", str(store), "--profile", "smoke", "--quiet", "--name", name]
        done = run_main([*arguments, *common])
        assert done.code == 0, done.err
        ids[field] = Path(done.out.strip()).name
    demos = Store(store).resolve(ids["demos"]).artefact
    (expert,) = Store(store).index().parents(demos)["expert engine-power=1x"]
    return {**ids, "expert": expert.id}


def copy_store(source: Path, to: Path) -> Path:
    """A copy of a store that other workers may be reading."""
    # The mark of a reader comes and goes.
    passing = shutil.ignore_patterns(".reader.*")
    return shutil.copytree(source, to, symlinks=True, ignore=passing)


@pytest.fixture
def store_copy(smoke_store: SmokeStore, tmp_path: Path) -> SmokeStore:
    """A copy of the smoke store that a test may change."""
    path = copy_store(smoke_store.path, tmp_path / "runs")
    return SmokeStore(**{**asdict(smoke_store), "path": path})


@pytest.fixture(scope="session")
def copied() -> Callable[[Path, Path], Path]:
    """:func:`copy_store`, for fixtures that outlive a test."""
    return copy_store


@pytest.fixture(scope="session")
def run_irl() -> Callable[[list[str]], Result]:
    """:func:`run_main`, for fixtures that outlive a test."""
    return run_main


@pytest.fixture
def irl(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """``irl("ls", "--store", path)`` in this process, through the real entry point."""
    monkeypatch.delenv("IRL_STORE", raising=False)
    return lambda *arguments: run_main([str(a) for a in arguments])


@pytest.fixture
def empty_store(tmp_path: Path) -> Store:
    """A new store without artefacts."""
    store = Store(tmp_path / "runs")
    store.create()
    return store


SMALL_FILES = {"reward.pt": bytes(range(256)) * 8, "nested/table.parquet": b"PAR1" * 100}


def publish_files(
    store: Store,
    files: Mapping[str, bytes] = SMALL_FILES,
    *,
    stage: str = "train-airl",
    version: int = 1,
    parameters: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
    places: Mapping[str, str] | None = None,
    environment: Mapping[str, Any] | None = None,
) -> Published:
    """Publish ``files`` as a stage would, without the cost of running one.

    ``inputs`` are contents by role, ``places`` says where they were read, ``environment`` describes
    one from outside the package.
    """
    record = KeyRecord(stage, version, dict(parameters or {"seed": 0}), dict(inputs or {}))
    store.create()
    with store.in_use(), store.working_on(record.key, wait=False) as scratch:
        output = scratch.new_output()
        for name, data in files.items():
            (output / name).parent.mkdir(parents=True, exist_ok=True)
            (output / name).write_bytes(data)
        origin: dict[str, Any] = {"command": ["irl", stage], "inputs": dict(places or {})}
        if environment is not None:
            origin["environment"] = dict(environment)
        return store.publish(record, output, origin)


@pytest.fixture
def publish() -> Callable[..., Published]:
    """:func:`publish_files`."""
    return publish_files
