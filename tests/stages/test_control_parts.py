"""The positive controls through the command line, at the smoke profile."""

import csv

import numpy as np
import pyarrow.parquet as pq
import pytest
from msgspec.structs import replace

from irlcli.configs import load_config
from irlcli.controls import cued_fits
from irlcli.controls.classifier import Schedule, accuracy, train
from irlcli.controls.cued_labels import UNIT_TESTS, permuted, unit_test
from irlcli.controls.methods import LabelMethod
from irlcli.experiments.runner import Runner
from irlcli.stages import control, control_labels, control_maps
from irlcli.stages.base import Job
from irlcli.stages.control_labels import methods

SMOKE = load_config("control", "smoke").control


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A store that holds the smoke profile's control, made in this process."""
    path = tmp_path_factory.mktemp("control") / "runs"
    runner = Runner(path)
    runner.store.create()
    runner.run(control.request(SMOKE))
    return path


@pytest.fixture
def run(irl, store):
    return lambda *arguments: irl(*arguments, "--profile", "smoke", "--store", store)


def test_the_control_is_a_table_of_experiments(run, tmp_path):
    plan = run("plan", "control")
    assert plan.code == 0
    assert all(line.startswith("HIT") for line in plan.out.splitlines())
    done = run("run", "control", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert (tmp_path / "out" / "control.png").read_bytes()[:4] == b"\x89PNG"
    page = (tmp_path / "out" / "README.md").read_text()
    assert "![" not in done.err and "|" not in done.err
    shown = [line for line in page.splitlines() if line and not line.startswith(("|", "!["))]
    assert all(line in done.err for line in shown)
    with open(tmp_path / "out" / "control.csv") as file:
        rows = list(csv.DictReader(file))
    assert all(float(r["low"]) <= float(r["mean"]) <= float(r["high"]) for r in rows)
    for method in ("irmv1-full 10, labels shuffled", "vrex 10", "erm, sees the texture only"):
        assert f"| {method} |" in page and any(r["method"] == method for r in rows)
    for method in methods("coloured digits"):
        assert f"| {method} |" in page


def test_listings_tell_the_parts_apart(irl, store):
    listed = irl("ls", "--store", store).out
    assert all(f"control-labels  {p}" in listed for p in ("coloured digits", "example 2"))
    assert all(f"control-maps    {p}" in listed for p in ("linear", "learned", "choice"))


def test_a_report_needs_every_part(irl, tmp_path):
    done = irl("report", "control", "--profile", "smoke", "--store", tmp_path / "empty")
    assert done.code == 3 and "lacks 9 of 9 steps" in done.err


def test_the_order_of_the_lambdas_does_not_matter():
    lambdas = (1.0, 10.0, 100.0)
    rising, falling = (replace(SMOKE.maps, penalty_weights=w) for w in (lambdas, lambdas[::-1]))
    assert list(control_maps.cases(rising)) == list(control_maps.cases(falling))


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        ("control.maps.strengths=[0.9]", "needs? two|need two"),
        ("control.labels.strengths=[0.9]", "need two"),
        ("control.maps.settings=[1,2]", "need two"),
        ("control.maps.choices=[[0.9,0.8]]", "need two"),
        ("control.maps.strengths=[0.9,1.2]", "control.maps.strengths.*at most 1"),
        ("control.maps.unseen=-0.1", "control.maps.unseen.*at least 0"),
        ("control.labels.strengths=[1.5,0.9]", "control.labels.strengths.*at most 1"),
        ("control.maps.gaps=[0.5]", r"leaves \[0, 1\]"),
        ("control.maps.warmup=500", "none of"),
        ("control.labels.warmup=500", "none of"),
        ("control.maps.penalty_weights=[]", "is empty"),
        ("control.maps.gaps=[]", "control.maps.gaps is empty"),
        ("control.maps.settings=[]", "control.maps.settings is empty"),
        ("control.maps.gaps=[0.1,0.1]", r"control.maps.gaps.* repeated .*0.1, 0.1"),
        ("control.maps.settings=[2,3,2]", r"control.maps.settings.* repeated .*2, 3, 2"),
    ],
)
def test_bad_input_is_one_line_that_says_what_is_allowed(irl, tmp_path, setting, named):
    done = irl("plan", "control", "--set", setting, "--store", tmp_path / "runs")
    assert (done.code, done.out) == (2, "")
    error, hint = done.err.splitlines()[-2:]
    assert error.startswith("error: ") and hint.startswith("hint: ")
    with pytest.raises(AssertionError, match=named):
        raise AssertionError(error)


def test_rows_methods_and_seeds_are_those_of_the_settings_file(irl, tmp_path):
    for option in (["--seeds", "1"], ["--methods", "erm"], ["--rows", "ant"]):
        done = irl("plan", "control", *option, "--store", tmp_path / "runs")
        assert done.code == 2 and f"control takes no {option[0]}" in done.err


class Checkpoints:
    """Keeps every state that is offered; begins with one of them."""

    def __init__(self, begin=None):
        self.begin, self.states = begin, []

    def load(self):
        return self.begin

    def discard(self, reason):
        raise AssertionError(reason)

    def offer(self, state):
        self.states.append(state())


class Silent:
    def progress(self, *facts):
        pass

    def warn(self, message):
        raise AssertionError(message)


def test_an_interrupted_part_ends_with_the_same_bytes(tmp_path):
    parameters = control_maps.parts(SMOKE.maps)["settings"].parameters
    found = []
    begin = None
    for name in ("whole", "resumed"):
        (tmp_path / name).mkdir()
        kept = Checkpoints(begin)
        control_maps.run(Job(parameters, {}, tmp_path / name, kept, Silent()))
        found.append((tmp_path / name / "results.parquet").read_bytes())
        begin = begin or kept.states[1]
    assert len(kept.states) == len(parameters.cases) - 2
    assert found[0] == found[1]


def test_every_seed_has_a_row_for_each_setting_left_out(store):
    part = control_maps.parts(SMOKE.maps)["choice"]
    rows = pq.read_table(Runner(store).run(part).directory / "results.parquet").to_pylist()
    assert {row["left_out"] for row in rows} == {-1, 0, 1, 2}
    assert all((row["held_out_risk"] is None) == (row["left_out"] < 0) for row in rows)


def test_cases_have_the_strengths_of_the_config():
    cases = {case.name: case for case in control_maps.cases(SMOKE.maps)}
    assert cases["settings.3.colours.1"].strengths == (0.95, 0.8, 0.65)
    assert cases["settings.3.colours.2"].colours == 2
    assert cases["gap.0.1"].strengths == (0.925, 0.825)


def test_equal_methods_of_a_case_are_one():
    maps = replace(SMOKE.maps, l2s=(0.0, 0.1, 0.1), penalty_weights=(1.0, 1.0, 100.0))
    for case in control_maps.cases(maps):
        assert len({*case.variants}) == len(case.variants), case.name


def test_two_colours_have_strengths_of_their_own_in_every_seed(monkeypatch):
    (case,) = (c for c in control_maps.cases(SMOKE.maps) if c.name == "settings.3.colours.2")
    drawn, original = [], cued_fits.dataset

    def dataset(maps, strengths, seeds):
        drawn.append(strengths.copy())
        return original(maps, strengths, seeds)

    monkeypatch.setattr(cued_fits, "dataset", dataset)
    control_maps._rows(case, SMOKE.maps)
    (strengths,) = drawn
    assert len(np.unique(strengths)) == strengths.size
    assert strengths.min() >= 0.65 and strengths.max() <= 0.95


def test_the_oracle_learns_from_inputs_that_tell_nothing_false(store):
    labels = SMOKE.labels
    seeds = range(labels.seeds)
    trained, unseen = unit_test(UNIT_TESTS["example 2"], seeds, labels.unit_samples)
    schedule = Schedule(labels.unit_steps, labels.unit_steps // 4, labels.learning_rate)
    oracle = permuted(trained.numpy(), seeds)
    networks = train(oracle, LabelMethod(oracle=True), schedule, 0, seeds)
    made = Runner(store).run(control_labels.request("example 2", labels))
    rows = pq.read_table(made.directory / "accuracy.parquet").to_pylist()
    for name, samples in (("trained", trained), ("unseen", unseen)):
        found = [row[name] for row in rows if row["method"] == "oracle"]
        assert found == pytest.approx(accuracy(networks, samples).mean(1).tolist())
