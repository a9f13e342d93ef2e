"""Figure 2's statistics against numbers worked out by hand."""

import numpy as np
import pandas as pd
import pytest

from irlcli.report.figure2 import MEASURES, curves, differences, summary, table
from irlcli.report.tables import markdown_table


def quality(variant, setting, seen, values, **more):
    """A row per dataset; every measure has the same value."""
    given = {"grouping": "pooled", "penalty": "none", "penalty_weight": 0.0, "l2": 0.0} | more
    return [
        {"variant": variant, **given, "seed": seed, "setting": setting}
        | {"seen": seen, **dict.fromkeys(MEASURES, value)}
        for seed, value in enumerate(values)
    ]


def test_worst_is_taken_within_each_dataset_and_among_trained_settings():
    rows = quality("erm", "a", True, [1.0, 4.0]) + quality("erm", "b", True, [3.0, 2.0])
    rows += quality("erm", "c", False, [-9.0, -9.0])
    found = summary(pd.DataFrame(rows)).set_index(["setting", "measure"])["mean"]
    assert found["worst", "goal_probability"] == 1.5
    assert found["worst", "value_difference"] == 3.5  # the larger, the worse
    assert found["a", "true_return"] == 2.5
    assert found["c", "log_likelihood"] == -9.0


def test_an_undefined_rank_correlation_counts_as_zero():
    found = summary(pd.DataFrame(quality("erm", "a", True, [np.nan, 1.0])))
    means = found.set_index(["setting", "measure"])["mean"]
    assert means["a", "rank_correlation"] == 0.5


def test_table_has_a_row_per_variant():
    rows = quality("erm", "a", True, [1.0, 1.0]) + quality("erm", "c", False, [0.25, 0.25])
    columns, body = table(summary(pd.DataFrame(rows)), ["c"])
    assert columns[:3] == ["method", "goal probability, worst trained", "goal probability, c"]
    assert body[0][:3] == ["erm", "1.00 [1.00, 1.00]", "0.25 [0.25, 0.25]"]
    assert markdown_table(columns[:2], [r[:2] for r in body]).splitlines() == [
        "| method | goal probability, worst trained |",
        "| --- | --- |",
        "| erm | 1.00 [1.00, 1.00] |",
    ]


def test_differences_are_paired_over_datasets():
    """The datasets differ by 0.5, the methods by 0.1 in each of them."""
    rows = quality("erm", "c", False, [0.1, 0.6]) + quality(
        "erm l2 0.1", "c", False, [1.0, 1.0], l2=0.1
    )
    rows += quality("erm-balanced", "c", False, [0.2, 0.2], grouping="balanced")
    for grouping, variant, values in (
        ("per-setting", "irm", [0.2, 0.7]),
        ("shuffled", "irm-shuffled", [0.0, 0.9]),
    ):
        penalised = {"grouping": grouping, "penalty": "irmv1", "penalty_weight": 0.05}
        rows += quality(f"{variant} irmv1 0.05", "c", False, values, **penalised)
    found = differences(pd.DataFrame(rows), ["c"]).set_index("against")
    assert set(found["variant"]) == {"irm irmv1 0.05"}
    assert found["mean"].round(9).to_dict() == {
        "erm": 0.1,
        "erm-balanced": 0.25,
        "irm-shuffled irmv1 0.05": 0.0,
    }
    assert found.loc["erm", ["low", "high"]].tolist() == pytest.approx([0.1, 0.1])


def test_curves_start_at_weight_zero_with_the_control_beside_the_method():
    rows = quality("erm", "a", True, [1.0]) + quality("erm l2 0.1", "a", True, [1.0], l2=0.1)
    rows += quality("erm-balanced", "a", True, [1.0], grouping="balanced")
    for grouping, variant in (("per-setting", "irm"), ("shuffled", "irm-shuffled")):
        penalised = {"grouping": grouping, "penalty": "closed-form", "penalty_weight": 0.05}
        rows += quality(f"{variant} closed-form 0.05", "a", True, [1.0], **penalised)
    found = curves(pd.DataFrame(rows))
    assert {curve.label: curve.points for curve in found} == {
        "ERM + L2": ((0.0, "erm"), (0.1, "erm l2 0.1")),
        "IRM closed-form": ((0.0, "erm-balanced"), (0.05, "irm closed-form 0.05")),
        "IRM closed-form, labels shuffled": (
            (0.0, "erm-balanced"),
            (0.05, "irm-shuffled closed-form 0.05"),
        ),
    }
    assert found[1].colour == found[2].colour != found[0].colour
