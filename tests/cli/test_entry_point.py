"""The entry point as a process: help, completion, signals, closed pipes."""

from __future__ import annotations

import json
import os
import signal
import subprocess

import pytest
from answers import IRL, LANDER, Done, arguments, assert_answered

from irlcli import __version__
from irlcli.cli.app import COMMANDS
from irlcli.envs.registry import ENVIRONMENTS
from irlcli.methods import METHODS
from irlcli.store import Store


def test_without_arguments(irl):
    """Nothing asked for: the help, whole and on stdout, as with --help."""
    result = irl()
    assert (result.code, result.err) == (0, "")
    assert result.out == irl("--help").out and "collect-experts" in result.out


def test_help_fits_a_terminal_of_80_columns(irl):
    """Every command with its whole line of help: nothing is cut, nothing is wider."""
    lines = irl("--help").out.splitlines()
    assert max(map(len, lines)) < 80
    shown = " ".join(" ".join(lines).split())
    for name, (_, line) in COMMANDS.items():
        assert f"{name} {line}" in shown
    assert "..." not in shown.partition("Commands:")[2]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_that_begins_with_its_line_in_the_list(irl, name):
    result = irl(name, "--help")
    assert (result.code, result.err) == (0, "")
    assert f"Usage: irl {name} [OPTIONS]" in result.out
    assert COMMANDS[name][1] in " ".join(result.out.split())
    assert "--store" in result.out and "--json" in result.out


def test_version(irl):
    assert irl("--version") == (0, f"irlcli {__version__}\n", "")


def completed(*words: str) -> list[str]:
    """What bash is offered for the last of ``words``."""
    variables = {
        "_IRL_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    done = Done([], env={**os.environ, **variables})
    assert (done.code, done.err) == (0, "")
    return done.out.split()


def test_the_shell_completes_commands():
    assert set(completed("irl", "")) == set(COMMANDS)
    assert completed("irl", "train-") == ["train-airl", "train-maxent"]


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["train-airl", "--method", ""], list(METHODS)),
        (["train-airl", "--method", "erm-"], ["erm-balanced"]),
        (["train-airl", "--penalty", "i"], ["irmv1", "iga", "input-gradient"]),
        (["train-maxent", "--method", "g"], ["group-dro"]),
        (["train-maxent", "--penalty", "c"], ["closed-form"]),
        (["train-airl", "--grouping", "per"], ["per-setting"]),
        (["collect-experts", "--env", ""], list(ENVIRONMENTS)),
        (["evaluate", "--env", "ant", "--profile", "s"], ["smoke", "standard"]),
        (["plan", "table"], ["table1", "table1-5"]),
        (["transfer", "--rew"], ["--reward"]),
    ],
)
def test_the_shell_completes_values(words, offered):
    assert sorted(completed("irl", *words)) == sorted(offered)


def test_completion_can_be_installed(tmp_path):
    # Typer would ask which shell calls, and a service may call without one.
    named = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1", "HOME": str(tmp_path)}
    done = Done(["--show-completion", "bash"], env={**os.environ, **named})
    assert (done.code, done.err) == (0, "") and "_IRL_COMPLETE=complete_bash" in done.out


@pytest.mark.parametrize(
    ("text", "code", "named"),
    [
        ("collect-experts --env lunar-landr --intervention bounce=1", 2, "'lunar-landr'"),
        ("show nothing", 3, "'nothing'"),
        ("report returns demos --json", 2, "'demos'"),
        ("nonsense", 2, "nonsense"),
    ],
)
def test_in_a_process(smoke_store, text, code, named):
    done = Done(arguments(text, smoke_store.path))
    assert_answered(done, code, named, as_json="--json" in text)


def test_in_a_process_the_store_comes_from_the_environment(tmp_path):
    (tmp_path / "STORE").write_text('{"format": 9}')
    done = Done(["ls"], env={**os.environ, "IRL_STORE": str(tmp_path)})
    assert_answered(done, 4, "format 9")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_with_a_checkpoint(irl, tmp_path, number):
    store = tmp_path / "runs"
    text = f"collect-experts {LANDER} --set expert.total_steps=50_000_000"
    line = arguments(text, store)
    process = subprocess.Popen(
        [*IRL, *line], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    shown = []
    for row in process.stderr:
        shown.append(row)
        if " steps " in row:
            process.send_signal(number)
            break
    out, rest = process.communicate(timeout=120)

    class Result:
        code, err = process.returncode, "".join(shown) + rest

    Result.out = out
    assert_answered(Result, 130, "checkpoint")
    planned = irl(*line, "--dry-run")
    assert planned.code == 0 and planned.out.startswith("RESUME  train-expert")
    assert "BLOCKED collect-experts" in planned.out


def test_a_closed_pipe_is_quiet(smoke_store):
    line = arguments("show airl", smoke_store.path)
    process = subprocess.Popen([*IRL, *line], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert (process.wait(), err) == (141, b"")


def test_a_dry_run_prints_every_resolved_parameter(irl, smoke_store):
    """Those that the artefact then has, and those of the steps before it."""
    made = Store(smoke_store.path).resolve("airl").artefact.manifest.record
    where = ["--store", smoke_store.path, "--profile", "smoke", "--dry-run", "--json"]
    line = ["train-airl", "--demos", "demos", "--method", "irm", *where]
    (hit,) = json.loads(irl(*line).out)["steps"]
    assert (hit["status"], hit["key"]) == ("HIT", made.key)
    assert hit["parameters"] == made.parameters
    (new,) = json.loads(irl(*line, "--set", "airl.learning_rate=0.5").out)["steps"]
    assert new["status"] == "RUN" and new["parameters"]["airl"]["learning_rate"] == 0.5
