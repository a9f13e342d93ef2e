"""The comparison with other libraries: when a goal is earned, and what the tables say."""

import json
import math
import sys

import pytest

from benchmarks.peers.__main__ import enough, main
from benchmarks.peers.checks import first_kept, share
from benchmarks.peers.ours import requested
from benchmarks.peers.results import read_run, tables, until_text, write
from benchmarks.peers.tasks import METHODS, ROWS, chosen, tasks
from irlcli.errors import Busy, UsageError
from irlcli.store.lock import locked

SETTINGS = {"lunar-lander.engine-power": ["engine-power=1x", "engine-power=1.25x"]}


@pytest.fixture
def record(tmp_path):
    """Writes a run whose student earned ``shares`` of the expert's return; 10 CPU s a check."""

    def written(method, seed, shares, end="limit"):
        about = {
            "method": method,
            "row": "lunar-lander.engine-power",
            "settings": SETTINGS["lunar-lander.engine-power"],
            "seed": seed,
            "targets": [200.0, 100.0],
            "demonstrations": "demos",
            "limit": 60,
            "commit": "abc",
            "machine": "2 cores",
            "versions": {"torch": "2"},
        }
        checks = [
            {"cpu_seconds": 10.0 * k, "steps": 1000 * k, "returns": [200.0 * part, 100.0 * part]}
            for k, part in enumerate(shares, 1)
        ]
        path = tmp_path / f"{method}.{seed}.jsonl"
        path.write_text("".join(json.dumps(x) + "\n" for x in [about, *checks, {"end": end}]))
        return read_run(path)

    return written


def test_a_single_lucky_check_earns_nothing():
    assert first_kept([0.1, 0.95, 0.7, 0.85], 0.9) is None


def test_the_first_of_two_checks_in_a_row_counts():
    assert first_kept([0.95, 0.2, 0.9, 0.97, 0.5], 0.9) == 2


def test_the_last_check_alone_is_not_confirmed():
    assert first_kept([0.1, 0.2, 0.99], 0.9) is None
    assert first_kept([], 0.9) is None


def test_every_setting_counts_the_same():
    assert share([2820.0, 0.0], [2820.0, 100.0]) == 0.5


def test_costs_are_a_median_and_a_range():
    assert until_text([30.0, 10.0, 20.0]) == "20 (10 to 30)"
    assert until_text([1234.0]) == "1,234"


def test_seeds_that_never_got_there_are_counted():
    assert until_text([math.inf, math.inf, math.inf]) == "never (3 of 3)"
    assert until_text([30.0, math.inf, 20.0]) == "20, 30; never (1 of 3)"


def test_a_table_of_recorded_runs(record):
    runs = [
        record("airl", 1, [0.5, 0.85, 0.88, 0.91, 0.95], "goal"),
        record("airl", 2, [0.85, 0.95, 0.96], "goal"),
        record("imitation-gail", 1, [0.1, 0.85, 0.2]),
    ]
    (table,) = tables(runs).values()
    assert "| 2 | 15 (10 to 20) | 30 (20 to 40) | 1,500 (1,000 to 2,000) |" in table
    assert "| 1 | never (1 of 1) | never (1 of 1) |" in table
    # The gail student had 10 and 85 %, then 85 and 20 %.
    assert table.splitlines()[-1].endswith("| 20% | 30 s, 3,000 steps |")


def test_a_partial_benchmark_says_what_is_missing(record, tmp_path):
    write(tmp_path, [record("airl", 1, [0.95, 0.95], "goal"), record("expert", 1, [])], 7, "run it")
    page = (tmp_path / "README.md").read_text()
    assert "Missing: 5 of 7 runs." in page
    assert "experts of engine-power=1x" in page
    assert (tmp_path / "peers.png").stat().st_size > 1000
    assert len((tmp_path / "checks.csv").read_text().splitlines()) == 3


def test_a_run_is_repeated_after_a_lower_limit_or_on_other_demonstrations(record, tmp_path):
    ended, reached = record("airl", 1, [0.5], "limit"), record("airl", 2, [0.95, 0.95], "goal")
    first, second = tmp_path / "airl.1.jsonl", tmp_path / "airl.2.jsonl"
    assert enough(first, ended.task, "demos", 60)
    assert not enough(first, ended.task, "demos", 1800)
    assert enough(second, reached.task, "demos", 1800)
    assert not enough(second, reached.task, "others", 1800)
    elsewhere = reached.task._replace(settings=("engine-power=2x",))
    assert not enough(second, elsewhere, "demos", 1800)
    assert not enough(tmp_path / "airl.3.jsonl", reached.task, "demos", 60)


def test_experts_have_one_setting_and_students_all():
    found = tasks(SETTINGS, ["airl", "expert"], [1, 2])
    assert [(t.method, len(t.settings), t.seed) for t in found] == [
        ("airl", 2, 1),
        ("expert", 1, 1),
        ("expert", 1, 1),
        ("airl", 2, 2),
        ("expert", 1, 2),
        ("expert", 1, 2),
    ]
    assert len({task.name for task in found}) == 6


def test_a_variable_horizon_is_only_tried_where_episodes_can_end():
    found = tasks({row: ["a", "b"] for row in ROWS}, list(METHODS), [1])
    variable = {task.row for task in found if task.method == "imitation-airl-variable"}
    assert variable == {"lunar-lander.engine-power"}


def test_one_process_at_a_time(tmp_path, monkeypatch, capsys):
    for name in ("runs", "records"):
        (tmp_path / name).mkdir()
    unfinished = tmp_path / "records" / "ours.part"
    unfinished.touch()
    monkeypatch.setattr(sys, "argv", ["peers", "--out", str(tmp_path)])
    with (
        locked(tmp_path / "runs" / ".lock"),
        pytest.raises(SystemExit, match=str(Busy.exit_code)),
    ):
        main()
    assert str(tmp_path / "runs") in capsys.readouterr().err
    assert unfinished.exists()


@pytest.mark.parametrize("method", ["airl", "airl-plain"])
def test_challengers_take_as_many_steps_as_they_are_trained_with(method, tmp_path):
    run = {"method": method, "row": "half-cheetah.friction", "seed": 1}
    run["settings"] = ["friction=1.5:0.1:0.1", "friction=2:0.6:0.6"]
    request, steps = requested(run, tmp_path)
    worlds = request.parameters.airl.ppo.n_envs
    assert worlds == 18
    # A round of a challenger is two rollouts of 512 steps.
    assert steps == {"airl": worlds * 512 * 2, "airl-plain": 0}[method]


def test_names_are_checked():
    assert chosen("half-cheetah.friction", ROWS, "--rows") == ["half-cheetah.friction"]
    with pytest.raises(UsageError, match="--rows: unknown name 'ant'"):
        chosen("ant", ROWS, "--rows")


@pytest.mark.parametrize("option", [["--rows", "ant"], ["--seeds", "a"], ["--jobs", "0"], ["--x"]])
def test_a_bad_option_is_one_line(option, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["peers", *option])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
