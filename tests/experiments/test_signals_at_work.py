"""What signals and slow checkpoints do to work that is nearly finished or has just begun."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys

import msgspec
import pytest

from irlcli.errors import Interrupted
from irlcli.experiments import checkpoints
from irlcli.experiments.runner import Runner, Silent
from irlcli.experiments.signals import STOPPING, stop_requests
from irlcli.stages.base import Request, Stage
from irlcli.store import Store


class Nothing(msgspec.Struct, frozen=True):
    pass


def one_line(job):
    (job.output / "text").write_text("done\n")


@pytest.fixture(autouse=True)
def heard():
    """nohup makes the tests, and their children, deaf to SIGHUP."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", STOPPING)
def test_a_signal_while_an_artefact_is_published_loses_no_work(tmp_path, monkeypatch, number):
    publish = Store.publish

    def signalled(*arguments):
        os.kill(os.getpid(), number)
        return publish(*arguments)

    request = Request(Stage("one-line", 1, one_line), Nothing(), {}, "a line")
    monkeypatch.setattr(Store, "publish", signalled)
    with pytest.raises(Interrupted):
        Runner(tmp_path / "runs").run(request)
    monkeypatch.setattr(Store, "publish", publish)
    [artefact] = Store(tmp_path / "runs").index().artefacts.values()
    assert (artefact.directory / "text").read_text() == "done\n"


def test_an_artefact_that_cannot_be_published_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    request = Request(Stage("one-line", 1, one_line), Nothing(), {}, "a line")
    monkeypatch.setattr(Store, "publish", full)
    with pytest.raises(Exception, match="No space left"):
        Runner(tmp_path / "runs").run(request)
    assert not [*(tmp_path / "runs").rglob("text")]


def test_a_checkpoint_that_takes_long_is_followed_by_as_much_work_as_any(tmp_path, monkeypatch):
    """Rounds of 2 s, 10 s between two checkpoints, 25 s for each."""
    now, saved = [0.0], []
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])

    class Scratch:
        def load(self):
            return None

        def save(self, data):
            now[0] += 25.0
            saved.append(data)

    kept = checkpoints.StageCheckpoints(Scratch(), Silent(), 10.0)
    for _ in range(20):
        now[0] += 2.0
        kept.offer(lambda: b"state")
    assert len(saved) == 4


def test_a_signal_that_the_shell_ignores_stays_ignored():
    before, asked = signal.signal(signal.SIGINT, signal.SIG_IGN), []
    try:
        with stop_requests(lambda: asked.append("stop")):
            os.kill(os.getpid(), signal.SIGINT)
            assert not asked
            os.kill(os.getpid(), signal.SIGTERM)
        assert asked == ["stop"] and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


WORK_IN_A_TERMINAL = """
import sys
from irlcli.experiments.signals import stop_requested, stop_requests

with stop_requests(lambda: print("asked to stop", file=sys.stderr, flush=True)):
    print("at work", flush=True)
    while not stop_requested():
        pass
    print("the checkpoint is written", flush=True)
    open(sys.argv[1], "w").write("whole")
"""


def test_work_ends_in_order_after_its_terminal_has_closed(tmp_path):
    terminal, end = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", WORK_IN_A_TERMINAL, str(tmp_path / "checkpoint")],
        stdout=end,
        stderr=end,
        start_new_session=True,
    )
    os.close(end)
    assert b"at work" in os.read(terminal, 100)
    os.close(terminal)
    process.send_signal(signal.SIGHUP)
    try:
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()
    assert (tmp_path / "checkpoint").read_text() == "whole"
