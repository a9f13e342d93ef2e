"""The statistics of a comparison against scipy, brute force, worked examples and the paper."""

from itertools import chain, combinations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from irlcli.report import paper
from irlcli.report.statistics import (
    bootstrap_interval,
    compare,
    detectable_difference,
    holm,
    identical_runs,
    interquartile_mean,
    paired_p,
    summarise,
)

returns = st.lists(st.integers(-50, 50).map(float), min_size=1, max_size=9)
p_values = st.lists(st.none() | st.floats(0, 1), min_size=1, max_size=6)


def with_moments(mean, deviation, n=paper.SEEDS):
    """A sample of ``n`` with exactly this mean and standard deviation (n - 1)."""
    z = np.arange(n) - (n - 1) / 2
    return mean + deviation * z / z.std(ddof=1)


def test_the_papers_p_values_are_students_and_by_welch_two_exceed_5_percent():
    found = {
        row: compare(with_moments(*printed.irm), with_moments(*printed.erm))
        for row, printed in paper.TABLE1.items()
    }
    student = [round(c.student, 4) for c in found.values()]
    assert student == [0.0486, 0.0456, 0.0041, 0.0052]
    # As printed, except for two swapped digits in the first.
    assert [p.p_value for p in paper.TABLE1.values()] == [0.0458, *student[1:]]
    lost = [row for row, c in found.items() if c.welch > 0.05]
    assert lost == [("lunar-lander", "bounce"), ("lunar-lander", "engine-power")]
    # After Holm over the four rows, no LunarLander row is significant by either test.
    assert [p <= 0.05 for p in holm(student)] == [False, False, True, True]
    assert found["ant", "friction"].difference == pytest.approx(783.9 - 542.7)


@pytest.mark.filterwarnings("error")
def test_one_constant_sample_is_compared_without_warnings():
    found = compare([1.0, 1.0], [1.0, 2.0])
    # Both tests: t = -0.5 / 0.5, with one (Welch) and two degrees of freedom.
    assert found.welch == pytest.approx(0.5)
    assert found.student == pytest.approx(1 - 1 / 3**0.5)


@given(returns.filter(lambda v: len(set(v)) > 1), returns.filter(lambda v: len(v) > 1))
def test_tests_are_scipys(x, y):
    found = compare(x, y)
    mean_x, mean_y, n, m = np.mean(x), np.mean(y), len(x), len(y)
    if len(y) > 1:
        variances = np.var(x, ddof=1) / n + np.var(y, ddof=1) / m
        freedom = variances**2 / (
            (np.var(x, ddof=1) / n) ** 2 / (n - 1) + (np.var(y, ddof=1) / m) ** 2 / (m - 1)
        )
        t = (mean_x - mean_y) / variances**0.5
        assert found.welch == pytest.approx(2 * stats.t.sf(abs(t), freedom), abs=1e-9)
    assert found.student == pytest.approx(stats.ttest_ind(x, y).pvalue, abs=1e-12)


@given(st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=2, max_size=9))
def test_the_paired_test_is_a_t_test_of_the_differences(pairs):
    x, y = np.array(pairs, float).T
    d, n = x - y, len(pairs)
    if np.ptp(d) == 0:
        assert paired_p(x, y) is None
        return
    t = d.mean() / (d.std(ddof=1) / n**0.5)
    assert paired_p(x, y) == pytest.approx(2 * stats.t.sf(abs(t), n - 1), abs=1e-12)
    assert paired_p(x, y) == pytest.approx(stats.ttest_rel(x, y).pvalue, abs=1e-12)


def test_pairs_take_out_what_seeds_share():
    """Each seed shifts both methods alike: only the paired test sees the constant gain."""
    x, y = [1.1, 101.2, 201.0, 301.1], [0.0, 100.0, 200.0, 300.0]
    assert paired_p(x, y) < 0.001 < 0.9 < compare(x, y).welch
    assert paired_p([1.0], [0.0]) is None
    # 0.1 each time, but for rounding.
    assert paired_p([10.1, 20.2, 30.3], [10.0, 20.1, 30.2]) is None


@pytest.mark.parametrize(("n", "effect"), [(26, 0.8), (64, 0.5), (394, 0.2)])
def test_the_detectable_difference_is_cohens(n, effect):
    """Cohen (1988), table 2.4.1: the fewest samples of each group that find an effect."""

    def detectable(size):
        return detectable_difference(*[with_moments(0.0, 1.0, size)] * 2)

    assert detectable(n) <= effect < detectable(n - 1)


@pytest.mark.parametrize(
    ("deviations", "sizes"),
    [
        ((3.0, 3.0), (9, 9)),
        ((9.0, 0.5), (5, 5)),
        ((1.0, 2.0), (2, 2)),
        ((1.0, 1.0), (3, 3)),
        ((1.0, 3.0), (5, 2)),
        ((1.0, 0.0), (2, 4)),
    ],
)
@pytest.mark.filterwarnings("ignore:Precision loss occurred")
def test_the_detectable_difference_is_found_four_times_in_five(deviations, sizes):
    rng = np.random.default_rng(0)
    x, y = (with_moments(0.0, sd, n) for sd, n in zip(deviations, sizes, strict=True))
    shift = detectable_difference(x, y)
    drawn = [
        rng.normal(mean, sd, (20_000, n))
        for mean, sd, n in zip((shift, 0.0), deviations, sizes, strict=True)
    ]
    found = stats.ttest_ind(*drawn, axis=1, equal_var=False).pvalue < 0.05
    assert found.mean() == pytest.approx(0.8, abs=0.02)


@given(returns, returns)
def test_the_interval_excludes_zero_where_welch_is_significant(x, y):
    found = compare(x, y)
    assume(found.interval is not None and abs(found.welch - 0.05) > 1e-6)
    low, high = found.interval
    assert low <= found.difference <= high
    assert (low > 0 or high < 0) == (found.welch < 0.05)


def test_a_missing_p_value_has_a_reason():
    one = compare([3.0], [1.0, 2.0])
    assert (one.welch, one.student) == (None, None)
    assert "one seed" in one.why
    assert (one.difference, one.improvement) == (1.5, None)
    constant = compare([2.0, 2.0], [1.0, 1.0])
    assert constant.welch is None and "variance is zero" in constant.why
    assert compare([0.1] * 3, [0.1] * 3).improvement == 0.5
    assert compare([], [1.0]).difference is None
    assert compare([], [1.0]).why
    half = compare([2.0, 2.0, 2.0], [1.0, 2.0, 0.0])
    assert half.welch is not None and not half.why


@given(returns, returns)
def test_improvement_counts_the_pairs_that_are_better(x, y):
    assume(min(len(x), len(y)) > 1)
    better = [(a > b) + (a == b) / 2 for a in x for b in y]
    assert compare(x, y).improvement == pytest.approx(np.mean(better))


@given(p_values)
def test_holm_is_the_closure_of_bonferroni(values):
    """A hypothesis is rejected if Bonferroni rejects every intersection that holds it."""
    known = [i for i, p in enumerate(values) if p is not None]
    for i, adjusted in enumerate(holm(values)):
        if values[i] is None:
            assert adjusted is None
            continue
        others = [j for j in known if j != i]
        subsets = chain.from_iterable(combinations(others, r) for r in range(len(others) + 1))
        worst = max((len(s) + 1) * min(values[j] for j in (i, *s)) for s in subsets)
        assert adjusted == pytest.approx(min(1.0, worst))


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


def test_interquartile_mean_by_hand():
    assert interquartile_mean([5.0]) == 5.0
    assert interquartile_mean([1.0, 2.0]) == 1.5
    assert interquartile_mean([4.0, 1.0, 1000.0, 2.0]) == 3.0
    # Of five: 0.75, 1 and 0.75 of the middle three.
    assert interquartile_mean([-99.0, 1.0, 2.0, 6.0, 99.0]) == pytest.approx(
        (0.75 * 1 + 2 + 0.75 * 6) / 2.5
    )


@given(returns)
def test_interquartile_mean_weighs_half(values):
    x, n = np.sort(values), len(values)
    edges = np.arange(n + 1) / n
    weights = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0, None)
    assert weights.sum() == pytest.approx(0.5)
    assert interquartile_mean(values) == pytest.approx(np.average(x, weights=weights))


def test_interval_is_that_of_a_normal_mean():
    sample = np.random.default_rng(1).normal(3.0, 2.0, 400)
    low, high = bootstrap_interval(sample)
    error = 1.96 * sample.std() / 20
    assert low == pytest.approx(sample.mean() - error, abs=0.02)
    assert high == pytest.approx(sample.mean() + error, abs=0.02)
    assert bootstrap_interval(np.full(5, 0.1)) == (0.1, 0.1)


def test_interval_is_seeded_and_that_of_all_resamples():
    sample = np.array([0.0, 1.0, 5.0])
    means = [np.mean([a, b, c]) for a in sample for b in sample for c in sample]
    low, high = bootstrap_interval(sample)
    assert (low, high) == bootstrap_interval(sample)
    # The least and the greatest of the 27 have probability 1/27 = 3.7 % each.
    assert (low, high) == pytest.approx((min(means), max(means)))


def test_few_seeds_are_summarised():
    assert summarise([]).mean is None
    one = summarise([4.0])
    assert (one.n, one.mean, one.deviation, one.interval, one.iqm) == (1, 4.0, None, None, 4.0)
    two = summarise([1.0, 3.0])
    assert two.deviation == pytest.approx(2**0.5)
    assert two.interval[0] <= two.mean <= two.interval[1]
    # Rounding in the mean must not make a spread of a constant.
    assert summarise([0.1, 0.1, 0.1]).deviation == 0.0


def test_identical_runs_are_bitwise_equal():
    episodes = {0: [1.0, 2.0], 1: [1.0, 2.5], 2: [1.0, 2.0], 3: [1.0, 2.5 + 1e-15]}
    assert identical_runs(episodes) == [(0, 2)]
    assert identical_runs({0: [1.0]}) == []


def counted(x, y):
    """The share of all splits of the values whose ranks lie as far apart as those of x and y."""
    values = np.array([*x, *y])
    ranks = stats.rankdata(values)
    sums = np.array(
        [ranks[list(chosen)].sum() for chosen in combinations(range(len(values)), len(x))]
    )
    distance = abs(sums - len(x) * ranks.mean())
    return (distance >= distance[0] - 1e-9).mean()


@pytest.mark.parametrize(
    ("x", "y"),
    [
        ([5.0, 6.0, 7.0, 8.0, 900.0], [0.0, 1.0, 2.0, 3.0, -900.0]),
        ([1.0, 4.0, 2.5], [3.0, 0.0]),
        ([1.0, 1.0, 2.0, 3.0], [1.0, 2.0, 2.0, 0.0]),
        ([1.0, 1.0], [1.0, 1.0]),
    ],
)
def test_the_rank_test_counts_splits(x, y):
    assert compare(x, y).rank == pytest.approx(counted(x, y))


def test_an_extreme_value_does_not_hide_an_order():
    """Five against five without overlap: two splits of 252."""
    found = compare([1.0, 2.0, 3.0, 4.0, 5.0], [-1.0, -2.0, -3.0, -4.0, -1e6])
    assert found.rank == pytest.approx(2 / 252) and found.welch > 0.3


def test_one_seed_has_no_rank_test():
    assert compare([1.0], [2.0, 3.0]).rank is None
