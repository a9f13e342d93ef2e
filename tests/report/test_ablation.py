"""Variants side by side: shares of the experts, their comparison with the base, gates."""

import numpy as np
import pandas as pd
import pytest
from report_examples import BOUNCE, ROWS, column, table

from irlcli.report.build import as_json, build
from irlcli.report.parameters import Cell, Parameters, Variant

VARIANTS = (
    Variant("full"),
    Variant("no ceiling", ("transfer.ceiling=none",)),
    Variant("no challengers", ("airl.challenger.life=0",)),
)
FIRST, SECOND = "bounce=0.1", "bounce=0.5"
EXPERTS = {FIRST: (200.0, 50.0), SECOND: (100.0, 20.0)}


def ablation(returns, experts=EXPERTS, method="erm", shared=()):
    """The report; ``returns`` maps (variant, measure, setting) to a return for each seed.

    In place of a return there may be a list: one for each retraining. The variants and measures
    of ``shared`` have the runs of "full".
    """
    points, cells, runs = [], [], {}

    def add(agent, measure, setting, seed, value, progress, retraining=0):
        owner = "full" if (agent, measure) in shared else agent
        own = f"{len(cells):016x}"
        run = (
            ""
            if value is None
            else runs.setdefault((owner, measure, setting, seed, retraining), own)
        )
        why = "" if run else "no result of transfer"
        where = setting if measure == "transfer-id" else ""
        cells.append(Cell(BOUNCE, agent, measure, seed, where, run, why, retraining))
        if run:
            point = {"row": BOUNCE, "agent": agent, "measure": measure, "seed": seed}
            point |= {"retraining": retraining, "setting": setting, "true_return": value}
            point |= {"progress": progress, "learned_return": None, "episodes": 20, "stopped": 0}
            points.append(point | {"evaluation": run})

    for setting, (value, progress) in experts.items():
        add("expert", "id", setting, None, value, progress)
    for (variant, measure, setting), values in returns.items():
        for seed, value in enumerate(values):
            for retraining, each in enumerate(value if isinstance(value, list) else [value]):
                add(variant, measure, setting, seed, each, 10.0, retraining)
    p = Parameters(
        kind="retraining",
        title="Parts",
        command="irl report retraining",
        measures=("transfer-id", "id"),
        rows=ROWS[:1],
        methods=tuple(v.name for v in VARIANTS),
        variants=VARIANTS,
        learned_by=method,
        seeds=(0, 1, 2),
        cells=tuple(cells),
        runs={},
        libraries={},
        others=(),
    )
    return build(p, pd.DataFrame(points), {}, {})


def test_a_variant_is_not_compared_on_runs_that_it_shares():
    found = ablation(RETURNS, shared={("no ceiling", "id")}).comparisons
    assert set(found[found["measure"] == "id"]["x"]) == {"no challengers"}
    assert set(found[found["measure"] == "transfer-id"]["x"]) == {"no ceiling", "no challengers"}
    assert set(ablation(RETURNS).comparisons["x"]) == {"no ceiling", "no challengers"}
    assert len(ablation(RETURNS).comparisons) == 4


RETURNS = {
    ("full", "transfer-id", FIRST): [180.0, 190.0, 200.0],
    ("full", "transfer-id", SECOND): [72.0, 87.0, 98.0],
    ("full", "id", FIRST): [160.0] * 3,
    ("full", "id", SECOND): [90.0] * 3,
    ("no ceiling", "transfer-id", FIRST): [20.0, 50.0, 20.0],
    ("no ceiling", "transfer-id", SECOND): [10.0, 5.0, 10.0],
    ("no ceiling", "id", FIRST): [160.0] * 3,
    ("no ceiling", "id", SECOND): [90.0] * 3,
    # Seed 2 lacks a setting, so it has no mean over settings.
    ("no challengers", "transfer-id", FIRST): [100.0, 140.0, 180.0],
    ("no challengers", "transfer-id", SECOND): [50.0, 60.0, None],
}


def test_a_seed_that_lacks_a_retraining_is_not_compared():
    returns = RETURNS | {
        ("full", "transfer-id", FIRST): [[180.0, 160.0], [190.0, 170.0], [200.0, None]],
        ("full", "transfer-id", SECOND): [[72.0] * 2, [87.0] * 2, [98.0] * 2],
    }
    report = ablation(returns)
    full = report.variants.set_index("agent").loc["full"]
    assert full["seeds"] == 2 and full["mean"] == pytest.approx(np.mean([0.785, 0.885]))
    first = report.by_training_setting
    first = first[(first["agent"] == "full") & (first["setting"] == FIRST)]
    assert first[["seeds", "mean"]].values.tolist() == [[2, 175.0]]


def test_returns_are_shares_of_the_settings_own_expert():
    shares = ablation(RETURNS).shares
    chosen = shares[(shares["agent"] == "full") & (shares["measure"] == "transfer-id")]
    found = chosen.pivot(index="seed", columns="setting", values="share")
    assert found[FIRST].tolist() == [0.9, 0.95, 1.0]
    assert found[SECOND].tolist() == [0.72, 0.87, 0.98]
    progress = chosen.pivot(index="seed", columns="setting", values="progress_share")
    assert set(progress[FIRST]) == {0.2} and set(progress[SECOND]) == {0.5}


def test_a_variant_is_its_seeds_means_over_settings():
    full, no_ceiling, no_challengers = ablation(RETURNS).variants.to_dict("records")
    # (0.9 + 0.72) / 2, (0.95 + 0.87) / 2 and (1 + 0.98) / 2.
    assert full["mean"] == pytest.approx((0.81 + 0.91 + 0.99) / 3)
    assert full["deviation"] == pytest.approx(np.std([0.81, 0.91, 0.99], ddof=1))
    # In every setting: 0.9 and 0.72, 0.95 and 0.87, 1 and 0.98.
    assert (full["seeds"], full["passed_80"], full["passed_90"]) == (3, 2, 1)
    assert full["student"] == pytest.approx((0.8 + 0.9) / 2)
    assert full["progress"] == pytest.approx(0.35)
    assert pd.isna(full["difference"]) and full["pairs"] == 0
    assert no_ceiling["mean"] == pytest.approx((0.1 + 0.15 + 0.1) / 3)
    assert no_ceiling["overrides"] == "transfer.ceiling=none" and no_ceiling["passed_80"] == 0
    assert (no_challengers["seeds"], no_challengers["pairs"]) == (2, 2)
    assert no_challengers["mean"] == pytest.approx(0.575) and pd.isna(no_challengers["student"])


def test_a_lambda_is_shown_where_the_method_of_the_variants_has_a_penalty():
    for method, shown in (("erm", "-"), ("irm", "1")):
        (budget,) = [t for t in ablation(RETURNS, method=method).tables if t.title == "Budgets"]
        assert budget.rows[0][budget.columns.index("lambda")] == shown


def test_variants_are_compared_with_the_first_by_the_paired_test():
    _, no_ceiling, no_challengers = ablation(RETURNS).variants.to_dict("records")
    # 0.1, 0.15 and 0.1 against 0.81, 0.91 and 0.99.
    d = np.array([-0.71, -0.76, -0.89])
    assert no_ceiling["difference"] == pytest.approx(d.mean())
    t = abs(d.mean()) / (d.std(ddof=1) / 3**0.5)
    # Student's t with two degrees of freedom.
    assert no_ceiling["p_paired"] == pytest.approx(1 - t / (t**2 + 2) ** 0.5)
    # 0.5 - 0.81 and 0.65 - 0.91: mean -0.285, t = 11.4 with one degree of freedom.
    assert no_challengers["difference"] == pytest.approx(-0.285)
    assert no_challengers["p_paired"] == pytest.approx(1 - 2 * np.arctan(11.4) / np.pi)
    assert no_ceiling["p_paired"] < no_challengers["p_paired"]
    assert no_ceiling["p_paired_holm"] == pytest.approx(2 * no_ceiling["p_paired"])
    assert no_challengers["p_paired_holm"] == pytest.approx(no_challengers["p_paired"])
    report = ablation(RETURNS)
    # Welch's p of both variants are one family.
    smaller = report.comparisons.sort_values("p_welch").iloc[0]
    assert smaller["p_welch_holm"] == pytest.approx(2 * smaller["p_welch"])
    pairs = report.comparisons[["x", "y"]].drop_duplicates().to_numpy().tolist()
    assert pairs == [["no ceiling", "full"], ["no challengers", "full"]]


def test_the_table_has_a_line_for_each_variant_with_each_seed():
    shown = table(ablation(RETURNS), "Retrained in distribution: lunar-lander bounce")
    assert column(shown, "variant") == ["full", "no ceiling", "no challengers"]
    assert column(shown, FIRST)[0] == "95 % ± 5 (90, 95, 100)"
    assert column(shown, "all settings")[2] == "57 % ± 11 (50, 65)"
    assert column(shown, "80 % and 90 % reached") == ["2/3, 1/3", "0/3, 0/3", "0/2, 0/2"]
    assert column(shown, "difference") == ["-", "-78.7 (3)", "-28.5 (2)"]
    assert column(shown, "student")[0] == "85 % ± 0 (85, 85, 85)"
    assert "AIRL-ERM. " in shown.note and "to those of full" in shown.note


def test_there_is_no_share_of_an_expert_that_earns_nothing():
    report = ablation(RETURNS, {FIRST: (-20.0, 0.0), SECOND: (100.0, 20.0)})
    shares = report.shares.set_index("setting")
    assert shares.loc[FIRST, "share"].isna().all() and shares.loc[SECOND, "share"].notna().all()
    shown = table(report, "Retrained in distribution: lunar-lander bounce")
    assert column(shown, "all settings") == ["-"] * 3 and column(shown, FIRST) == ["-"] * 3


def test_without_an_evaluation_a_variant_has_no_numbers():
    returns = {key: values for key, values in RETURNS.items() if key[0] == "full"}
    report = ablation(returns)
    shown = table(report, "Retrained in distribution: lunar-lander bounce")
    assert column(shown, "all settings")[1:] == ["-", "-"]
    assert as_json(report)["variants"][1]["mean"] is None
