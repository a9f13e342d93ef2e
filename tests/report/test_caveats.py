"""Everything that a reader must know before drawing conclusions is in the caveats."""

import numpy as np
import pytest
from msgspec.structs import replace
from report_examples import (
    BOUNCE,
    POWER,
    cell,
    complete,
    example,
    metrics,
    run_of,
    scored,
    table,
)

from irlcli.report.build import build
from irlcli.report.parameters import Others, Variant


def test_a_complete_table_has_no_caveats():
    assert build(*example(complete()), {}, {}).caveats == []


def test_episodes_that_an_error_stopped():
    p, points = example(complete())
    at_bounce, agent = points["row"] == BOUNCE, points["agent"]
    students = at_bounce & (agent == "erm") & (points["measure"] == "zero-shot")
    points.loc[students & (points["seed"] == 1), "stopped"] = 3
    points.loc[at_bounce & (agent == "idle"), "stopped"] = 2
    (caveat,) = build(p, points, {}, {}).caveats
    assert caveat.startswith(f"Episodes stopped by an error: {BOUNCE}: ")
    assert "AIRL-ERM zero-shot in bounce=0.9 3 of 60" in caveat
    assert "idle in bounce=0.9 2 of 20" in caveat


def test_a_student_that_did_not_imitate():
    found = build(*example(complete(student=199.0)), {}, {}).caveats
    (marked,) = (c for c in found if c.startswith(f"Not imitated: {BOUNCE}, AIRL-ERM"))
    assert "over a fifth less than the expert (79.6% of its return)" in marked


@pytest.mark.parametrize(("expert", "weak"), [(99.0, True), (100.0, True), (101.0, False)])
@pytest.mark.parametrize("agent", ["random", "idle"])
def test_an_expert_no_better_than_an_agent_that_learns_nothing(agent, expert, weak):
    returns = complete() | {(BOUNCE, agent, "ood"): [100.0], (BOUNCE, "expert", "ood"): [expert]}
    found = build(*example(returns), {}, {}).caveats
    named = [c for c in found if c.startswith("Weak expert") and "no more than" in c]
    assert len(named) == weak
    assert all(f"{BOUNCE}: in bounce=0.9" in c and f"the {agent} agent" in c for c in named)
    # A table of the training settings says nothing about the held-out one.
    p, points = example(returns)
    seen = build(replace(p, measures=("id",)), points, {}, {}).caveats
    assert not any(c.startswith("Weak expert") for c in seen)


@pytest.mark.parametrize(
    ("agent", "measure", "earned", "better"),
    [
        ("reused", "ood", [90.0, 251.0], "the best training expert there (251.0)"),
        ("irm", "transfer", [249.0, 252.0, 252.0], "AIRL-IRM's transfer policies (251.0)"),
        ("irm", "transfer", [200.0, 210.0, 339.0], None),
        ("reused", "id", [400.0, 400.0], None),
    ],
)
def test_an_expert_below_another_policy_is_named(agent, measure, earned, better):
    """The expert earns 250. Policies of the training settings say nothing about the held-out one."""
    found = build(*example(complete() | {(BOUNCE, agent, measure): earned}), {}, {}).caveats
    named = [c for c in found if c.startswith(f"Expert not the best: {BOUNCE}: in bounce=0.9")]
    assert [better in c for c in named] == [True] * (better is not None)


def test_every_method_whose_policies_beat_an_expert_is_named():
    earned = {(BOUNCE, "erm", "transfer"): [260.0] * 3, (BOUNCE, "irm", "transfer"): [255.0] * 3}
    found = build(*example(complete() | earned), {}, {}).caveats
    (named,) = (c for c in found if c.startswith("Expert not the best"))
    assert "AIRL-ERM's transfer policies (260.0) and AIRL-IRM's transfer policies (255.0)" in named


def test_an_expert_below_a_variants_policies_is_named():
    returns = {(BOUNCE, "expert", "ood"): [250.0], (BOUNCE, "no ceiling", "transfer"): [999.0] * 3}
    variants = (Variant("full"), Variant("no ceiling", ("transfer.ceiling=none",)))
    names = tuple(v.name for v in variants)
    p, points = example(returns, variants=variants, methods=names, learned_by="erm")
    (named,) = (c for c in build(p, points, {}, {}).caveats if "it earns 250.0, less than" in c)
    assert "no ceiling's transfer policies (999.0)" in named


@pytest.mark.parametrize(("bar", "low"), [(None, False), (250.0, False), (251.0, True)])
def test_an_expert_below_its_bar_is_named(bar, low):
    p, points = example(complete())
    expert = p.rows[0].config["expert"] | {"bar": bar}
    rows = tuple(replace(row, config=row.config | {"expert": expert}) for row in p.rows)
    found = build(replace(p, rows=rows), points, {}, {}).caveats
    assert any(c.startswith(f"Expert below its bar of 251: {BOUNCE}: ") for c in found) == low


def test_a_saturated_discriminator():
    learning = {
        (BOUNCE, "irm", 0): metrics(0.94, 0.001, 8.0),
        (BOUNCE, "irm", 1): metrics(0.98, 0.004, 0.5),
        (BOUNCE, "erm", 0): metrics(0.99, 0.0, 0.0),
        (POWER, "irm", 0): metrics(0.60, 0.5, 4.0),
    }
    (caveat,) = build(*example(complete()), {}, learning).caveats
    assert caveat.startswith(f"Saturated: {BOUNCE}, AIRL-IRM: ")
    assert "96.0% of the round's samples" in caveat
    assert "2.5% of the optimised cross-entropy" in caveat


def test_a_saturated_discriminator_without_cross_entropy():
    certain = metrics(1.0, -0.0001, 4.0).assign(optimised_cross_entropy=0.0)
    (caveat,) = build(*example(complete()), {}, {(BOUNCE, "irm", 0): certain}).caveats
    assert "penalty is - of the optimised cross-entropy" in caveat


def test_a_page_with_shares_and_verdicts_says_that_they_are_measured_differently():
    def told(report):
        return [c for c in report.caveats if c.startswith("Two criteria")]

    pairs = {(BOUNCE, "erm"): [(9, 10), (9, 10), (9, 10)]}
    (line,) = told(scored(pairs))
    assert "whole return" in line and "above the random agent" in line
    assert not told(build(*example(complete()), {}, {}))  # No verdicts.
    p, points = example({k: v for k, v in complete().items() if "id" not in k})
    assert not told(build(p, points, {}, {}))


def test_a_wrong_reward_and_a_failed_optimisation_are_told_apart():
    pairs = {
        (BOUNCE, "erm"): [(4, 1), (5, 1), (9, 10)],
        (BOUNCE, "irm"): [(1, 2), (1, 3), (1, 2)],
    }
    erm, irm = (c for c in scored(pairs).caveats if c.startswith("Short of the expert"))
    assert erm.startswith(f"Short of the expert: {BOUNCE}, AIRL-ERM: 3 of 3 retrained policies. ")
    assert "Wrong reward: it scores 2 of them at least as high as the expert." in erm
    assert "Optimisation fell short: the reward scores the expert above 1 of them." in erm
    assert irm.startswith(f"Short of the expert: {BOUNCE}, AIRL-IRM: 3 of 3 retrained policies. ")
    assert "Wrong reward" not in irm
    assert "the reward scores the expert above 3 of them" in irm


def test_missing_evaluations_and_tests():
    values = complete()
    values[BOUNCE, "irm", "transfer"] = [5.0, None, None]
    values[POWER, "irm", "transfer"] = [None] * 3
    found = build(*example(values), {}, {}).caveats
    (bounce,) = (c for c in found if c.startswith(f"Missing: {BOUNCE}: 24 of 26"))
    assert "no result of train-airl: AIRL-IRM 1, 2." in bounce
    assert any(c.startswith(f"No p-value: {BOUNCE}: 1 of 3") for c in found)


def test_runs_that_are_bitwise_equal():
    same = {("irm", s): np.array([1.0, 2.0 + (s == 2)]) for s in range(3)}
    (caveat,) = build(*example(complete()), {(BOUNCE, "transfer"): same}, {}).caveats
    assert caveat.startswith(f"Identical: {BOUNCE}, transfer: AIRL-IRM seed 0, AIRL-IRM seed 1 ")
    assert "seed 2" not in caveat
    methods = {("irm", 0): same["irm", 0], ("erm", 0): same["irm", 0]}
    (caveat,) = build(*example(complete()), {(BOUNCE, "id"): methods}, {}).caveats
    assert "AIRL-IRM seed 0, AIRL-ERM seed 0 have bitwise equal returns" in caveat


def with_demonstrations(sets):
    """The parameters of :func:`complete`; a row's seed k learns from ``sets[row][k]``."""
    p, points = example(complete())
    runs = dict(p.runs)
    for c in p.cells:
        if c.row in sets and c.seed is not None:
            demos = sets[c.row][c.seed]
            runs[c.run] = run_of(1, inputs=(demos,))
            runs[demos] = run_of(2, "collect-experts")
    return replace(p, runs=runs), points


def test_seeds_that_share_demonstrations_do_not_vary_them():
    """Of the two rows, one has a set of demonstrations for each seed."""
    sets = {BOUNCE: ["shared"] * 3, POWER: ["a", "b", "c"]}
    (caveat,) = build(*with_demonstrations(sets), {}, {}).caveats
    assert caveat.startswith(f"Shared demonstrations: {BOUNCE}: all seeds and methods")
    assert "one expert per setting" in caveat
    both = build(*with_demonstrations(dict.fromkeys((BOUNCE, POWER), ["shared"] * 3)), {}, {})
    (caveat,) = both.caveats
    assert caveat.startswith(f"Shared demonstrations: {BOUNCE}, {POWER}: ")


def test_another_commit_far_behind_a_cell_marks_it():
    p, points = example(complete())
    (target,) = (
        c for c in p.cells if (c.row, c.agent, c.measure, c.seed) == (BOUNCE, "irm", "transfer", 2)
    )
    runs = {
        **p.runs,
        target.run: run_of(2, inputs=("parent",)),
        "parent": run_of(1, inputs=("expert",)),
        "expert": run_of(0, commit="0ld"),
    }
    report = build(replace(p, runs=runs), points, {}, {})
    assert cell(report, BOUNCE, "irm", "transfer")["mixed"]
    assert not cell(report, BOUNCE, "erm", "transfer")["mixed"]
    assert table(report, "Transfer").rows[0][3].endswith("‡")
    (caveat,) = report.caveats
    assert caveat.startswith(f"Mixed: {BOUNCE}") and "commit 0ld" in caveat


@pytest.mark.parametrize(
    ("other", "shown"),
    [({"dirty": "abc"}, "with changes abc"), ({"libraries": "newer"}, "libraries newer: 1 run")],
)
def test_changes_and_other_libraries_count_as_mixed(other, shown):
    p, points = example(complete())
    runs = {**p.runs, p.cells[0].run: run_of(0, **other)}
    (caveat,) = build(replace(p, runs=runs), points, {}, {}).caveats
    assert caveat.startswith("Mixed: ") and shown in caveat


def test_runs_with_other_parameters_are_counted_and_named():
    others = Others(stage="train-airl", about="x irm", why="seed 1 instead of 0", ids=("aa", "bb"))
    (caveat,) = build(*example(complete(), others=(others,)), {}, {}).caveats
    assert caveat == "Left out: 2 runs of train-airl, x irm (aa, bb): seed 1 instead of 0."
