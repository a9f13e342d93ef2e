"""How well a reward ranks a bank of policies, and why a retrained policy falls short."""

import math
import tracemalloc

import numpy as np
import pytest
from scipy import stats

from irlcli.data.descriptions import Measured, RewardOrigin
from irlcli.report import reward_quality
from irlcli.report.assessment import assess
from irlcli.report.reward_quality import (
    Member,
    agreement,
    judge,
    lower_half,
    measured,
    pearson,
    return_distance,
    spearman,
    split_regret,
)

EVERYWHERE = np.ones(4, dtype=bool)


def member(policy, true, learned, kind="clone", setting="e", steps=100):
    """A policy with equal episodes but for +-1 in the true return."""
    wiggle = np.array([-1.0, 1.0, -1.0, 1.0])
    learned = np.broadcast_to(np.asarray(learned, float), 4).copy()
    return Member(policy, kind, setting, true + wiggle, learned, np.full(4, steps))


def bank(true, learned):
    return [member(f"policy {i}", t, x) for i, (t, x) in enumerate(zip(true, learned, strict=True))]


def test_ranks_that_agree_in_all_but_one_pair():
    """Ranks 1 2 3 4 and 1 2 4 3: rho = 1 - 6 * 2 / (4 * 15) = 0.8."""
    true, learned = np.array([1.0, 5.0, 6.0, 100.0]), np.array([-3.0, 0.0, 9.0, 8.0])
    assert spearman(true, learned, EVERYWHERE) == pytest.approx(0.8)


def test_ties_share_their_mean_rank():
    """Ranks 1.5 1.5 3 4 and 1 2 3 4: r = 4.5 / sqrt(4.5 * 5)."""
    true, learned = np.array([2.0, 2.0, 3.0, 4.0]), np.array([1.0, 2.0, 3.0, 4.0])
    assert spearman(true, learned, EVERYWHERE) == pytest.approx(4.5 / math.sqrt(22.5))


def test_absent_policies_do_not_count():
    true, learned = np.array([1.0, 2.0, 3.0, -50.0]), np.array([1.0, 2.0, 3.0, 1e6])
    here = np.array([True, True, True, False])
    assert pearson(true, learned, here) == pytest.approx(1.0)
    assert spearman(true, learned, here) == pytest.approx(1.0)


def test_intervals_resample_episodes_and_keep_their_two_returns_together():
    """Two kinds of policies, three of each: the correlation is 1 or -1 in each resample."""
    noise = np.array([-9.0, 9.0, -8.0, 8.0])

    def low(true, learned):
        members = [
            Member(f"{i} {copy}", "clone", "e", i + t, i + x, np.ones(4))
            for i, (t, x) in enumerate(zip(true, learned, strict=True))
            for copy in range(3)
        ]
        return agreement(members).pearson.low

    assert low((0 * noise, 0 * noise), (noise, -noise)) == pytest.approx(-1.0)
    assert low((noise, -noise), (noise, -noise)) == pytest.approx(1.0)
    # What the start state adds to every policy's return does not change their order.
    assert low((0 * noise, 0 * noise), (noise, noise)) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_both_correlations_equal_scipys(seed):
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(3, 12))
    learned = np.round(true + rng.normal(size=(3, 12)))
    here = rng.random((3, 12)) < 0.7
    for i in range(3):
        x, y = true[i, here[i]], learned[i, here[i]]
        assert pearson(true, learned, here)[i] == pytest.approx(stats.pearsonr(x, y)[0])
        assert spearman(true, learned, here)[i] == pytest.approx(stats.spearmanr(x, y)[0])


def test_intervals_do_not_depend_on_how_many_episodes_are_resampled_at_once(monkeypatch):
    rng = np.random.default_rng(0)
    members = [
        Member(f"p{i}", "clone", "e", i + rng.normal(size=7), i + rng.normal(size=7), np.ones(7))
        for i in range(5)
    ]
    found = []
    for size in (1, 5 * 7 * 3, 10**9):
        monkeypatch.setattr(reward_quality, "RESAMPLED_AT_ONCE", size)
        found.append(agreement(members))
    assert found[0] == found[1] == found[2]


def test_a_bank_of_many_episodes_needs_little_memory():
    returns = np.random.default_rng(0).normal(size=(12, 3, 1000))
    members = [
        Member(f"p{i}", "clone", f"e{s}", returns[i, s], returns[i, s], np.ones(1000))
        for i in range(12)
        for s in range(3)
    ]
    tracemalloc.start()
    agreement(members)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100 << 20


def test_without_variation_no_correlation_is_defined():
    """Also where a mean is not representable, so that deviations from it are not zero."""
    constant = agreement(bank([1.0, 2.0, 3.0], [0.1, 0.1, 0.1]))
    assert constant.spearman is None and constant.pearson is None
    assert agreement(bank([0.1, 0.1, 0.1], [1.0, 2.0, 3.0])).spearman is None
    assert agreement(bank([1.0], [1.0])).pearson is None
    assert return_distance(bank([1.0, 2.0], [0.1, 0.1])) is None


def test_the_lower_half_holds_the_policies_up_to_the_median():
    odd, even = np.array([5.0, 1.0, 3.0, 2.0, 4.0]), np.array([4.0, 1.0, 3.0, 2.0])
    assert odd[lower_half(odd, np.ones(5, bool))].tolist() == [1.0, 3.0, 2.0]
    assert even[lower_half(even, np.ones(4, bool))].tolist() == [1.0, 2.0]


def test_a_reward_may_be_right_about_good_policies_and_wrong_about_bad_ones():
    true = [0.0, 100.0, 200.0, 1000.0, 2000.0, 3000.0]
    learned = [30.0, 20.0, 10.0, 100.0, 200.0, 300.0]
    overall = agreement(bank(true, learned))
    lower = agreement(bank(true, learned), lower=True)
    assert overall.pearson.value > 0.9
    assert (lower.policies, lower.spearman.value) == (3, -1.0)


def test_the_interval_of_the_lower_half_is_over_the_lower_half_of_each_resample():
    """All of ten bad policies are ranked the wrong way round, all of ten good ones above them."""
    true = [*range(10), *range(1000, 1010)]
    learned = [*range(0, -10, -1), *range(100, 110)]
    assert agreement(bank(true, learned)).spearman.low > 0.0
    found = agreement(bank(true, learned), lower=True).spearman
    assert found.value == -1.0 and found.low == pytest.approx(-1.0)


def test_the_interval_contains_the_value_and_does_not_depend_on_the_run():
    rng = np.random.default_rng(0)
    true = rng.normal(scale=100.0, size=12)
    members = bank(true, true + rng.normal(scale=80.0, size=12))
    found = agreement(members)
    assert found.pearson.low < found.pearson.value < found.pearson.high < 1.0
    assert agreement(members) == found


def test_the_interval_covers_the_true_correlation():
    """Of 60 banks of 20 policies with r = 0.6, 57 on average, with a standard deviation of 1.7."""
    covered = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true = rng.normal(size=20)
        learned = 0.6 * true + 0.8 * rng.normal(size=20)
        found = agreement(
            [
                Member(f"{i}", "clone", "e", t + e, x + e, np.ones(8))
                for i, (t, x) in enumerate(zip(true, learned, strict=True))
                for e in [rng.normal(scale=0.05, size=8)]
            ]
        ).pearson
        covered += found.low <= 0.6 <= found.high
    assert 54 <= covered <= 60


@pytest.mark.parametrize("seed", range(2))
def test_the_interval_of_constant_episodes_is_scipys_bootstrap(seed):
    true, noise = np.random.default_rng(seed).normal(size=(2, 20))
    learned = 0.6 * true + 0.8 * noise
    constant = [
        Member(f"{i}", "clone", "e", np.full(3, t), np.full(3, x), np.ones(3))
        for i, (t, x) in enumerate(zip(true, learned, strict=True))
    ]
    found = agreement(constant).pearson
    low, high = stats.bootstrap(
        (true, learned),
        lambda x, y, axis: stats.pearsonr(x, y, axis=axis).statistic,
        paired=True,
        method="percentile",
        rng=0,
    ).confidence_interval
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.02)


def test_a_policy_is_resampled_with_all_its_settings():
    """Six policies, repeated in five settings, are no thirty policies."""
    true, learned = 100 * np.arange(6.0), np.array([10.0, 0.0, 30.0, 20.0, 50.0, 40.0])
    once = agreement(bank(true, learned)).pearson
    repeated = agreement(
        [
            member(f"policy {i}", t, x, setting=f"e{s}")
            for i, (t, x) in enumerate(zip(true, learned, strict=True))
            for s in range(5)
        ]
    ).pearson
    assert repeated.value == pytest.approx(once.value)
    assert repeated.low == pytest.approx(once.low, abs=0.05)


@pytest.mark.parametrize(("policies", "known"), [(3, False), (4, False), (5, True)])
def test_few_policies_have_no_interval(policies, known):
    """Of three, resamples that are not constant have two or three points: nearly all have +-1."""
    found = agreement(
        [
            member(f"policy {i}", t, t, setting=f"e{s}")
            for i, t in enumerate(range(policies))
            for s in range(3)
        ]
    )
    assert found.spearman.value == pytest.approx(1.0)
    assert (found.spearman.low is not None) is known


def test_the_return_distance_of_equal_and_of_opposite_rewards():
    members = [Member("p", "clone", "e", np.arange(4.0), 3 * np.arange(4.0) + 7, np.ones(4))]
    assert return_distance(members) == pytest.approx(0.0, abs=1e-6)
    opposite = [m._replace(learned=-m.learned) for m in members]
    assert return_distance(opposite) == pytest.approx(1.0)


def known(mean, error=1.0):
    return Measured(mean=mean, error=error)


@pytest.mark.parametrize(
    ("earned", "gap", "verdict", "clear"),
    [
        (99.0, -50.0, "matches the expert", True),
        (91.0, 50.0, "matches the expert", False),  # regret 9 of the 10 allowed, error 1
        (50.0, -50.0, "wrong reward", True),
        (50.0, 0.0, "wrong reward", False),
        (50.0, 50.0, "optimisation fell short", True),
        (50.0, 1.5, "optimisation fell short", False),
        (89.0, -50.0, "wrong reward", False),  # regret 11 of the 10 allowed
        (89.0, 50.0, "optimisation fell short", False),
    ],
)
def test_the_verdict_on_a_retrained_policy(earned, gap, verdict, clear):
    assert judge(known(100.0 - earned), 100.0, known(gap)) == (verdict, clear)


def test_the_allowed_regret_is_a_tenth_of_what_the_expert_earns_above_random():
    """Of an expert at 100 and a random agent at -900: 100."""
    assert judge(known(99.0), 1000.0, known(1.0)).verdict == "matches the expert"
    assert judge(known(101.0), 1000.0, known(1.0)).verdict != "matches the expert"


@pytest.mark.parametrize("margin", [0.0, -400.0])
def test_beside_an_expert_no_better_than_random_there_is_no_verdict(margin):
    for regret in (1.0, -1.0):
        assert judge(known(regret), margin, known(1.0)) == (None, False)


def test_episodes_from_one_start_are_compared_with_each_other():
    """Start states decide nearly all of both returns: the policy loses 20 or 22 in each of four."""
    start, loss = np.array([0.0, 300.0, 600.0, 900.0]), np.array([20.0, 22.0, 20.0, 22.0])
    expert = Member("expert", "expert", "e", start, start, np.ones(4))
    policy = Member("retrained", "retrained", "e", start - loss, start + loss, np.ones(4))
    random = Member("random", "random", "e", np.full(4, 350.0), np.zeros(4), np.ones(4))
    split = split_regret(policy, expert, random)
    error = np.std([20, 22, 20, 22], ddof=1) / 2
    assert split.true_regret == Measured(mean=21.0, error=pytest.approx(error))
    assert split.learned_gap == Measured(mean=-21.0, error=pytest.approx(error))
    # 21 of the 10 allowed, clear for pairs only: each return has a standard error of 194.
    assert (split.verdict, split.clear) == ("wrong reward", True)


@pytest.mark.parametrize(("discounted", "clear"), [(3.0, True), (-3.0, False)])
@pytest.mark.parametrize("gap", [5.0, -5.0])
def test_a_verdict_is_uncertain_if_discounting_reverses_the_gap(gap, discounted, clear):
    """Training maximises discounted returns, so it may have reached the best of them."""
    known = Measured(mean=50.0, error=1.0)
    of_gap = Measured(mean=gap, error=1.0)
    sign = 1.0 if gap > 0 else -1.0
    found = judge(known, 100.0, of_gap, Measured(mean=sign * discounted, error=1.0))
    expected = "optimisation fell short" if gap > 0 else "wrong reward"
    assert found == (expected, clear) and judge(known, 100.0, of_gap) == (expected, True)
    # A policy that matches the expert does so whatever the reward says.
    matching = judge(Measured(mean=0.0, error=1.0), 100.0, of_gap, Measured(mean=-gap, error=1.0))
    assert matching == ("matches the expert", True)


def test_a_single_episode_has_no_standard_error():
    assert measured(np.array([3.0])) == Measured(mean=3.0, error=None)
    split = split_regret(
        *(Member(k, k, "e", np.array([t]), np.array([0.0]), np.ones(1)) for k, t in TRIPLE)
    )
    assert split.true_regret == Measured(mean=90.0, error=None) and not split.clear


TRIPLE = (("retrained", 10.0), ("expert", 100.0), ("random", 0.0))


def reward(members):
    return assess("ant", RewardOrigin(method="erm", seed=0, settings=("e",)), members, {})


def test_expert_minus_idle_is_per_step():
    """The expert is scored 50 over 100 steps, the idle agent -20 over 200."""
    members = [member("idle", 0, -20.0, "idle", steps=200), member("random", 1, 0.0, "random")]
    expert = member("expert of e", 10, 50.0, "expert")
    (found,) = reward([*members, expert]).settings
    assert found.expert_minus_idle.mean == pytest.approx(0.5 + 0.1)
    (found,) = reward(members).settings
    assert found.expert_minus_idle is None and found.retrained == ()


def test_one_setting_is_not_pooled_and_two_are():
    members = bank([1.0, 2.0], [1.0, 2.0])
    assert reward(members).pooled is None
    both = reward([*members, *(m._replace(setting="f") for m in members)])
    assert [s.setting for s in both.settings] == ["e", "f"]
    assert both.pooled.overall.policies == 4
