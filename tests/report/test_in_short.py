"""The lines that say what came out."""

import pytest
from report_examples import BOUNCE, POWER, complete, example

from irlcli.report.build import build


def lines(values, **more):
    return dict(zip((BOUNCE, POWER), build(*example(values, **more), {}, {}).in_short, strict=True))


def test_a_row_has_the_returns_of_its_first_measure():
    line = lines(complete())[BOUNCE]
    assert line.startswith(
        f"{BOUNCE} = 0.9, transfer, true return: AIRL-ERM 2.0; AIRL-IRM 4.0; expert 250.0; "
        "training experts, reused 110.0; random -200.0; idle -120.0."
    )


@pytest.mark.parametrize(
    ("irm", "claim"),
    [
        ([2.0, 3.0, 7.0], "AIRL-IRM and AIRL-ERM do not differ significantly: +2.0"),
        ([41.0, 42.0, 43.0], "AIRL-IRM earns significantly more than AIRL-ERM: +40.0"),
        ([-39.0, -38.0, -37.0], "AIRL-IRM earns significantly less than AIRL-ERM: -40.0"),
    ],
)
def test_a_difference_is_claimed_where_it_is_significant(irm, claim):
    values = complete() | {(BOUNCE, "irm", "transfer"): irm}
    assert claim in lines(values)[BOUNCE]


def test_significance_is_that_after_holm():
    """Of two rows with p = 0.033 neither stays significant."""
    erm, irm = [1.0, 2.0, 3.0], [3.6, 4.6, 5.6]
    both = {(row, "irm", "transfer"): irm for row in (BOUNCE, POWER)}
    both |= {(row, "erm", "transfer"): erm for row in (BOUNCE, POWER)}
    one = both | {(POWER, "irm", "transfer"): erm}
    assert "significantly more" not in lines(complete() | both)[BOUNCE]
    assert "do not differ" in lines(complete() | one)[POWER]


def test_the_detectable_difference_follows_the_claim():
    line = lines(complete())[BOUNCE]
    assert (
        "0.321, adjusted by Holm 0.643). Without adjustment, a difference of 8.1 would be" in line
    )
    line = lines(complete() | {(POWER, "irm", "transfer"): [5.0]})[BOUNCE]
    assert "p 0.321). A difference of 8.1 would be found with a power of 80 %." in line


def test_one_seed_has_returns_and_no_test():
    values = complete() | {(BOUNCE, m, "transfer"): [5.0] for m in ("erm", "irm")}
    line = lines(values)[BOUNCE]
    assert "AIRL-ERM 5.0 (1/3); AIRL-IRM 5.0 (1/3)" in line
    assert "Do not compare AIRL-IRM with AIRL-ERM" in line and "one seed has no variance" in line


def test_one_method_is_not_compared():
    values = {key: of for key, of in complete().items() if key[1] != "irm"}
    assert lines(values, methods=("erm",))[BOUNCE].endswith("random -200.0; idle -120.0.")


def test_students_that_did_not_imitate_are_named_and_not_compared():
    values = complete(student=100.0)
    assert lines(values)[BOUNCE].endswith(
        " AIRL-ERM did not imitate in distribution: do not interpret the gap."
    )
    values |= {(BOUNCE, "irm", "id"): [90.0, 91.0, 92.0]}
    assert "AIRL-IRM and AIRL-ERM did not imitate" in lines(values)[BOUNCE]
    assert "significantly" not in lines(values)[BOUNCE]


def test_a_row_without_a_reward_has_no_line():
    values = {
        key: of for key, of in complete().items() if key[0] == BOUNCE or key[2] in ("ood", "id")
    }
    (line,) = build(*example(values), {}, {}).in_short
    assert line.startswith(BOUNCE)
