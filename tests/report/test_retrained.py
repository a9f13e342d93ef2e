"""Policies retrained in distribution, from the student, and several times on one reward."""

import msgspec
import numpy as np
import pandas as pd
import pytest
from msgspec.structs import replace
from report_examples import BOUNCE, cell, column, complete, example, table

from irlcli.data.descriptions import RewardOrigin
from irlcli.report.assessment import assess
from irlcli.report.build import as_json, build
from irlcli.report.retrained import paired_errors
from irlcli.report.reward_quality import Member

MEASURES = ("transfer", "from-student", "transfer-id", "zero-shot", "id")


def with_points(p, points, *more):
    """The report with further points; each is (agent, measure, seed, retraining, setting, return)."""
    columns = ["agent", "measure", "seed", "retraining", "setting", "true_return"]
    added = pd.DataFrame([dict(zip(columns, m, strict=True)) for m in more])
    added = added.assign(row=BOUNCE, episodes=20, evaluation="0" * 16)
    both = pd.concat([points, added.reindex(columns=points.columns)], ignore_index=True)
    return build(p, both.astype({"progress": "float", "learned_return": "float"}), {}, {})


def test_retrainings_are_averaged_and_their_spread_is_told_apart():
    values = complete()
    del values[BOUNCE, "irm", "transfer"]
    p, points = example(values, retrainings=2)
    returns = {0: (10.0, 14.0), 1: (20.0, 20.0)}
    report = with_points(
        p,
        points,
        *(
            ("irm", "transfer", seed, k, "bounce=0.9", value)
            for seed, pair in returns.items()
            for k, value in enumerate(pair)
        ),
    )
    found = cell(report, BOUNCE, "irm", "transfer")
    # The means of the rewards are 12 and 20. Their retrainings' variances are 8 and 0.
    assert (found["seeds"], found["mean"]) == (2, 16.0)
    assert found["deviation"] == pytest.approx(32**0.5)
    assert found["between_retrainings"] == pytest.approx(2.0)
    assert pd.isna(cell(report, BOUNCE, "erm", "transfer")["between_retrainings"])
    # The paired test compares the means: 12 - 1 and 20 - 2.
    first = report.comparisons.iloc[0]
    assert (first["pairs"], first["difference"]) == (2, 16.0 - 2.0)
    assert "retrained 2 times" in report.tables[0].note
    assert "retrained" not in build(*example(complete()), {}, {}).tables[0].note


def test_retrainings_in_several_settings_do_not_average_their_spread_away():
    """The policies of each setting differ by 10: variances of 50, whatever the other setting's are."""
    values = complete()
    p, points = example(values, measures=MEASURES, retrainings=2)
    points = points[points["measure"] != "transfer-id"]
    report = with_points(
        p,
        points,
        *(
            ("irm", "transfer-id", 0, k, setting, value)
            for setting, pair in (("bounce=0.1", (0.0, 10.0)), ("bounce=0.5", (20.0, 10.0)))
            for k, value in enumerate(pair)
        ),
    )
    found = cell(report, BOUNCE, "irm", "transfer-id")["between_retrainings"]
    assert found == pytest.approx(50.0**0.5)


def test_retraining_in_distribution_is_a_share_of_each_settings_own_expert():
    values = complete()
    del values[BOUNCE, "expert", "id"]
    p, points = example(values, measures=MEASURES)
    report = with_points(
        p,
        points,
        ("expert", "id", None, 0, "bounce=0.1", 200.0),
        ("expert", "id", None, 0, "bounce=0.5", 100.0),
        ("erm", "transfer-id", 0, 0, "bounce=0.1", 100.0),
        ("erm", "transfer-id", 0, 0, "bounce=0.5", 90.0),
        ("erm", "transfer-id", 1, 0, "bounce=0.1", 180.0),
    )
    found = report.by_training_setting.set_index(["row", "setting", "agent"])
    first, second = (found.loc[(BOUNCE, f"bounce={v}", "erm")] for v in ("0.1", "0.5"))
    assert (first["seeds"], first["mean"], first["of_expert"]) == (2, 140.0, 0.7)
    assert (second["seeds"], second["mean"], second["of_expert"]) == (1, 90.0, 0.9)
    shown = table(report, "Retrained in distribution, by setting")
    assert column(shown, "of the expert") == ["70%", "90%"]
    assert "by_training_setting" in as_json(report)


def test_retraining_from_the_student_is_compared_with_the_same_seeds_student():
    values = complete()
    values[BOUNCE, "erm", "from-student"] = [130.0, 115.0, 110.0]
    p, points = example(values, measures=MEASURES)
    report = build(p, points, {}, {})
    (found,) = report.against_zero_shot.to_dict("records")
    # The students earn 100, 110 and 120.
    assert (found["agent"], found["pairs"], found["better"]) == ("erm", 3, 2)
    assert found["difference"] == pytest.approx((30 + 5 - 10) / 3)
    assert 0.0 < found["p_paired"] < 1.0
    assert column(table(report, "From the student, against"), "better") == ["2/3"]
    without, points = example(values, measures=("transfer", "zero-shot", "id"))
    assert build(without, points, {}, {}).against_zero_shot.empty


def test_measures_in_distribution_stand_beside_the_training_settings_experts():
    values = complete()
    values[BOUNCE, "erm", "transfer-id"] = [125.0]
    p, points = example(values, measures=MEASURES)
    report = build(p, points, {}, {})
    found = cell(report, BOUNCE, "erm", "transfer-id")
    # The expert earns 250; one of several evaluations may be missing, which is no share.
    assert found["of_expert"] == 0.5 and pd.isna(found["imitated"])
    missing = [c for c in p.cells if (c.agent, c.measure) == ("erm", "transfer-id")]
    part = msgspec.structs.replace(
        missing[0], run="", setting="bounce=0.5", why="no result of transfer"
    )
    p = msgspec.structs.replace(p, cells=(*p.cells, part))
    assert pd.isna(cell(build(p, points, {}, {}), BOUNCE, "erm", "transfer-id")["of_expert"])


def test_verdicts_are_on_policies_that_began_at_random_whatever_their_names():
    def member(policy, kind, true, spread=1.0):
        returns = np.array([true - spread, true + spread])
        return Member(policy, kind, "bounce=0.9", returns, returns, np.ones(2))

    members = [
        member("idle", "idle", 0.0),
        member("random", "random", -100.0),
        member("expert of bounce=0.9", "expert", 100.0),
        member("begun as a student", "retrained", 99.0),
        member("the other", "from-student", -50.0),
    ]
    reward = RewardOrigin(method="irm", seed=0, settings=("bounce=0.1",))
    assessment = assess("lunar-lander", reward, members, {})
    verdicts = {r.policy: r.verdict for s in assessment.settings for r in s.retrained}
    assert verdicts["the other"] == "optimisation fell short"
    p, points = example(complete())
    report = build(p, points, {}, {}, {(BOUNCE, "irm", 0): assessment})
    assert report.reward_quality["verdicts"].tolist() == [["matches the expert"]]
    assert report.reward_quality["uncertain"].tolist() == [0]
    # Regrets of 16 and 20, of which 20 are allowed: 2 less in the mean, one standard error.
    members[3] = member("begun as a student", "retrained", 82.0, spread=-1.0)
    close = assess("lunar-lander", reward, members, {})
    report = build(p, points, {}, {}, {(BOUNCE, "irm", 0): close})
    assert report.reward_quality["uncertain"].tolist() == [1]
    assert column(table(report, "Reward quality"), "uncertain") == ["1/1"]
    # Beside an expert that earns no more than the random agent, a verdict says nothing.
    members[1] = member("random", "random", 100.0)
    weak = assess("lunar-lander", reward, members, {})
    report = build(p, points, {}, {}, {(BOUNCE, "irm", 0): weak})
    assert report.reward_quality["verdicts"].tolist() == [[]]
    assert any("bounce=0.9 the expert earns no more" in caveat for caveat in report.caveats)
    assert [r.verdict for s in weak.settings for r in s.retrained] == [None, None]
    # Beside an idle agent that earns more, the verdict stays.
    members[1] = member("random", "random", -100.0)
    idle = assess("lunar-lander", reward, [*members, member("idle", "idle", 100.0)], {})
    report = build(p, points, {}, {}, {(BOUNCE, "irm", 0): idle})
    assert report.reward_quality["verdicts"].tolist() == [["matches the expert"]]
    (named,) = (c for c in report.caveats if c.startswith("Weak expert"))
    assert "no more than the idle agent" in named


def test_the_budget_of_retraining_from_the_student_is_listed():
    plain, more = (
        table(build(*example(complete(), measures=measures), {}, {}), "Budgets")
        for measures in (("transfer", "id"), ("transfer", "from-student", "id"))
    )
    assert column(more, "from the student") == ["400", "400"]
    assert column(plain, "from the student") == ["-", "-"]
    assert column(plain, "transfer steps") == column(more, "transfer steps") == ["3,000", "3,000"]


def test_a_budget_that_training_may_leave_unused_is_an_upper_limit():
    p, points = example(complete())
    first, second = p.rows
    early = first.config | {"airl": first.config["airl"] | {"plateau_rounds": 10}}
    p = replace(p, rows=(replace(first, config=early), second))
    shown = table(build(p, points, {}, {}), "Budgets")
    assert column(shown, "AIRL steps") == ["at most 2,000", "2,000"]


def test_a_difference_has_no_standard_error_where_an_error_stopped_an_episode():
    """The means are then of other episodes than the pairs."""

    def episodes(returns, errors):
        rows = enumerate(zip(returns, errors, strict=True))
        return pd.DataFrame(
            [
                {"setting": setting, "episode": k, "seed": k, "true_return": value + k}
                | {"error": error if setting == "b" else ""}
                for k, (value, error) in rows
                for setting in ("a", "b")
            ]
        )

    policy = episodes([0.0, 100.0, 101.0], ["", "", ""])
    for errors in (["", "fell", ""], ["fell"] * 3):
        found = paired_errors(policy, episodes([50.0, 100.0, 102.0], errors))
        assert found == {("a", "true_return"): pytest.approx(np.std([50, 0, 1], ddof=1) / 3**0.5)}
