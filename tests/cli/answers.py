"""Command lines for tests, and what every error owes the person who made it."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

LANDER = "--env lunar-lander --intervention engine-power=1x"
_STAGES = ("collect-experts", "train-airl", "transfer", "evaluate")


def assert_answered(result, code: int, named: str, as_json: bool = False) -> str:
    """What every error owes the person who made it; returns the error line."""
    assert "Traceback" not in result.err
    assert "this is a defect" not in result.err, result.err
    assert result.code == code, result.err
    lines = result.err.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert len(errors) == 1, result.err
    assert named in errors[0]
    assert len(errors[0]) < 1000
    assert lines[-1].startswith("hint: ") and lines[-1] != "hint: ", result.err
    if as_json:
        document = json.loads(result.out)  # exactly one
        assert (document["kind"], document["exit_code"]) == ("error", code)
        assert named in document["message"] and document["hint"]
        assert isinstance(document["version"], int)
    else:
        assert result.out == ""
    return errors[0]


def arguments(text: str, store: Path) -> list[str]:
    """A command line against ``store``, with the budgets of the smoke profile."""
    words = shlex.split(text)
    if words[0] in _STAGES and "--profile" not in words:
        words += ["--profile", "smoke"]
    if not words[0].startswith("-"):
        words += ["--store", str(store)]
    return words


def snapshot(store: Path) -> set[str]:
    """Every file of a store except its locks, which readers may create, too."""
    return {
        str(p.relative_to(store))
        for p in store.rglob("*")
        if ".locks" not in p.parts and p.is_file()
    }


def flip_last(path: Path) -> None:
    data = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))


def halve(path: Path) -> None:
    path.chmod(0o644)
    os.truncate(path, path.stat().st_size // 2)


IRL = [sys.executable, "-m", "irlcli"]


class Done:
    """A finished process, in the form of ``run_main``'s results."""

    def __init__(self, line: list[str], **options):
        done = subprocess.run([*IRL, *line], capture_output=True, text=True, timeout=120, **options)
        self.code, self.out, self.err = done.returncode, done.stdout, done.stderr
