"""The report of the positive controls: means over seeds, and which lambda leaving out chooses."""

import pandas as pd

from irlcli.report.control import MEASURES, choices, summary
from irlcli.report.means import interval_text


def maps(rows):
    """A frame of results; ``rows`` are (variant, seed, left out, held-out risk, quality)."""
    names = ("variant", "seed", "left_out", "held_out_risk", "quality")
    other = {measure: 0.0 for measure in MEASURES if measure != "quality"}
    return pd.DataFrame(
        [{"case": "choice.1", **other, **dict(zip(names, row, strict=True))} for row in rows]
    )


def test_the_method_is_chosen_whose_mean_risk_in_the_settings_left_out_is_least():
    found = choices(
        maps(
            [
                *(("a", 0, -1, None, 0.3), ("a", 0, 0, 1.0, 0.9), ("a", 0, 1, 4.0, 0.9)),
                *(("b", 0, -1, None, 0.6), ("b", 0, 0, 2.0, 0.1), ("b", 0, 1, 2.0, 0.1)),
                *(("a", 1, -1, None, 0.4), ("a", 1, 0, 1.0, 0.9), ("a", 1, 1, 1.0, 0.9)),
                *(("b", 1, -1, None, 0.7), ("b", 1, 0, 0.5, 0.1), ("b", 1, 1, 2.0, 0.1)),
            ]
        )
    )
    assert found["method"].tolist() == ["b", "a"]
    assert found["quality"].tolist() == [0.6, 0.4]


def test_fits_without_a_setting_are_in_no_mean():
    labels = pd.DataFrame(
        [
            {"problem": "p", "method": "erm", "seed": seed, "trained": 0.8, "unseen": 0.1 * seed}
            for seed in (1, 2)
        ]
    )
    results = maps([("a", 0, -1, None, 0.3), ("a", 1, -1, None, 0.5), ("a", 0, 0, 1.0, 0.9)])
    found = summary(labels, results).set_index(["case", "method", "measure"])
    quality = found.loc[("choice.1", "a", "quality")]
    assert quality["mean"] == 0.4 and quality["seeds"] == 2
    assert 0.3 <= quality["low"] <= quality["high"] <= 0.5
    assert abs(found.loc[("p", "erm", "unseen")]["mean"] - 0.15) < 1e-12


def test_zero_has_no_sign():
    assert interval_text(-0.001, -0.004, 0.2, 2) == "0.00 [0.00, 0.20]"
