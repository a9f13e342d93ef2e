"""Interruptions, streams that nobody reads, and text that would drive a terminal."""

import contextlib
import io
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from chains import CHAIN, GRIDWORLD, SMOKE, assert_refused

from irlcli.cli import console
from irlcli.cli import main as cli


def test_text_of_an_artefact_does_not_drive_the_terminal(irl, empty_store, publish):
    """Control characters in parameters, references and warnings are replaced."""
    made = publish(empty_store, parameters={"env": "\x1b[2J\x9b31m", "setting": "a\nb"}).artefact
    listed = irl("ls", "--store", empty_store.root)
    assert made.id in listed.out and len(listed.out.splitlines()) == 2
    ref = irl("show", "\x1b[2J\u202e\nerror: forged", "--store", empty_store.root)
    assert_refused((ref.code, ref.out, ref.err), 3, "[2J")
    shown = io.StringIO()
    with contextlib.redirect_stderr(shown):
        console.TerminalConsole().warn("a\x1b[2Jb\nerror: forged")
    assert shown.getvalue() == "warning: a?[2Jb?error: forged\n"


class InterruptingStream(io.StringIO):
    """A stderr that sends SIGINT to its own process when ``trigger`` is first written."""

    def __init__(self, trigger: str):
        super().__init__()
        self.trigger = trigger

    def write(self, text: str) -> int:
        if self.trigger and self.trigger in text:
            self.trigger = ""
            signal.raise_signal(signal.SIGINT)
        return super().write(text)


ENDLESS = "9000000000"


INTERRUPTED = {
    "train-expert": (
        [*CHAIN[0], "--seed", "3", "--set", f"expert.total_steps={ENDLESS}"],
        "checkpoint",
    ),
    "train-airl": ([*CHAIN[1], "--set", f"airl.total_steps={ENDLESS}"], "checkpoint"),
    "transfer": ([*CHAIN[2], "--set", f"transfer.total_steps={ENDLESS}"], "checkpoint"),
    "collect-experts": ([*CHAIN[0], "--seed", "3"], "stopped after"),
    "evaluate": (["evaluate", "--policy", "airl", "--ood", "1.7x,1.8x"], "stopped after"),
    "train-maxent": ([*GRIDWORLD[1], "--set", f"maxent.iterations={ENDLESS}"], "checkpoint"),
}


@pytest.mark.parametrize("stage", INTERRUPTED)
def test_ctrl_c_at_every_stage(monkeypatch, irl, store_copy, maze_store, tmp_path, stage):
    """Exit code 130, with a checkpoint if the stage has rounds; other stages finish first."""
    line, reported = INTERRUPTED[stage]
    store = store_copy.path
    if stage == "train-maxent":
        store = tmp_path / "mazes"
        shutil.copytree(maze_store, store, symlinks=True)
    line = [*line, *SMOKE, "--store", str(store)]
    stream = InterruptingStream(f"  {stage} ")  # The first report of progress.
    out = io.StringIO()
    monkeypatch.setattr(sys, "argv", ["irl", *line])
    with (
        contextlib.redirect_stderr(stream),
        contextlib.redirect_stdout(out),
        pytest.raises(SystemExit) as stop,
    ):
        cli.main()
    err = stream.getvalue()
    assert (stop.value.code, out.getvalue()) == (130, ""), err
    assert "Traceback" not in err and "hint: run the same command again" in err
    (message,) = (text for text in err.splitlines() if text.startswith("error: "))
    assert reported in message
    planned = irl(*line, "--dry-run").out
    assert planned.startswith("RESUME" if reported == "checkpoint" else "HIT"), planned


IRL = f"{sys.executable} -m irlcli"


@pytest.mark.parametrize(
    ("text", "codes"),
    [
        ("{irl} ls --store {store} | head -0", (0, 141)),
        ("{irl} show airl --store {store} | true", (141,)),
        ("{irl} lineage score --store {store} --json | true", (141,)),
        ("{irl} --help | true", (0, 1, 141)),
        ("{irl} nonsense --json | true", (2,)),
        ("{irl} nonsense 2>&1 >/dev/null | true", (2,)),
        ("{irl} verify --store {store} >&-", (0,)),
        ("{irl} ls --store {store} 2>&-", (0,)),
        ("{irl} nonsense >&- 2>&-", (2,)),
        (
            "{irl} evaluate --policy moved --ood 1.5x --profile smoke --store {store} <&- >&- 2>&-",
            (0,),
        ),
        (
            "{irl} evaluate --policy moved --ood 1.5x --profile smoke --store {store} 2>&1 | true",
            (141,),
        ),
        ("{irl} show airl --store {store} > /dev/full", (1,)),
    ],
)
def test_streams_that_nobody_reads(smoke_store, text, codes):
    """Closed pipes, closed descriptors and a full device: no traceback, a sensible exit code."""
    line = text.format(irl=IRL, store=smoke_store.path)
    done = subprocess.run(
        ["bash", "-c", f"{line}\necho CODE ${{PIPESTATUS[0]}}"], capture_output=True, text=True
    )
    written = done.stdout + done.stderr
    for word in ("Traceback", "Exception ignored", "BrokenPipe", "this is a defect"):
        assert word not in written
    assert int(written.rpartition("CODE ")[2].split()[0]) in codes, written
    if "full" not in text:
        assert done.stderr == ""


def test_paths_are_printed_as_their_bytes_whatever_the_streams_can_encode(
    smoke_store, copied, tmp_path
):
    store = os.fsencode(tmp_path) + b"/store \xc3\xa9"
    copied(smoke_store.path, Path(os.fsdecode(store)))
    line = [*CHAIN[3], *SMOKE, "--quiet", "--store", store]
    for name in ("UTF-8", "ascii"):
        done = subprocess.run(
            [sys.executable, "-m", "irlcli", *line],
            capture_output=True,
            env={**os.environ, "PYTHONIOENCODING": name},
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout == store + b"/" + smoke_store.evaluation.encode() + b"\n"
