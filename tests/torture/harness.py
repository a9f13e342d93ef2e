"""Shared by the torture scripts: the real command line in child processes with injected faults.

A script re-runs itself with `faults.c` preloaded, loads the heavy libraries once, and forks a
child for every command: the code under test is the product's own, from `main()` down to the system
call, and a trial costs no import. Faults come from a preloaded library and not from patches in
Python, because libraries that write by themselves (pyarrow) and the interpreter go through it too;
it needs a C compiler, which installing the project needs anyway.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import json
import os
import pkgutil
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent.parent))  # test the checkout that contains this script
SHIM = "IRL_TORTURE_SHIM"
KILL = 0  # the shim's action; any other is an errno


class Fault(NamedTuple):
    """The call at which a fault is injected.

    Only ``calls`` (names) are counted, all if empty; those below the folder ``spared`` are not.
    """

    at: int = -1
    action: int = KILL
    persist: bool = False
    calls: tuple[str, ...] = ()
    clock: int = 0  # seconds added to the time of day
    spared: Path | None = None


class Ended(NamedTuple):
    """How a child ended: exit code (negative: the signal), stdout and stderr."""

    code: int
    out: str
    err: str


def preload() -> None:
    """Build the shim and start this script again with it, unless it is loaded already."""
    if SHIM in os.environ:
        return
    if shutil.which("cc") is None:
        sys.exit("the torture needs a C compiler: install cc")
    with tempfile.TemporaryDirectory(prefix="irl-torture-") as build:
        shim = os.path.join(build, "faults.so")
        command = ["cc", "-shared", "-fPIC", "-O1", "-o", shim, str(HERE / "faults.c"), "-ldl"]
        subprocess.run(command, check=True)
        environment = {**os.environ, SHIM: shim, "LD_PRELOAD": shim, "OMP_NUM_THREADS": "1"}
        sys.exit(subprocess.run([sys.executable, *sys.argv], env=environment).returncode)


def warm_up() -> None:
    """Load what the stages import once, before forking: else imports are most of a trial's time."""
    import torch
    import torch._dynamo  # the first optimiser imports it, which takes a second

    import irlcli

    torch.set_num_threads(1)
    for module in pkgutil.walk_packages(irlcli.__path__, "irlcli."):
        if module.name.split(".")[1] in ("cli", "data", "report", "requests", "rl", "stages"):
            importlib.import_module(module.name)


class Child:
    """A forked child that runs ``irl ARGUMENTS``; checkpoints after every round."""

    def __init__(self, store: Path, arguments: Sequence[str], fault: Fault = Fault()):
        self._log = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            self._run([*arguments, "--store", str(store)], store, fault)

    def _run(self, arguments: list[str], store: Path, fault: Fault) -> None:
        code = 70
        try:
            for number, log in zip((1, 2), self._log, strict=True):
                os.dup2(log.fileno(), number)
            from irlcli.cli import main as cli
            from irlcli.experiments import runner

            # Smoke stages last a second: without this they would write no checkpoints.
            runner.Runner = functools.partial(runner.Runner, checkpoint_seconds=0.0)
            sys.argv = ["irl", *arguments]
            calls = f",{','.join(fault.calls)}," if fault.calls else ""
            ctypes.CDLL(os.environ[SHIM]).faults_arm(
                os.fsencode(store),
                ctypes.c_long(fault.at),
                fault.action,
                int(fault.persist),
                calls.encode(),
                os.fsencode(fault.spared or ""),
                ctypes.c_long(fault.clock),
            )
            try:
                cli.main()
                code = 0
            except SystemExit as stop:
                code = stop.code or 0
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)

    def ended(self) -> bool:
        """Whether it has ended. Neither waits for it nor reaps it."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def kill(self) -> None:
        os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> Ended:
        status = os.waitpid(self.pid, 0)[1]
        texts = []
        for log in self._log:
            log.seek(0)
            texts.append(log.read().decode("utf-8", "replace"))
            log.close()
        return Ended(os.waitstatus_to_exitcode(status), *texts)


def irl(store: Path, *arguments: str, fault: Fault = Fault()) -> Ended:
    """Run ``irl ARGUMENTS`` in a child process."""
    return Child(store, arguments, fault).wait()


def must(ended: Ended, code: int = 0) -> Ended:
    assert ended.code == code, f"exit code {ended.code} instead of {code}: {ended.err}"
    assert "this is a defect" not in ended.err and "Traceback" not in ended.err, ended.err
    return ended


SMOKE = ("--profile", "smoke", "--quiet")
LANDER = ("--env", "lunar-lander", "--intervention", "engine-power=1x,1.25x")
GRID = ("--env", "gridworld", "--intervention", "path-group=1,2,3", "--episodes", "20,5,2")
_MAXENT = ("--set", "maxent.iterations=52", "--set", "maxent.held_out=1")
_AIRL = ("--set", "airl.total_steps=3072", "--set", "airl.ppo.rollouts_per_round=1")
STAGES: dict[str, tuple[str, ...]] = {
    "grid": ("collect-experts", *GRID),
    "train-maxent": ("train-maxent", "--demos", "grid", "--method", "irm", *_MAXENT),
    "collect-experts": ("collect-experts", *LANDER, "--set", "expert.total_steps=3072"),
    "train-airl": ("train-airl", "--demos", "collect-experts", "--method", "irm", *_AIRL),
    "transfer": ("transfer", "--reward", "train-airl", "--ood", "1.5x"),
    "evaluate": ("evaluate", "--policy", "transfer", "--episodes", "1"),
}


def command(stage: str) -> list[str]:
    """The command line of a stage; its artefact is named after the stage."""
    return [*STAGES[stage], *SMOKE, "--name", stage]


class Chain:
    """A store before and after each stage of an undisturbed run."""

    def __init__(self, root: Path, stages: Sequence[str] = tuple(STAGES)):
        from irlcli.store import Store

        self.before: dict[str, Path] = {}
        self.ids: dict[str, list[str]] = {}
        self.seconds: dict[str, float] = {}
        self.whole = root / "whole"
        for stage in stages:
            self.before[stage] = root / f"before-{stage}"
            if self.whole.exists():
                shutil.copytree(self.whole, self.before[stage], symlinks=True)
            begin = time.monotonic()
            must(irl(self.whole, *command(stage)))
            self.seconds[stage] = time.monotonic() - begin
            self.ids[stage] = Store(self.whole).ids()

    def fresh(self, stage: str, root: Path) -> Path:
        """A copy of the store before ``stage``."""
        if root.exists():
            shutil.rmtree(root)
        if self.before[stage].exists():
            shutil.copytree(self.before[stage], root, symlinks=True)
        return root

    def assert_sound(self, stage: str, root: Path) -> None:
        """Whatever readers can see is whole, and equal to the undisturbed run."""
        from irlcli.store import Store

        if not (root / "STORE").exists():
            return
        store = Store(root)
        ids = store.ids()
        assert store.verify(ids).damaged == {}
        assert set(ids) <= set(self.ids[stage]), (ids, self.ids[stage])
        assert set(store.names().values()) <= set(ids)

    def assert_completes(self, stage: str, root: Path) -> None:
        """The same command gives the same bytes, and gc removes all leftovers."""
        from irlcli.store import Store

        must(irl(root, *command(stage)))
        self.assert_sound(stage, root)
        store = Store(root)
        assert store.ids() == self.ids[stage]
        assert store.names()[stage] == Store(self.whole).names()[stage]
        assert list((root / ".quarantine").iterdir()) == []
        must(irl(root, "gc", "--delete", "--grace-days", "0"))
        assert store.ids() == self.ids[stage]
        assert list((root / ".work").iterdir()) == []
        for directory in (root, root / ".keys", root / ".names"):
            known = {".keys", ".names", ".work", ".locks", ".quarantine"}
            assert {p.name for p in directory.iterdir() if p.name[0] == "."} <= known


def figures(theme: str, values: dict[str, Any]) -> None:
    """Print measurements, one per line, and then all of them as JSON."""
    for name, value in values.items():
        print(f"{theme}: {name}: {value}", flush=True)
    print(json.dumps({"theme": theme, **values}), flush=True)


def seeded() -> random.Random:
    """A random generator with the seed TORTURE_SEED, by default 0."""
    return random.Random(int(os.environ.get("TORTURE_SEED", "0")))
