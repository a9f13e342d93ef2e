"""Each kind of extension is one file and one line: done here in a temporary package.

The files are those of docs/extending.md; the line is an entry of the registry that it names.
"""

import re
import sys
from pathlib import Path

import pytest

from irlcli import learners, penalties, rl
from irlcli.envs import registry
from irlcli.errors import StageFailed
from irlcli.experiments.references import demonstrations
from irlcli.experiments.runner import Runner
from irlcli.store import Store

PAGE = Path(__file__).parent.parent / "docs" / "extending.md"


def example(name):
    """The code block of docs/extending.md that begins with ``# lab/NAME.py``."""
    blocks = re.findall(r"```(?:python|toml)\n(.*?)```", PAGE.read_text(), re.S)
    (block,) = (b for b in blocks if re.match(rf"# \S*{re.escape(name)}\n", b))
    return block


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """``lab("fairl.py")`` writes the page's file into a package ``lab`` that can be imported."""
    package = tmp_path / "packages" / "lab"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(package.parent)

    def write(name):
        (package / name).write_text(example(name))
        return package / name

    yield write
    for module in [m for m in sys.modules if m == "lab" or m.startswith("lab.")]:
        del sys.modules[module]


def trained(irl, store, *more):
    """The id of a reward learned from the smoke store's demonstrations."""
    common = ["--store", store.path, "--profile", "smoke", "--quiet"]
    done = irl("train-airl", "--demos", "demos", *more, *common)
    assert done.code == 0, done.err
    return Store(store.path).resolve(done.out.strip().rpartition("/")[2]).artefact


def test_a_penalty(irl, lab, store_copy, monkeypatch):
    lab("risk_range.py")
    unknown = [
        "train-airl",
        "--demos",
        "demos",
        "--grouping",
        "per-setting",
        "--penalty",
        "risk-range",
    ]
    assert irl(*unknown, "--store", store_copy.path, "--profile", "smoke").code == 2
    entry = penalties.Penalty("lab.risk_range", ("airl",), compares=True, reads=())
    monkeypatch.setitem(penalties.PENALTIES, "risk-range", entry)
    artefact = trained(irl, store_copy, "--grouping", "per-setting", "--penalty", "risk-range")
    assert artefact.manifest.record.parameters["airl"]["penalty"] == "risk-range"
    metrics = artefact.directory / "metrics.parquet"
    import pyarrow.parquet as pq

    values = pq.read_table(metrics)["optimised_penalty"].to_pylist()
    # A range of risks: never negative, and of two different settings not zero.
    assert min(values) >= 0.0 and max(values) > 0.0


@pytest.mark.parametrize("place", ["nowhere.fairl:FAIRL", "irlcli.learners.gail:GALE"])
def test_what_is_registered_with_a_wrong_place(irl, store_copy, monkeypatch, place):
    monkeypatch.setitem(learners.LEARNERS, "fairl", learners.Learner(place))
    monkeypatch.setitem(rl.ALGORITHMS, "other", place)
    common = ["--store", store_copy.path, "--profile", "smoke"]
    learned = ["train-airl", "--demos", "demos", "--set", "airl.learner=fairl"]
    for line in (
        learned,
        ["transfer", "--reward", "airl", "--ood", "1.5x", "--algorithm", "other"],
    ):
        done = irl(*line, *common)
        assert done.code == 1 and f"{place} cannot be imported" in done.err
        assert "PYTHONPATH" in done.err and "defect" not in done.err


PENALTY = """\
import torch


def discriminator(samples, options):
    return {}
"""


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (
            PENALTY.format("samples.risk.mean()"),
            "wrong.py, line 5, raised AttributeError: 'Samples'",
        ),
        (
            PENALTY.format("torch.ones(2, 3) @ torch.ones(2)"),
            "wrong.py, line 5, raised RuntimeError",
        ),
        (PENALTY.format("samples.risks"), "penalty 'wrong' returned [2], not a scalar tensor"),
        (PENALTY.format("1.5"), "penalty 'wrong' returned float, not a scalar tensor"),
        (PENALTY.format("samples.risks.max() * float('nan')"), "penalty 'wrong' is nan in round 0"),
        (PENALTY.format("samples.risks.detach().max()"), "penalty 'wrong' has no gradient"),
        (PENALTY.replace("):", ")"), "lab.wrong:discriminator cannot be imported (expected ':'"),
        ("def penalty(samples, options): ...", "has no attribute 'discriminator'"),
        ("from irlcli.penalties import Sample", "cannot import name 'Sample'"),
    ],
)
def test_a_mistake_in_a_penalty_is_named(irl, lab, store_copy, monkeypatch, code, said):
    (lab("risk_range.py").parent / "wrong.py").write_text(code)
    monkeypatch.setitem(penalties.PENALTIES, "wrong", penalties.Penalty("lab.wrong", ("airl",)))
    line = ["train-airl", "--demos", "demos", "--grouping", "per-setting", "--penalty", "wrong"]
    line += ["--set", "airl.penalty_warmup_rounds=1"]
    done = irl(*line, "--store", store_copy.path, "--profile", "smoke", "--quiet")
    assert done.code == 1 and said in done.err, done.err
    assert done.err.count("error:") == 1 and "hint:" in done.err and "defect" not in done.err
    assert not list((store_copy.path / ".work").iterdir())


@pytest.mark.parametrize(
    ("code", "hint"),
    [
        (PENALTY.replace("):", ")"), "wrong.py, line 4"),
        ("import nothing_here", "the module imports nothing_here"),
        ("import math\nX = math.nothing\n", "wrong.py, line 2"),
        ("def penalty(samples, options): ...", "correct the registered name"),
    ],
)
def test_the_hint_says_what_to_correct_in_a_module(lab, monkeypatch, code, hint):
    (lab("risk_range.py").parent / "wrong.py").write_text(code)
    monkeypatch.setitem(penalties.PENALTIES, "wrong", penalties.Penalty("lab.wrong", ("airl",)))
    with pytest.raises(StageFailed) as caught:
        penalties.discriminator_penalty("wrong")
    assert hint in caught.value.hint


def test_an_interface_that_is_not_kept_is_not_called_a_defect_alone(
    irl, lab, store_copy, monkeypatch
):
    (lab("risk_range.py").parent / "wrong.py").write_text(
        PENALTY.replace(", options", "").format(0)
    )
    line = ["train-airl", "--demos", "demos", "--grouping", "per-setting", "--penalty", "wrong"]
    line += ["--store", store_copy.path, "--profile", "smoke", "--quiet"]
    monkeypatch.setitem(penalties.PENALTIES, "wrong", penalties.Penalty("lab.wrong", ("airl",)))
    done = irl(*line)
    assert done.code == 1 and "takes 1 positional argument but 2 were given" in done.err
    assert "lab.wrong" in done.err.partition("hint:")[2], done.err


def test_an_option_that_no_penalty_can_read_is_refused(irl, store_copy, monkeypatch):
    entry = penalties.Penalty("irlcli.penalties.irmv1", ("airl",), reads=("scaling",))
    monkeypatch.setitem(penalties.PENALTIES, "wrong", entry)
    line = ["train-airl", "--demos", "demos", "--grouping", "per-setting", "--penalty", "wrong"]
    done = irl(*line, "--store", store_copy.path, "--profile", "smoke", "--dry-run")
    assert done.code == 2 and "reads 'scaling'" in done.err and "penalty_scaling" in done.err


def test_a_penalty_whose_module_is_missing(irl, store_copy, monkeypatch):
    entry = penalties.Penalty("nowhere.risk_range", ("airl",), compares=True, reads=())
    monkeypatch.setitem(penalties.PENALTIES, "risk-range", entry)
    line = ["train-airl", "--demos", "demos", "--grouping", "per-setting"]
    line += ["--penalty", "risk-range", "--store", store_copy.path, "--profile", "smoke"]
    done = irl(*line)
    assert done.code == 1 and "nowhere.risk_range:discriminator cannot be imported" in done.err
    assert "PYTHONPATH" in done.err
    # A stage that fails leaves no output behind, and no directory without a checkpoint.
    assert not list((store_copy.path / ".work").iterdir())


def test_a_learner(irl, lab, store_copy, monkeypatch):
    lab("fairl.py")
    fixes = {"policy_reward": "f-log-pi", "fixed_horizon": False}
    entry = learners.Learner("lab.fairl:FAIRL", fixes)
    monkeypatch.setitem(learners.LEARNERS, "fairl", entry)
    fairl = trained(irl, store_copy, "--set", "airl.learner=fairl")
    airl = trained(irl, store_copy, "--set", "airl.fixed_horizon=false")
    parameters = fairl.manifest.record.parameters["airl"]
    assert (parameters["learner"], parameters["fixed_horizon"]) == ("fairl", False)
    policies = [(a.directory / "policy.pt").read_bytes() for a in (fairl, airl)]
    assert policies[0] != policies[1]


def test_an_algorithm(irl, lab, store_copy, monkeypatch):
    lab("one_epoch.py")
    monkeypatch.setitem(rl.ALGORITHMS, "one-epoch", "lab.one_epoch:OneEpoch")
    common = ["--ood", "1.5x", "--store", store_copy.path, "--profile", "smoke", "--quiet"]
    done = irl("transfer", "--reward", "airl", "--set", "transfer.algorithm=one-epoch", *common)
    assert done.code == 0, done.err
    made = Store(store_copy.path).resolve(done.out.strip().rpartition("/")[2]).artefact
    assert made.id != store_copy.transfer
    assert made.manifest.record.parameters["transfer"]["algorithm"] == "one-epoch"


def test_an_environment(irl, lab, tmp_path, monkeypatch):
    lab("slide.py")
    settings = tmp_path / "settings"
    settings.mkdir()
    (settings / "slide.toml").write_text(example("slide.toml"))
    monkeypatch.setattr("irlcli.configs.load.settings_directory", lambda: settings)
    from lab.slide import SPEC

    monkeypatch.setitem(registry.ENVIRONMENTS, SPEC.name, SPEC)
    common = ["--store", tmp_path / "runs", "--profile", "smoke", "--quiet", "--name"]
    for arguments in (
        ["collect-experts", "--env", "slide", "--intervention", "drag", *common, "demos"],
        ["train-airl", "--demos", "demos", "--method", "irm", *common, "irm"],
        ["transfer", "--reward", "irm", "--ood", "drag", *common, "moved"],
        ["evaluate", "--policy", "moved", *common, "score"],
    ):
        done = irl(*arguments)
        assert done.code == 0, done.err
    assert "slide drag=0.9" in done.err


def test_an_environment_with_symmetries(irl, lab, tmp_path, monkeypatch):
    lab("slide.py")
    written = lab("slide_symmetries.py")
    (tmp_path / "slide.toml").write_text(example("slide.toml"))
    monkeypatch.setattr("irlcli.configs.load.settings_directory", lambda: tmp_path)
    from lab.slide import SPEC

    spec = SPEC._replace(symmetries="lab.slide_symmetries:symmetries")
    monkeypatch.setitem(registry.ENVIRONMENTS, spec.name, spec)
    common = ["--store", tmp_path / "runs", "--profile", "smoke", "--quiet"]
    demos = ["collect-experts", "--env", "slide", "--intervention", "drag", "--name", "demos"]
    train = ["train-airl", "--demos", "demos", "--method", "erm", "--set", "airl.logit=f"]
    made = []
    for words in (demos, train, [*train, "--set", "airl.symmetries=true"]):
        done = irl(*words, *common)
        assert done.code == 0, done.err
        made.append(done.out.strip())
    assert len({(Path(at) / "reward.pt").read_bytes() for at in made[1:]}) == 2
    assert "PASS  its symmetries" in irl("envs", "check", "slide").out
    # Two slides that are no group.
    written.write_text(written.read_text().replace("-1.0", "-2.0"))
    del sys.modules["lab.slide_symmetries"]
    done = irl(*train, *common, "--set", "airl.symmetries=true", "--seed", 1)
    assert done.code == 1
    assert "lab.slide_symmetries:symmetries" in done.err and "no group" in done.err
    done = irl("envs", "check", "slide")
    assert done.code == 1 and "no group" in done.out


def test_a_stage(lab, store_copy):
    lab("count_steps.py")
    from lab import count_steps

    runner = Runner(store_copy.path)
    source, _, _ = demonstrations(runner.store, "demos")
    first, again = (runner.run(count_steps.request(source)) for _ in range(2))
    assert first.id == again.id
    steps = int((first.directory / "steps.txt").read_text())
    import pyarrow.parquet as pq

    assert steps == pq.read_table(source.path / "steps.parquet").num_rows
