"""``examples/own-environment/run.sh``: from an own environment to a report, and out to other tools."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "own-environment"
WARM = Path(__file__).parent / "warm_python.py"


@pytest.fixture
def python(tmp_path):
    """A Python without the cost of imports."""
    socket, program = tmp_path / "socket", tmp_path / "python"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -S {WARM} run {socket} "$@"\n')
    program.chmod(0o755)
    server = subprocess.Popen([sys.executable, WARM, "serve", socket], stdout=subprocess.PIPE)
    assert server.stdout is not None and server.stdout.readline() == b"ready\n"
    yield program
    server.kill()
    server.wait()
    server.stdout.close()


def test_the_example_runs_from_another_directory(tmp_path, python):
    done = subprocess.run(
        [EXAMPLE / "run.sh", "out", "smoke", "--methods", "irm", "--seeds", "0", "--quiet"],
        cwd=tmp_path,
        env={
            **os.environ,
            "IRL": f"{python} -m irlcli",
            "PYTHON": str(python),
            "WARM_PYTHON": str(python),
        },
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr
    assert "SAC on the reward irm: true return" in done.stdout
    report = tmp_path / "out" / "report"
    assert "cart" in (report / "README.md").read_text()
    assert (report / "cart.html").is_file()
    # An environment of 40 lines.
    assert len((EXAMPLE / "cart.py").read_text().splitlines()) <= 40
