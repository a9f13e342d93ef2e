"""Which of the policy's and the experts' samples meet in a risk."""

import numpy as np
import pytest
import torch

from irlcli.learners.grouping import group
from irlcli.learners.pools import Pool
from irlcli.learners.risks import risk_strata

# Episodes in each of two settings.
COUNTS = [1, 3]
SAMPLES = 128


def pool(*values):
    """Transitions at ``values``."""
    rows = torch.tensor(values, dtype=torch.float32).reshape(-1, 1)
    zeros = torch.zeros(len(rows))
    return Pool(rows, rows, rows, zeros, zeros, torch.arange(len(rows)))


# The setting's number, in earlier rounds less 10. An episode is its setting's number and tenths.
CURRENT = [pool(0.0, 0.0), pool(1.0)]
PAST = [pool(-10.0), pool(-9.0, -9.0)]


def expert(part):
    return pool(*(part.setting + episode / 10 for episode in part.episodes))


def strata(grouping, pairing="matched", past=PAST):
    groups = group(grouping, COUNTS, np.random.default_rng(0))
    return risk_strata(groups, SAMPLES, CURRENT, past, expert, pairing)


def at(pool):
    return set(pool.observations.flatten().tolist())


@pytest.mark.parametrize(
    ("pairing", "met"), [("matched", [{0.0}, {1.0}]), ("pooled", 2 * [{0.0, 1.0}])]
)
def test_a_risk_meets_the_policys_samples_of_its_own_setting_or_of_all(pairing, met):
    risks = strata("per-setting", pairing)
    assert [at(stratum.policy) for (stratum,) in risks] == met
    assert [{value + 10.0 for value in at(stratum.past)} for (stratum,) in risks] == met
    assert [len(at(stratum.expert)) for (stratum,) in risks] == COUNTS


@pytest.mark.parametrize("grouping", ["pooled", "balanced", "per-setting", "shuffled"])
def test_every_grouping_draws_as_many_samples(grouping):
    counts = [[stratum.count for stratum in risk] for risk in strata(grouping)]
    assert sum(map(sum, counts)) == SAMPLES
    assert len({sum(risk) for risk in counts}) == 1


def test_the_policys_samples_are_shared_out_as_the_demonstrations_are():
    """Otherwise the discriminator could learn how often a setting was demonstrated."""
    ((first, second),) = strata("pooled")
    assert (first.count, second.count) == (SAMPLES // 4, 3 * SAMPLES // 4)
    assert (at(first.policy), at(second.policy)) == ({0.0}, {1.0})


def test_shuffled_risks_share_out_all_episodes_and_keep_them_with_their_settings_policy():
    dealt = [stratum for risk in strata("shuffled") for stratum in risk]
    shown = [value for stratum in dealt for value in at(stratum.expert)]
    assert sorted(shown) == pytest.approx([0.0, 1.0, 1.1, 1.2])
    for stratum in dealt:
        assert at(stratum.policy) == {float(int(value)) for value in at(stratum.expert)}


def test_without_earlier_rounds_there_is_no_past():
    assert all(stratum.past is None for risk in strata("balanced", past=[]) for stratum in risk)
