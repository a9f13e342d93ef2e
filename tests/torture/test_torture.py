"""The short forms of `make torture`, each script in its own process."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def short(name: str) -> dict:
    """All measurements of a script's short form."""
    done = subprocess.run(
        [sys.executable, str(HERE / f"{name}.py"), "--short"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found: dict = {}
    for line in done.stdout.splitlines():
        if line.startswith("{"):
            found |= json.loads(line)
    return found


needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="faults.c needs a C compiler")


@needs_cc
def test_kills_failing_calls_and_changed_clocks():
    found = short("crash")
    kills = sum(number for name, number in found.items() if "kills" in name)
    assert kills >= 6 and found["refused calls"] >= 6 and found["clocks set"] == 2


@needs_cc
def test_many_processes_beside_gc_and_verify():
    found = short("concurrency")
    assert (
        found["artefacts made or copied"] >= found["artefacts at the end"] > 0
        and found["artefacts collected"] > 0
    )


def test_a_hit_does_not_grow_with_the_store():
    found = short("growth")
    assert "open" in found["a hit opens"] and "list" not in found["a hit opens"]
