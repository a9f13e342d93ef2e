"""Which rounds' rewards are averaged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from irlcli.learners.averaging import averaged_after


@given(st.integers(1, 300), st.data())
def test_with_equal_weights_the_rounds_are_equally_spaced(rounds, data):
    members = data.draw(st.integers(1, rounds))
    expected = [rounds * k // members - 1 for k in range(1, members + 1)]
    assert averaged_after([1e-3] * rounds, members) == expected


@pytest.mark.parametrize("members", [100, 300])
def test_the_plain_mean_of_many_members_is_the_weighted_mean_of_all_rounds(members):
    rounds = np.arange(90)
    weights = 1.0 - rounds / 90
    found = averaged_after(weights, members)
    assert len(found) == members and found == sorted(found) and found[-1] == 89
    # Each member is the last round of what it stands for.
    assert np.mean(found) == pytest.approx(np.average(rounds, weights=weights), abs=1.0)


def test_with_a_falling_rate_half_of_the_members_are_early():
    found = averaged_after(1.0 - np.arange(900) / 900, 30)
    assert found[14] + 1 == pytest.approx(900 * (1 - 0.5**0.5), abs=1.0)


def test_a_round_with_most_of_the_weight_joins_several_times():
    assert averaged_after([1.0, 7.0, 1.0, 1.0], 5) == [0, 0, 0, 1, 3]


def test_only_the_last_of_the_rounds_without_weight_joins():
    assert averaged_after([1.0, 0.0, 0.0], 2) == [0, 2]
