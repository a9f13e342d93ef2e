"""A report's numbers, from evaluations made up here."""

import msgspec
import numpy as np
import pandas as pd
import pytest
from report_examples import (
    BOUNCE,
    CONFIG,
    POWER,
    ROWS,
    cell,
    complete,
    example,
    metrics,
    scored,
    table,
)

from irlcli.configs import Config
from irlcli.report.agents import comparisons
from irlcli.report.build import build
from irlcli.report.compute import compare_methods, imitates
from irlcli.report.parameters import EXPERT_BY_REWARD, Cell


def test_cells_are_means_over_seeds():
    report = build(*example(complete()), {}, {})
    found = cell(report, BOUNCE, "irm", "transfer")
    assert (found["mean"], found["seeds"], found["seeds_wanted"]) == (4.0, 3, 3)
    assert found["deviation"] == pytest.approx(7**0.5)


def test_only_a_mean_can_be_partial():
    values = complete()
    values[BOUNCE, "reused", "ood"] = [None]
    found = cell(build(*example(values), {}, {}), BOUNCE, "reused", "ood")
    assert (found["complete"], found["partial"], found["seeds"]) == (False, False, 0)


def test_methods_are_compared_row_by_row():
    report = build(*example(complete()), {}, {})
    first = report.comparisons.iloc[0]
    assert (first["row"], first["x"], first["y"]) == (BOUNCE, "irm", "erm")
    assert first["difference"] == 2.0
    # Two rows with the same p: Holm doubles it.
    assert first["p_welch_holm"] == pytest.approx(2 * first["p_welch"])
    assert first["improvement"] == pytest.approx((1.5 + 2.5 + 3) / 9)


def test_the_paired_test_uses_the_seeds_that_both_methods_have():
    values = complete()
    # Seeds 1 and 2 are common; their differences are 4 and 2: t = 3 with one degree of freedom.
    values[BOUNCE, "erm", "transfer"] = [None, 5.0, 1.0]
    values[BOUNCE, "irm", "transfer"] = [-100.0, 9.0, 3.0]
    report = build(*example(values), {}, {})
    first = report.comparisons.iloc[0]
    assert first["pairs"] == 2
    assert first["p_paired"] == pytest.approx(1 - 2 * np.arctan(3) / np.pi)
    shown = table(report, "Comparisons")
    assert shown.rows[0][shown.columns.index("paired")] == "0.205 (2)"


def test_methods_that_seek_invariance_are_compared_with_all_others():
    methods = ("erm", "irm", "erm-balanced", "irm-shuffled", "mine")
    controls = ("erm", "erm-balanced", "irm-shuffled", "mine")
    assert comparisons(methods) == [("irm", control) for control in controls]
    assert comparisons(("erm", "erm-balanced")) == []


def test_reused_experts_are_one_number_and_no_sample():
    report = build(*example(complete()), {}, {})
    unseen, trained = (cell(report, BOUNCE, "reused", m) for m in ("ood", "id"))
    assert (unseen["mean"], unseen["seeds"], unseen["seeds_wanted"]) == (110.0, 1, 1)
    assert pd.isna(unseen["deviation"]) and pd.isna(unseen["of_expert"])
    assert (trained["mean"], trained["of_expert"]) == (250.0, 1.0)
    assert trained["imitated"] is pd.NA
    partly = complete() | {(BOUNCE, "reused", "id"): [200.0, None]}
    assert cell(build(*example(partly), {}, {}), BOUNCE, "reused", "id")["of_expert"] is pd.NA


@pytest.mark.parametrize(
    ("student", "expert", "expected"),
    [
        *((80.0, 100.0, True), (79.9, 100.0, False), (-11.9, -10.0, True), (-12.1, -10.0, False)),
        *((None, 1.0, None), (1.0, None, None), (0.0, 0.0, True)),
    ],
)
def test_imitation_is_within_a_fifth_of_the_expert(student, expert, expected):
    assert imitates(student, expert) is expected


def test_a_student_below_the_bar_has_not_imitated():
    report = build(*example(complete(student=199.0)), {}, {})
    assert not cell(report, BOUNCE, "erm", "id")["imitated"]
    assert cell(report, BOUNCE, "irm", "id")["imitated"]
    assert cell(report, BOUNCE, "erm", "id")["of_expert"] == pytest.approx(0.796)
    assert set(report.comparisons["not_imitated"]) == {"erm"}


def test_a_student_must_imitate_in_every_training_setting():
    """It earns 100 and 70 of the experts' 100; its three seeds count once."""
    p, points = example(complete(), rows=ROWS[:1])
    own = points["agent"].isin(["expert", "irm"]) & (points["measure"] == "id")
    in_both = [
        points[own].assign(
            setting=setting,
            true_return=[100.0 if agent == "expert" else earned for agent in points[own]["agent"]],
        )
        for setting, earned in (("bounce=0.1", 100.0), ("bounce=0.5", 70.0))
    ]
    found = cell(build(p, pd.concat([points[~own], *in_both]), {}, {}), BOUNCE, "irm", "id")
    assert not found["imitated"]
    assert found["of_expert"] == pytest.approx(0.85)
    assert found["least_of_expert"] == pytest.approx(0.7)


def test_a_negative_expert_has_no_share():
    values = complete() | {(BOUNCE, "expert", "id"): [-250.0]}
    assert cell(build(*example(values), {}, {}), BOUNCE, "irm", "id")["of_expert"] is pd.NA


def test_the_paired_test_pairs_equal_seeds():
    """The differences are 2, -1 and -1; those of the sorted returns would be zero."""
    values = complete()
    values[BOUNCE, "erm", "transfer"] = [1.0, 2.0, 3.0]
    values[BOUNCE, "irm", "transfer"] = [3.0, 1.0, 2.0]
    first = build(*example(values), {}, {}).comparisons.iloc[0]
    assert first["p_paired"] == pytest.approx(1.0)


def test_each_pair_of_methods_is_adjusted_over_the_rows_alone():
    values = complete()
    for row in (BOUNCE, POWER):
        values[row, "irm-shuffled", "transfer"] = [0.0, 1.0, 9.0]
        values[row, "irm-shuffled", "id"] = [240.0, 241.0, 242.0]
    given = {"methods": ("erm", "irm", "irm-shuffled"), "measures": ("transfer",)}
    two = build(*example(values, **given), {}, {}).comparisons
    assert two["p_welch_holm"].tolist() == pytest.approx(
        (2 * two["p_welch"]).clip(upper=1).tolist()
    )
    one = build(*example(values, rows=ROWS[:1], **given), {}, {}).comparisons
    assert len(one) == 2 and one["p_welch_holm"].tolist() == one["p_welch"].tolist()


def test_learned_returns_rank_policy_and_expert():
    pairs = {
        (BOUNCE, "erm"): [(4, 1), (5, 1), (9, 10)],
        (BOUNCE, "irm"): [(1, 2), (1, 1), (1, 2)],
    }
    report = scored(pairs)
    assert report.learned_returns.to_dict("records") == [
        {
            **{"row": BOUNCE, "agent": agent, "seeds": 3, "judged": 3},
            **{"retrained": policy, "expert": expert, "short": 3, "short_scored_higher": higher},
            **{"uncertain": 3, "short_uncertain": 3},
        }
        for agent, policy, expert, higher in (("erm", 6.0, 4.0, 2), ("irm", 1.0, 5 / 3, 1))
    ]
    # The expert's returns under the rewards are in no cell.
    assert set(report.cells["measure"]) == {"ood", "id", "transfer", "zero-shot"}


@pytest.mark.parametrize(
    ("returns", "short"), [([206.0, 250.0, 260.0], 0), ([280.0, 0.0, 204.0], 2)]
)
def test_only_policies_that_fall_short_count_as_scored_higher(returns, short):
    values = complete() | {(BOUNCE, "erm", "transfer"): returns}
    values[BOUNCE, "erm", EXPERT_BY_REWARD] = [250.0] * 3
    p, points = example(values)
    # The reward scores seed 0 higher, which does not fall short in either case.
    higher = (points["measure"] == "transfer") & (points["seed"] == 0)
    points["learned_return"] = higher.astype(float)
    points.loc[points["measure"] == EXPERT_BY_REWARD, "learned_return"] = 0.5
    report = build(p, points, {}, {})
    (found,) = report.learned_returns.itertuples()
    assert (found.agent, found.short, found.short_scored_higher) == ("erm", short, 0)
    assert any(c.startswith("Short of") for c in report.caveats) == (short > 0)


def test_beside_an_expert_no_better_than_random_none_is_judged():
    values = complete() | {(BOUNCE, "erm", "transfer"): [5.0] * 3}
    values[BOUNCE, "erm", EXPERT_BY_REWARD] = [10.0] * 3
    values[BOUNCE, "random", "ood"] = [50.0]
    p, points = example(values)
    points["learned_return"] = 0.0
    report = build(p, points, {}, {})
    (found,) = report.learned_returns.itertuples()
    assert (found.judged, found.short, found.short_scored_higher) == (0, 0, 0)
    (table,) = (t for t in report.tables if t.title == "Learned returns")
    assert dict(zip(table.columns, table.rows[0], strict=True))["short"] == "-"
    assert not any(c.startswith("Short of") for c in report.caveats)


@pytest.mark.parametrize(("error", "uncertain"), [(None, 3), (4.0, 0), (6.0, 1), (30.0, 2)])
def test_verdicts_within_two_standard_errors_are_uncertain(error, uncertain):
    """Learned returns of the expert are higher by 10, 20 and 100."""
    values = complete() | {(BOUNCE, "erm", EXPERT_BY_REWARD): [250.0] * 3}
    p, points = example(values)
    mine = (
        (points["measure"] == "transfer") & (points["agent"] == "erm") & (points["row"] == BOUNCE)
    )
    points.loc[mine, "learned_return"] = [90.0, 80.0, 0.0]
    points.loc[points["measure"] == EXPERT_BY_REWARD, "learned_return"] = 100.0
    points[["regret_error", "gap_error"]] = error
    (found,) = build(p, points, {}, {}).learned_returns.itertuples()
    assert (found.short, found.uncertain, found.short_uncertain) == (3, uncertain, uncertain)


def test_only_policies_that_fall_short_count_as_uncertain_in_the_caveat():
    """Regrets of 45, 46 and 200, of which 45 are allowed: the first is no caveat, however uncertain."""
    values = complete() | {(BOUNCE, "erm", EXPERT_BY_REWARD): [250.0] * 3}
    values[BOUNCE, "erm", "transfer"] = [205.0, 204.0, 50.0]
    p, points = example(values)
    points["learned_return"] = (points["measure"] == EXPERT_BY_REWARD) * 100.0
    points[["regret_error", "gap_error"]] = 1.0
    report = build(p, points, {}, {})
    (found,) = report.learned_returns.itertuples()
    assert (found.short, found.uncertain, found.short_uncertain) == (2, 2, 1)
    (caveat,) = (c for c in report.caveats if c.startswith("Short of"))
    assert "2 of 3" in caveat and caveat.endswith("standard errors): 1 of the 2.")


def test_every_retrained_policy_of_a_reward_is_judged():
    """Of two policies on one reward one is as good as the expert; their mean would be short, too."""
    values = complete() | {(BOUNCE, "erm", "transfer"): [280.0, 280.0, 280.0]}
    values[BOUNCE, "erm", EXPERT_BY_REWARD] = [280.0] * 3
    p, points = example(values)
    second = points[(points["measure"] == "transfer") & (points["agent"] == "erm")]
    points = pd.concat([points, second.assign(true_return=-100.0)], ignore_index=True)
    points["learned_return"] = 1.0
    (found,) = build(p, points, {}, {}).learned_returns.itertuples()
    assert (found.seeds, found.judged, found.short) == (3, 6, 3)


def test_seeds_count_equally_however_often_each_was_retrained():
    """Seed 0 has three policies in its training setting, the other seeds have one."""
    values = complete() | {(BOUNCE, "erm", EXPERT_BY_REWARD): [280.0] * 3}
    values[BOUNCE, "erm", "transfer-id"] = [125.0, 250.0, 250.0]
    p, points = example(values, measures=("transfer", "transfer-id", "id"))
    mine = (points["row"] == BOUNCE) & (points["agent"] == "erm")
    first = points[mine & (points["seed"] == 0) & points["measure"].str.startswith("transfer")]
    points["learned_return"] = (points["measure"] == "transfer") * points["seed"].fillna(0.0)
    again = [first.assign(retraining=n, learned_return=0.0) for n in (1, 2)]
    report = build(p, pd.concat([points, *again], ignore_index=True), {}, {})
    found = next(r for r in report.learned_returns.itertuples() if r.row == BOUNCE)
    assert (found.judged, found.retrained) == (5, pytest.approx((0 + 1 + 2) / 3))
    share = cell(report, BOUNCE, "erm", "transfer-id")["of_expert"]
    assert share == pytest.approx((125 + 250 + 250) / 3 / 250)


def test_learned_returns_need_both_evaluations_of_a_seed():
    values = complete()
    values[BOUNCE, "erm", EXPERT_BY_REWARD] = [250.0, None, 250.0]
    p, points = example(values)
    points["learned_return"] = 2.0
    points.loc[(points["measure"] == "transfer") & (points["seed"] == 0), "learned_return"] = None
    found = build(p, points, {}, {}).learned_returns
    assert [(r.agent, r.seeds) for r in found.itertuples()] == [("erm", 1)]


def test_the_penaltys_share_is_of_what_was_optimised():
    learning = {
        # Fresh samples have a penalty of 0.5 and a cross-entropy of 0.4 (0.3 and 0.5).
        (BOUNCE, "irm", 0): metrics(0.94, 0.001, 8.0),
        (BOUNCE, "irm", 1): metrics(0.98, 0.004, 0.5),
        (BOUNCE, "erm", 0): metrics(0.99, 0.0, 0.0),
    }
    found = build(*example(complete()), {}, learning).discriminators.set_index("agent")
    # (8 * 0.001 + 0.5 * 0.004) / 2 of 0.2, not the product of the means.
    assert found.loc["irm", "share"] == pytest.approx(0.025)
    assert found.loc["irm", "optimised_penalty"] == pytest.approx(0.0025)
    assert found.loc["irm", "optimised_cross_entropy"] == pytest.approx(0.2)
    assert found.loc["irm", ["penalty", "cross_entropy"]].tolist() == pytest.approx([0.5, 0.4])
    assert found.loc["irm", "accuracy"] == pytest.approx(0.96)
    assert (found.loc["erm", "share"], found.loc["irm", "seeds"]) == (0.0, 2)


def test_the_penaltys_share_is_of_the_students_part_of_the_loss():
    """Challengers have nine tenths of it in the first method's loss."""
    rows = [msgspec.structs.replace(row, student_share={"irm": 0.1}) for row in ROWS]
    learning = {(BOUNCE, method, 0): metrics(0.9, 0.001, 8.0) for method in ("irm", "vrex")}
    p, points = example(complete(), rows=tuple(rows), methods=("irm", "vrex"))
    found = build(p, points, {}, learning).discriminators.set_index("agent")
    assert found.loc["irm", "share"] == pytest.approx(0.4)
    assert found.loc["vrex", "share"] == pytest.approx(0.04)
    assert found["optimised_cross_entropy"].tolist() == pytest.approx([0.2, 0.2])


def test_a_share_of_a_zero_cross_entropy_is_missing():
    certain = metrics(1.0, -0.0001, 4.0).assign(optimised_cross_entropy=0.0)
    report = build(*example(complete()), {}, {(BOUNCE, "irm", 0): certain})
    (found,) = report.discriminators.itertuples()
    assert pd.isna(found.share)


def test_seeds_are_missing_from_cells_and_tests():
    values = complete()
    values[BOUNCE, "irm", "transfer"] = [5.0, None, None]
    values[POWER, "irm", "transfer"] = [None] * 3
    report = build(*example(values), {}, {})
    c = report.comparisons[report.comparisons["measure"] == "transfer"]
    assert c[["p_welch", "p_welch_holm", "p_paired"]].isna().all(axis=None)
    assert c["pairs"].tolist() == [1, 0]
    assert "one seed" in c.iloc[0]["why"] and "no seed" in c.iloc[1]["why"]


def test_the_configs_of_the_rows_are_those_that_the_budgets_read():
    tree = msgspec.to_builtins(Config())
    for stage, values in CONFIG.items():
        assert set(values) <= set(tree[stage])


def test_a_seed_without_all_evaluations_is_not_compared():
    """Two equal methods in settings of about 100 and 300; ERM lacks the second in two seeds."""
    cells, points = [], []
    for agent, lacking in (("erm", {2, 3}), ("irm", set())):
        for seed in range(4):
            for setting, value in (("bounce=0.1", 100.0), ("bounce=0.5", 300.0)):
                run = "" if seed in lacking and setting == "bounce=0.5" else f"{len(points):016x}"
                cells.append(Cell(BOUNCE, agent, "transfer-id", seed, setting=setting, run=run))
                if run:
                    of = {"row": BOUNCE, "agent": agent, "measure": "transfer-id", "seed": seed}
                    points.append(of | {"true_return": value + seed, "progress": None})
    p, _ = example({}, measures=("transfer-id",), seeds=(0, 1, 2, 3))
    p = msgspec.structs.replace(p, cells=tuple(cells))
    columns = {"row": [], "agent": [], "imitated": [], "measure": []}
    found = compare_methods(p, pd.DataFrame(points), pd.DataFrame(columns))
    (one,) = found[found["row"] == BOUNCE].itertuples()
    # Seeds 0 and 1 of ERM against all four of IRM: 200.5 and 201.5.
    assert one.difference == pytest.approx(1.0) and one.pairs == 2
