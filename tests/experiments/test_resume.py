"""Killed and interrupted stages resume, and end in the same bytes as uninterrupted ones."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from irlcli.experiments.runner import Runner
from irlcli.store import Store

# The real stages at the smoke profile, checkpointing after every round; prints the id.
CHAIN = """
import sys
import msgspec
from irlcli.cli.console import TerminalConsole
from irlcli.interventions import parse_setting, parse_settings
from irlcli.experiments.runner import Runner
from irlcli.configs import load_config
from irlcli.stages.base import From
from irlcli.stages import collect_experts, train_airl, train_expert, transfer

def request(stage):
    config = load_config("lunar-lander", "smoke")
    settings = parse_settings("lunar-lander", "engine-power=1x,1.25x")
    if stage == "expert":
        return train_expert.request("lunar-lander", settings[0], 0, config.expert)
    demos = collect_experts.request("lunar-lander", settings, config)
    if stage == "collect-experts":
        return demos
    # Each of the rounds is scored, so that the best one has to outlive the kill too.
    airl = msgspec.structs.replace(config.airl, select="episodes", select_every=1)
    reward = train_airl.request(From(demos), "lunar-lander", settings, airl, seed=3)
    if stage == "train-airl":
        return reward
    setting = parse_setting("lunar-lander", "engine-power=1.5x")
    return transfer.request(
        From(reward, "reward.pt"), "lunar-lander", setting, config.transfer, seed=3
    )
"""
RUN = (
    CHAIN
    + """
runner = Runner(sys.argv[1], TerminalConsole(), command=["irl", "test"], checkpoint_seconds=0.0)
print(runner.run(request(sys.argv[2])).manifest.id)
"""
)


def start(store, stage):
    return subprocess.Popen(
        [sys.executable, "-c", RUN, str(store), stage],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run_here(store, stage, *console):
    """The artefact of ``stage``, made in this process."""
    namespace = {}
    exec(CHAIN, namespace)
    return Runner(store, *console).run(namespace["request"](stage))


def finish(process):
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return output.strip()


def checkpoints(store):
    """Paths and modification times of all checkpoints now."""
    found = {}
    for path in Path(store).glob(".work/*/checkpoint"):
        with contextlib.suppress(FileNotFoundError):
            found[path] = path.stat().st_mtime_ns
    return found


def kill_after_checkpoint(store, process, resumed=False):
    """SIGKILL the process right after it wrote a checkpoint; False if it ended before.

    The checkpoint is the first one of a stage, or, with ``resumed``, any.
    """
    before = checkpoints(store)
    while process.poll() is None:
        now = checkpoints(store)
        if now.keys() - before.keys() or (resumed and now != before):
            os.kill(process.pid, signal.SIGKILL)
            process.communicate()
            return True
        time.sleep(0.001)
    process.communicate()
    return False


def test_killed_stages_end_in_the_same_bytes(tmp_path):
    undisturbed = run_here(tmp_path / "a", "transfer").manifest.id
    run_here(tmp_path / "b", "expert")
    # The other expert, AIRL twice, and the retrained policy. One round at least is left after each
    # kill, so that resuming is what finishes it.
    for resumed in (False, False, True, False):
        process = start(tmp_path / "b", "transfer")
        assert kill_after_checkpoint(tmp_path / "b", process, resumed)
    assert run_here(tmp_path / "b", "transfer").manifest.id == undisturbed
    a, b = Store(tmp_path / "a"), Store(tmp_path / "b")
    assert a.ids() == b.ids()
    assert not b.verify(b.ids()).damaged
    resumed = {a.manifest.record.stage for a in b.artefacts() if a.provenance()["resumed"]}
    assert resumed == {"train-expert", "train-airl", "transfer"}
    assert not any(artefact.provenance()["resumed"] for artefact in a.artefacts())


def irl(*arguments):
    return [sys.executable, "-m", "irlcli", *arguments]


def interrupted(arguments):
    """Exit code and stderr of a command that gets SIGINTs from when it is at work until it ends."""
    process = subprocess.Popen(
        irl(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    line = process.stderr.readline()
    while not line.startswith("RUN"):
        line = process.stderr.readline()
    time.sleep(3.0)  # past the imports, into the episodes
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
        time.sleep(0.002)
    _, errors = process.communicate(timeout=400)
    return process.returncode, errors


def test_a_stage_without_rounds_answers_ctrl_c_too(tmp_path):
    """While a key is held down: signals during the exit change nothing."""
    arguments = ["evaluate", "--random", "--env", "lunar-lander", "--intervention", "bounce=0.9"]
    arguments += ["--episodes", "1500", "--store", str(tmp_path / "runs")]
    code, errors = interrupted(arguments)
    assert code == 130
    assert "error:" in errors and "hint:" in errors and "Traceback" not in errors


def test_a_foreign_input_that_changes_after_planning_is_noticed(tmp_path):
    from irlcli.configs import load_config
    from irlcli.errors import IntegrityError
    from irlcli.experiments.inputs import foreign_source
    from irlcli.interventions import parse_settings
    from irlcli.stages import evaluate

    path = tmp_path / "policy.pt"
    path.write_bytes(b"one")
    config = load_config("lunar-lander", "smoke")
    request = evaluate.request(
        "lunar-lander",
        parse_settings("lunar-lander", "bounce=0.9"),
        config.evaluation,
        foreign_source(path),
    )
    path.write_bytes(b"two")
    with pytest.raises(IntegrityError, match=r"policy\.pt changed"):
        Runner(tmp_path / "runs").run(request)


def test_a_damaged_checkpoint_is_reported_and_not_used(tmp_path):
    process = start(tmp_path, "collect-experts")
    assert kill_after_checkpoint(tmp_path, process)
    (path,) = checkpoints(tmp_path)
    path.write_bytes(path.read_bytes()[:-1] + b"\x00\x01")
    warnings = []

    class Console:
        def __getattr__(self, name):
            return lambda *arguments, **keywords: None

        def warn(self, message):
            warnings.append(message)

    artefact = run_here(tmp_path, "collect-experts", Console())
    assert any("damaged" in w and "starting over" in w for w in warnings)
    assert artefact.manifest.id == run_here(tmp_path / "other", "collect-experts").manifest.id


def test_processes_that_ask_for_the_same_artefact_share_the_work(tmp_path):
    processes = [start(tmp_path, "collect-experts") for _ in range(2)]
    ended = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], ended
    assert len({out for out, _ in ended}) == 1
    store = Store(tmp_path)
    # Two experts and the dataset, each made once.
    assert sum(errors.count("RUN ") for _, errors in ended) == len(store.ids()) == 3
    assert not list(tmp_path.glob(".work/*"))
    assert not store.verify(store.ids()).damaged
