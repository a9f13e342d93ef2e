"""``irl run``: one process per missing artefact, restartable, several runs at once."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from test_architecture import loaded_by

from irlcli.configs import load_config
from irlcli.errors import StageFailed
from irlcli.experiments.execute import Execution, Outcome
from irlcli.experiments.failures import Failure
from irlcli.experiments.runner import Runner, Silent
from irlcli.interventions import parse_settings
from irlcli.requests.session import StageSession
from irlcli.requests.tables import TableChoice, open_plan
from irlcli.stages import train_expert
from irlcli.store import Store
from irlcli.store.sources import open_sources

TABLES = """
[tiny]
title = "Engine power"
rows = ["lunar-lander.engine-power"]
methods = ["erm", "irm"]
seeds = [0]
measures = ["zero-shot"]
"""
ROW = "smoke.lunar-lander.engine-power"
REWARDS = ["--until", "rewards"]  # three experts, the demonstrations, two rewards


class Runs:
    """``irl run tiny`` in processes of its own, with stages that compute next to nothing."""

    def __init__(self, directory: Path):
        self.log = directory / "log"
        self.log.touch()
        self.tables = directory / "tables.toml"
        self.tables.write_text(TABLES)
        self.words = ["run", "tiny", "--experiments", str(self.tables), "--profile", "smoke"]

    def start(self, store: Path, *more: object, **environment: str) -> subprocess.Popen:
        line = [sys.executable, "-P", "-m", "irlcli", *self.words, "--store", store, *more]
        fakes = str(Path(__file__).parent / "fake_stages")
        path = os.pathsep.join([fakes, *filter(None, [os.environ.get("PYTHONPATH")])])
        return subprocess.Popen(
            [str(word) for word in line],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": path, "IRL_TEST_LOG": str(self.log), **environment},
            # As a shell starts it: Ctrl-C is a signal to this group.
            process_group=0,
        )

    def run(self, store: Path, *more: object, code: int = 0, **environment: str) -> str:
        """What a run printed on stderr."""
        process = self.start(store, *more, **environment)
        _, errors = process.communicate(timeout=600)
        assert process.returncode == code, errors
        return errors

    def lines(self) -> list[dict]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]

    def processes(self) -> list[str]:
        """The step of each child process that was started."""
        started = [line["argv"] for line in self.lines() if "argv" in line]
        return [argv[argv.index("--only") + 1] for argv in started if "--only" in argv]

    def computed(self) -> Counter:
        """How often each result was computed, or resumed."""
        return Counter(
            json.dumps(line["parameters"]) for line in self.lines() if "computes" in line
        )

    def wait_for(self, found, process: subprocess.Popen) -> None:
        while not any(found(line) for line in self.lines()):
            assert process.poll() is None, process.communicate()
            time.sleep(0.01)


@pytest.fixture
def runs(tmp_path):
    return Runs(tmp_path)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The ids of a run that nothing disturbed, its log, and what it printed."""
    directory = tmp_path_factory.mktemp("uninterrupted")
    runs = Runs(directory)
    runs.errors = runs.run(directory / "runs", "--jobs", "8", *REWARDS)
    return Store(directory / "runs").ids(), runs


def test_each_missing_artefact_has_one_process_and_one_name(uninterrupted):
    ids, runs = uninterrupted
    steps = ["expert.1x", "expert.1.25x", "expert.1.5x", "demos", "erm.0", "irm.0"]
    assert sorted(runs.processes()) == sorted(f"{ROW}.{step}" for step in steps)
    store = Store(runs.log.parent / "runs")
    assert store.names() == {f"{ROW}.{step}": id16 for step, id16 in _named(store, steps)}
    assert len(ids) == len(steps) and set(store.names().values()) == set(ids)
    for name, id16 in store.names().items():
        command = store.resolve(id16).artefact.provenance()["command"]
        assert command[:5] == ["irl", "run", "tiny", "--only", name]
    pids = {line["pid"] for line in runs.lines() if "computes" in line}
    assert len(pids) == len(steps)


def test_a_step_starts_when_what_it_needs_exists(uninterrupted):
    _, runs = uninterrupted
    lines = [line.split(" in ")[0].replace(f"{ROW}.", "") for line in runs.errors.splitlines()]
    at = {line: number for number, line in enumerate(lines)}
    assert at["RUN expert.1.5x"] < min(at[f"DONE expert.{value}"] for value in ("1x", "1.25x"))
    assert at["RUN demos"] > max(at[f"DONE expert.{value}"] for value in ("1x", "1.25x"))
    assert min(at["RUN erm.0"], at["RUN irm.0"]) > at["DONE demos"]
    assert max(at["RUN erm.0"], at["RUN irm.0"]) < min(at["DONE erm.0"], at["DONE irm.0"])


def _named(store, steps):
    return [(step, store.resolve(f"{ROW}.{step}").artefact.id) for step in steps]


def test_what_exists_needs_no_process(uninterrupted, runs):
    _, earlier = uninterrupted
    store = earlier.log.parent / "runs"
    before = earlier.log.read_bytes()
    errors = runs.run(store, *REWARDS)
    assert "6 of 6 steps exist" in errors
    process = runs.start(store, *REWARDS, "--json")
    document = json.loads(process.communicate(timeout=600)[0])
    assert (document["kind"], document["existed"], document["made"]) == ("run", 6, 0)
    assert runs.processes() == [] and earlier.log.read_bytes() == before


@pytest.mark.parametrize("more", [[], ["--cluster", "local"]])
def test_what_exists_without_a_name_gets_its_name(uninterrupted, runs, tmp_path, more):
    if more:
        pytest.importorskip("submitit")
    source, store = uninterrupted[1].log.parent / "runs", tmp_path / "runs"
    shutil.copytree(source, store, symlinks=True)
    for name in (store / ".names").iterdir():
        name.unlink()
    runs.run(store, *REWARDS, *more)
    assert runs.processes() == [] and Store(store).names() == Store(source).names()


@pytest.mark.parametrize("more", [[], ["--cluster", "local"]])
def test_nothing_is_imported_from_the_working_directory(runs, tmp_path, monkeypatch, more):
    if more:
        pytest.importorskip("submitit")
    for name in ("queue", "typer"):
        (tmp_path / f"{name}.py").write_text(f"raise RuntimeError('this is not {name}')")
    monkeypatch.chdir(tmp_path)
    runs.run(tmp_path / "runs", "--until", "experts", "--jobs", "3", *more)


def test_killed_and_started_again_it_ends_in_the_same_artefacts(uninterrupted, runs, tmp_path):
    ids, _ = uninterrupted
    store = tmp_path / "runs"
    slow = {"IRL_TEST_ROUND": "0.2"}
    for stage in ("train_expert", "train_airl"):
        process = runs.start(store, *REWARDS, "--jobs", "2", **slow)
        runs.wait_for(lambda line, s=stage: line.get("computes", "").startswith(s), process)
        while not list(store.glob(".work/*/checkpoint")):
            time.sleep(0.01)
        # As a power cut: the run and its children.
        process.kill()
        for line in runs.lines():
            with contextlib.suppress(ProcessLookupError):
                os.kill(line["pid"], signal.SIGKILL)
        process.communicate()
    assert Store(store).ids() != ids
    runs.run(store, *REWARDS, "--jobs", "2")
    assert Store(store).ids() == ids
    assert any(artefact.provenance()["resumed"] for artefact in Store(store).artefacts())
    assert not list(store.glob(".work/*/checkpoint"))


def test_children_of_a_killed_run_do_not_disturb_the_next(uninterrupted, runs, tmp_path):
    """They either finish what they are at, or end; the next run waits for them."""
    ids, _ = uninterrupted
    store = tmp_path / "runs"
    process = runs.start(store, *REWARDS, "--jobs", "2", IRL_TEST_ROUND="0.3")
    runs.wait_for(lambda line: "computes" in line, process)
    process.kill()
    process.communicate()
    runs.run(store, *REWARDS, "--jobs", "2")
    assert Store(store).ids() == ids and not Store(store).verify(ids).damaged


def test_two_runs_at_once_make_each_artefact_once(uninterrupted, runs, tmp_path):
    ids, _ = uninterrupted
    store = tmp_path / "runs"
    both = [runs.start(store, *REWARDS, "--jobs", "2", IRL_TEST_ROUND="0.1") for _ in range(2)]
    for process in both:
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors
    assert Store(store).ids() == ids
    assert set(runs.computed().values()) == {1} and len(runs.computed()) == len(ids)


def test_a_run_makes_other_steps_while_it_waits_for_another_run(uninterrupted, runs, tmp_path):
    """With one job each, two runs would otherwise do every step together."""
    store = tmp_path / "runs"
    line = (store, "--until", "experts")
    first = runs.start(*line, IRL_TEST_ROUND="1")
    runs.wait_for(lambda line: "computes" in line, first)
    (child,) = {line["pid"] for line in runs.lines() if "computes" in line}
    os.kill(child, signal.SIGSTOP)
    second = runs.start(*line, IRL_TEST_ROUND="0.1")
    while len(Store(store).ids()) < 2:
        assert second.poll() is None
        time.sleep(0.05)
    os.kill(child, signal.SIGCONT)
    _, errors = second.communicate(timeout=600)
    assert second.returncode == 0 and "WAIT " in errors, errors
    assert first.communicate(timeout=600) and first.returncode == 0
    assert len(Store(store).ids()) == 3 and set(runs.computed().values()) == {1}
    waited, *_ = (line.split()[1] for line in errors.splitlines() if line.startswith("WAIT "))
    done = [line.split()[1] for line in errors.splitlines() if line.startswith("DONE ")]
    assert done[-1] == waited.rstrip(":") and len(done) == 3


def test_a_failed_step_stops_only_what_depends_on_it(runs, tmp_path):
    store = tmp_path / "runs"
    failing = "train_airl per-setting"
    errors = runs.run(store, "--jobs", "2", "--until", "returns", code=1, IRL_TEST_FAIL=failing)
    assert f"warning: {ROW}.irm.0 failed: " in errors and "it was asked to fail" in errors
    assert "hint: do not ask for it" in errors
    assert f"error: 1 of 13 steps failed: {ROW}.irm.0; 1 waits for it" in errors
    made = set(Store(store).names())
    assert f"{ROW}.erm.0.zero-shot-returns" in made and len(made) == 11
    assert not made & {f"{ROW}.irm.0", f"{ROW}.irm.0.zero-shot-returns"}
    before = len(runs.processes())
    runs.run(store, "--until", "returns")
    assert len(runs.processes()) == before + 2 and len(Store(store).names()) == 13


def test_a_figure_of_failed_steps_is_not_drawn(irl, tmp_path, monkeypatch):
    """Drawing it would compute them in the process of `irl run` itself."""
    why = Failure(1, "it was asked to fail", "do not ask for it")
    failed = {f"smoke.figure2.{step}": why for step in ("sweep", "a", "b", "c", "d")}
    outcome = Outcome([], [], [], failed, [], False)
    monkeypatch.setattr("irlcli.cli.experiments._make_all", lambda *_: outcome)
    monkeypatch.setattr(Runner, "run", lambda *_: pytest.fail("a step was computed"))
    done = irl("run", "figure2", "--profile", "smoke", "--store", tmp_path / "runs")
    assert done.code == 1 and "steps failed: smoke.figure2.sweep" in done.err
    assert "and 2 more" in done.err


@pytest.mark.parametrize(("codes", "worst"), [((1, 4), 4), ((75, 2), 2), ((130, 3, 99), 99)])
def test_the_exit_code_is_that_of_the_worst_failure(codes, worst):
    """A code that is none of an error's is that of a crash."""
    failed = {f"step {code}": Failure(code, "", "") for code in codes}
    assert Outcome(failed=failed).exit_code == worst


def test_a_damaged_artefact_is_set_aside_and_then_made_again(uninterrupted, runs, tmp_path):
    ids, _ = uninterrupted
    store = tmp_path / "runs"
    runs.run(store, *REWARDS)
    demos = Store(store).resolve(f"{ROW}.demos").artefact.directory
    demos.chmod(0o755)
    (demos / "summary.json").chmod(0o644)
    (demos / "summary.json").write_text("{}")
    errors = runs.run(store, *REWARDS, code=4)
    assert f"{ROW}.demos failed: artefact {demos.name} was damaged" in errors
    assert f"irl run tiny --only {ROW}.demos " in errors  # how to repair it
    runs.run(store, *REWARDS)
    assert Store(store).ids() == ids


def test_a_damaged_copy_elsewhere_is_computed_instead(irl, store_copy, tmp_path):
    tables = tmp_path / "tables.toml"
    tables.write_text(TABLES)
    steps = store_copy.path / store_copy.demos / "steps.parquet"
    steps.chmod(0o644)
    data = bytearray(steps.read_bytes())
    data[100] ^= 1
    steps.write_bytes(data)
    words = ["tiny", "--experiments", tables, "--profile", "smoke", "--store", tmp_path / "new"]
    made = irl("run", *words, "--only", f"{ROW}.demos", "--from", store_copy.path)
    assert made.code == 0, made.err
    assert "warning: not copying artefact" in made.err and "RUN collect-experts" in made.err
    assert made.err.count("FOUND train-expert") == 2
    assert Path(made.out.strip()).name == store_copy.demos
    assert steps.read_bytes() == data


def test_interrupted_once_it_checkpoints_and_twice_it_kills(uninterrupted, runs, tmp_path):
    ids, _ = uninterrupted
    store = tmp_path / "runs"
    for count, slow in ((1, "2"), (2, "60")):
        begin = len(runs.lines())
        process = runs.start(store, *REWARDS, "--jobs", "2", IRL_TEST_ROUND=slow)
        # The second run finds the checkpoint of the first.
        while not (
            any("computes" in line for line in runs.lines()[begin:])
            and list(store.glob(".work/*/checkpoint"))
        ):
            assert process.poll() is None
            time.sleep(0.01)
        for _ in range(count):
            process.send_signal(signal.SIGINT)
            time.sleep(0.3)
        out, errors = process.communicate(timeout=600)
        assert (process.returncode, out) == (130, "")
        assert "error: stopped: " in errors and "same command again" in errors
        assert " failed: " not in errors
        computing = {line["pid"] for line in runs.lines()[begin:] if "computes" in line}
        ended = {line["pid"] for line in runs.lines()[begin:] if "exits" in line}
        assert (computing <= ended) == (count == 1)
        assert list(store.glob(".work/*/checkpoint"))
    assert not alive(line["pid"] for line in runs.lines())
    runs.run(store, *REWARDS)
    assert Store(store).ids() == ids


def test_a_signal_to_the_whole_process_tree_leaves_a_checkpoint(runs, tmp_path):
    """As a batch system or a service manager sends it: the step gets it twice."""
    store = tmp_path / "runs"
    process = runs.start(store, "--until", "experts", IRL_TEST_ROUND="1.5")
    runs.wait_for(lambda line: "computes" in line, process)
    (child,) = {line["pid"] for line in runs.lines() if "computes" in line}
    process.send_signal(signal.SIGTERM)
    os.kill(child, signal.SIGTERM)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 130, errors
    assert len(list(store.glob(".work/*/checkpoint"))) == 1


def test_ctrl_c_in_a_pipeline_leaves_a_checkpoint_although_the_reader_died_of_it(runs, tmp_path):
    store = tmp_path / "runs"
    process = runs.start(store, "--until", "experts", IRL_TEST_ROUND="1.5")
    runs.wait_for(lambda line: "computes" in line, process)
    process.stderr.close()
    process.send_signal(signal.SIGINT)
    process.wait(timeout=200)
    assert process.returncode == 130
    assert len(list(store.glob(".work/*/checkpoint"))) == 1


@pytest.mark.parametrize("more", [[], ["--cluster", "local"]])
def test_a_step_whose_settings_changed_since_the_plan_is_not_made(runs, tmp_path, more):
    """What is changed takes effect in a new run; a tag must not mix two configs."""
    store, settings = tmp_path / "runs", tmp_path / "my.toml"
    settings.write_text("[demonstrations]\nepisodes = 3\n")
    line = ("--settings", settings, "--tag", "a", "--until", "demos", *more)
    process = runs.start(store, *line, IRL_TEST_ROUND="0.2")
    runs.wait_for(lambda line: "computes" in line, process)
    settings.write_text("[demonstrations]\nepisodes = 77\n")
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 2 and "has changed since the run was planned" in errors
    computed = map(json.loads, runs.computed())
    assert not [step for step in computed if 77 in step.get("episodes", [])]
    # The artefact's own command makes it whatever has changed.
    stored = Store(store).index().artefacts.values()
    assert not any("--expect" in artefact.provenance()["command"] for artefact in stored)
    plan = runs.start(store, *line[:2], "--tag", "b", "--dry-run")
    planned, errors = plan.communicate()
    assert plan.returncode == 0 and "b.lunar-lander.engine-power.erm.0" in planned, errors


def alive(pids):
    found = []
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, 0)
            found.append(pid)
    return found


def test_lambda_is_chosen_before_the_reward_is_learned(irl, tmp_path, smoke_store):
    """The reward's key is known only when the choice was made: its step still runs once."""
    tables = tmp_path / "tables.toml"
    tables.write_text(TABLES.replace('["erm", "irm"]', '["irm"]'))
    small = ["--set", "airl.total_steps=1536", "--set", "evaluation.episodes=1"]
    words = ["tiny", "--experiments", tables, "--profile", "smoke", *small, "--tag", "chosen"]
    words += ["--choose-penalty", "1,10", "--store", tmp_path / "runs"]
    name = "chosen.lunar-lander.engine-power.irm.0"
    made = irl("run", *words, "--only", name, "--from", smoke_store.path, "--quiet")
    assert made.code == 0, made.err
    store = Store(tmp_path / "runs")
    choice = store.resolve(f"{name}.choice").artefact
    weight = json.loads((choice.directory / "choice.json").read_text())["chosen"]
    learned = store.resolve(name).artefact.manifest.record
    assert learned.parameters["airl"]["penalty_weight"] == weight
    assert len(store.names()) == 13  # two experts, demos, four rewards and returns, choice, reward
    planned = irl("plan", *words, "--until", "rewards", "--json")
    assert json.loads(planned.out)["counts"]["HIT"] == 13
    # No report follows, so the run says what was chosen.
    told = irl("run", *words, "--until", "rewards")
    assert told.code == 0 and f"{name}.choice: lambda {weight:g} " in told.err


CHOSEN_REWARD = "x.lunar-lander.engine-power.irm.0"


def choosing(directory):
    """A session in a new store, and the options of a table that chooses lambda."""
    tables = directory / "tables.toml"
    tables.write_text(TABLES.replace('["erm", "irm"]', '["irm"]'))
    store = Store(directory / "runs")
    store.create()
    line = {"profile": "smoke", "file": None, "overrides": [], "sources": [], "command": ["irl"]}
    session = StageSession(store.root, Silent(), **line)
    return session, TableChoice(
        "tiny", choose_penalty="1,10", until="rewards", tag="x", file=tables
    )


def publish_step(plan, store, name):
    """Make a step of a table that chooses lambda, without any training. It chooses 10."""
    record = plan.lookup.record(plan.tasks[name].request)
    with store.working_on(record.key, True) as scratch:
        output = scratch.new_output()
        for file in ("policy.pt", "reward.pt", "summary.json", "metrics.parquet"):
            (output / file).write_text(f"{file} of {name}")
        if plan.chooses(name):
            found = {"env": "lunar-lander", "weights": [1.0, 10.0], "scores": [{}, {}]}
            (output / "choice.json").write_text(json.dumps(found | {"chosen": 10.0, "ties": 1}))
        store.publish(record, output, {})
    plan.refresh()


def test_a_choice_that_another_run_makes_meanwhile_is_used(tmp_path):
    """Another run chooses lambda 10 while this one trains an expert; the table's own lambda is 1."""
    session, choice = choosing(tmp_path)
    plan, others = (open_plan(session, choice) for _ in range(2))
    reward = CHOSEN_REWARD

    def command(name):
        for missing in others.tasks if name != reward else [reward]:
            if others.step(missing).status != "HIT" and (name == reward or missing != reward):
                publish_step(others, session.store, missing)
        return [sys.executable, "-c", ""]

    outcome = Execution(plan, session.runner(), command, 1, Unseen()).run()
    assert outcome.exit_code == 0 and outcome.made[-1] == reward
    assert plan.tasks[reward].request.parameters.airl.penalty_weight == 10.0


def test_a_copy_that_fails_does_not_end_other_steps(tmp_path):
    """The process that is started instead copies, or says what is wrong."""
    tables = tmp_path / "tables.toml"
    tables.write_text(TABLES)
    line = {"profile": "smoke", "file": None, "overrides": [], "sources": [], "command": ["irl"]}
    session = StageSession(tmp_path / "runs", Silent(), **line)
    session.store.create()
    plan = open_plan(session, TableChoice("tiny", until="experts", tag="smoke", file=tables))
    runner = session.runner()

    def copy(request, lookup):
        raise StageFailed("the connection was lost", "run the same command again")

    runner.copy = copy
    step = plan.step
    plan.step = lambda name: step(name)._replace(status="FOUND")
    outcome = Execution(plan, runner, lambda name: [sys.executable, "-c", ""], 2, Unseen()).run()
    assert len(outcome.failed) == 3 and not outcome.copied
    assert {failure.code for failure in outcome.failed.values()} == {1}


class Unseen:
    """A display that shows nothing."""

    def __getattr__(self, name):
        return lambda *arguments: None


def test_a_table_end_to_end(irl, smoke_store, tmp_path):
    """Real stages: copied from another store where it has them, computed elsewhere, reported."""
    tables, store = tmp_path / "tables.toml", tmp_path / "runs"
    tables.write_text(TABLES.replace('["erm", "irm"]', '["irm"]'))
    words = ["tiny", "--experiments", tables, "--profile", "smoke", "--store", store]
    words += ["--from", smoke_store.path]
    # In this process, which has loaded the libraries.
    for step in ("random-returns", "idle-returns", "expert-returns", "expert.1x.reused-returns"):
        made = irl("run", *words, "--only", f"{ROW}.{step}", "--quiet")
        assert made.code == 0, made.err
    done = irl("run", *words, "--jobs", "2", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    events = {"RUN": [], "FOUND": [], "DONE": []}
    for line in done.err.splitlines():
        event, _, rest = line.partition(" ")
        if f"{ROW}." in rest:
            events[event].append(rest.removeprefix(f"{ROW}.").split()[0].rstrip(":"))
    assert sorted(events["RUN"]) == ["expert.1.25x.reused-returns", "irm.0.zero-shot-returns"]
    assert events["DONE"] == events["RUN"] or events["DONE"] == events["RUN"][::-1]
    assert events["FOUND"] == ["expert.1.25x", "demos", "irm.0"]
    assert "6 of 11 steps exist" in done.err and "(11 of 11)" in done.err
    made = Store(store)
    assert made.resolve(f"{ROW}.irm.0").artefact.id == smoke_store.airl
    assert not made.verify(made.ids()).damaged
    report = made.resolve("smoke.tiny").artefact
    assert done.out.strip() == str(report.directory)
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"README.md", "tiny.csv", "tiny.png", "seeds.csv"} <= files
    assert (tmp_path / "out" / "tiny.csv").stat().st_mode & 0o200
    # The report is that of `irl report`, and a second run finds everything.
    again = irl("report", *words)
    assert again.out == done.out
    second = irl("run", *words, "--jobs", "2")
    assert second.out == done.out and "\nRUN" not in second.err
    assert "11 of 11 steps exist" in second.err
    assert loaded_by("run", *map(str, words)) == "LOADED []"

    # The reward's policy is damaged, and what was measured of it is lost.
    policy = made.resolve(f"{ROW}.irm.0").artefact.directory / "policy.pt"
    policy.chmod(0o644)
    policy.write_bytes(policy.read_bytes()[:-1] + b"x")
    shutil.rmtree(made.resolve(f"{ROW}.irm.0.zero-shot-returns").artefact.directory)
    failed = irl("run", *words[:-2])
    assert failed.code == 4 and f"error: 1 of 11 steps failed: {ROW}.irm.0" in failed.err
    assert failed.err.splitlines()[-1].startswith("hint: run the same command again")


def test_a_copy_does_not_wait_for_a_process_that_works_on_the_same_artefact(smoke_store, tmp_path):
    """It may take hours, and `irl run` would not answer Ctrl-C meanwhile."""
    (setting,) = parse_settings("lunar-lander", "engine-power=1x")
    config = load_config("lunar-lander", "smoke")
    request = train_expert.request("lunar-lander", setting, 0, config.expert_of(setting))
    runner = Runner(tmp_path / "new", sources=open_sources([smoke_store.path], pytest.fail))
    runner.store.create()
    lookup = runner.lookup()
    step = lookup(request)
    assert step.status == "FOUND"
    with runner.store.working_on(step.key, wait=False):
        assert runner.copy(request, lookup) is None
    assert runner.copy(request, lookup).id == smoke_store.expert
