"""``benchmarks.intervals`` pools the seeds of several published reports."""

import numpy as np
import pandas as pd
import pytest

from benchmarks.intervals import contrast, main, pooled
from irlcli.report.statistics import compare


def _seeds(numbers, expert="e1", returns=100.0):
    rows = [
        {"agent": "expert", "measure": "ood", "setting": "mass=3x", "expert_of": "mass=3x"}
        | {"true_return": 300.0, "evaluation": expert}
    ]
    rows += [
        {"agent": method, "measure": "transfer", "setting": "mass=3x", "seed": seed}
        | {"true_return": returns + seed * (1 if method == "erm" else 3)}
        for method in ("erm", "irm")
        for seed in numbers
    ]
    return pd.DataFrame(rows).assign(row="ant mass", retraining=0)


def test_pooled_reports_equal_one_report_of_all_seeds(tmp_path, capsys):
    for name, numbers in {"one": [0, 1], "two": [2], "all": [0, 1, 2]}.items():
        (tmp_path / name).mkdir()
        _seeds(numbers).to_csv(tmp_path / name / "seeds.csv", index=False)
    main([tmp_path / "one", tmp_path / "two"], pool=True)
    together = capsys.readouterr().out
    main([tmp_path / "all"], pool=False)
    assert together.replace("one + two", "all") == capsys.readouterr().out
    assert "ERM 101.0 ± 1.0 (3 seeds), IRM 103.0 ± 3.0 (3 seeds), IRM - ERM 2.0" in together


def test_the_contrast_of_two_means_is_welchs_test():
    x, y = [3.0, 5.0, 10.0], [1.0, 2.0, 4.0, 4.5]
    groups = [(s, np.mean(v), np.std(v, ddof=1), len(v)) for s, v in ((1, x), (-1, y))]
    found = compare(x, y)
    assert contrast(groups) == pytest.approx((found.difference, *found.interval, found.welch))


def test_the_papers_difference_stands_beside_ours(tmp_path, capsys):
    _seeds([0, 1, 2]).assign(row="ant friction").to_csv(tmp_path / "seeds.csv", index=False)
    main([tmp_path], pool=False)
    assert "the paper's IRM - ERM 241.2 [" in capsys.readouterr().out


def test_a_seed_in_two_reports_is_refused():
    with pytest.raises(ValueError, match="seed 1 of erm"):
        pooled([_seeds([0, 1]), _seeds([1, 2])])


def test_reports_of_different_demonstrations_are_refused():
    one, two = _seeds([0]).assign(demonstrations="d1"), _seeds([1]).assign(demonstrations="d2")
    with pytest.raises(ValueError, match=r"erm of ant mass .* demonstrations: d1, d2"):
        pooled([one, two])
    # A report of an earlier version does not say what its seeds learned from.
    for other in (_seeds([1]), two.assign(demonstrations="d1")):
        assert len(pooled([one, other])) == 5


def test_reports_with_different_experts_are_refused():
    with pytest.raises(ValueError, match="different experts"):
        pooled([_seeds([0]), _seeds([1], expert="e2")])
